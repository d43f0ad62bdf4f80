"""The catalog of a workspace: which days, tables and models exist, what made them, and where they are valid.

In go datasets of a day (`Run.stage`, `write_segment`), calibration tables, models and delivered files; out
come lazy Datasets (`Catalog.open`), days with their state, lineage and releases. A run publishes all its days
in one transaction, or none. Open `catalog` first; `records` defines the words; `readers` opens delivered
files.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
