"""Steps: each reads from the catalog, calls the physics and publishes its result.

In go a catalog and a mission; out come datasets, tables, products, reports and models in the catalog. Three
folders: `archive` (delivered files to level 1, and samples of a day), `pipelines` (samples to calibration
tables and level-2 products), `analysis` (compare, diagnose, revise a model). Open `pipelines` first; beside
them stand versions of models (`models.py`), releases, and the report of a run (`report.py`).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
