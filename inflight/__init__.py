"""In-flight calibration of magnetometers: pure physics over numpy and xarray.

The package itself opens no file. Storage lives in :mod:`inflight.catalog`, pipeline steps in
:mod:`inflight.tasks`, Prefect flows in :mod:`inflight.flows`. Names are imported when they are first asked
for, here and in every folder: the command line must not wait for numpy to print its help.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
