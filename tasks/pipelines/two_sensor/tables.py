"""Tables of states across windows: numbers that run on, the constant part, units and channels.

Each window is fitted by itself, in any order. Afterwards its table continues one of those before it
(`continue_table`, `inflight.dual.tracking`), so that the same state and unit have one number in all of them.
When a window changes, only that window is fitted again; those behind it are continued anew. A window with few
states does not end the sequence: the next one may continue one before that.

The constant part (`describe_constant`): corrections by states are relative to one state, and windows that
know it continue each other. A gradiometer is determined from changes alone, and its constant is arbitrary: it
is set to that of the states of the same window, so that the field does not step where one method follows the
other.

`named_units` finds the housekeeping channel that switches with each unit. `with_remark` notes sensors that
look exchanged.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.dual import (
    ASSIGNMENT_SETTINGS,
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
from inflight.tasks.archive import partial_problem
from inflight.tasks.pipelines.base import UsedTable, product_of, scalar_channels
from inflight.time import SECOND, DayLike, Int64, day_bounds, day_of, usual_step

#: Characters of a key that depend on a window's own inputs; the others depend on the windows before it.
OWN_KEY = 32


@dataclass(frozen=True, kw_only=True)
class StateTableSettings:
    """Numbers of tables of states across windows.

    Attributes
    ----------
    most_before : int
        So many windows before it a window may continue. Assumed.
    near_cadences : float
        A reading of housekeeping is this many of its cadences away from a switching at most. Assumed.
    clear_sigmas : float
        A unit counts in `with_remark` when it changes the outboard reading by so many sigmas. Assumed.
    exchanged_ratio : float
        Sensors look exchanged when the outboard one sees so much more of the units. Assumed.
    """

    most_before: int = 5
    near_cadences: float = 2.5
    clear_sigmas: float = 4.0
    exchanged_ratio: float = 1.5


STATE_TABLE_SETTINGS = StateTableSettings()

_CHANGES = ("change", "change_sigma", "aged")


def continued_key(own: str, before: Sequence[str]) -> str:
    """Return the key of a continued table, from that of its own inputs and those of the tables before it."""
    content = "".join([own, *before])
    return own[:OWN_KEY] + hashlib.sha256(content.encode()).hexdigest()[: 64 - OWN_KEY]


@dataclass
class TablesBefore:
    """The tables that the next window may continue.

    Attributes
    ----------
    keys : list of str
        Of tables with states, the newest first.
    tables : list of Dataset
    """

    keys: list[str] = field(default_factory=list)
    tables: list[xr.Dataset] = field(default_factory=list)

    @classmethod
    def of_day(cls, cat: Catalog, name: str, day: np.datetime64) -> TablesBefore:
        """Return the certified tables of a name that began before a day."""
        begin, _ = day_bounds(day)
        found = [
            (start, record.id, record)
            for record in cat.tables(name)
            for context, start, _ in record.certified
            if context is None and start < begin and not record.damaged
        ]
        out = cls()
        for _, number, record in sorted(found, key=lambda one: one[:2], reverse=True):
            table = cat.table_by_id(number)
            if table.sizes["state"]:
                out.keys.append(record.key)
                out.tables.append(table)
            if len(out.keys) == STATE_TABLE_SETTINGS.most_before:
                break
        return out

    def add(self, key: str, table: xr.Dataset) -> None:
        """Put the next window's continued table in front; one without states is nothing to continue."""
        if table.sizes["state"]:
            self.add_key(key)
            self.tables[:] = [table, *self.tables[: STATE_TABLE_SETTINGS.most_before - 1]]

    def add_key(self, key: str) -> None:
        """Put the key in front of a table that is still to be made."""
        self.keys[:] = [key, *self.keys[: STATE_TABLE_SETTINGS.most_before - 1]]


def continue_table(before: Sequence[xr.Dataset], table: xr.Dataset) -> xr.Dataset:
    """Return a window's table with the numbers and the constant part of one of those before it.

    Parameters
    ----------
    before : sequence of Dataset
        Continued themselves, the newest first; without any, the sequence begins here. Those whose correction
        is applied come first: a window that is not corrected may have few states, and its constant is in no
        product. Of these the newest is taken with which the constant part stays the same.
    table : Dataset
        As it was fitted, or continued from any other.

    Returns
    -------
    Dataset
        Numbers and constant part of `inflight.dual.tracking.continue_training`. Of states that both windows
        know: `change` and `change_sigma` (state, axis), nT, by how much the outboard correction changed
        beyond what all have in common, and `aged` (state,) where that is more than noise. Attribute `goes_on`
        is ``yes`` or ``no``.
    """
    later = training_from_dataset(table)
    bare = table.drop_vars([name for name in _CHANGES if name in table])
    bare.attrs.pop("table_id", None)
    known = [(one, training_from_dataset(one)) for one in before if one.sizes["state"]]
    if not known or not len(later):
        return _with_training(bare, standalone_training(later), "no")
    ageing = _best_continuation(known, later)
    change, sigma = np.full((2, len(ageing.training), 3), np.nan)
    aged, rows = np.zeros(len(ageing.training), np.int64), ageing.matched[:, 1]
    change[rows], sigma[rows], aged[rows] = ageing.change, ageing.sigma, ageing.aged
    continued = _with_training(bare, ageing.training, "yes" if len(ageing.matched) else "no")
    return continued.assign(
        change=(("state", "axis"), change, {"units": "nT"}),
        change_sigma=(("state", "axis"), sigma, {"units": "nT"}),
        aged=("state", aged),
    )


def _best_continuation(known: Sequence[tuple[xr.Dataset, Training]], later: Training) -> ContinuedTraining:
    """Return how a window continues the best of those before it."""
    # A number that any window before has given is given to nothing else.
    number = max(training.next_number for _, training in known)
    unit = max(training.next_unit for _, training in known)
    tried: list[ContinuedTraining] = []
    for _, earlier in sorted(known, key=lambda one: str(one[0].attrs.get("applied")) != "yes"):
        ageing = continue_training(replace(earlier, next_number=number, next_unit=unit), later)
        training = ageing.training
        same_reference = not earlier.constant_known and training.reference == earlier.reference
        if len(ageing.matched) and (training.constant_known or same_reference):
            return ageing
        tried.append(ageing)
    return next((ageing for ageing in tried if len(ageing.matched)), tried[0])


def _with_training(table: xr.Dataset, training: Training, goes_on: str) -> xr.Dataset:
    """Return a table whose states and units are those of a training."""
    stored = training_to_dataset(training)
    return table.assign(stored.data_vars).assign_attrs({**stored.attrs, "goes_on": goes_on})


#: What the gradiometer takes off in each state of its window, nT.
IN_STATES = "gradiometer_in_states"

#: Descriptions of the constant part of a field; see `describe_constant`.
MEASURED, ABSOLUTE = "as measured", "absolute"


def gradiometer_in_states(table: xr.Dataset, readings: Readings) -> xr.Dataset:
    """Return a table with what its gradiometer takes off in each of its states; (state, axis), nT.

    Parameters
    ----------
    table : Dataset
        With states and a gradiometer.
    readings : Readings
        Those it was fitted to.

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
        sure = taken.known & (states.probability >= ASSIGNMENT_SETTINGS.least_probability)
        for row, number in enumerate(training.number.tolist()):
            inside = sure & (states.state == number)
            if inside.any():
                mean[row] = taken.field[inside].mean(axis=0)
    return table.assign({IN_STATES: (("state", "axis"), mean, {"units": "nT"})})


def gradiometer_with_states(table: xr.Dataset, readings: Readings) -> Correction:
    """Return the correction by a table's gradiometer, with the constant part and the numbers of its states.

    The field is the gradiometer's; flags about states do not concern it. Where only quick changes are taken
    off, the error of the constant is not part of its covariance.
    """
    found = correction_by_stored_gradiometer(table, readings)
    training = training_from_dataset(table)
    if not len(training) or not readings.good.any():
        return found
    states = correction_by_states(readings, training)
    found = replace(found, state=states.state, probability=states.probability)
    constant = _constant(table)
    if constant is None:
        return found
    value, sigma = constant
    return replace(
        found,
        field=found.field + value,
        covariance=found.covariance + (not omits_slow_part(table)) * np.diag(sigma**2),
        constant_known=training.constant_known,
    )


def constant_part(table: xr.Dataset) -> Floats:
    """Return the constant that a table's correction has, nT, but for one that is always the same; (axis,).

    It changes when the window continues one before it.
    """
    if str(table.attrs["method"]) == "gradiometer":
        constant = _constant(table)
        return np.zeros(3) if constant is None else constant[0]
    training = training_from_dataset(table)
    # The constant is that of every state.
    return training.correction[0] if len(training) else np.zeros(3)


def describe_constant(table: xr.Dataset) -> str:
    """Describe the constant part of the field that a table makes: where it changes, the field may step.

    Returns
    -------
    str
        ``as measured`` where nothing is taken off, or only what changes quickly; ``absolute`` where the
        ambient field was known, ``relative to state N``, or ``that of the window from DAY alone`` where a
        gradiometer has no state.
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
        As `describe_constant` returns them.
    """
    days = sorted(constants)
    return [
        {"day": str(day), "before": constants[last], "after": constants[day]}
        for last, day in pairwise(days)
        if constants[last] != constants[day]
    ]


def constant_sentences(changes: Sequence[Mapping[str, str]]) -> list[str]:
    """Return a sentence for each time at which the field may step by a constant."""
    return [
        f"at the beginning of {one['day']} the field may step by a constant: before it is {one['before']}, "
        f"from then on {one['after']}"
        for one in changes
    ]


def _constant(table: xr.Dataset) -> tuple[Floats, Floats] | None:
    """Return what is added to the gradiometer's correction, and its standard deviation; (axis,), nT.

    It is the weighted mean, over states, of a state's correction less what the gradiometer takes off there.
    What all states have in common does not average out: the error is that of one state, or the scatter of the
    states where that is larger.
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


def unit_signs(table: xr.Dataset, at: Switchings) -> Floats:
    """Return which units are switched on (+1) or off (-1) at each switching; (switching, number of unit).

    Switchings to or from a state that is not in the table have 0.
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


def concatenate_signs(signs: Sequence[Floats]) -> Floats:
    """Return `unit_signs` of several days together; days that do not know the last units have zeros."""
    width = max(one.shape[1] for one in signs)
    return np.concatenate([np.pad(one, ((0, 0), (0, width - one.shape[1]))) for one in signs])


def concatenate_changes(changes: Sequence[Mapping[str, Floats]], counts: Sequence[int]) -> dict[str, Floats]:
    """Return `channel_changes` of days of so many switchings together; NaN on days without a channel."""
    return {
        name: np.concatenate(
            [one.get(name, np.full(count, np.nan)) for one, count in zip(changes, counts, strict=True)]
        )
        for name in sorted({name for one in changes for name in one})
    }


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
    channels, span = housekeeping_channels(mission), slice(str(day), str(day + np.timedelta64(1, "D")))
    for instrument in dict.fromkeys(home for home, _ in channels.values()):
        names = {name: channel for name, (home, channel) in channels.items() if home == instrument}
        published = cat.days(f"l1/{instrument}", span, states=("published",))
        source = next((one for one in published if one.day == day), None)
        if source is None:
            continue
        data = cat.read(source, list(names.values()), with_time=False)
        stamps = np.asarray(data["tt2000"].values, dtype=np.int64)
        reach = STATE_TABLE_SETTINGS.near_cadences * mission.instruments[instrument].cadence
        for name, channel in names.items():
            values = np.asarray(data[channel].values, dtype=np.float64)
            known = np.isfinite(values)
            out[name] = _change_across(stamps[known], values[known], before, after, reach)
    return out


def _change_across(stamps: Int64, values: Floats, before: Int64, after: Int64, reach: float) -> Floats:
    """Return the first value after less the last one before each switching; NaN beyond `reach`, ns."""
    if not stamps.size:
        return np.full(before.size, np.nan)
    last = np.searchsorted(stamps, before, side="right") - 1
    first = np.searchsorted(stamps, after, side="left")
    inside = (last >= 0) & (first < stamps.size)
    last, first = np.clip(last, 0, None), np.clip(first, None, stamps.size - 1)
    near = inside & (before - stamps[last] <= reach) & (stamps[first] - after <= reach)
    return np.where(near, values[first] - values[last], np.nan)


def named_units(
    cat: Catalog, mission: Mission, comparison: str, start: DayLike | None, end: DayLike | None
) -> list[dict[str, Any]] | None:
    """Return the units of the span's states and the channels behind them, as plain fields.

    None for a comparison without products. Units without a channel are marked as such.
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
    series = concatenate_changes(changes, [len(one) for one in signs])
    out = []
    for unit in match_channels_to_units(concatenate_signs(signs), series):
        # The vectors are those of the last table that knows the unit.
        if unit.unit not in tables:
            continue
        table = tables[unit.unit]
        (row,) = np.flatnonzero(table["unit_number"].values == unit.unit)
        out.append(
            {
                "unit": unit.unit,
                "switchings": unit.switchings,
                "channels": list(unit.channels),
                "agreement": list(unit.agreement),
                "change_when_on": list(unit.per_unit),
                "sentence": describe_unit(unit),
                "difference_nT": table["unit"].values[row].tolist(),
                "outboard_nT": table["unit_correction"].values[row].tolist(),
            }
        )
    return out


def describe_unit(unit: UnitChannels) -> str:
    """Return a sentence about a unit and the channels that switch with it."""
    begin = f"unit {unit.unit}, seen to switch {unit.switchings} times"
    if not unit.channels:
        return f"{begin}, is a unit without housekeeping: {unit.reason}"
    if len(unit.channels) > 1:
        return f"{begin}, switches with {' and '.join(unit.channels)}: these cannot be told apart"
    return f"{begin}, switches with {unit.channels[0]} ({100.0 * unit.agreement[0]:.0f} % of the changes)"


#: Remark on sensors of which the outboard one sees more of the spacecraft.
EXCHANGED = "the sensor called outboard sees more of the spacecraft's field than the one called inboard"

_REMEDY = "look whether the mission's file has the two sensors exchanged"


def with_remark(table: xr.Dataset) -> xr.Dataset:
    """Return a table with attribute `remark`: empty, or what is strange about its readings."""
    return table.assign_attrs(remark=EXCHANGED if _looks_exchanged(table) else "")


def _looks_exchanged(table: xr.Dataset) -> bool:
    """Return True when what switches adds more to the outer than to the inner sensor."""
    ratio = STATE_TABLE_SETTINGS.exchanged_ratio
    # What units, then states less the longest one, add to the outboard sensor and to the difference.
    names = ("unit_correction", "unit", "unit_covariance"), ("correction", "centre", "covariance")
    for place, (correction, centre, covariance) in enumerate(names):
        outer, difference = (np.asarray(table[name].values) for name in (correction, centre))
        if place and len(outer):
            longest = int(np.argmax(table["seconds"].values))
            outer, difference = outer - outer[longest], difference - difference[longest]
        inner = outer + difference
        variance = np.einsum("uii->ui", np.asarray(table[covariance].values))
        sigma = np.sqrt(np.clip(variance, 0.0, None))
        clear = (np.abs(outer) > STATE_TABLE_SETTINGS.clear_sigmas * sigma).any(axis=1)
        if clear.any():
            return float(np.linalg.norm(outer[clear])) > ratio * float(np.linalg.norm(inner[clear]))
    if has_gradiometer(table) and str(table.attrs["method"]) == "gradiometer":
        matrix = gradiometer_from_dataset(table).matrix
        return float(np.linalg.norm(matrix)) > ratio * float(np.linalg.norm(matrix + np.eye(3)))
    return False


def remarks_of(tables: Mapping[np.datetime64, UsedTable]) -> list[dict[str, str]]:
    """Return the remarks of the tables in use, as problems of days that have products all the same."""
    seen: dict[int, dict[str, str]] = {}
    for day in sorted(tables):
        number, _, table = tables[day]
        if table.attrs.get("remark"):
            seen.setdefault(number, partial_problem(day, str(table.attrs["remark"]), _REMEDY))
    return list(seen.values())
