"""The scorecard: each published figure with what the software obtains for it, and the verdict.

In: ids or a section (`select_figures`). Out: a `Report` of every `Figure` (`run_scorecard`), which
``inflight figures`` prints. A figure is obtained from theory, or from values that are put into simulated days
(`SimulatedDays`) and given back; what needs a mission's own data says so. Open figure.py first, then any
module with `FIGURES`; registry.py lists them. zero_level_studies.py holds published studies that need a long
record.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
