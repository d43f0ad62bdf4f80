"""Other readings of a clock error: another moment of an averaging is stamped, or a filter is late.

Takes what the mission states of its instruments' stamps; makes words with the line that would mend them
(`stamp_readings`). They are rivals, which the number alone cannot tell from a clock that is off.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from inflight.instruments import Instrument
from inflight.mission import Mission
from inflight.time import SECOND

_MOMENTS = ("start", "centre", "end")


@dataclass(frozen=True, kw_only=True)
class StampSettings:
    """When a shift of the clock is read as a matter of stamps.

    Attributes
    ----------
    sigmas : float
        It differs from what the reading would make by no more than so many sigmas: 95 % of true ones do ...
    part : float
        ... or by this part of it, which is a shift's first order and what resampling leaves; assumed.
    known : float
        It is told when it is so many sigmas from nothing: otherwise any reading would do.
    """

    sigmas: float = 2.0
    part: float = 0.02
    known: float = 3.0


STAMP_SETTINGS = StampSettings()


def stamp_readings(mission: Mission, comparison: str, seconds: float, sigma: float) -> tuple[str, ...]:
    """Return what a constant shift of the clock may be instead, in words with the lines that would mend it.

    Parameters
    ----------
    seconds, sigma : float
        What is to be added to the stamps of the vector sensor (or taken from those of the scalar one), s.
    """
    if not 0.0 < STAMP_SETTINGS.known * sigma < abs(seconds):
        return ()
    found = []
    for role, name in mission.comparisons[comparison].instruments().items():
        sign = 1.0 if role == "vector" else -1.0
        for added_ns, words in _changes(name, mission.instruments[name]):
            size = abs(added_ns) / SECOND
            allowed = max(STAMP_SETTINGS.sigmas * sigma, STAMP_SETTINGS.part * size)
            if size and abs(sign * added_ns / SECOND - seconds) <= allowed:
                found.append(words)
    return tuple(found)


def _changes(name: str, instrument: Instrument) -> Iterator[tuple[int, str]]:
    """Return what each other statement of an instrument's stamps would add to them, ns, and its words."""
    stated = bool(instrument.averaging)
    over_ns = instrument.averaging or instrument.cadence
    over = f"{name}'s {'averaging' if stated else 'spacing'} of {over_ns / SECOND:g} s"
    places = {"start": 1, "centre": 0, "end": -1}
    for moment in _MOMENTS:
        steps = places[moment] - places[instrument.stamp]
        if not steps:
            continue
        how_much = "half of" if abs(steps) == 1 else "as long as"
        line = f"stamp: {moment}" + ("" if stated else f", averaging: {over_ns / SECOND:g} s")
        words = f"{how_much} {over}, as if its stamps were the {moment} of it"
        yield steps * over_ns // 2, f"{words} (instruments: {{{name}: {{{line}}}}})"
    if instrument.delay:
        yield (
            instrument.delay,
            f"{name}'s delay of {instrument.delay / SECOND:g} s, as if it were in the stamps already "
            f"(instruments: {{{name}: {{delay: 0 s}}}})",
        )
