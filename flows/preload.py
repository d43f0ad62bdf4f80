"""What the processes of a run share, imported once by the process that they are forks of (`cluster`).

What most of their tasks need, and what that imports at its first use: xarray asks for Dask's arrays, stores
for Zarr, models for units. Importing this module is all there is to do with it.
"""

import gc
from importlib import import_module
from typing import Final

from inflight.threads import OBJECTS_TO_COLLECT

_IMPORTED: Final = (
    "dask.array",
    "distributed",
    "distributed.nanny",
    "inflight.tasks.pipelines.base.job",
    "inflight.tasks.pipelines.scalar.day",
    "inflight.tasks.pipelines.scalar.product",
    "inflight.samples.interpolation",
    "inflight.calibration.residual_loops",
    "pint",
    "zarr",
)

# Python would look through all that is imported for what could go, again and again: a fifth of the time.
gc.disable()
try:
    for name in _IMPORTED:
        import_module(name)
finally:
    # What is imported stays: nor does it touch, and so copy, memory that the processes share.
    gc.freeze()
    gc.enable()
    gc.set_threshold(OBJECTS_TO_COLLECT)
