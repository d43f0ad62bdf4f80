"""The units of a table of states beside housekeeping: which channel switches with which unit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.dual.naming import NamedUnit, name_units
from inflight.dual.residual_steps import Switchings, switchings
from inflight.mission import Mission
from inflight.tasks.compare_rows import scalar_channels
from inflight.tasks.planning import product_of
from inflight.tasks.reprocess_dual import dual_comparisons, is_calibrated_apart
from inflight.time import SECOND, DayLike, Int64, usual_step

#: A reading is this many of its cadences away from a switching at most.
_NEAR = 2.5


def is_told_by_states(mission: Mission, comparison: str) -> bool:
    """Return True for two sensors on one boom that no scalar sensor calibrates."""
    return comparison in dual_comparisons(mission) and not is_calibrated_apart(mission, comparison)


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


def housekeeping(mission: Mission) -> dict[str, tuple[str, str]]:
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
    wanted = housekeeping(mission)
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
        data = cat.read(found[0], list(names.values()), dated=False)
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

    None of a comparison without products of states. Units without a channel are told as such.
    """
    if not is_told_by_states(mission, comparison):
        return None
    span = slice(str(start) if start is not None else None, str(end) if end is not None else None)
    days = cat.days(product_of(comparison), span, states=("published",))
    if not days:
        return None
    signs, changes = [], []
    tables: dict[int, xr.Dataset] = {}
    for day in days:
        product = cat.read(day, ["state", "tt2000"], dated=False)
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
    return [_told(one, tables[one.unit]) for one in name_units(joined, series) if one.unit in tables]


def _told(one: NamedUnit, table: xr.Dataset) -> dict[str, Any]:
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


def sentence(one: NamedUnit) -> str:
    """Return what is known of a unit in words."""
    begin = f"unit {one.unit}, seen to switch {one.switchings} times"
    if not one.channels:
        return f"{begin}, is a unit without housekeeping: {one.reason}"
    if len(one.channels) > 1:
        return f"{begin}, switches with {' and '.join(one.channels)}: these cannot be told apart"
    return f"{begin}, switches with {one.channels[0]} ({100.0 * one.agreement[0]:.0f} % of the changes)"
