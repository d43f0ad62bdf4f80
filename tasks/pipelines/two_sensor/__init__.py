"""Two sensors on one boom and no other reference: a correction by the spacecraft's states.

In go the samples of both sensors and the housekeeping; out come a table of states for each window, with its
units and whether its correction helps, and the field without that of the spacecraft. `pipeline.py` is the
file to open first; `day.py` checks readings, fits a window and corrects a day, `windows.py` continues tables
in the order of time, `tables.py` has the numbers, constants and channels of states, `compare.py` measures the
remaining steps.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
