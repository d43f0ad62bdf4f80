"""Values in time: constant, trends, events, splines, and blocks held in a calibration table.

``constant``: one; ``linear``: ``a + b (t - t0)/per``; ``parabola``: ``a + b x + c x^2`` with
``x = (t - t0)/per``; ``log``: ``a + b ln((t - t0)/per)`` (Yin 2010, section 3.2); ``event``: one value
for each interval between the times ``at``; ``spline``: values at the times ``at``, with lines or a natural
cubic between them, and the outer ones held beyond; ``block``: one value a calibration interval, held in the
table that a reprocessing makes; ``table``: the values of a named table of the catalog, taken as they are.

`Dependence` holds the functions of time, `TimedValue` the coefficients that multiply them. Time dependence
belongs to the model, never to an effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.effects import Parameter
from inflight.errors import ModelError, did_you_mean
from inflight.time import DAY, parse_duration, parse_utc, to_tt2000, to_utc
from inflight.units import factor_and_offset

if TYPE_CHECKING:
    import xarray as xr

    from inflight.mission import Event


TIMES = ("constant", "linear", "parabola", "log", "block", "event", "spline", "table")

#: Functions of the time since `t0`: their first coefficient is a value, the others its growth.
TRENDS = ("linear", "parabola", "log")

INTERPOLATIONS = ("cubic", "linear")

#: Keys of a parameter's entry that describe its time dependence.
KEYS = ("t0", "per", "at", "events", "interpolation")


@dataclass(frozen=True)
class TimeDependence:
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
            elapsed = (t - self.t0) / self.per
            if self.time == "log":
                if np.any(elapsed <= 0):
                    raise ModelError(
                        f"'{key}' follows a logarithm that begins at {to_utc(self.t0)}, asked for before it",
                        remedy="use time: constant there, or an earlier t0",
                    )
                elapsed = np.log(elapsed)
            return np.stack([elapsed**power for power in range(self.count)], axis=-1)
        if self.time == "event":
            interval = np.searchsorted(np.asarray(self.at, dtype=np.int64), t, side="right")
            return np.asarray(np.eye(self.count)[interval])
        if self.time == "spline":
            # Days since the first knot keep the polynomials' numbers small.
            knots = (np.asarray(self.at, dtype=np.int64) - self.at[0]) / DAY
            x = np.clip((t - self.at[0]) / DAY, knots[0], knots[-1])
            unit = np.eye(knots.size)
            if self.interpolation == "linear" or knots.size == 2:
                return np.stack([np.interp(x, knots, row) for row in unit], axis=-1)
            return np.asarray(scipy.interpolate.CubicSpline(knots, unit, bc_type="natural")(x))
        return np.ones((*t.shape, 1))

    def as_yaml(self) -> dict[str, Any]:
        """Return the keys of a parameter's entry that describe it."""
        found: dict[str, Any] = {"time": self.time}
        if self.is_trend:
            found |= {"t0": f"{to_utc(self.t0)}Z", "per": f"{self.per} ns"}
        if self.at:
            found["at"] = [f"{to_utc(moment)}Z" for moment in self.at]
        if self.time == "spline":
            found["interpolation"] = self.interpolation
        return found


def parse_dependence(key: str, entry: Mapping[str, Any], events: Sequence[Event] = ()) -> TimeDependence:
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
    allowed = dict.fromkeys(TRENDS, ("t0", "per"))
    allowed |= {"event": ("at", "events"), "spline": ("at", "interpolation")}
    if stray := [name for name in KEYS if name in entry and name not in allowed.get(time, ())]:
        raise ModelError(
            f"'{key}' has time '{time}', which has no '{stray[0]}'", remedy="take it out, or change 'time'"
        )
    if time in TRENDS:
        return _parse_trend(key, time, entry)
    if time in ("event", "spline"):
        return _parse_dated(key, time, entry, events)
    return TimeDependence(time)


def _parse_trend(key: str, time: str, entry: Mapping[str, Any]) -> TimeDependence:
    if "t0" not in entry:
        raise ModelError(f"'{key}' changes with time but has no 't0'", remedy="say from when: t0: 2000-05-30")
    per = str(entry.get("per", "1 d"))
    per = per if per.strip()[:1].isdigit() else f"1 {per}"
    try:
        return TimeDependence(time, int(to_tt2000(parse_utc(entry["t0"]))), parse_duration(per))
    except ValueError as error:
        raise ModelError(f"'{key}': {error}", remedy="write t0: 2000-05-30, per: 1 d") from None


def _parse_dated(key: str, time: str, entry: Mapping[str, Any], events: Sequence[Event]) -> TimeDependence:
    if time == "event" and "events" in entry:
        kind = str(entry["events"])
        given: Sequence[Any] = sorted(to_utc(event.at) for event in events if event.kind == kind)
        if not given:
            kinds = sorted({event.kind for event in events})
            raise ModelError(
                f"'{key}': the mission has no event of kind {kind!r}{did_you_mean(kind, kinds)}",
                remedy=f"it has {', '.join(kinds) or 'none'}; list times in 'at', "
                "or add events to the mission",
            )
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
    return TimeDependence(time, at=at, interpolation=interpolation)


@dataclass(frozen=True, kw_only=True)
class TimedValue:
    """A parameter of a model: its coefficients, what is known of them, and how they depend on time.

    Attributes
    ----------
    parameter : Parameter
        Its definition by the effect, in the unit the model states.
    time : str
        One of `TIMES`: see `inflight.model.time_dependence`.
    value, sigma : ndarray, shape (component, coefficient)
        Value and standard deviation; for block, those known beforehand.
    free : bool
        Whether a fit may move it. Left out of the YAML, it is free with time ``block`` or a stated sigma.
    t0, per : int
        Origin (TT2000) and unit of a trend's time, nanoseconds.
    table : xarray.Dataset, optional
        Bound calibration table, of a block parameter or of one with time ``table``.
    key : str
        ``effect.parameter``, the name in tables.
    table_name : str
        Name of the table its values lie in, as the model YAML states it; with time ``table`` its name and
        the first digits of its key.
    change_times : tuple of int
        TT2000 of the events between intervals, or of a spline's knots.
    interpolation : str
        Between knots: ``cubic`` or ``linear``.
    before : ndarray, shape (component, coefficient), optional
        Sigma that was known before a fit made value and sigma; None of one that was never fitted.
    """

    parameter: Parameter
    time: str
    value: Floats
    sigma: Floats
    free: bool = True
    t0: int = 0
    per: int = DAY
    table: xr.Dataset | None = None
    key: str = ""
    table_name: str = ""
    change_times: tuple[int, ...] = ()
    interpolation: str = "cubic"
    before: Floats | None = None

    @property
    def prior_sigma(self) -> Floats:
        """What was known before any fit, which a fit begins with: days that taught it are counted once."""
        return self.sigma if self.before is None else self.before

    @property
    def dependence(self) -> TimeDependence:
        """Which functions of time the coefficients multiply."""
        return TimeDependence(self.time, self.t0, self.per, self.change_times, self.interpolation)

    @property
    def columns(self) -> list[str]:
        """Names of the coefficients, component by component; as `value` flattened.

        ``effect.parameter[axis]``; a trend's growth adds ``*b`` (a parabola's
        ``*b, *c``), the values of intervals between events
        ``*e0, *e1, ...``, those of a spline's knots ``*k0, *k1, ...``.
        """
        names = component_names(self.key, self.parameter)
        return [f"{name}{suffix}" for name in names for suffix in self.dependence.suffixes]

    @property
    def has_own_sigma(self) -> bool:
        """Whether a sigma was stated or fitted: the effect's own says how far a fit may go."""
        usual = _filled(self.parameter, self.dependence, self.parameter.sigma)
        return not np.array_equal(self.sigma, usual)

    def at(self, tt2000: npt.ArrayLike) -> Floats:
        """Return the value at a time, shape (component,), or at times, shape (time, component).

        Where one value holds at all times it comes once, (component,).

        Raises
        ------
        ModelError
            When a log trend is asked before its origin, or a time lies outside the bound table.
        """
        if self.time == "constant" or (self.time == "block" and self.table is None):
            return self.value[:, 0]
        t = np.asarray(tt2000, dtype=np.int64)
        if self.time == "table":
            return self._held(t, "value")
        if self.table is not None and self.time == "block":
            return self._from_table(self.table, t)
        return np.asarray(self.dependence.basis(t, self.key) @ self.value.T)

    def sigma_at(self, tt2000: npt.ArrayLike) -> Floats:
        """Return one sigma at a time, shape (component,), or at times, shape (time, component).

        Of time ``table``, the table's; beyond its intervals, where the nearest one is held, also what two
        intervals differ by. Else that of a constant, 0 where none is stated.

        Raises
        ------
        ModelError
            As `at`.
        """
        if self.time == "table":
            return self._held(np.asarray(tt2000, dtype=np.int64), "sigma")
        stated = self.sigma[:, 0] if self.time == "constant" and self.free else np.zeros(len(self.sigma))
        return np.where(np.isfinite(stated), stated, 0.0)

    def is_held_at(self, tt2000: int) -> bool:
        """Return True where a table of time ``table`` has no interval: the nearest one's value is held."""
        if self.time != "table" or self.table is None:
            return False
        return not bool(_nearest_interval(self.table, np.asarray(tt2000, dtype=np.int64))[1])

    def is_own_at(self, tt2000: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return where a table of time ``table`` has a value of that time, not one of other times."""
        times = np.asarray(tt2000, dtype=np.int64)
        if self.time != "table" or self.table is None:
            return np.ones(times.shape, dtype=bool)
        index, inside = _nearest_interval(self.table, times)
        return np.asarray(inside & self.table["own"].values[index])

    def _held(self, t: npt.NDArray[np.int64], what: str) -> Floats:
        """Return value or sigma of a table at times; beyond its intervals the nearest one's."""
        if self.table is None:
            raise ModelError(
                f"'{self.key}' takes its values from table {self.table_name!r}, which is not there",
                remedy=f"'inflight set {self.key}={self.table_name.partition(':')[0]}' takes the newest one, "
                f"'inflight drop {self.key.partition('.')[0]}' does without",
            )
        index, inside = _nearest_interval(self.table, t)
        found = np.asarray(self.table[what].values[index])
        if what == "sigma" and not inside.all():
            value = self.table["value"].values
            # Two intervals that know nothing of each other; of a single one, all it has.
            apart = np.sqrt(2.0) * value.std(axis=0) if len(value) > 1 else np.abs(value[0])
            found = np.where(inside[..., None], found, np.hypot(found, apart))
        return found

    def with_table(self, table: xr.Dataset) -> TimedValue:
        """Return a copy of time ``table`` with the table's values: components that it has not are 0.

        Parameters
        ----------
        table : xarray.Dataset
            dim interval (`start`, `end`), and a second one, ``axis`` or ``parameter`` (whose names end in
            ``[axis]``): `value` and `sigma`, with units in their attributes or in `units` (parameter); where
            it has one, `state` (interval) with its meanings, *interpolated* and *held* among them.

        Raises
        ------
        ModelError
            When it has another form or unit.
        """
        import xarray as xr

        try:
            (dim,) = (str(one) for one in table["value"].dims if one != "interval")
            names = [str(one).rpartition("[")[2].rstrip("]") for one in table[dim].values]
            unit = str(table["units"].values[0] if "units" in table else table["value"].attrs["units"])
            factor, _ = factor_and_offset(unit, self.parameter.unit)
        except (KeyError, ValueError) as error:
            raise ModelError(
                f"table {self.table_name!r} has no values for '{self.key}', {self.parameter.unit}: {error}",
                remedy="name a table of intervals by axis, such as main-z-offset",
            ) from None
        axes = self.parameter.axes or (names[0],)
        wide = np.zeros((table.sizes["interval"], len(axes), 2))
        for place, axis in enumerate(axes):
            if axis in names:
                one = table.isel({dim: names.index(axis)})
                wide[:, place] = factor * np.stack([one["value"].values, one["sigma"].values], axis=-1)
        each = ("interval", "component")
        own = np.ones(len(wide), dtype=bool)
        if "state" in table:
            meanings = np.array(str(table["state"].attrs["flag_meanings"]).split())
            own = ~np.isin(meanings[table["state"].values], ("interpolated", "held"))
        return replace(
            self,
            table=xr.Dataset(
                {
                    "own": ("interval", own),
                    "value": (each, wide[..., 0]),
                    "sigma": (each, wide[..., 1]),
                    "start": ("interval", table["start"].values),
                    "end": ("interval", table["end"].values),
                },
                attrs={"id": table.attrs.get("id", "")},
            ),
        )

    def _from_table(self, table: xr.Dataset, t: npt.NDArray[np.int64]) -> Floats:
        """Return the values of the intervals of a table that hold at times (...); see `at`."""
        # Stamps of one interval are most there are: they need one look, and have one value.
        if t.ndim == 1 and t.size > 1 and self._interval(table, t.min()) == self._interval(table, t.max()):
            return self._from_table(table, t[0])
        if t.ndim == 1 and np.all(t[1:] >= t[:-1]):
            # Of others in order, one look an interval is enough.
            begins = np.unique(np.append(0, np.searchsorted(t, table["start"].values)))
            begins = begins[begins < t.size]
            counts = np.diff(begins, append=t.size)
            index = self._interval(table, t[begins + counts - 1])
            if np.all(self._holds(table, index, t[begins + counts - 1])):
                return np.repeat(self._values_in(table, index), counts, axis=0)
        index = self._interval(table, t)
        inside = self._holds(table, index, t)
        if not np.all(inside):
            first = np.atleast_1d(t)[~np.atleast_1d(inside)][0]
            raise ModelError(
                f"the calibration table for '{self.key}' is not valid at {to_utc(first)}",
                remedy="reprocess the span, or certify a table for it",
            )
        return self._values_in(table, index)

    def _values_in(self, table: xr.Dataset, index: npt.NDArray[np.int64]) -> Floats:
        """Return the values in intervals of a table; (..., component)."""
        places = {name: place for place, name in enumerate(table["parameter"].values.tolist())}
        columns = [places[name] for name in component_names(self.key, self.parameter)]
        return np.asarray(table["value"].values[:, columns][index])

    @staticmethod
    def _holds(
        table: xr.Dataset, index: npt.NDArray[np.int64], t: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.bool_]:
        """Return whether times are in the intervals that begin last before them."""
        return np.asarray((index >= 0) & (t < table["end"].values[np.clip(index, 0, None)]))

    @staticmethod
    def _interval(table: xr.Dataset, t: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return the interval that begins last before times."""
        return np.asarray(np.searchsorted(table["start"].values, t, side="right") - 1)

    def bind(self, table: xr.Dataset) -> TimedValue:
        """Return a copy that takes its values from a calibration table, when the table has it."""
        names = component_names(self.key, self.parameter)
        if self.time != "block" or not set(names) <= set(table["parameter"].values.tolist()):
            return self
        return replace(self, table=table)

    def with_columns(self, value: Mapping[str, float], sigma: Mapping[str, float]) -> TimedValue:
        """Return a copy with new values and standard deviations of the named coefficients, as a fit has them.

        The sigma before the first fit stays known; of what had none it is that of the effect itself.
        """
        names, shape, before = self.columns, self.value.shape, self.before
        if before is None and any(name in sigma for name in names):
            usual = _filled(self.parameter, self.dependence, self.parameter.sigma)
            before = np.where(self.sigma > 0, self.sigma, usual)
        values = [value.get(name, old) for name, old in zip(names, self.value.ravel(), strict=True)]
        sigmas = [sigma.get(name, old) for name, old in zip(names, self.sigma.ravel(), strict=True)]
        return replace(self, value=np.reshape(values, shape), sigma=np.reshape(sigmas, shape), before=before)

    def as_yaml(self) -> dict[str, Any]:
        """Return the mapping the model YAML holds for it."""
        axes = self.parameter.axes
        found: dict[str, Any] = {**self.dependence.as_yaml(), "unit": self.parameter.unit}
        if self.time == "table":
            return found | {"table": self.table_name}
        found["value"] = _as_yaml(self.value, axes)
        if self.has_own_sigma:
            found["sigma"] = _as_yaml(self.sigma, axes)
        if self.before is not None:
            found["sigma_before"] = _as_yaml(self.before, axes)
        if self.table_name:
            found["table"] = self.table_name
        found["free"] = self.free
        return found


def _nearest_interval(
    table: xr.Dataset, t: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Return the interval that holds at times, or the nearest one, and where one holds; (...) each."""
    start, end = table["start"].values, table["end"].values
    before = np.clip(np.searchsorted(start, t, side="right") - 1, 0, None)
    inside = (start[before] <= t) & (t < end[before])
    after = np.clip(before + 1, None, start.size - 1)
    nearer = ~inside & (t >= end[before]) & (np.abs(start[after] - t) < np.abs(t - end[before]))
    return np.asarray(np.where(nearer, after, before)), np.asarray(inside)


def component_names(key: str, parameter: Parameter) -> list[str]:
    """Return the names of a parameter's components: ``effect.parameter[axis]``."""
    return [f"{key}[{axis}]" for axis in parameter.axes] if parameter.axes else [key]


def parse_timed(key: str, parameter: Parameter, given: Any, events: Sequence[Event] = ()) -> TimedValue:
    """Read a parameter's entry of the model YAML; a bare number or list is a constant.

    Parameters
    ----------
    events : sequence of Event
        The mission's, for ``time: event, events: KIND``.

    Raises
    ------
    ModelError
        Naming the parameter and what is wrong.
    """
    entry = dict(given) if isinstance(given, dict) else {"value": given}
    known = ["time", "unit", "value", "sigma", "sigma_before", "free", "table", *KEYS]
    if unknown := [name for name in entry if name not in known]:
        raise ModelError(
            f"'{key}' has unknown keys {unknown}{did_you_mean(str(unknown[0]), known)}",
            remedy=f"known are {', '.join(sorted(known))}",
        )
    dependence = parse_dependence(key, entry, events)
    if dependence.time == "table" and (not entry.get("table") or {"value", "sigma"} & entry.keys()):
        raise ModelError(
            f"'{key}' has time 'table' and " + ("a value of its own" if entry.get("table") else "names none"),
            remedy="write {time: table, table: main-z-offset}",
        )
    unit = str(entry.get("unit", parameter.unit))
    if unit != parameter.unit:
        raise ModelError(
            f"'{key}' is given in {unit}, it is in {parameter.unit}", remedy="convert the values"
        )
    value = _coefficients(key, parameter, dependence, entry.get("value"), parameter.default_values)
    sigma, before = (
        _coefficients(key, parameter, dependence, entry.get(name), parameter.sigma)
        for name in ("sigma", "sigma_before")
    )
    if np.isnan([sigma, before]).any() or np.any([sigma < 0, before < 0]) or np.isnan(value).any():
        raise ModelError(
            f"'{key}' has a value or sigma that is no number, or a sigma below 0", remedy="correct it"
        )
    stated = entry.get("sigma") is not None
    free = bool(entry.get("free", dependence.time == "block" or stated)) and dependence.time != "table"
    return TimedValue(
        parameter=parameter,
        time=dependence.time,
        value=value,
        sigma=sigma,
        free=free,
        t0=dependence.t0,
        per=dependence.per,
        key=key,
        table_name=str(entry.get("table", "")),
        change_times=dependence.at,
        interpolation=dependence.interpolation,
        before=before if "sigma_before" in entry else None,
    )


def _filled(parameter: Parameter, dependence: TimeDependence, default: Floats | float) -> Floats:
    """Return a default for every coefficient, (component, coefficient); a trend does not grow."""
    filled = np.zeros((parameter.size, dependence.count))
    filled[:, : 1 if dependence.is_trend else None] = np.reshape(default, (-1, 1))
    return filled


def _coefficients(
    key: str, parameter: Parameter, dependence: TimeDependence, given: Any, default: Floats | float
) -> Floats:
    """Return an array (component, coefficient) from a number, a list, or a mapping by axis."""
    if given is None:
        return _filled(parameter, dependence, default)
    if isinstance(given, dict):
        if set(given) != set(parameter.axes or ()):
            axes = ", ".join(parameter.axes or ("no axes",))
            raise ModelError(
                f"'{key}' has components {', '.join(given)}, expected {axes}", remedy="name each"
            )
        given = [given[axis] for axis in parameter.axes or ()]
    shape = (parameter.size, dependence.count)
    try:
        array = np.asarray(given, dtype=np.float64)
        if array.ndim < 2 and not dependence.is_trend and array.size in (1, parameter.size):
            # One value a component holds for every interval and knot.
            return np.array(np.broadcast_to(array.reshape(-1, 1), shape))
        if array.ndim == 1 and parameter.size > 1:
            raise ValueError
        return array.reshape(shape)
    except ValueError:
        raise ModelError(
            f"'{key}': {given!r} does not give {shape[0]} components of {shape[1]} coefficients",
            remedy="write a list, or a mapping by axis",
        ) from None


def _as_yaml(array: Floats, axes: tuple[str, ...] | None) -> Any:
    plain = [row[0] if len(row) == 1 else row for row in array.tolist()]
    return dict(zip(axes, plain, strict=True)) if axes else plain[0]
