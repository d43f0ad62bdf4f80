"""Tables of zero levels: three offsets a window with covariance, methods, and the test of every assumption.

`zero_level_table` takes the averages of days (`inflight.tasks.pipelines.zero_level.pipeline`) and makes a row
for each window from all methods together (`inflight.zero_level.combine_methods`); `step_table` makes zero
levels of steps of some hours, as published ones are. An axis that nature does not tell keeps what was known
before: the start, with the deviation of a uniform distribution within the bound.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.arrays import Floats
from inflight.calibration import with_changes, with_learnt_spans
from inflight.errors import CalibrationError, InflightError
from inflight.lsq import robust_sigma
from inflight.mission import ZeroLevelComparison
from inflight.progress import Progress, silent, tell_each
from inflight.time import SECOND, Int64, as_day, day_bounds, utc_text
from inflight.zero_level import (
    AXES,
    Assumption,
    CombinedEstimate,
    Intervals,
    OffsetSearch,
    check_assumptions,
    combine_methods,
    correlation_sets,
    independent_covariance,
)

if TYPE_CHECKING:
    import xarray as xr

#: Names of the three parameters.
NAMES = tuple(f"zero_level.offset[{axis}]" for axis in AXES)

#: Attribute of a product of two sensors: the zero level that was taken off its field, nT; three numbers.
SUBTRACTED = "zero_level"
#: Attribute of such a product and of its table: the table of states that the level goes with.
STATES_TABLE = "states_table"
#: Entry of the report of a product of two sensors: its key but for the zero level.
BEFORE_ZERO_LEVEL = "before_zero_level"

_EACH, _ONE = ("interval", "parameter"), ("interval",)


@dataclass(frozen=True, kw_only=True)
class ZeroTableSettings:
    """Numbers of a table of zero levels.

    Attributes
    ----------
    fewest_intervals : int
        Fewer intervals give no zero level. Measured: of twenty in rough wind one mean in forty lies beyond
        four of the stated errors (docs/science/zero-level.md).
    fewest_days : int
        So many days with levels of their own tell how the level wanders from day to day. Assumed.
    fewest_steps : int
        So many steps tell their scatter. Assumed.
    """

    fewest_intervals: int = 24
    fewest_days: int = 3
    fewest_steps: int = 4


ZERO_TABLE_SETTINGS = ZeroTableSettings()


@dataclass(frozen=True)
class DayMeans:
    """Averages of a day.

    Attributes
    ----------
    start, end : int
        TT2000 of the day.
    time : ndarray of int64, shape (mean,)
        TT2000 of the averages' middles; those that are there.
    mean : ndarray, shape (mean, 3)
        nT.
    report : mapping
        Of the day's statistics: `constant` and `basis` of a product that was taken.
    """

    start: int
    end: int
    time: Int64
    mean: Floats
    report: Mapping[str, Any]

    @classmethod
    def of(cls, statistics: xr.Dataset, report: Mapping[str, Any]) -> DayMeans:
        """Return the averages of a day's statistics."""
        time, mean = (np.asarray(statistics[name].values[0]) for name in ("mean_time", "mean"))
        there = np.isfinite(mean).all(axis=1)
        start, end = (int(statistics[name].values[0]) for name in ("start", "end"))
        return cls(start, end, time[there], mean[there], report)


@dataclass
class _Row:
    """A window's zero level; axes that are not told keep the start."""

    value: Floats
    covariance: Floats
    determined: np.ndarray
    each: Floats
    used: Int64
    why: list[str]
    start: int = 0
    end: int = 0
    learnt: tuple[int, int] = (0, 0)
    method: str = "none"
    reason: str = ""
    independent: Floats = field(default_factory=lambda: np.full(3, np.nan))
    wander: Floats = field(default_factory=lambda: np.zeros(3))
    tests: tuple[Assumption, ...] = ()
    kinds: tuple[int, int, int] = (0, 0, 0)
    basis: str = ""
    constant: str = ""


def search_of(entry: ZeroLevelComparison) -> OffsetSearch:
    """Return which axes are estimated, from where and within which bound."""
    x, y, z = (axis in entry.axes for axis in AXES)
    return OffsetSearch(free=(x, y, z), start=entry.start, bound=entry.bound, turning=entry.turns)


def edges_of_constants(days: Sequence[DayMeans], edges: Sequence[np.datetime64]) -> list[np.datetime64]:
    """Return edges of windows with those days among them from which on the constant part is another."""
    changes = [
        as_day(utc_text(later.start)[:10])
        for earlier, later in pairwise(days)
        if earlier.report.get("constant") != later.report.get("constant")
    ]
    return sorted({*edges, *(day for day in changes if edges[0] < day < edges[-1])})


def zero_level_table(
    days: Sequence[DayMeans],
    entry: ZeroLevelComparison,
    edges: Sequence[np.datetime64],
    attributes: Mapping[str, str],
    daily: xr.Dataset | None = None,
    made: dict[tuple[int, ...], _Row] | None = None,
    progress: Progress = silent,
) -> xr.Dataset:
    """Return the zero level of each window that has a day.

    Parameters
    ----------
    days : sequence of DayMeans
        In order of time.
    edges : sequence of datetime64[D]
        Of the windows.
    attributes : mapping of str to str
        Of the table.
    daily : Dataset, optional
        The table of days: how their levels scatter beyond their errors is part of a window's error.
    made : dict, optional
        Rows of other tables of these days, by their days: what is the same is not estimated again.
    progress : callable, optional
        Called with ("intervals", done, total).

    Returns
    -------
    xarray.Dataset
        dims interval, parameter (three offsets): `value`, `sigma`, `covariance` nT, of the level on any day
        of the window; `determined`, `prior`, `prior_sigma`, `source`, `origin`, `units`, `start`, `end`, and
        `learnt_start`, `learnt_end` as other calibration tables; `independent_sigma`, what the methods would
        state if they had independent data; `wander`, scatter of the days' levels beyond their errors, in the
        covariance; `method`, `reason`, `basis`, `constant` (interval). Over `method_name`: `method_value`,
        `method_sigma` (interval, method_name, parameter), `method_used`, `method_reason`. Over `assumption`:
        `assumption_text`, `_value`, `_limit`, `_holds`, `_used`. `kinds` (interval,
        kind): Alfvenic, compressional and other intervals.
    """
    rows, known = [], {} if made is None else made
    for start, end in tell_each(progress, "intervals", list(pairwise(day_bounds(edge)[0] for edge in edges))):
        inside = [day for day in days if start <= day.start < end]
        if not inside:
            continue
        which = tuple(day.start for day in inside)
        if which not in known:
            known[which] = _row(inside, entry)
        row = replace(known[which], start=start, end=end)
        rows.append(row if daily is None else _with_wander(row, daily))
    if not rows:
        raise CalibrationError("no window has a day", remedy="ingest the days' files first")
    table = _table(rows, entry, attributes)
    return with_changes(table, [table if daily is None else daily])


def _row(days: Sequence[DayMeans], entry: ZeroLevelComparison) -> _Row:
    """Return the zero level of the days of a window, by the methods asked for together."""
    search, asked = search_of(entry), np.array([axis in entry.axes for axis in AXES])
    prior = np.where(asked, entry.bound / np.sqrt(3.0), 0.0)
    count = len(entry.methods)
    row = _Row(
        np.array(entry.start),
        np.diag(prior**2),
        np.zeros(3, dtype=bool),
        np.full((count, 2, 3), np.nan),
        np.zeros(count, dtype=np.int64),
        [""] * count,
    )
    row.basis = "; ".join(sorted({str(day.report["basis"]) for day in days if day.report.get("basis")}))
    row.constant = str(days[0].report.get("constant", ""))
    time, mean = (np.concatenate([getattr(day, name) for day in days]) for name in ("time", "mean"))
    intervals = None
    try:
        intervals = Intervals.of(time, mean, entry.interval / SECOND)
        if len(intervals) < ZERO_TABLE_SETTINGS.fewest_intervals:
            row.reason = (
                f"{len(intervals)} intervals of {entry.interval / SECOND:g} s, at least "
                f"{ZERO_TABLE_SETTINGS.fewest_intervals} needed: take longer windows"
            )
            return row
        found = combine_methods(intervals, search, entry.methods)
    except InflightError as error:
        row.reason = f"{error.message}; {error.remedy}" if error.remedy else error.message
        return row
    _fill_row(row, found, intervals, search, entry.methods)
    if row.determined.any():
        row.learnt = days[0].start, days[-1].end
    return row


def _fill_row(
    row: _Row, found: CombinedEstimate, intervals: Intervals, search: OffsetSearch, methods: Sequence[str]
) -> None:
    """Put what was found into a row: what is determined, each method, tests and reasons."""
    estimate, known = found.estimate, found.estimate.determined
    row.determined, row.method = known, estimate.method
    row.value = np.where(known, estimate.solution, row.value)
    inside = np.ix_(known, known)
    row.covariance[inside] = estimate.covariance[inside]
    alone = np.sqrt(np.diag(independent_covariance(found.methods, search)))
    row.independent = np.where(known, alone, np.nan)
    for one in found.methods:
        place = methods.index(one.method)
        row.each[place] = one.value, np.where(one.determined, one.sigma, np.nan)
        row.used[place], row.why[place] = int(one.used.sum()), "; ".join(one.reasons)
    for place, name in enumerate(methods):
        told = [one.removeprefix(f"{name}: ") for one in found.unusable if one.startswith(name)]
        row.why[place] = row.why[place] or "; ".join(told)
    row.tests = check_assumptions(found, intervals, search)
    kinds = found.kinds
    row.kinds = (int(kinds.alfvenic.sum()), int(kinds.compressional.sum()), int(kinds.neither.sum()))
    notes = (*estimate.reasons, *intervals.notes)
    row.reason = "; ".join([found.kinds.summary(), *dict.fromkeys(notes)])


def _with_wander(row: _Row, daily: xr.Dataset) -> _Row:
    """Add the scatter of the days' levels, beyond their errors, to a window's error.

    The moment estimator of a random effect (DerSimonian and Laird 1986): the weighted squares of the days
    about their mean less what their errors make of them.
    """
    inside = (daily["start"].values >= row.start) & (daily["end"].values <= row.end)
    wander = np.zeros(3)
    for axis in np.flatnonzero(row.determined):
        chosen = inside & daily["determined"].values[:, axis].astype(bool)
        if chosen.sum() < ZERO_TABLE_SETTINGS.fewest_days:
            continue
        value, sigma = (daily[name].values[chosen, axis] for name in ("value", "sigma"))
        weight = sigma**-2.0
        square = float(weight @ (value - weight @ value / weight.sum()) ** 2)
        scale = float(weight.sum() - (weight**2).sum() / weight.sum())
        wander[axis] = np.sqrt(max(square - (value.size - 1), 0.0) / scale)
    return replace(row, wander=wander, covariance=row.covariance + np.diag(wander**2))


def _table(rows: Sequence[_Row], entry: ZeroLevelComparison, attributes: Mapping[str, str]) -> xr.Dataset:
    import xarray as xr

    determined = np.array([row.determined for row in rows])
    asked = np.array([axis in entry.axes for axis in AXES])
    prior = np.where(asked, entry.bound / np.sqrt(3.0), 0.0)
    of_methods, of_tests = ("interval", "method_name"), ("interval", "assumption")
    most = max(len(row.tests) for row in rows)
    tests = [[*row.tests, *[None] * (most - len(row.tests))] for row in rows]
    origin = [[row.method if known else "start" for known in row.determined] for row in rows]
    covariance = np.array([row.covariance for row in rows])
    table = xr.Dataset(
        {
            "value": (_EACH, np.array([row.value for row in rows]), {"units": "nT"}),
            "sigma": (_EACH, np.sqrt(np.einsum("tii->ti", covariance)), {"units": "nT"}),
            "covariance": ((*_EACH, "other"), covariance, {"units": "nT2"}),
            "determined": (_EACH, determined),
            "source": (_EACH, np.where(determined, 2, 0).astype(np.int8)),
            "origin": (_EACH, np.array(origin, dtype=np.str_)),
            "independent_sigma": (_EACH, np.array([row.independent for row in rows]), {"units": "nT"}),
            "wander": (_EACH, np.array([row.wander for row in rows]), {"units": "nT"}),
            "prior": ("parameter", np.array(entry.start, dtype=np.float64)),
            "prior_sigma": ("parameter", prior),
            "units": ("parameter", np.array(["nT"] * 3, dtype="U8")),
            "start": (_ONE, np.array([row.start for row in rows], dtype=np.int64), {"scale": "TT2000"}),
            "end": (_ONE, np.array([row.end for row in rows], dtype=np.int64), {"scale": "TT2000"}),
            "kinds": (("interval", "kind"), np.array([row.kinds for row in rows], dtype=np.int64)),
            "method_value": ((*of_methods, "parameter"), np.array([row.each[:, 0] for row in rows])),
            "method_sigma": ((*of_methods, "parameter"), np.array([row.each[:, 1] for row in rows])),
            "method_used": (of_methods, np.array([row.used for row in rows])),
            "method_reason": (of_methods, np.array([row.why for row in rows], dtype=np.str_)),
        }
        | {
            name: (_ONE, np.array([getattr(row, name) for row in rows], dtype=np.str_))
            for name in ("method", "reason", "basis", "constant")
        }
        | {
            f"assumption_{name}": (of_tests, _tests(tests, name, empty))
            for name, empty in (("value", np.nan), ("limit", np.nan), ("holds", False), ("used", False))
        }
        | {
            "assumption_text": (
                of_tests,
                np.array([[one.summary() if one else "" for one in row] for row in tests], dtype=np.str_),
            )
        },
        coords={
            "parameter": list(NAMES),
            "other": list(NAMES),
            "method_name": list(entry.methods),
            "kind": ["Alfvenic", "compressional", "neither"],
        },
        attrs=dict(attributes),
    )
    learnt = np.array([row.learnt for row in rows], dtype=np.int64)
    return with_learnt_spans(table, learnt[:, 0], learnt[:, 1])


def _tests(tests: Sequence[Sequence[Assumption | None]], name: str, empty: float | bool) -> np.ndarray:
    """Return one number of every assumption; (interval, assumption)."""
    return np.array([[getattr(one, name) if one else empty for one in row] for row in tests])


def step_table(
    days: Sequence[DayMeans], entry: ZeroLevelComparison, average_s: float, attributes: Mapping[str, str]
) -> xr.Dataset:
    """Return zero levels of steps of some hours by minimum correlation, each by itself.

    Published levels of Helios are of two hours: results in their own right, too uncertain to correct a field
    with. Each has the error of its own intervals, or the robust scatter of all steps where that is larger.

    Returns
    -------
    xarray.Dataset
        dims interval, parameter: `value`, `sigma` nT (the start, and what was known beforehand, where a step
        has no zero), `determined`, `units`, `start`, `end`.

    Raises
    ------
    CalibrationError
        When no step is whole.
    """
    import xarray as xr

    assert entry.step is not None
    time, mean = (np.concatenate([getattr(day, name) for day in days]) for name in ("time", "mean"))
    search = search_of(entry)
    size = round(entry.step / SECOND / average_s)
    start = np.array(entry.start)
    found = correlation_sets(time, mean - start, size, bound=entry.bound, free=search.free)
    known = found.determined[:, None] & np.array(search.free)
    sigma = found.sigma
    if found.determined.sum() >= ZERO_TABLE_SETTINGS.fewest_steps:
        values = found.value[found.determined]
        scatter = [robust_sigma(column - np.median(column)) for column in values.T]
        sigma = np.maximum(sigma, scatter)
    prior = np.where(np.array(search.free), entry.bound / np.sqrt(3.0), 0.0)
    return xr.Dataset(
        {
            "value": (_EACH, start + np.where(known, found.value, 0.0), {"units": "nT"}),
            "sigma": (_EACH, np.where(known, sigma, prior), {"units": "nT"}),
            "determined": (_EACH, known),
            "units": ("parameter", np.array(["nT"] * 3, dtype="U8")),
            "start": (_ONE, found.start, {"scale": "TT2000"}),
            "end": (
                _ONE,
                np.minimum(found.end, np.append(found.start[1:], found.end[-1])),
                {"scale": "TT2000"},
            ),
        },
        coords={"parameter": list(NAMES)},
        attrs=dict(attributes),
    )
