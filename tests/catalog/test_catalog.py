from catalog_contract import CatalogContract


class TestCatalog(CatalogContract):
    """The catalog on both databases, through the `catalog` fixture of this folder."""
