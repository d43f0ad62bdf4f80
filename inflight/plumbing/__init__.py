"""Plumbing before physics: faults of units, clocks, axes and channels, and the YAML lines that mend them.

In go channels of some days at their own stamps (`Survey` of `Record`) and, where there is one, the present
model; out come `Finding`s. Open ``check.py`` first: `find_faults` runs all tests. ``records.py`` holds the
statistics, ``fields.py`` units and axes of two fields, ``clocks.py`` their stamps, ``orbit.py`` what the main
field says, ``channels.py`` what a channel tells of itself, ``coefficients.py`` what the model says of it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
