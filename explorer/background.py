"""Long work beside the page: one piece at a time, in a thread, its progress read by whoever asks."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from inflight.tasks import Progress, error_fields


@dataclass
class BackgroundJob:
    """One piece of work: asked for, under way, or done with a result or an error.

    Attributes
    ----------
    name : str
        What a person calls it.
    stage, done, total
        How far it is, as the steps of the pipeline tell it; no stage before it begins.
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
    #: Of an unexpected error, for whoever started the page.
    trace: str = ""
    _finished: threading.Event = field(default_factory=threading.Event)

    @property
    def is_finished(self) -> bool:
        """Whether there is a result or an error."""
        return self._finished.is_set()

    def wait(self, seconds: float | None = None) -> bool:
        """Wait until it is finished; False when the time is over before."""
        return self._finished.wait(seconds)

    def tell(self, stage: str, done: int, total: int) -> None:
        """Take note of how far the work is."""
        self.stage, self.done, self.total = stage, done, total

    def carry_out(self, work: Callable[[Progress], Any]) -> None:
        """Do the work; whatever it raises is kept, because nobody waits for it here."""
        self.tell("begin", 0, 0)
        try:
            self.result = work(self.tell)
        except Exception as error:
            self.error, self.trace = error_fields(error), traceback.format_exc()
        finally:
            self._finished.set()


class Background:
    """One thread that does one piece of work after the other.

    A pass over the archive fills memory and cores by itself: two at a time would only slow each other.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="explorer")

    def begin(self, name: str, work: Callable[[Progress], Any]) -> BackgroundJob:
        """Do the work as soon as what was asked for before is done; return at once.

        Parameters
        ----------
        name : str
            What a person calls it.
        work : callable
            Of one function ``(stage, done, total)`` that it tells its progress.
        """
        job = BackgroundJob(name)
        self._pool.submit(job.carry_out, work)
        return job

    def close(self) -> None:
        """Drop what has not begun; what is under way ends by itself."""
        self._pool.shutdown(wait=False, cancel_futures=True)
