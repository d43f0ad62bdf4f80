"""The catalog of a workspace: which days, tables and models exist, what made them, and where they are valid.

In go datasets of a day (`Run.stage`, `write_segment`), calibration tables, models and delivered files; out
come lazy Datasets (`Catalog.open`), days with their state, lineage and releases. A run publishes all its days
in one transaction, or none. Open `catalog` first: it names every operation; `records` defines the words.

What is stored: `schema`, `database` and `backends` (SQLite, PostgreSQL), where `location` says and `moving`
puts it; `segments`, `layout`, `encoding` and `manifest` write Zarr stores, `stores` and `opening` read them.
What is asked: `days`, `validity` (tables), `provenance` (models, contexts, files, lineage), `lineage` (as a
graph in words), `contexts` (by name). What is done: `runs`, `upkeep` (inventory, verify, repair), `garbage`,
`release`. `readers` opens delivered files; `workspace` is the folder of one mission.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
