"""The page of a long mission in a real browser: first paint, each tab, Try, Add, Undo.

The archive is written directly, a sample every eight minutes: what grows with the mission is its days.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from benchmarks.measured import Row, timed
from inflight.catalog import Catalog, Workspace
from inflight.tasks.analysis import diagnose_span
from inflight.tasks.pipelines import reprocess
from inflight.threads import one_thread
from tests.long_mission import make_long_workspace
from tests.web.chromium import Chromium, Served, find_chromium

#: Text of each tab that is there when its content is.
_TABS = {
    "Products and runs": "Click one to see it.",
    "Tables": "Circles are each day's own values",
    "Diagnosis": "All figures of this diagnosis",
    "Model against measurement": "Noise floor",
    "The loop": "Where it fails",
}
#: Seconds after which the page says what it is doing.
_SAID_S = 0.7
#: Seconds that are asked for.
_PAINT, _TAB, _TRY, _ADD = "2 s", "1 s", "0.5 s", "1 s"
_EFFECT = "channel_field(heater_current)"


def page(days: Sequence[int], keep: Path | None = None) -> Iterator[Row]:
    """Yield the rows of missions of so many days, as they are measured.

    Parameters
    ----------
    days : sequence of int
    keep : Path, optional
        Folder of the diagnosed workspaces, made once and kept; the page adds versions of the model to them.

    Raises
    ------
    SystemExit
        When there is no browser.
    """
    program = find_chromium()
    if program is None:
        sys.exit("no Chromium is on the path; install it, or name one by INFLIGHT_CHROMIUM")
    with tempfile.TemporaryDirectory() as scratch:
        for count in days:
            root = (keep or Path(scratch)) / f"page-{count}"
            if not root.exists():
                yield from _made(root, count)
            browser = Chromium(program, Path(scratch) / f"profile-{count}")
            served = Served(root)
            try:
                yield from _measured(browser, served.url, count)
            finally:
                browser.close()
                served.process.terminate()
                served.process.communicate(timeout=30)


def _made(root: Path, count: int) -> Iterator[Row]:
    """Yield what it takes to make a diagnosed workspace."""
    with one_thread():
        make_long_workspace(root, count)
        workspace = Workspace.open(root)
        seconds = timed(lambda: reprocess(Catalog(root), workspace.mission()))
        yield Row(what=f"{count} days: reprocess", seconds=seconds)
        yield Row(what=f"{count} days: diagnose", seconds=timed(lambda: diagnose_span(workspace)))


def _measured(browser: Chromium, url: str, count: int) -> Iterator[Row]:
    def until(text: str, act: Callable[[], object], *, gone: bool = False) -> list[float]:
        """Return the seconds from an act until a text is shown, or no more."""
        act()
        begun = time.perf_counter()
        there = f"window.allText && {'!' if gone else ''}window.allText().includes({json.dumps(text)})"
        browser.wait_for(there, 600, pause=0.01)
        return [time.perf_counter() - begun]

    opened = lambda: browser.open(url)  # noqa: E731
    first = until("Next:", opened)
    # The process has imported what a page needs: what any page after the first one takes.
    again = until("Next:", opened)
    yield Row(what=f"{count} days: first paint, the first page of a server", seconds=first)
    yield Row(what=f"{count} days: first paint", seconds=again, aim=_PAINT)
    drawn = until("Residual of products", lambda: None)
    yield Row(what=f"{count} days: then until the residual of 30 days is drawn", seconds=drawn)
    # The page says what it does when that takes long enough to be read.
    time.sleep(_SAID_S)
    read = [_SAID_S + seconds for seconds in until("Reads the equations", lambda: None, gone=True)]
    yield Row(what=f"{count} days: then until the equations are read", seconds=read)
    for _ in range(2):
        for name, text in _TABS.items():
            seconds = until(text, lambda name=name: browser.press(".bk-tab", name))
            yield Row(what=f"{count} days: tab {name}", seconds=seconds, aim=_TAB)
    browser.wait_for("!window.allText().includes('Reads the equations')", 600)
    browser.fill_placeholder("a channel, an effect", _EFFECT)
    # A workspace that is kept has the versions of earlier measurements.
    found = re.findall(r"(\d+) \(in use\)", browser.text())
    version = int(found[0]) if found else 1
    for verb, text, aim in (
        ("Try", "Tried; nothing is saved.", _TRY),
        ("Add", f"{version + 1} (in use)", _ADD),
        ("Undo", f"{version + 2} (in use)", _ADD),
    ):
        # As a person does who looks at what the last one drew.
        browser.rest()
        seconds = until(text, lambda verb=verb: browser.press("button", verb))
        yield Row(what=f"{count} days: {verb}", seconds=seconds, aim=aim)
