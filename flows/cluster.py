"""The Dask cluster of a run: processes on this machine, or a scheduler that exists already."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from distributed import Client

#: Address of a Dask scheduler to use instead of starting processes here.
SCHEDULER_VARIABLE = "INFLIGHT_DASK_SCHEDULER"
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def available_cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def dask_client(workers: int | None = None) -> Iterator[Client]:
    """Yield one client for the whole run.

    Parameters
    ----------
    workers : int, optional
        Processes to start; the cores of this machine when absent. Each has one thread and one BLAS
        thread, so that results do not depend on how many there are. The environment variable
        ``INFLIGHT_DASK_SCHEDULER`` names a running scheduler instead.
    """
    import dask
    from distributed import Client, LocalCluster

    # Workers import numpy before any task can set these, so they are part of how they are started.
    settings = {
        "distributed.nanny.pre-spawn-environ": {**_ONE_THREAD, "MALLOC_TRIM_THRESHOLD_": "65536"},
        "distributed.worker.memory.spill": False,
        "distributed.admin.large-graph-warning-threshold": "100MB",
    }
    address = os.environ.get(SCHEDULER_VARIABLE)
    with dask.config.set(settings):
        if address:
            with Client(address, set_as_default=False) as client:
                yield client
            return
        with (
            LocalCluster(
                n_workers=workers or available_cores(),
                threads_per_worker=1,
                processes=True,
                dashboard_address=None,
                silence_logs=40,
            ) as cluster,
            Client(cluster, set_as_default=False) as client,
        ):
            yield client
