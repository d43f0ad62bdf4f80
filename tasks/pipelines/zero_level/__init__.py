"""A vector sensor whose zero level nature tells, without an absolute instrument and without spin.

In go averages of the readings, or of another comparison's product; out come a table of three offsets for each
window with the test of every assumption, and the field without them. `pipeline.py` is the file to open first;
`day.py` reads and averages a day, `tables.py` estimates a window, `report.py` says what was found.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
