"""How a value may depend on time: the functions of time its coefficients multiply.

``constant``: one; ``linear``: ``a + b (t - t0)/per``; ``parabola``: ``a + b x + c x^2`` with
``x = (t - t0)/per``; ``log``: ``a + b ln((t - t0)/per)`` (Yin 2010, section 3.2); ``event``: one value
for each interval between the times ``at``; ``spline``: values at the times ``at``, with lines or a natural
cubic between them, and the outer ones held beyond; ``block``: one value a calibration interval, held in a
table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from inflight.arrays import Floats
from inflight.effects.naming import did_you_mean
from inflight.errors import ModelError
from inflight.time import DAY, parse_duration, parse_utc, to_tt2000, to_utc

if TYPE_CHECKING:
    from inflight.mission import Event

TIMES = ("constant", "linear", "parabola", "log", "block", "event", "spline")
#: Functions of the time since `t0`: their first coefficient is a value, the others its growth.
TRENDS = ("linear", "parabola", "log")
INTERPOLATIONS = ("cubic", "linear")
#: Keys of a parameter's entry that say how it depends on time.
KEYS = ("t0", "per", "at", "events", "interpolation")


@dataclass(frozen=True)
class Dependence:
    """How a value depends on time.

    Attributes
    ----------
    time : str
        One of `TIMES`.
    t0, per : int
        Origin (TT2000) and unit of a trend's time, nanoseconds.
    at : tuple of int
        TT2000 of the events between intervals, or of a spline's knots.
    interpolation : str
        Between knots: ``cubic`` or ``linear``.
    """

    time: str = "constant"
    t0: int = 0
    per: int = DAY
    at: tuple[int, ...] = ()
    interpolation: str = "cubic"

    @property
    def count(self) -> int:
        """Number of coefficients of each component."""
        counts = {"linear": 2, "parabola": 3, "log": 2, "event": len(self.at) + 1, "spline": len(self.at)}
        return counts.get(self.time, 1)

    @property
    def suffixes(self) -> list[str]:
        """What coefficients add to a component's name: nothing, ``*b``, ``*c``, ``*e0``, ``*k0``."""
        if self.time in ("event", "spline"):
            return [f"*{self.time[0] if self.time == 'event' else 'k'}{i}" for i in range(self.count)]
        return ["", "*b", "*c"][: self.count]

    @property
    def is_trend(self) -> bool:
        """True when only the first coefficient is a value and the others are its growth."""
        return self.time in TRENDS

    def basis(self, tt2000: npt.ArrayLike, key: str = "value") -> Floats:
        """Return the functions of time; (..., coefficient).

        Parameters
        ----------
        tt2000 : int or ndarray of int, shape (...)
            Nanoseconds.
        key : str
            The parameter, for errors.

        Raises
        ------
        ModelError
            When a log trend is asked before its origin.
        """
        t = np.asarray(tt2000, dtype=np.int64)
        if self.is_trend:
            return self._trend(t, key)
        if self.time == "event":
            interval = np.searchsorted(np.asarray(self.at, dtype=np.int64), t, side="right")
            return np.asarray(np.eye(self.count)[interval])
        if self.time == "spline":
            return self._spline(t)
        return np.ones((*t.shape, 1))

    def _trend(self, t: npt.NDArray[np.int64], key: str) -> Floats:
        elapsed = (t - self.t0) / self.per
        if self.time == "log":
            if np.any(elapsed <= 0):
                raise ModelError(
                    f"'{key}' follows a logarithm that begins at {to_utc(self.t0)}, asked for before it",
                    remedy="use time: constant there, or an earlier t0",
                )
            elapsed = np.log(elapsed)
        return np.stack([elapsed**power for power in range(self.count)], axis=-1)

    def _spline(self, t: npt.NDArray[np.int64]) -> Floats:
        # Days since the first knot keep the polynomials' numbers small.
        knots = (np.asarray(self.at, dtype=np.int64) - self.at[0]) / DAY
        x = np.clip((t - self.at[0]) / DAY, knots[0], knots[-1])
        unit = np.eye(knots.size)
        if self.interpolation == "linear" or knots.size == 2:
            return np.stack([np.interp(x, knots, row) for row in unit], axis=-1)
        return np.asarray(CubicSpline(knots, unit, bc_type="natural")(x))

    def as_yaml(self) -> dict[str, Any]:
        """Return the keys of a parameter's entry that say it."""
        found: dict[str, Any] = {"time": self.time}
        if self.is_trend:
            found |= {"t0": f"{to_utc(self.t0)}Z", "per": f"{self.per} ns"}
        if self.at:
            found["at"] = [f"{to_utc(moment)}Z" for moment in self.at]
        if self.time == "spline":
            found["interpolation"] = self.interpolation
        return found


def parse_dependence(key: str, entry: Mapping[str, Any], events: Sequence[Event] = ()) -> Dependence:
    """Read how a parameter depends on time.

    Parameters
    ----------
    key : str
        ``effect.parameter``, for errors.
    entry : mapping
        Its entry in the model YAML.
    events : sequence of Event
        The mission's, for ``events: KIND``; the model keeps their times, so that a later event of that
        kind changes nothing unless the model is written anew.

    Raises
    ------
    ModelError
        Naming the parameter and what is wrong.
    """
    time = str(entry.get("time", "constant"))
    if time not in TIMES:
        raise ModelError(
            f"'{key}': time {time!r} is unknown{did_you_mean(time, TIMES)}",
            remedy=f"one of {', '.join(TIMES)}",
        )
    wanted = dict.fromkeys(TRENDS, ("t0", "per"))
    wanted |= {"event": ("at", "events"), "spline": ("at", "interpolation")}
    if stray := [name for name in KEYS if name in entry and name not in wanted.get(time, ())]:
        raise ModelError(
            f"'{key}' has time '{time}', which has no '{stray[0]}'", remedy="take it out, or change 'time'"
        )
    if time in TRENDS:
        return _parse_trend(key, time, entry)
    if time in ("event", "spline"):
        return _parse_dated(key, time, entry, events)
    return Dependence(time)


def _parse_trend(key: str, time: str, entry: Mapping[str, Any]) -> Dependence:
    if "t0" not in entry:
        raise ModelError(f"'{key}' changes with time but has no 't0'", remedy="say from when: t0: 2000-05-30")
    per = str(entry.get("per", "1 d"))
    per = per if per.strip()[:1].isdigit() else f"1 {per}"
    try:
        return Dependence(time, int(to_tt2000(parse_utc(entry["t0"]))), parse_duration(per))
    except ValueError as error:
        raise ModelError(f"'{key}': {error}", remedy="write t0: 2000-05-30, per: 1 d") from None


def _parse_dated(key: str, time: str, entry: Mapping[str, Any], events: Sequence[Event]) -> Dependence:
    if time == "event" and "events" in entry:
        given = _events_of(key, str(entry["events"]), events)
    else:
        given = entry.get("at") or []
    try:
        at = tuple(int(to_tt2000(parse_utc(one))) for one in given)
    except (ValueError, TypeError) as error:
        raise ModelError(f"'{key}': at: {error}", remedy="list UTC dates or times") from None
    least = 2 if time == "spline" else 1
    if len(at) < least or any(late <= early for early, late in pairwise(at)):
        raise ModelError(
            f"'{key}' has time '{time}' with {len(at)} times in 'at'",
            remedy=f"list {least} or more rising UTC times" + (", or 'events: KIND'" if least == 1 else ""),
        )
    interpolation = str(entry.get("interpolation", "cubic"))
    if interpolation not in INTERPOLATIONS:
        raise ModelError(
            f"'{key}': interpolation {interpolation!r} is unknown",
            remedy=f"one of {', '.join(INTERPOLATIONS)}",
        )
    return Dependence(time, at=at, interpolation=interpolation)


def _events_of(key: str, kind: str, events: Sequence[Event]) -> list[Any]:
    found = sorted(to_utc(event.at) for event in events if event.kind == kind)
    if not found:
        kinds = sorted({event.kind for event in events})
        raise ModelError(
            f"'{key}': the mission has no event of kind {kind!r}{did_you_mean(kind, kinds)}",
            remedy=f"it has {', '.join(kinds) or 'none'}; list times in 'at', or add events to the mission",
        )
    return found
