"""How far a flow is, told to whoever watches this process; a flow run by a worker tells nobody."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from inflight.tasks import Progress


def _nobody(stage: str, done: int, total: int) -> None:
    """Take a step nobody watches."""


_listener: ContextVar[Progress] = ContextVar("progress", default=_nobody)


@contextmanager
def told_to(listener: Progress | None) -> Iterator[None]:
    """Tell the progress of what runs inside to `listener`, a function ``(stage, done, total)``."""
    token = _listener.set(listener or _nobody)
    try:
        yield
    finally:
        _listener.reset(token)


def tell(stage: str, done: int, total: int) -> None:
    """Tell the listener that `done` of `total` parts of a stage are done."""
    _listener.get()(stage, done, total)
