"""Compare the corrected field of two sensors with the measured one: by how far it steps at switchings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog, Day
from inflight.dual.residual_steps import (
    Remaining,
    Switchings,
    by_state,
    quiet_steps,
    quietest_width,
    regressed,
    rms,
    steps_across,
    switchings,
)
from inflight.errors import CatalogError
from inflight.mission import Mission
from inflight.tasks.compare_dual_page import states_parts, told_of_day, verdict_told
from inflight.tasks.compare_page import Compared
from inflight.tasks.compare_rows import scalar_channels
from inflight.tasks.planning import product_of
from inflight.tasks.report import Progress
from inflight.tasks.states_constant import constant_changes
from inflight.tasks.states_units import channel_changes, joined_signs, unit_signs
from inflight.time import SECOND, DayLike, Int64, usual_step

#: Points of a curve that a browser can draw.
_POINTS = 20_000
#: Said where nothing switched.
_NO_SWITCHING = "nothing switched in the span, so that its steps tell nothing of the correction"


@dataclass(frozen=True)
class Stretches:
    """Stretches of one state.

    Attributes
    ----------
    begin, end : ndarray of int64, shape (stretch,)
        TT2000; a stretch ends one step after its last sample.
    state : ndarray of int64, shape (stretch,)
    probability : ndarray, shape (stretch,)
    difference : ndarray, shape (stretch, axis)
        Mean ``B_in - B_out``, nT; NaN without a reading.
    """

    begin: Int64
    end: Int64
    state: Int64
    probability: Floats
    difference: Floats


@dataclass(frozen=True)
class DualDayRows:
    """What a comparison keeps of a day: its switchings, its stretches, a thin series."""

    day: Day
    method: str
    applied: str
    reason: str
    constant: str
    at: Switchings
    before: Floats
    after: Floats
    quiet: Floats
    difference: Floats
    signs: Floats
    changes: Mapping[str, Floats]
    stretches: Stretches
    stamps: Int64
    outboard: Floats
    field: Floats


@dataclass
class DualCompareReport:
    """What `compare_dual` found.

    Attributes
    ----------
    tables : list of Dataset
        Tables of states that hold in the span, each once, oldest first.
    path : Path, optional
        Of the page, when one was written.
    """

    comparison: str
    context: str
    days: list[DualDayRows]
    fails_where: list[tuple[Remaining, str]]
    tables: list[xr.Dataset]
    path: Path | None = None

    def joined(self, name: str) -> Floats:
        """Return an array of all days, (switching, axis)."""
        return np.concatenate([getattr(one, name) for one in self.days])

    @property
    def signs(self) -> Floats:
        """Which units are switched at each switching of all days; (switching, number of unit)."""
        return joined_signs([one.signs for one in self.days])

    @property
    def constants(self) -> list[dict[str, str]]:
        """Where the constant part of the field becomes another."""
        return constant_changes({one.day.day: one.constant for one in self.days})

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON; a residual is a step's rms component, nT."""
        before, after, floor = (rms(self.joined(name)) for name in ("before", "after", "quiet"))
        known = bool(np.isfinite(before))
        return {
            "command": "compare",
            "run": "",
            "context": self.context,
            "comparison": self.comparison,
            "kind": "dual",
            "residual": {
                "what": "step of the outboard field where the spacecraft switches, rms of a component",
                "before_nT": before,
                "after_nT": after,
                "noise_floor_nT": floor,
                "switchings": int(sum(len(one.at) for one in self.days)),
                "note": "" if known else _NO_SWITCHING,
            },
            "by_day": [told_of_day(one) for one in self.days],
            "fails_where": [
                {
                    "coordinate": one.coordinate,
                    "amplitude_nT": float(np.abs(one.value).max()),
                    "sigma_nT": float(one.sigma[np.argmax(np.abs(one.value))]),
                    "sentence": one.told(unit),
                }
                for one, unit in self.fails_where
            ],
            "constant_changes": self.constants,
            "verdict": {
                "applied": sorted({one.applied for one in self.days}),
                "reasons": sorted({one.reason for one in self.days if one.reason}),
                "told": verdict_told(self),
            },
            "path": str(self.path) if self.path else "",
        }


def compare_dual(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None,
    end: DayLike | None,
    comparison: str,
    progress: Progress | None,
) -> Compared[DualCompareReport]:
    """Measure what is left at the switchings of published products; parameters as `compare`.

    Raises
    ------
    CatalogError
        When no product of the comparison is published in the span.
    """
    span = slice(str(start) if start is not None else None, str(end) if end is not None else None)
    days = cat.days(product_of(comparison), span, states=("published",))
    if not days:
        raise CatalogError(
            f"'{product_of(comparison)}' has no published days in the span",
            remedy="run 'inflight reprocess' first",
        )
    rows, tell = [], progress or (lambda stage, done, total: None)
    tables: dict[int, xr.Dataset] = {}
    for done, day in enumerate(days):
        tell("compare", done, len(days))
        table = cat.table(f"{comparison}-states", str(day.day))
        tables.setdefault(int(table.attrs["table_id"]), table)
        rows.append(day_rows(cat, mission, day, table, thin=max(1, 86_400 * len(days) // _POINTS)))
    tell("compare", len(days), len(days))
    report = DualCompareReport(comparison, days[-1].context or "", rows, [], list(tables.values()))
    report.fails_where = sorted(
        fails_where(report, mission), key=lambda one: -float(np.abs(one[0].value / one[0].sigma).max())
    )
    title = f"{mission.mission}: two sensors on one boom, {days[0].day} to {days[-1].day}"
    return Compared(report, title, states_parts(report))


def day_rows(cat: Catalog, mission: Mission, day: Day, table: xr.Dataset, thin: int) -> DualDayRows:
    """Return what is kept of a day; every `thin`-th sample is drawn."""
    product = cat.read(day, dated=False)
    stamps = np.asarray(product["tt2000"].values, dtype=np.int64)
    state = np.asarray(product["state"].values, dtype=np.int64)
    outboard, field = (
        np.asarray(product[name].values, dtype=np.float64) for name in ("outboard", "field_spacecraft")
    )
    difference = np.asarray(product["inboard"].values, dtype=np.float64) - outboard
    at = switchings(state, stamps, usual_step(stamps, SECOND))
    width = quietest_width(field, at)
    thinned = slice(None, None, thin)
    return DualDayRows(
        day,
        str(product.attrs["method"]),
        str(product.attrs["applied"]),
        str(product.attrs["reason"]),
        str(product.attrs.get("constant", "")),
        at,
        steps_across(outboard, at, width),
        steps_across(field, at, width),
        quiet_steps(field, at, width),
        steps_across(difference, at, width),
        unit_signs(table, at),
        channel_changes(cat, mission, day.day, stamps[at.last], stamps[at.first]),
        stretches_of(state, product["probability"].values, difference, stamps, usual_step(stamps, SECOND)),
        stamps[thinned],
        outboard[thinned],
        field[thinned],
    )


def stretches_of(
    state: Int64, probability: Floats, difference: Floats, stamps: Int64, step: int
) -> Stretches:
    """Return the stretches of one state each; samples without a reading count in none of the means."""
    edges = np.flatnonzero(np.diff(state)) + 1
    first = np.concatenate([[0], edges]).astype(np.int64)
    last = np.concatenate([edges, [state.size]]).astype(np.int64)
    good: npt.NDArray[np.bool_] = np.asarray(np.isfinite(difference).all(axis=1))
    counts = np.add.reduceat(good.astype(np.float64), first)
    counts = np.where(counts > 0.0, counts, np.nan)
    mean = np.add.reduceat(np.where(good[:, None], difference, 0.0), first, axis=0) / counts[:, None]
    sure = np.asarray(probability, dtype=np.float64)[first]
    return Stretches(stamps[first], stamps[last - 1] + step, state[first], sure, mean)


def fails_where(report: DualCompareReport, mission: Mission) -> Iterator[tuple[Remaining, str]]:
    """Yield what the steps that are left go with, and its unit: states, units, currents."""
    steps = report.joined("after")
    at = Switchings(
        *(
            np.concatenate([getattr(one.at, name) for one in report.days])
            for name in ("last", "first", "before", "after", "room")
        )
    )
    floor = rms(report.joined("quiet"))
    for one in by_state(at, steps):
        if one.is_clear:
            yield one, "nT"
    signs = report.signs
    for unit in range(signs.shape[1]):
        found = regressed(f"unit {unit}", steps, signs[:, unit])
        if found is not None and found.is_clear:
            yield found, "nT"
    known = scalar_channels(mission)
    for name in sorted({name for one in report.days for name in one.changes}):
        change = np.concatenate([one.changes.get(name, np.full(len(one.at), np.nan)) for one in report.days])
        found = regressed(name, steps, change)
        # A change of noise alone makes a slope of any size: it must matter at the channel's usual change.
        usual = float(np.nanmax(np.abs(change), initial=0.0))
        if found is not None and found.is_clear and np.abs(found.value).max() * usual > floor:
            yield found, f"nT/{known[name][2].unit if name in known else 'unit'}"
