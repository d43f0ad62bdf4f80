"""Loops that numba compiles when they are first called, so that who does not call them waits for nothing."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def compiled(loop: Callable[P, R]) -> Callable[P, R]:
    """Return a function whose machine code is made, or read from numba's cache, at its first call.

    For loops called from Python. A loop that another compiled loop calls has to be `numba.njit` itself.
    """

    @cache
    def machine_code() -> Any:
        import numba

        return numba.njit(cache=True, nogil=True)(loop)

    @wraps(loop)
    def call(*arguments: P.args, **keywords: P.kwargs) -> R:
        found: R = machine_code()(*arguments, **keywords)
        return found

    return call
