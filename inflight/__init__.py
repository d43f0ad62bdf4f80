"""In-flight calibration of magnetometers: pure physics over numpy and xarray.

The package itself opens no file. Storage lives in :mod:`inflight.catalog`, pipeline steps in
:mod:`inflight.tasks`, Prefect flows in :mod:`inflight.flows`.
"""

__version__ = "0.1.0"
