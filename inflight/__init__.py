"""In-flight calibration of magnetometers: pure physics over numpy and xarray.

What a user needs first: `Mission` (what flew), `Model` and `Effect` (what disturbs the readings), `align`
(measurements on one time base), `NormalEquations` (what a fit reads). This package opens no file: storage
lives in :mod:`inflight.catalog`, steps in :mod:`inflight.tasks`, Prefect flows in :mod:`inflight.flows`.
`catalog`, `tasks`, `flows`, `serve`, `explorer` and `missions`
in here are links to the folders of these names beside this one. Open `inflight.effects.base` and
`inflight.model.model` first. Names are imported when they are first used,
here and in every folder: the command line must not wait for numpy to print its help.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
