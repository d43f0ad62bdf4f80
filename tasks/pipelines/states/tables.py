"""What tables of states say across windows: numbers that run on, the constant part, units and channels.

Windows are learnt from independently, in any order. Afterwards each goes on from one of those before it
(`joined`, `inflight.dual.tracking`), so that the same state and unit have one number in all of them. This can
be undone: a window that changed is learnt from again, and those behind it are only joined anew. A window with
few states does not end the sequence: the next one may go on from one before that.

The constant part (`constant_of`): corrections by states are relative to one state, and windows that know it
go on from each other. A gradiometer is determined from changes alone, and its constant is arbitrary: it is
put where the states of the same window have it, so that the field does not step where one method follows the
other.

Units beside housekeeping (`named_units`): which channel switches with which unit. `with_remark` notes sensors
that look exchanged.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.dual import (
    ASSIGNMENT,
    ContinuedTraining,
    Correction,
    Readings,
    Switchings,
    Training,
    UnitChannels,
    continue_training,
    correction_by_states,
    correction_by_stored_gradiometer,
    covariance_of_product,
    gradiometer_from_dataset,
    has_gradiometer,
    match_channels_to_units,
    omits_slow_part,
    standalone_training,
    switchings,
    training_from_dataset,
    training_to_dataset,
)
from inflight.mission import Mission
from inflight.tasks.pipelines.base import UsedTable, product_of, scalar_channels
from inflight.time import SECOND, DayLike, Int64, day_bounds, day_of, usual_step

#: Characters of a key that tell a window's own inputs; the others tell the windows before it, too.
OWN = 32

#: So many windows before it a window may go on from.
OFFERED = 5

_CHANGES = ("change", "change_sigma", "aged")


def chained_key(own: str, before: Sequence[str]) -> str:
    """Return the key of a joined table, from that of its own inputs and the joined ones before it."""
    told = "".join([own, *before])
    return own[:OWN] + hashlib.sha256(told.encode()).hexdigest()[: 64 - OWN]


@dataclass
class Chain:
    """The tables that the next window may go on from.

    Attributes
    ----------
    keys : list of str
        Of tables with states, the newest first.
    tables : list of Dataset
    """

    keys: list[str] = field(default_factory=list)
    tables: list[xr.Dataset] = field(default_factory=list)

    @classmethod
    def before(cls, cat: Catalog, name: str, day: np.datetime64) -> Chain:
        """Return the chain of the certified tables of a name that began before a day."""
        begin, _ = day_bounds(day)
        found = [
            (start, one.id, one)
            for one in cat.tables(name)
            for context, start, _ in one.certified
            if context is None and start < begin and not one.damaged
        ]
        keys: list[str] = []
        tables: list[xr.Dataset] = []
        for _, _, one in sorted(found, key=lambda each: each[:2], reverse=True):
            table = cat.table_by_id(one.id)
            if table.sizes["state"]:
                keys.append(one.key)
                tables.append(table)
            if len(keys) == OFFERED:
                break
        return cls(keys, tables)

    def add(self, key: str, table: xr.Dataset) -> None:
        """Put the next window's joined table in front; one without states tells the next ones nothing."""
        if table.sizes["state"]:
            self.keys[:] = [key, *self.keys[: OFFERED - 1]]
            self.tables[:] = [table, *self.tables[: OFFERED - 1]]

    def add_unknown(self, key: str) -> None:
        """Put a key in front whose table is still to be made."""
        self.keys[:] = [key, *self.keys[: OFFERED - 1]]


def joined(before: Sequence[xr.Dataset], table: xr.Dataset) -> xr.Dataset:
    """Return a window's table that goes on from one of those before it.

    Parameters
    ----------
    before : sequence of Dataset
        Joined themselves, the newest first; the chain begins here without any. Those whose correction is
        applied come first: a window that was left alone may have learnt little, and its constant is in no
        product. Of these the newest with which the constant goes on is taken.
    table : Dataset
        As it was learnt, or joined to any other.

    Returns
    -------
    Dataset
        Numbers and constant part of `inflight.dual.tracking.continue_training`. Of states that both windows
        know `change` and `change_sigma` (state, axis) tell how the outboard correction changed beside what
        all have in common, nT, and `aged` (state,) where that is more than noise. Attribute `goes_on` is
        ``yes`` or ``no``.
    """
    later = training_from_dataset(table)
    bare = table.drop_vars([name for name in _CHANGES if name in table])
    bare.attrs.pop("table_id", None)
    known = [(one, training_from_dataset(one)) for one in before if one.sizes["state"]]
    if not known or not len(later):
        return _with_training(bare, standalone_training(later), "no")
    going = _continued(known, later)
    told = _with_training(bare, going.training, "yes" if len(going.matched) else "no")
    return told.assign(_changes(going))


def _continued(known: Sequence[tuple[xr.Dataset, Training]], later: Training) -> ContinuedTraining:
    """Return how a window goes on from the best of those before it."""
    # A number that any window before has given is given to nothing else.
    number = max(one.next_number for _, one in known)
    unit = max(one.next_unit for _, one in known)
    order = sorted(known, key=lambda one: str(one[0].attrs.get("applied")) != "yes")
    tried: list[ContinuedTraining] = []
    for _, earlier in order:
        going = continue_training(replace(earlier, next_number=number, next_unit=unit), later)
        if _keeps_constant(earlier, going):
            return going
        tried.append(going)
    return next((one for one in tried if len(one.matched)), tried[0])


def _keeps_constant(earlier: Training, going: ContinuedTraining) -> bool:
    """Return True when the constant part of the correction is that of the window before."""
    if not len(going.matched):
        return False
    if going.training.constant_known:
        return True
    return not earlier.constant_known and going.training.reference == earlier.reference


def _with_training(table: xr.Dataset, training: Training, goes_on: str) -> xr.Dataset:
    fresh = training_to_dataset(training)
    return table.assign(fresh.data_vars).assign_attrs({**fresh.attrs, "goes_on": goes_on})


def _changes(going: ContinuedTraining) -> dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]]:
    count = len(going.training)
    change, sigma, aged = np.full((count, 3), np.nan), np.full((count, 3), np.nan), np.zeros(count, np.int64)
    rows = going.matched[:, 1]
    change[rows], sigma[rows], aged[rows] = going.change, going.sigma, going.aged
    both = ("state", "axis")
    return {
        "change": (both, change, {"units": "nT"}),
        "change_sigma": (both, sigma, {"units": "nT"}),
        "aged": (("state",), aged, {}),
    }


#: What the gradiometer takes off in each state of its window, nT.
IN_STATES = "gradiometer_in_states"

#: What is said of the constant part of a field.
MEASURED, ABSOLUTE = "as measured", "absolute"


def gradiometer_in_states(table: xr.Dataset, readings: Readings) -> xr.Dataset:
    """Return a table with what its gradiometer takes off in each of its states; (state, axis), nT.

    Parameters
    ----------
    table : Dataset
        With states and a gradiometer.
    readings : Readings
        Those it was learnt from.

    Returns
    -------
    Dataset
        With variable `gradiometer_in_states`, NaN for states in which no sample surely is.
    """
    training = training_from_dataset(table)
    mean = np.full((len(training), 3), np.nan)
    if len(training) and readings.good.any():
        taken = correction_by_stored_gradiometer(table, readings)
        states = correction_by_states(readings, training)
        sure = taken.known & (states.probability >= ASSIGNMENT.least_probability)
        for row, number in enumerate(training.number.tolist()):
            inside = sure & (states.state == number)
            if inside.any():
                mean[row] = taken.field[inside].mean(axis=0)
    return table.assign({IN_STATES: (("state", "axis"), mean, {"units": "nT"})})


def gradiometer_with_states(table: xr.Dataset, readings: Readings) -> Correction:
    """Return the correction by a table's gradiometer, with the constant part and the numbers of its states.

    The field is the gradiometer's; flags about states do not concern it. Where only what is quick will be
    taken off, the error of the constant is none of its own.
    """
    found = correction_by_stored_gradiometer(table, readings)
    training = training_from_dataset(table)
    if not len(training) or not readings.good.any():
        return found
    states = correction_by_states(readings, training)
    told = replace(found, state=states.state, probability=states.probability)
    constant = _constant(table)
    if constant is None:
        return told
    value, sigma = constant
    return replace(
        told,
        field=told.field + value,
        covariance=told.covariance + (not omits_slow_part(table)) * np.diag(sigma**2),
        constant_known=training.constant_known,
    )


def constant_part(table: xr.Dataset) -> Floats:
    """Return the constant that a table's correction has, nT, but for one that is always the same; (axis,).

    It moves when the window is joined to those before it.
    """
    if str(table.attrs["method"]) == "gradiometer":
        constant = _constant(table)
        return np.zeros(3) if constant is None else constant[0]
    training = training_from_dataset(table)
    # All states move alike.
    return training.correction[0] if len(training) else np.zeros(3)


def constant_of(table: xr.Dataset) -> str:
    """Return what the constant part of the field is that a table makes: where it changes the field may step.

    Returns
    -------
    str
        ``as measured`` where nothing is taken off, or only what changes quickly; ``absolute`` where the
        ambient field was known,
        ``relative to state N``, or ``that of the window from DAY alone`` where a gradiometer has no state
        to go by.
    """
    if str(table.attrs["applied"]) != "yes" or omits_slow_part(table):
        return MEASURED
    if str(table.attrs["method"]) == "gradiometer" and _constant(table) is None:
        return f"that of the window from {day_of(int(table['start']))!s:.10} alone"
    if table.attrs["constant_known"]:
        return ABSOLUTE
    return f"relative to state {int(table.attrs['reference'])}"


def constant_changes(constants: Mapping[np.datetime64, str]) -> list[dict[str, str]]:
    """Return where the constant part of the field becomes another: fields ``day``, ``before``, ``after``.

    Parameters
    ----------
    constants : mapping of day to str
        As `constant_of` tells.
    """
    days = sorted(constants)
    return [
        {"day": str(day), "before": constants[last], "after": constants[day]}
        for last, day in pairwise(days)
        if constants[last] != constants[day]
    ]


def constant_sentences(changes: Sequence[Mapping[str, str]]) -> list[str]:
    """Return in words where the field may step by a constant."""
    return [
        f"at the beginning of {one['day']} the field may step by a constant: before it is {one['before']}, "
        f"from then on {one['after']}"
        for one in changes
    ]


def _constant(table: xr.Dataset) -> tuple[Floats, Floats] | None:
    """Return what is added to the gradiometer's correction, and its standard deviation; (axis,), nT.

    Each state says how far its correction is from what the gradiometer takes off there: the mean by their
    errors. What all states have in common does not average out: the error is that of one state, or by how
    much they differ where that is more.
    """
    if IN_STATES not in table:
        return None
    taken = np.asarray(table[IN_STATES].values)
    seen = np.flatnonzero(np.isfinite(taken).all(axis=1))
    if not seen.size:
        return None
    training = training_from_dataset(table)
    centre, seconds = training.centre[seen], np.maximum(training.seconds[seen], 1.0)
    away = centre - np.average(centre, axis=0, weights=seconds)
    spread = training.covariance[seen] + covariance_of_product(
        gradiometer_from_dataset(table).covariance, away
    )
    variance = np.einsum("sii->si", spread) + training.scatter**2 + 1e-12
    weight = 1.0 / variance
    weight /= weight.sum(axis=0)
    apart = training.correction[seen] - taken[seen]
    value = np.sum(weight * apart, axis=0)
    scatter = np.sum(weight * (apart - value) ** 2, axis=0)
    return value, np.sqrt(np.maximum(np.sum(weight * variance, axis=0), scatter))


#: A reading is this many of its cadences away from a switching at most.
_NEAR = 2.5


def unit_signs(table: xr.Dataset, at: Switchings) -> Floats:
    """Return which units are switched on (+1) or off (-1) at each switching; (switching, number of unit).

    Nothing is known of switchings to or from a state that is not in the table: 0.
    """
    member = np.asarray(table["occupancy"].values, dtype=np.float64)
    number = np.asarray(table["number"].values, dtype=np.int64)
    units = np.asarray(table["unit_number"].values, dtype=np.int64)
    out = np.zeros((len(at), int(units.max(initial=-1)) + 1))
    if not number.size:
        return out
    order = np.argsort(number)
    rows = [
        order[np.clip(np.searchsorted(number, state, sorter=order), 0, number.size - 1)]
        for state in (at.before, at.after)
    ]
    known = (number[rows[0]] == at.before) & (number[rows[1]] == at.after)
    step = member[rows[1][known]] - member[rows[0][known]]
    out[np.ix_(known, units)] = step
    return out


def joined_signs(signs: Sequence[Floats]) -> Floats:
    """Return `unit_signs` of several days together; days that do not know the last units have zeros."""
    width = max(one.shape[1] for one in signs)
    return np.concatenate([np.pad(one, ((0, 0), (0, width - one.shape[1]))) for one in signs])


def housekeeping_channels(mission: Mission) -> dict[str, tuple[str, str]]:
    """Return the housekeeping channels of one number a time: name -> (instrument, channel)."""
    return {
        name: (home, channel)
        for name, (home, channel, _) in scalar_channels(mission).items()
        if mission.instruments[home].role == "housekeeping"
        and not mission.instruments[home].channels[channel].axis_names
    }


def channel_changes(
    cat: Catalog, mission: Mission, day: np.datetime64, before: Int64, after: Int64
) -> dict[str, Floats]:
    """Return how housekeeping changed across switchings of a day.

    Parameters
    ----------
    before, after : ndarray of int64, shape (switching,)
        TT2000 of the last sample before and of the first one after each.

    Returns
    -------
    dict of str to ndarray, shape (switching,)
        The first reading after less the last one before, in the channel's unit; NaN where one is far.
    """
    out: dict[str, Floats] = {}
    wanted = housekeeping_channels(mission)
    for instrument in dict.fromkeys(home for home, _ in wanted.values()):
        names = {name: channel for name, (home, channel) in wanted.items() if home == instrument}
        found = [
            one
            for one in cat.days(
                f"l1/{instrument}", slice(str(day), str(day + np.timedelta64(1, "D"))), states=("published",)
            )
            if one.day == day
        ]
        if not found:
            continue
        data = cat.read(found[0], list(names.values()), with_time=False)
        stamps = np.asarray(data["tt2000"].values, dtype=np.int64)
        reach = _NEAR * mission.instruments[instrument].cadence
        for name, channel in names.items():
            values = np.asarray(data[channel].values, dtype=np.float64)
            out[name] = _change(
                stamps[np.isfinite(values)], values[np.isfinite(values)], before, after, reach
            )
    return out


def _change(stamps: Int64, values: Floats, before: Int64, after: Int64, reach: float) -> Floats:
    if not stamps.size:
        return np.full(before.size, np.nan)
    left = np.searchsorted(stamps, before, side="right") - 1
    right = np.searchsorted(stamps, after, side="left")
    inside = (left >= 0) & (right < stamps.size)
    left, right = np.clip(left, 0, None), np.clip(right, None, stamps.size - 1)
    near = inside & (before - stamps[left] <= reach) & (stamps[right] - after <= reach)
    return np.where(near, values[right] - values[left], np.nan)


def named_units(
    cat: Catalog, mission: Mission, comparison: str, start: DayLike | None, end: DayLike | None
) -> list[dict[str, Any]] | None:
    """Return the units of the span's states and the channels behind them, as plain fields.

    None of a comparison without products. Units without a channel are told as such.
    """
    span = slice(str(start) if start is not None else None, str(end) if end is not None else None)
    days = cat.days(product_of(comparison), span, states=("published",))
    if not days:
        return None
    signs, changes = [], []
    tables: dict[int, xr.Dataset] = {}
    for day in days:
        product = cat.read(day, ["state", "tt2000"], with_time=False)
        stamps = np.asarray(product["tt2000"].values, dtype=np.int64)
        state = np.asarray(product["state"].values, dtype=np.int64)
        at = switchings(state, stamps, usual_step(stamps, SECOND))
        table = cat.table(f"{comparison}-states", str(day.day))
        tables |= dict.fromkeys(table["unit_number"].values.tolist(), table)
        signs.append(unit_signs(table, at))
        changes.append(channel_changes(cat, mission, day.day, stamps[at.last], stamps[at.first]))
    joined = joined_signs(signs)
    names = sorted({name for one in changes for name in one})
    series = {
        name: np.concatenate(
            [one.get(name, np.full(len(sign), np.nan)) for one, sign in zip(changes, signs, strict=True)]
        )
        for name in names
    }
    return [
        _told(one, tables[one.unit]) for one in match_channels_to_units(joined, series) if one.unit in tables
    ]


def _told(one: UnitChannels, table: xr.Dataset) -> dict[str, Any]:
    """Return a unit's fields; its vectors are those of the last table that knows it."""
    fields = {
        "unit": one.unit,
        "switchings": one.switchings,
        "channels": list(one.channels),
        "agreement": list(one.agreement),
        "change_when_on": list(one.per_unit),
        "sentence": sentence(one),
    }
    (row,) = np.flatnonzero(table["unit_number"].values == one.unit)
    for name, variable in (("difference_nT", "unit"), ("outboard_nT", "unit_correction")):
        fields[name] = table[variable].values[row].tolist()
    return fields


def sentence(one: UnitChannels) -> str:
    """Return what is known of a unit in words."""
    begin = f"unit {one.unit}, seen to switch {one.switchings} times"
    if not one.channels:
        return f"{begin}, is a unit without housekeeping: {one.reason}"
    if len(one.channels) > 1:
        return f"{begin}, switches with {' and '.join(one.channels)}: these cannot be told apart"
    return f"{begin}, switches with {one.channels[0]} ({100.0 * one.agreement[0]:.0f} % of the changes)"


#: Said of sensors of which the outer one sees more of the spacecraft.
SWAPPED = "the sensor called outboard sees more of the spacecraft's field than the one called inboard"

_REMEDY = "look whether the mission's file has the two sensors exchanged"

#: A unit counts that moves the outboard sensor by so many errors, and the larger side is so much larger.
_CLEAR, _LARGER = 4.0, 1.5


def with_remark(table: xr.Dataset) -> xr.Dataset:
    """Return a table with attribute `remark`: empty, or what is strange about its readings."""
    return table.assign_attrs(remark=SWAPPED if _looks_swapped(table) else "")


def _looks_swapped(table: xr.Dataset) -> bool:
    """Return True when what switches adds more to the outer than to the inner sensor."""
    for outer, apart, covariance in _steps(table):
        inner = outer + apart
        variance = np.einsum("uii->ui", covariance)
        clear = (np.abs(outer) > _CLEAR * np.sqrt(np.clip(variance, 0.0, None))).any(axis=1)
        if clear.any():
            return float(np.linalg.norm(outer[clear])) > _LARGER * float(np.linalg.norm(inner[clear]))
    if has_gradiometer(table) and str(table.attrs["method"]) == "gradiometer":
        matrix = gradiometer_from_dataset(table).matrix
        return float(np.linalg.norm(matrix)) > _LARGER * float(np.linalg.norm(matrix + np.eye(3)))
    return False


def _steps(table: xr.Dataset) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Give what units, then states, add to the outer sensor and to the difference, and the error."""
    names = ("unit_correction", "unit", "unit_covariance"), ("correction", "centre", "covariance")
    for place, (outer, apart, covariance) in enumerate(names):
        value, difference = (np.asarray(table[one].values) for one in (outer, apart))
        if place and len(value):
            longest = int(np.argmax(table["seconds"].values))
            value, difference = value - value[longest], difference - difference[longest]
        yield value, difference, np.asarray(table[covariance].values)


def remarks_of(tables: Mapping[np.datetime64, UsedTable]) -> list[dict[str, str]]:
    """Return the remarks of the tables that hold, as problems of days that are there all the same."""
    seen: dict[int, dict[str, Any]] = {}
    for day in sorted(tables):
        number, _, table = tables[day]
        if table.attrs.get("remark"):
            seen.setdefault(
                number,
                {
                    "day": str(day),
                    "channel": "",
                    "cause": "partial",
                    "remedy": _REMEDY,
                    "message": str(table.attrs["remark"]),
                },
            )
    return list(seen.values())
