"""How a process spares its processor: one thread for a product of matrices, few looks for dead cycles.

The matrices of a day are small, and work is spread over days: more threads would wait for each other (the fit
of 300 days took seven times the processor time with two), and the last digits of a sum would depend on the
machine.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

#: What tells the libraries that multiply matrices so, when set before they are loaded.
ONE_THREAD_VARIABLES = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

#: New objects after which Python looks for dead cycles. Its own 700 cost a tenth of a command's time: imports
#: and figures make objects by the hundred thousand, hardly any of which die.
OBJECTS_TO_COLLECT = 50_000


@contextmanager
def one_thread() -> Iterator[None]:
    """Let products of matrices take one thread, in this process and until the end of the block."""
    with _libraries().limit(limits=1):
        yield


@cache
def _libraries() -> ThreadpoolController:
    """Return the libraries that multiply matrices; looking for them takes as long as reading some days."""
    # scipy has a BLAS of its own, which is found only once it is loaded.
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
