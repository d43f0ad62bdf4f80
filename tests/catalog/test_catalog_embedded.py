from catalog_contract import CatalogContract


class TestEmbeddedCatalog(CatalogContract):
    """The catalog on SQLite, through the `catalog` fixture of this folder."""
