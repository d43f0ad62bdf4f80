"""Named points at which the fault tests end the process, to prove that nothing is lost.

Set ``INFLIGHT_KILL_AT`` to a name, or to ``name:n`` for the n-th time it is reached; unset, and always
outside tests, a point does nothing.
"""

from __future__ import annotations

import os
import signal
from collections import Counter
from typing import Final

#: In the order a run passes them.
POINTS: Final = (
    "segment_begun",
    "segment_written",
    "manifest_written",
    "attach",
    "publish_begun",
    "publish_flushed",
    "published",
    "release_file_written",
    "release_written",
    "release_renamed",
)
_reached: Counter[str] = Counter()


def fault_point(point: str) -> None:
    """Kill the process, as ``kill -9`` does, when the environment asks for it here."""
    requested = os.environ.get("INFLIGHT_KILL_AT")
    if not requested:
        return
    _reached[point] += 1
    name, _, number = requested.partition(":")
    if name == point and _reached[point] == int(number or 1):
        os.kill(os.getpid(), signal.SIGKILL)
