from catalog_contract import CatalogContract

BOTH_DATABASES = True


class TestCatalog(CatalogContract):
    """The catalog on both databases, through the `catalog` fixture of this folder."""
