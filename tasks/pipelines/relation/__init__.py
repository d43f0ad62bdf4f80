"""Two vector sensors that comparisons of their own calibrate, against each other.

In go the products of both, out come tables: how the sensors stand to each other and which of the three
disagrees (`relation.py`), or how the boom between two spinning sensors bends (`bending.py`). No field comes
of it. `pipeline.py` is the file to open first, `report.py` shows the tables.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
