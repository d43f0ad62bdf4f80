"""Tables of a spinning sensor: each day's parameters, windows of days, the offset along the spin axis, flips.

`spin_table` joins the days of a window and decides whether a new estimate replaces the value in use
(`inflight.spin.update`); `zero_level_table` finds the offset along the axis from natural fluctuations
(`inflight.zero_level`), `flipper_table` from flips of the sensor. `SpinResults` reads published tables with
their days.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog, Day
from inflight.errors import CalibrationError, CatalogError, InflightError
from inflight.figures import SubintervalEstimates
from inflight.lsq import sigma_of_mean
from inflight.mission import Mission
from inflight.model import Model, ModelEffect
from inflight.spin import (
    GROUND,
    NAMES,
    SPIN,
    SPIN_RELATED,
    UNITS,
    Bools,
    CalibrationParameters,
    Decision,
    ExternalValue,
    ParameterTable,
    ValueInUse,
    ValuesInUse,
    axial_offset_slope,
    choose_estimates,
    join_parameters,
)
from inflight.tasks.archive import flips_of
from inflight.tasks.pipelines.base import equations_of, newest_tables, product_of
from inflight.tasks.pipelines.spin.day import ground_of, require_spinning
from inflight.time import DAY, Int64, day_bounds, day_of, utc_text
from inflight.zero_level import (
    COMBINED_METHODS,
    PARTS,
    Flipped,
    Intervals,
    OffsetSearch,
    combine_methods,
    separate_flipped,
)

#: Intervals a zero level is told from, s: long against the correlation of the wind's fluctuations.
ZERO_INTERVAL_S = 900.0

#: Fewer quarter hours tell no offset: false zeros are found out, but of twenty in rough wind one mean in
#: forty still lies beyond four of the stated errors (docs/science/zero-level.md).
_FEWEST_INTERVALS = 24

#: The offset along the axis is looked for within so many of the ground's sigmas.
_REACH = 3.0

#: A value is determined when it is known this much better than before.
_BETTER = 0.5

#: Codes of the variable `source`, as `inflight.calibration.table.SOURCES` has them.
_PRIOR, _DATA = 0, 2

#: The parameter that the spin tells nothing of and nature does.
AXIAL = "offset[3]"


@dataclass(frozen=True)
class _Row:
    """One interval: what is used in it, and what was decided; `own` is the estimate with its sigma, (12,)."""

    start: int
    end: int
    twelve: ParameterTable
    covariance: Floats
    decisions: Mapping[str, Decision]
    own: tuple[Floats, Floats]
    days: int
    used: float
    excess: float


def spin_table(
    days: Sequence[xr.Dataset],
    model: Model,
    edges: Sequence[np.datetime64],
    kind: str,
    zero: xr.Dataset | None = None,
) -> xr.Dataset:
    """Return the table of windows of days; windows without a day are left out.

    Days are weighted by what each tells beyond the prior. Where they scatter by more than their errors say,
    as after a change of the spin axis, the errors grow with the scatter. From window to window a parameter
    keeps its value unless the new estimate warrants another (`inflight.spin.update`).

    Parameters
    ----------
    days : sequence of Dataset
        As `inflight.tasks.pipelines.spin.day.spin_day` makes them, in order of time.
    edges : sequence of datetime64[D]
        Of the windows.
    kind : str
        Name of the table.
    zero : Dataset, optional
        Offsets along the spin axis: see `zero_level_table`.

    Returns
    -------
    xarray.Dataset
        Twelve parameters an interval, with the variables of `inflight.calibration.table`: the values in use.
        `own`, `own_sigma` are the interval's own estimates, infinite sigma where it has none; `decision`
        (update, confirm, keep; empty for what stays as on the ground) and `reason` say what became of them.
    """
    entry = require_spinning(model)
    bounds = [day_bounds(edge)[0] for edge in edges]
    rows, book = list[_Row](), _Book.from_ground(entry, bounds[0])
    for start, end in itertools.pairwise(bounds):
        inside = [day for day in days if start <= int(day["start"].values[0]) < end]
        if inside:
            rows.append(book.row(inside, entry, start, end, zero))
    return _table(rows, entry, {"comparison": model.comparison, "kind": kind, "model": model.sha})


@dataclass
class _Book:
    """The values in use, from one interval to the next."""

    eight: ValuesInUse
    axial: ValueInUse
    source: str = GROUND

    @classmethod
    def from_ground(cls, entry: ModelEffect, tt2000: int) -> _Book:
        ground, sigma = ground_of(entry, tt2000)
        axial = ValueInUse(AXIAL, float(ground.offset[2]), sigma[AXIAL])
        return cls(ValuesInUse.from_ground(ground, sigma), axial)

    def row(
        self, days: Sequence[xr.Dataset], entry: ModelEffect, start: int, end: int, zero: xr.Dataset | None
    ) -> _Row:
        """Decide on what the days of an interval tell, and return what is used in it."""
        ground, sigma = ground_of(entry, (start + end) // 2)
        prior = np.array([sigma[name] for name in SPIN_RELATED])
        value, covariance, excess = _combined(days, ground.spin_related(), prior)
        free = [entry.parameters[name.partition("[")[0]].free for name in SPIN_RELATED]
        told = (np.sqrt(np.diag(covariance)) < _BETTER * prior) & free
        step = self.eight.update(value, covariance, told, (start + end) // 2 / DAY)
        self.eight = step.used
        known = _axial(zero, start, end)
        about, self.axial, error = self.axial.update(known.value, known.sigma)
        if about.verdict == "update":
            self.source = known.source
        stated = np.where(self.eight.from_flight, np.sqrt(np.diag(step.covariance)), np.inf)
        parameters = ground.changed(dict(zip(SPIN_RELATED, self.eight.value.tolist(), strict=True)))
        others = (
            {AXIAL: ExternalValue(self.axial.value, error, self.source)} if self.axial.from_flight else {}
        )
        twelve = join_parameters((self.eight.value, stated, parameters), ground, sigma, others)
        used = float(sum(np.isfinite(day["estimate"].values[..., 0]).sum() for day in days))
        decisions = dict(zip(SPIN_RELATED, step.decisions, strict=True)) | {AXIAL: about}
        # As the values in use, the interval's own offsets go with the third one that is used beside them.
        seen = ground.changed(dict(zip(SPIN_RELATED, step.estimate.tolist(), strict=True)))
        own = _own(join_parameters((step.estimate, step.sigma, seen), ground, sigma, others), known)
        whole = _whole(twelve, step.covariance, stated)
        return _Row(start, end, twelve, whole, decisions, own, len(days), used, excess)


def _own(twelve: ParameterTable, axial: ExternalValue) -> tuple[Floats, Floats]:
    """Return an interval's own estimates and their errors, (12,); NaN and infinite for none."""
    known = np.array([name in SPIN_RELATED for name in NAMES]) & twelve.determined
    value, error = np.where(known, twelve.value, np.nan), np.where(known, twelve.sigma, np.inf)
    if np.isfinite(axial.sigma):
        value[NAMES.index(AXIAL)], error[NAMES.index(AXIAL)] = axial.value, axial.sigma
    return value, error


def _combined(days: Sequence[xr.Dataset], start: Floats, prior: Floats) -> tuple[Floats, Floats, float]:
    """Return values of the eight, their covariance, and the days' scatter over its expectation."""
    before = np.diag(prior**-2.0)
    information, right = before.copy(), before @ start
    parts, free = [], 0
    for day in days:
        own = np.linalg.inv(day["covariance"].values[0])
        if not np.isfinite(day["sigma"].values[0]).any():
            continue  # it tells nothing
        # In units of the prior's errors: what a combination is told by beside what the ground knew.
        weight, vectors = np.linalg.eigh((own - before) * np.outer(prior, prior))
        known = vectors[:, weight > 0.0]
        told = (known * weight[weight > 0.0]) @ known.T / np.outer(prior, prior)
        free += int(np.count_nonzero(weight > 1.0))
        # The day's own value holds the prior, too: what it adds is what is beyond.
        alone = own @ day["value"].values[0] - before @ start
        alone = known @ (known.T @ (alone * prior)) / prior
        information, right = information + told, right + alone
        parts.append((told, day["value"].values[0]))
    covariance = np.linalg.inv(information)
    value = covariance @ right
    square = sum(float((one - value) @ told @ (one - value)) for told, one in parts)
    free -= int(np.count_nonzero(np.linalg.eigvalsh((information - before) * np.outer(prior, prior)) > 1.0))
    excess = max(1.0, square / free) if free > 0 else 1.0
    return value, np.asarray(covariance * excess), excess


def _axial(zero: xr.Dataset | None, start: int, end: int) -> ExternalValue:
    """Return the offset along the spin axis: of the interval around a window, or of all those in it.

    The mean of several is weighted, its error widened where they scatter beyond theirs. The sigma is
    infinite where nothing tells it.
    """
    nothing = ExternalValue(float("nan"), float("inf"), GROUND)
    if zero is None:
        return nothing
    begins, ends = zero["start"].values, zero["end"].values
    middle = (start + end) // 2
    around = (begins <= middle) & (middle < ends)
    inside = (begins >= start) & (ends <= end)
    taken = np.flatnonzero((inside if inside.sum() > 1 else around) & np.isfinite(zero["sigma"].values))
    if not taken.size:
        return nothing
    value, sigma = (np.asarray(zero[name].values[taken], dtype=np.float64) for name in ("value", "sigma"))
    weight = sigma**-2.0
    mean = float(weight @ value / weight.sum())
    scatter = float(weight @ (value - mean) ** 2) / max(taken.size - 1, 1)
    method = str(zero["method"].values[taken[-1]])
    told = method if taken.size == 1 else f"{method}, mean of {taken.size} windows"
    return ExternalValue(mean, float(np.sqrt(max(1.0, scatter) / weight.sum())), told)


def _whole(twelve: ParameterTable, covariance: Floats, told: Floats) -> Floats:
    """Return the covariance of the twelve: that of the eight, the variances of the rest beside it.

    Offsets 1 and 2 move with the error of the third, so that in the spin plane nearly all of it cancels.
    """
    out = np.diag(np.where(np.isfinite(twelve.sigma), twelve.sigma, 0.0) ** 2)
    places = [NAMES.index(name) for name in SPIN_RELATED]
    known = np.isfinite(told)
    for row, column in itertools.product(np.flatnonzero(known), repeat=2):
        if row != column:
            out[places[row], places[column]] = covariance[row, column]
    offsets = [NAMES.index(f"offset[{axis}]") for axis in (1, 2, 3)]
    variance = out[offsets[2], offsets[2]]
    slope = axial_offset_slope(twelve.parameters) * [twelve.source[at] == SPIN for at in offsets[:2]]
    for at, moved in zip(offsets[:2], slope, strict=True):
        out[at, offsets[2]] = out[offsets[2], at] = moved * variance
    both = slope[0] * slope[1] * variance
    out[offsets[0], offsets[1]] += both
    out[offsets[1], offsets[0]] += both
    return out


def _table(rows: Sequence[_Row], entry: ModelEffect, attributes: Mapping[str, str]) -> xr.Dataset:
    ground, sigma = ground_of(entry, rows[0].start)
    names = [f"{entry.name}.{name}" for name in NAMES]
    each, one = ("interval", "parameter"), ("interval",)
    from_ground = [[source == GROUND for source in row.twelve.source] for row in rows]
    return xr.Dataset(
        {
            "value": (each, np.array([row.twelve.value for row in rows])),
            "sigma": (each, np.array([row.twelve.sigma for row in rows])),
            "covariance": ((*each, "other"), np.array([row.covariance for row in rows])),
            "determined": (each, np.array([row.twelve.determined for row in rows])),
            "source": (each, np.where(from_ground, _PRIOR, _DATA).astype(np.int8)),
            "origin": (each, np.array([row.twelve.source for row in rows], dtype=np.str_)),
            "own": (each, np.array([row.own[0] for row in rows])),
            "own_sigma": (each, np.array([row.own[1] for row in rows])),
            "decision": (each, np.array([_decided(row)[0] for row in rows], dtype="U8")),
            "reason": (each, np.array([_decided(row)[1] for row in rows], dtype=np.str_)),
            "prior": ("parameter", ground.values()),
            "prior_sigma": ("parameter", np.array([sigma[name] for name in NAMES])),
            "units": ("parameter", np.array([UNITS[name] for name in NAMES], dtype="U8")),
            "start": (one, np.array([row.start for row in rows], dtype=np.int64), {"scale": "TT2000"}),
            "end": (one, np.array([row.end for row in rows], dtype=np.int64), {"scale": "TT2000"}),
            "blocks": (one, np.array([row.days for row in rows], dtype=np.int64)),
            "count": (one, np.array([row.used for row in rows])),
            "inflation": (one, np.array([row.excess for row in rows])),
        },
        coords={"parameter": names, "other": names},
        attrs=dict(attributes),
    )


def _decided(row: _Row) -> tuple[list[str], list[str]]:
    """Return verdict and reason of each of the twelve; of what stays as on the ground, that."""
    kept = "nothing in flight tells it: as on the ground"
    found = [row.decisions.get(name) for name in NAMES]
    return [one.verdict if one else "" for one in found], [one.reason if one else kept for one in found]


def zero_level_table(days: Sequence[xr.Dataset], model: Model, edges: Sequence[np.datetime64]) -> xr.Dataset:
    """Return the offset along the spin axis in windows of days, from nature's own statistics.

    Parameters
    ----------
    days : sequence of Dataset
        With `mean` and `mean_time`.
    edges : sequence of datetime64[D]
        Of the windows.

    Returns
    -------
    xarray.Dataset
        dims interval: `value`, `sigma` (infinite where nothing tells it) nT, sensor axis 3, in units of the
        reading; `method`, `reason`; `method_value`, `method_sigma` (interval, method) nT and `method_used`,
        intervals of 15 minutes each method took, of each method by itself; `start`, `end` TT2000.
    """
    entry = require_spinning(model)
    bounds = [day_bounds(edge)[0] for edge in edges]
    rows = []
    for start, end in itertools.pairwise(bounds):
        inside = [day for day in days if start <= int(day["start"].values[0]) < end]
        if inside:
            ground, sigma = ground_of(entry, (start + end) // 2)
            rows.append((start, end, _zero(inside, ground, _REACH * sigma["offset[3]"])))
    one, each = ("interval",), ("interval", "method_name")
    return xr.Dataset(
        {
            "value": (one, np.array([row[2].value for row in rows]), {"units": "nT"}),
            "sigma": (one, np.array([row[2].sigma for row in rows]), {"units": "nT"}),
            "method": (one, np.array([row[2].method for row in rows], dtype=np.str_)),
            "reason": (one, np.array([row[2].reason for row in rows], dtype=np.str_)),
            "method_value": (each, np.array([row[2].each[0] for row in rows]), {"units": "nT"}),
            "method_sigma": (each, np.array([row[2].each[1] for row in rows]), {"units": "nT"}),
            "method_used": (each, np.array([row[2].each[2] for row in rows])),
            "intervals": (one, np.array([row[2].intervals for row in rows], dtype=np.int64)),
            "start": (one, np.array([row[0] for row in rows], dtype=np.int64), {"scale": "TT2000"}),
            "end": (one, np.array([row[1] for row in rows], dtype=np.int64), {"scale": "TT2000"}),
        },
        coords={"method_name": list(COMBINED_METHODS)},
        attrs={"comparison": model.comparison, "kind": "zero-level", "model": model.sha},
    )


@dataclass(frozen=True)
class _Zero:
    """A window's offset along the spin axis; `each` has value, sigma and intervals of `COMBINED_METHODS`."""

    value: float
    sigma: float
    method: str
    reason: str
    intervals: int
    each: Floats


def _zero(days: Sequence[xr.Dataset], ground: CalibrationParameters, bound: float) -> _Zero:
    """Return a window's offset along the spin axis, of all methods and of each."""
    times = np.concatenate([day["mean_time"].values[0] for day in days])
    means = np.concatenate([day["mean"].values[0] for day in days])
    known = np.isfinite(means).all(axis=1)
    times, means = _sorted(times[known], means[known])
    each = np.array([[np.nan], [np.inf], [0.0]]) * np.ones(len(COMBINED_METHODS))
    count, start = 0, float(ground.offset[2])
    search = OffsetSearch(free=(False, False, True), bound=bound)
    try:
        intervals = Intervals.of(times, means, ZERO_INTERVAL_S)
        count = len(intervals.start)
        if count < _FEWEST_INTERVALS:
            why = f"{count} quarter hours, at least {_FEWEST_INTERVALS} needed"
            return _Zero(start, float("inf"), GROUND, why, count, each)
        found = combine_methods(intervals, search)
    except InflightError as error:
        return _Zero(start, float("inf"), GROUND, error.message, count, each)
    # A field of no size along the axis reads as the matrix's last row makes of the offset.
    turn = float(ground.matrix()[2, 2])
    for one in (one for one in found.methods if one.method in COMBINED_METHODS):
        told = start + one.value[2] / turn, one.sigma[2] / turn, int(one.used.sum())
        each[:, COMBINED_METHODS.index(one.method)] = told
    estimate = found.estimate
    if not estimate.determined[2]:
        return _Zero(start, float("inf"), GROUND, "; ".join(estimate.reasons), count, each)
    value, sigma = start + float(estimate.value[2]) / turn, float(estimate.sigma[2]) / turn
    return _Zero(value, sigma, estimate.method, found.summary(), count, each)


def _sorted(times: Int64, means: Floats) -> tuple[Int64, Floats]:
    order = np.argsort(times, kind="stable")
    return times[order], means[order]


TABLES = ("daily", "window", "zero-level")

#: A published uncertainty is so many standard deviations of white noise (Plaschke et al. 2019, table 2).
_PUBLISHED = 1.7


@dataclass(frozen=True)
class SpinResults:
    """Tables and day results of a spin comparison.

    Attributes
    ----------
    tables : mapping of str to Dataset
        ``daily``, ``window``, ``zero-level``.
    days : list of Dataset
        As `inflight.tasks.pipelines.spin.day.spin_day` makes them, those of the daily table.
    records, products : list of Day
        Of the same days.
    """

    cat: Catalog
    mission: Mission
    comparison: str
    tables: Mapping[str, xr.Dataset]
    days: list[xr.Dataset]
    records: list[Day]
    products: list[Day]

    @classmethod
    def of(cls, cat: Catalog, mission: Mission, comparison: str) -> SpinResults:
        """Read the newest tables that are certified, and the days they are made of.

        Raises
        ------
        CatalogError
            When there are none.
        """
        tables = newest_tables(cat, comparison, TABLES)
        if set(tables) != set(TABLES) or "own" not in tables["daily"]:
            raise CatalogError(
                f"no tables are published for comparison '{comparison}'",
                remedy=f"run 'inflight reprocess --comparison {comparison}' first",
            )
        wanted = set(day_of(tables["daily"]["start"].values).tolist())
        records = [
            day
            for day in cat.days(equations_of(comparison), states=("published",))
            if day.day.item() in wanted
        ]
        products = [
            day for day in cat.days(product_of(comparison), states=("published",)) if day.day.item() in wanted
        ]
        return cls(cat, mission, comparison, tables, [cat.read(day) for day in records], records, products)

    @property
    def span(self) -> list[str]:
        """First and last day."""
        return [str(one)[:10] for one in day_of(self.tables["daily"]["start"].values[[0, -1]])]

    @cached_property
    def cloud(self) -> SubintervalEstimates:
        """All sub-intervals of all days, and those that a threshold chooses."""
        kept = [_filled(day) for day in self.days]

        def joined(name: str) -> np.ndarray:
            return np.concatenate(
                [day[name].values[0][which] for day, which in zip(self.days, kept, strict=True)]
            )

        return cloud_of(*(joined(name) for name in ("sub_start", "sub_end", "estimate", "uncertainty")))

    @cached_property
    def selected(self) -> tuple[Floats, Floats]:
        """Means of selected estimates, and errors, day by day; (day, 8), beside the daily table's `own`."""
        own = self.tables["daily"]["own"].values[:, [NAMES.index(name) for name in SPIN_RELATED]]
        value, sigma = np.full(own.shape, np.nan), np.full(own.shape, np.inf)
        rows = self.tables["daily"]["start"].values.tolist()
        for day in self.days:
            # A day of the table may be gone since.
            row, which = rows.index(int(day["start"].values[0])), _filled(day)
            one = cloud_of(
                *(day[name].values[0][which] for name in ("sub_start", "sub_end", "estimate", "uncertainty"))
            )
            # Estimates go with the pre-flight third offset, the table's offsets with the one in use.
            value[row] = one.value + np.nan_to_num(own[row] - day["value"].values[0])
            sigma[row] = one.sigma
        return value, sigma


def _filled(day: xr.Dataset) -> Bools:
    """Return which of a day's sub-intervals are any, (sub,): rows that fill up a store have no length."""
    return np.asarray(day["sub_end"].values[0] > day["sub_start"].values[0])


def cloud_of(
    start: np.ndarray, end: np.ndarray, estimate: Floats, uncertainty: Floats
) -> SubintervalEstimates:
    """Choose of estimates (sub, 8) by their uncertainties, and return them with the means."""
    chosen = np.zeros(estimate.shape, dtype=np.bool_)
    threshold, value = (np.full(estimate.shape[1], np.nan) for _ in range(2))
    sigma = np.full(estimate.shape[1], np.inf)
    for at in range(estimate.shape[1]):
        chosen[:, at], _ = choose_estimates(
            np.where(np.isfinite(estimate[:, at]), uncertainty[:, at], np.nan)
        )
        if not chosen[:, at].any():
            continue
        mine, errors = estimate[chosen[:, at], at], uncertainty[chosen[:, at], at]
        threshold[at], value[at] = float(errors.max()), float(mine.mean())
        expected = float(np.sqrt(np.sum((errors / _PUBLISHED) ** 2)) / mine.size)
        sigma[at] = max(expected, sigma_of_mean(mine))
    return SubintervalEstimates(start, end, estimate, uncertainty, chosen, threshold, value, sigma)


#: Offsets along x and z among the twelve.
_X, _Z = NAMES.index("offset[1]"), NAMES.index("offset[3]")


def flipper_table(
    days: Sequence[xr.Dataset], model: Model, edges: Sequence[np.datetime64], mission: Mission
) -> xr.Dataset:
    """Return what each flip tells of sensors and spacecraft, from the positions before and after it.

    Parameters
    ----------
    days : sequence of Dataset
        As `inflight.tasks.pipelines.spin.day.spin_day` makes them, in order of time.
    edges : sequence of datetime64[D]
        Of the positions: see `inflight.tasks.archive.samples.split_at_flips`.

    Returns
    -------
    xarray.Dataset
        dims interval (from a flip to the next), parameter (`inflight.zero_level.flipper.PARTS`): `value`,
        `sigma`, `covariance` nT, `units`, `start`, `end` TT2000. The offsets are those of the readings as
        delivered, pre-flight values not taken off.

    Raises
    ------
    CalibrationError
        When no flip has all four corrections.
    """
    zero = zero_level_table(days, model, edges)
    table = spin_table(days, model, edges, "positions", zero)
    rows, missing = [], []
    for at, flipped in flips_of(mission):
        before, after = _beside(table, at)
        if before is None or after is None:
            missing.append(f"{utc_text(at)}: no day on one side")
            continue
        plain, turned = (before, after) if flipped else (after, before)
        try:
            found = separate_flipped(*_corrections(plain, turned), _covariance(plain, turned))
        except CalibrationError as error:
            missing.append(f"{utc_text(at)}: {error.message}")
            continue
        rows.append((max(at, int(table["start"].values[0])), int(after["end"].values), found))
    if not rows:
        raise CalibrationError(
            f"no flip tells sensors and spacecraft apart: {'; '.join(missing)}",
            remedy="take a span with some days of wind in both positions",
        )
    return _flipper_table(rows, model)


def _beside(table: xr.Dataset, at: int) -> tuple[xr.Dataset | None, xr.Dataset | None]:
    """Return the rows of the positions before and after a flip; edges lie within half a day of it."""
    middle = (table["start"].values + table["end"].values) // 2
    before, after = np.flatnonzero(middle < at), np.flatnonzero(middle >= at)
    return (
        table.isel(interval=int(before[-1])) if before.size else None,
        table.isel(interval=int(after[0])) if after.size else None,
    )


def _corrections(plain: xr.Dataset, turned: xr.Dataset) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return (C', C'') and (D', D''), nT; NaN for what remains at its ground value."""
    both = [np.where(one["determined"].values, one["value"].values, np.nan) for one in (plain, turned)]
    return (float(both[0][_Z]), float(both[1][_Z])), (float(both[0][_X]), float(both[1][_X]))


def _covariance(plain: xr.Dataset, turned: xr.Dataset) -> Floats:
    """Return the covariance of (C', C'', D', D''), nT^2; positions are independent of each other."""
    out = np.zeros((4, 4))
    for at, one in enumerate((plain, turned)):
        places = np.array([at, at + 2])
        out[np.ix_(places, places)] = one["covariance"].values[np.ix_([_Z, _X], [_Z, _X])]
    return out


def _flipper_table(rows: Sequence[tuple[int, int, Flipped]], model: Model) -> xr.Dataset:
    each, one = ("interval", "parameter"), ("interval",)
    # A flip's parts hold until the next one, whatever days its position has.
    ends = [*(later[0] for later in rows[1:]), rows[-1][1]]
    return xr.Dataset(
        {
            "value": (each, np.array([row[2].value for row in rows]), {"units": "nT"}),
            "sigma": (each, np.array([row[2].sigma for row in rows]), {"units": "nT"}),
            "covariance": ((*each, "other"), np.array([row[2].covariance for row in rows])),
            "told": (one, np.array([row[2].summary() for row in rows], dtype=np.str_)),
            "units": ("parameter", np.array(["nT"] * len(PARTS), dtype="U8")),
            "start": (one, np.array([row[0] for row in rows], dtype=np.int64), {"scale": "TT2000"}),
            "end": (one, np.array(ends, dtype=np.int64), {"scale": "TT2000"}),
        },
        coords={"parameter": list(PARTS), "other": list(PARTS)},
        attrs={"comparison": model.comparison, "kind": "flipper", "model": model.sha},
    )
