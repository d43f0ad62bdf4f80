"""A place of the page that shows what a job brings: how far it is, its result, or its error."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

import panel as pn

from inflight.explorer import panes
from inflight.explorer.background import Background, BackgroundJob
from inflight.figures import LazySection
from inflight.tasks import Progress

#: How often the page looks how far a job is, ms.
_PERIOD = 300


def lazy_tabs(parts: Sequence[LazySection], background: Background) -> pn.Tabs:
    """Return sections behind tabs, each made when it is looked at for the first time.

    Parameters
    ----------
    parts : sequence of Later
        Made in a thread of the background.
    """
    places = [JobPane(background) for _ in parts]
    begun: set[int] = set()
    tabs = pn.Tabs(
        *((heading, place.panel) for (heading, _), place in zip(parts, places, strict=True)),
        dynamic=True,
        sizing_mode="stretch_width",
    )

    def look_at(place: int) -> None:
        if place not in begun:
            begun.add(place)
            heading, make = parts[place]
            places[place].begin(heading, lambda progress: make(), lambda inside: panes.section(*inside))

    tabs.param.watch(lambda event: look_at(event.new), "active")
    if parts:
        look_at(0)
    return tabs


class JobPane:
    """Where results of jobs appear, one after the other; the newest job wins.

    Parameters
    ----------
    background : Background
        What does the work.
    """

    def __init__(self, background: Background) -> None:
        self._background = background
        self._status = pn.pane.HTML("", visible=False, margin=(5, 10))
        self._content = pn.Column(sizing_mode="stretch_width")
        self._job: BackgroundJob | None = None
        self._look: Any = None
        self._show: Callable[[Any], pn.viewable.Viewable] = panes.text
        #: What the page holds.
        self.panel = pn.Column(self._status, self._content, sizing_mode="stretch_width")

    @property
    def is_busy(self) -> bool:
        """Whether a job is under way."""
        return self._job is not None

    def put(self, *parts: pn.viewable.Viewable) -> None:
        """Show something at once, in the place of what was there."""
        self._content.objects = list(parts)

    def begin(
        self, name: str, work: Callable[[Progress], Any], show: Callable[[Any], pn.viewable.Viewable]
    ) -> None:
        """Begin a job; its result is shown when it is there, unless another was begun meanwhile.

        Parameters
        ----------
        work : callable
            Of the progress function; in a thread of its own.
        show : callable
            Makes a part of the page from the result; in the page's thread.
        """
        self._job, self._show = self._background.begin(name, work), show
        self._status.visible = True
        self._status.object = panes.progress(self._job)
        if self._look is None:
            self._look = pn.state.add_periodic_callback(self._poll, period=_PERIOD)

    def _poll(self) -> None:
        job = self._job
        if job is None:
            return
        if not job.is_finished:
            self._status.object = panes.progress(job)
            return
        self._job, self._status.visible = None, False
        if self._look is not None:
            self._look.stop()
            self._look = None
        if job.error is None:
            self.put(self._show(job.result))
        else:
            # What is a defect leaves its traceback where the page was started.
            if job.error["message"].startswith("unexpected"):
                print(job.trace, file=sys.stderr)
            self.put(panes.error(job.error))
