"""Long work in a background thread: one job at a time, with its progress, result or error."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from inflight.progress import Progress
from inflight.tasks import error_fields


@dataclass
class BackgroundJob:
    """A piece of work: waiting, running, or finished with a result or an error.

    Attributes
    ----------
    name : str
        Name shown to the user.
    stage, done, total
        Progress, as the steps of the pipeline report it; no stage before it begins.
    result : object
        What the work returned, once it is done.
    error : mapping, optional
        As `error_fields`, when it raised.
    """

    name: str
    stage: str = ""
    done: int = 0
    total: int = 0
    result: Any = None
    error: Mapping[str, str] | None = None
    #: Traceback of the error, for the terminal the page was started from.
    trace: str = ""
    _finished: threading.Event = field(default_factory=threading.Event)
    #: When the stage began, and how many were done then.
    _begun: tuple[float, int] = (0.0, 0)

    @property
    def is_finished(self) -> bool:
        """Whether there is a result or an error."""
        return self._finished.is_set()

    def wait(self, seconds: float | None = None) -> bool:
        """Wait until it is finished; False when the time is over before."""
        return self._finished.wait(seconds)

    def report_progress(self, stage: str, done: int, total: int) -> None:
        """Record the progress of the work."""
        if stage != self.stage:
            self._begun = time.monotonic(), done
        self.stage, self.done, self.total = stage, done, total

    @property
    def pace(self) -> str:
        """How many of the stage are done in a second, and how long the rest takes; empty while unknown."""
        begun, first = self._begun
        seconds, made = time.monotonic() - begun, self.done - first
        if made < 1 or self.total < 2 or seconds <= 0 or self.done >= self.total:
            return ""
        rate = made / seconds
        return f"{rate:.2g}/s, {duration_text((self.total - self.done) / rate)} left"

    def carry_out(self, work: Callable[[Progress], Any]) -> None:
        """Do the work; an exception is kept as `error`, because no caller could catch it."""
        self.report_progress("begin", 0, 0)
        try:
            self.result = work(self.report_progress)
        except Exception as error:
            self.error, self.trace = error_fields(error), traceback.format_exc()
        finally:
            self._finished.set()


class Background:
    """One thread that does jobs one after the other.

    A pass over the archive fills memory and cores by itself: two at a time would only slow each other.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="explorer")

    def begin(self, name: str, work: Callable[[Progress], Any]) -> BackgroundJob:
        """Queue work behind the jobs that were begun before; return at once.

        Parameters
        ----------
        name : str
            Name shown to the user.
        work : callable
            Takes one function ``(stage, done, total)``, to which it reports its progress.
        """
        job = BackgroundJob(name)
        self._pool.submit(job.carry_out, work)
        return job

    def close(self) -> None:
        """Cancel jobs that have not begun; the running one ends by itself."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def duration_text(seconds: float) -> str:
    """Return a duration as a person says it: ``40 s``, ``12 min``, ``3.5 h``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
