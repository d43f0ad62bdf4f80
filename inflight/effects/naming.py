"""Names people write: registered names of classes, names of slowed channels, and what was perhaps meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

from inflight.derived import parse
from inflight.errors import ModelError
from inflight.time import SECOND, parse_duration


def snake_case(name: str) -> str:
    """Return ``ScalarBias`` as ``scalar_bias``."""
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in name).lstrip("_")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``": did you mean 'x'?"`` with the known name most like a wrong one, else nothing."""
    alike = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return f"; did you mean '{alike[0]}'?" if alike else ""


def slowed(channel: str, lag: Any = None, width: Any = None) -> str:
    """Return the name of a channel's slow response or play, as `inflight.derived` reads it.

    Parameters
    ----------
    channel : str
        A channel, or a derived one without the option that is added.
    lag : duration text, optional
        Time constant, such as ``600 s``.
    width : float, optional
        Full width of the play, in the channel's unit.

    Raises
    ------
    ModelError
        When it makes no channel's name.
    """
    name = channel
    if lag is not None:
        try:
            seconds = parse_duration(str(lag)) / SECOND
        except ValueError as error:
            raise ModelError(f"lag: {error}", channel=channel, remedy="write such as lag: 600 s") from None
        name += f"@lag={seconds:.12g}s" if seconds else ""
    if width is not None:
        try:
            name += f"@width={float(width):.12g}"
        except (TypeError, ValueError):
            raise ModelError(
                f"width: {width!r} is no number", channel=channel, remedy="give it in the channel's unit"
            ) from None
    return parse(name).name if name else name
