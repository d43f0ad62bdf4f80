"""A model: an ordered set of effects with time dependence and values. It says *what* disturbs the readings.

In go a model YAML and a mission (`Model.parse`), or effects; out come corrected samples (`Model.correct`),
disturbed ones, and the rows of a residual (`rows_of`). Calibration tables say how much and when; `Model.bind`
takes their values. Open `model` first, then `apply`; `rows` holds what a comparison compares, `substitution`
what replaces missing channels.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
