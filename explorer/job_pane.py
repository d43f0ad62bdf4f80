"""A pane that shows a background job: its progress, then its result or its error."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import panel as pn

from inflight.explorer import panes
from inflight.explorer.background import Background, BackgroundJob
from inflight.figures import LazySection
from inflight.progress import Progress

#: How often the progress of a job is polled, ms, and how long a job takes before any is shown, s. A browser
#: lays the page out again for each text that comes and goes: a quick job would wait for its own progress.
_POLL_MS, _QUIET_S = 50, 0.4
#: How long a browser has to show a result before what follows it is drawn, s.
_SEEN_S = 0.4


def lazy_tabs(
    parts: Sequence[LazySection],
    background: Background,
    section: Callable[..., pn.viewable.Viewable] = panes.section,
) -> pn.Tabs:
    """Return sections behind tabs, each made when its tab is opened for the first time.

    Parameters
    ----------
    parts : sequence of Later
        Made in a thread of the background.
    section : callable
        Makes a pane of text and figures.
    """
    job_panes = [JobPane(background) for _ in parts]
    begun: set[int] = set()
    tabs = pn.Tabs(
        *((heading, pane.panel) for (heading, _), pane in zip(parts, job_panes, strict=True)),
        dynamic=True,
        sizing_mode="stretch_width",
    )

    def show(index: int) -> None:
        if index < len(parts) and index not in begun:
            begun.add(index)
            heading, make = parts[index]
            job_panes[index].begin(heading, lambda progress: make(), lambda body: section(*body))

    tabs.param.watch(lambda event: show(event.new), "active")
    if parts:
        show(0)
    return tabs


class JobPane:
    """Shows the result of one job after the other; of several, that of the newest.

    Parameters
    ----------
    background : Background
        Does the work.
    """

    def __init__(self, background: Background) -> None:
        self._background = background
        self._status = pn.pane.HTML("", visible=False, margin=(5, 10))
        self._content = pn.Column(sizing_mode="stretch_width")
        self._job: BackgroundJob | None = None
        self._begun = self._told = 0.0
        self._poll_callback: Any = None
        self._show: Callable[[Any], pn.viewable.Viewable] = panes.text
        self._then: Callable[[Any], None] | None = None
        #: What follows a result that was shown.
        self._due: Callable[[], None] | None = None
        #: What the page holds.
        self.panel = pn.Column(self._status, self._content, sizing_mode="stretch_width")

    @property
    def is_busy(self) -> bool:
        """Whether a job is running or waiting."""
        return self._job is not None

    def put(self, *parts: pn.viewable.Viewable) -> None:
        """Show some panes now; they replace what was there."""
        self._content.objects = list(parts)

    def begin(
        self,
        name: str,
        work: Callable[[Progress], Any],
        show: Callable[[Any], pn.viewable.Viewable],
        then: Callable[[Any], None] | None = None,
    ) -> None:
        """Begin a job; its result is shown when it is finished, unless another was begun meanwhile.

        Parameters
        ----------
        work : callable
            Takes the progress function; runs in the background thread.
        show : callable
            Makes a pane of the result; runs in the page's thread.
        then : callable, optional
            Called with the result once it is shown: what takes long and need not be seen at once.
        """
        # What follows a result that was shown is not lost, nor done after what is begun now.
        self._do_what_is_due()
        self.follow(self._background.begin(name, work), show, then)

    def follow(
        self,
        job: BackgroundJob,
        show: Callable[[Any], pn.viewable.Viewable],
        then: Callable[[Any], None] | None = None,
    ) -> None:
        """Show the progress and the result of a job that was begun, as `begin` does."""
        self._job, self._show, self._then, self._due = job, show, then, None
        self._begun = time.monotonic()
        # What changes while a browser still takes the page in may never reach it: a quick job's result.
        pn.state.onload(self._begin_to_poll)

    def _begin_to_poll(self) -> None:
        if self._poll_callback is None and self._job is not None:
            self._poll_callback = pn.state.add_periodic_callback(self._poll, period=_POLL_MS)

    def _poll(self) -> None:
        job = self._job
        if job is None:
            if self._due is not None and time.monotonic() - self._told < _SEEN_S:
                return
            self._end_polling()
            self._do_what_is_due()
            return
        if not job.is_finished:
            if time.monotonic() - self._begun > _QUIET_S:
                self._status.param.update(object=panes.progress(job), visible=True)
            return
        self._job, self._status.visible = None, False
        if job.error is None:
            self.put(self._show(job.result))
            self._told = time.monotonic()
            if (then := self._then) is not None:
                self._due = lambda: then(job.result)
                return
        self._end_polling()
        if job.error is not None:
            # An unexpected error leaves its traceback in the terminal.
            if job.error["message"].startswith("unexpected"):
                print(job.trace, file=sys.stderr)
            self.put(panes.error(job.error))

    def _do_what_is_due(self) -> None:
        due, self._due = self._due, None
        if due is not None:
            due()

    def _end_polling(self) -> None:
        if self._poll_callback is not None:
            self._poll_callback.stop()
            self._poll_callback = None
