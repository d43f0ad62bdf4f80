"""Two sensors on one boom and nothing else to hold them against: the spacecraft's states are told apart.

In go the samples of both sensors and the housekeeping; out come a table of states a window, each with its
units and whether its correction helps, and the field without the spacecraft's. `pipeline.py` is the file to
open first; `day.py` looks through readings, learns from a window and corrects a day, `windows.py` joins
windows in the order of time, `tables.py` has what tables say of units, constants and channels, `compare.py`
measures what is left.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
