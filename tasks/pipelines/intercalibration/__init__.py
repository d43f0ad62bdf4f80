"""Two vector sensors that comparisons of their own calibrate, against each other.

In go the products of both, out come tables (`tables.py`): how the sensors stand to each other and which of
the three disagrees, or how the boom between two spinning sensors bends. There are no products. `pipeline.py`
is the file to open first; `pair.py` finds the two comparisons, `report.py` shows the tables.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
