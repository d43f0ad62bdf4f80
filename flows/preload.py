"""What the processes of a run share, imported once by the process that they are forks of (`cluster`).

What most of their tasks need, and what that imports at its first use: xarray asks for Dask's arrays, stores
for Zarr, models for units. Importing this module is all there is to do with it.
"""

import gc
from contextlib import suppress
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
    "scipy.spatial.transform",
    "zarr",
)


def _use_once() -> None:
    """Do what takes a tenth of a second or more at its first use, and then holds for every fork as well.

    Numba reads what it knows of Python and numpy when it first calls a loop; which libraries multiply
    matrices is looked for when they are first told how many threads to take.
    """
    import numpy as np

    from inflight.samples import running_means
    from inflight.threads import one_thread

    with one_thread():
        running_means(np.arange(2, dtype=np.int64), np.zeros((2, 1)), 1)


# Python would look through all that is imported for what could go, again and again: a fifth of the time.
gc.disable()
try:
    for name in _IMPORTED:
        import_module(name)
    # What fails here fails again in a task, which tells of it; without this process there would be none.
    with suppress(Exception):
        _use_once()
finally:
    # What is imported stays: nor does it touch, and so copy, memory that the processes share.
    gc.freeze()
    gc.enable()
    gc.set_threshold(OBJECTS_TO_COLLECT)
