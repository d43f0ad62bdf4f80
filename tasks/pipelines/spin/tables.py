"""Tables of a spinning sensor: each day's parameters, windows of days, the offset along the spin axis, flips.

`spin_table` joins the days of a window and decides whether a new estimate replaces the value in use
(`inflight.spin.update`); `zero_level_table` finds the offset along the axis from natural fluctuations
(`inflight.zero_level`), `flipper_table` from flips of the sensor. `SpinResults` reads published tables with
their days.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import with_changes, with_learnt_spans
from inflight.catalog import Catalog, Day
from inflight.errors import CalibrationError, CatalogError, InflightError
from inflight.figures import SubintervalEstimates
from inflight.lsq import sigma_of_mean
from inflight.mission import Mission
from inflight.model import Model, ModelEffect
from inflight.progress import Progress, silent, tell_each
from inflight.spin import (
    GROUND,
    HELD,
    PARAMETER_NAMES,
    PARAMETER_UNITS,
    SPIN_RELATED,
    Bools,
    CalibrationParameters,
    Decision,
    ExternalValue,
    ParameterTable,
    SpinParametersInUse,
    ValueInUse,
    choose_estimates,
    fit_held,
    held_slopes,
    join_parameters,
)
from inflight.tasks.archive import flips_of
from inflight.tasks.pipelines.base import equations_of, newest_tables, product_of
from inflight.tasks.pipelines.spin.day import ground_of, parts_of, require_spinning
from inflight.time import DAY, day_bounds, day_of, utc_text
from inflight.zero_level import (
    COMBINED_METHODS,
    PARTS,
    FlipperSolution,
    Intervals,
    OffsetSearch,
    combine_methods,
    separate_flipped,
)


@dataclass(frozen=True, kw_only=True)
class SpinTableSettings:
    """Numbers of the tables of a spinning sensor.

    Attributes
    ----------
    zero_interval_s : float
        Intervals that a zero level is found from, s. Assumed: long against the correlation of the solar
        wind's fluctuations.
    fewest_intervals : int
        Fewer such intervals give no offset. Measured: false zeros are found out, but of twenty in rough wind
        one mean in forty still lies beyond four of the stated errors (docs/science/zero-level.md).
    reach : float
        The offset along the axis is searched within so many sigmas of its pre-flight value. Assumed.
    determined_part : float
        A parameter is determined when its sigma is below this part of the prior's. Assumed.
    published_sigmas : float
        A published uncertainty is so many standard deviations of white noise (Plaschke et al. 2019, table 2).
    """

    zero_interval_s: float = 900.0
    fewest_intervals: int = 24
    reach: float = 3.0
    determined_part: float = 0.5
    published_sigmas: float = 1.7


SPIN_TABLE_SETTINGS = SpinTableSettings()

#: Codes of the variable `source`, as `inflight.calibration.table.VALUE_ORIGINS` has them.
_PRIOR, _DATA = 0, 2

#: Places of the eight among the twelve.
_EIGHT = np.array([PARAMETER_NAMES.index(name) for name in SPIN_RELATED])

#: The parameter that leaves no tone and is found from natural fluctuations.
AXIAL = "offset[3]"

#: Origin of what a model of the Earth's field tells.
FIELD_MODEL = "field model"


@dataclass(frozen=True)
class _Row:
    """One interval of a table.

    Attributes
    ----------
    learnt : tuple of int
        Half-open TT2000 of the days with estimates that the values in use rest on last; empty for none.
    twelve, covariance : ParameterTable and ndarray, shape (12, 12)
        The values in use and their covariance.
    decisions : mapping of str to Decision
        What was decided on the interval's estimate of each parameter.
    conditional : ndarray, shape (12,)
        Sigma of the values in use for given values of what leaves no tone.
    own : tuple of ndarray, each of shape (12,)
        The interval's own estimates and their sigma for these values; NaN and infinite for none.
    days, used : int and float
        Days, and sub-intervals used.
    excess : float
        Scatter of the days over its expectation, a factor of the variance.
    """

    start: int
    end: int
    learnt: tuple[int, int]
    twelve: ParameterTable
    covariance: Floats
    conditional: Floats
    decisions: Mapping[str, Decision]
    own: tuple[Floats, Floats]
    days: int
    used: float
    excess: float


def _windows(
    days: Sequence[xr.Dataset], edges: Sequence[np.datetime64], progress: Progress, *, cut: bool = False
) -> Iterator[tuple[int, int, list[xr.Dataset]]]:
    """Yield TT2000 start and end of each window that has days, and its days, or parts of days.

    With `cut` a window ends where a day is cut, too.
    """
    bounds = {day_bounds(edge)[0] for edge in edges}
    parts = parts_of(days)
    starts = np.array([int(part["start"].values[0]) for part in parts], dtype=np.int64)
    if cut:
        bounds |= {at for at in starts.tolist() if at != day_bounds(str(day_of(at)))[0]}
    for start, end in tell_each(progress, "intervals", list(itertools.pairwise(sorted(bounds)))):
        inside = [parts[place] for place in np.flatnonzero((starts >= start) & (starts < end))]
        if inside:
            yield start, end, inside


def spin_table(
    days: Sequence[xr.Dataset],
    model: Model,
    edges: Sequence[np.datetime64],
    kind: str,
    zero: xr.Dataset | None = None,
    external_nT: float | None = None,
    progress: Progress = silent,
) -> xr.Dataset:
    """Return the table of windows of days; windows without a day are skipped.

    Days are weighted by their information beyond the prior. Where they scatter by more than their errors,
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
    external_nT : float, optional
        What the field model lacks that tells gains and rotation (`inflight.spin.fit_held`); without it
        they keep the ground's values.
    progress : callable, optional
        Called with ("intervals", done, total).

    Returns
    -------
    xarray.Dataset
        Twelve parameters an interval, with the variables of `inflight.calibration.table`: the values in use.
        `sigma` and `covariance` hold the errors of all twelve; `conditional_sigma` is that of the eight for
        given values of `inflight.spin.HELD`, which leave no tone: what tones tell. `own`, `own_sigma` are the
        interval's own estimates and their conditional sigma, infinite where it has none; `decision` (update,
        confirm, keep; empty for what stays as on the ground) and `reason` state what was decided on these.
    """
    entry = require_spinning(model)
    in_use = _InUse.from_ground(entry, day_bounds(edges[0])[0], external_nT)
    rows = [
        in_use.row(inside, entry, start, end, zero)
        for start, end, inside in _windows(days, edges, progress, cut=True)
    ]
    return _table(rows, entry, {"comparison": model.comparison, "kind": kind, "model": model.sha})


@dataclass
class _InUse:
    """The values in use, from one interval to the next."""

    eight: SpinParametersInUse
    axial: ValueInUse
    #: Gains and rotation, which a field model tells, and the correlation of the four of `HELD`.
    others: dict[str, ValueInUse]
    correlation: Floats
    external: float | None = None
    source: str = GROUND
    learnt: tuple[int, int] = (0, 0)

    @classmethod
    def from_ground(cls, entry: ModelEffect, tt2000: int, external: float | None) -> _InUse:
        """Return the values in use before the flight."""
        ground, sigma = ground_of(entry, tt2000)
        values = dict(zip(PARAMETER_NAMES, ground.values().tolist(), strict=True))
        held = {name: ValueInUse(name, values[name], sigma[name]) for name in HELD}
        axial, eight = held.pop(AXIAL), SpinParametersInUse.from_ground(ground, sigma)
        return cls(eight, axial, held, np.eye(len(HELD)), external)

    def row(
        self, days: Sequence[xr.Dataset], entry: ModelEffect, start: int, end: int, zero: xr.Dataset | None
    ) -> _Row:
        """Decide on the estimates of an interval's days, and return what is used in it."""
        ground, sigma = ground_of(entry, (start + end) // 2)
        prior = np.array([sigma[name] for name in SPIN_RELATED])
        value, covariance, excess = _combine_days(days, ground.spin_related(), prior)
        free = [entry.parameters[name.partition("[")[0]].free for name in SPIN_RELATED]
        determined = (np.sqrt(np.diag(covariance)) < SPIN_TABLE_SETTINGS.determined_part * prior) & free
        step = self.eight.update(value, covariance, determined, (start + end) // 2 / DAY)
        self.eight = step.used
        axial = _axial_offset(zero, start, end)
        decision, self.axial, error = self.axial.update(axial.value, axial.sigma)
        if decision.verdict == "update":
            self.source = axial.source
        decisions = dict(zip(SPIN_RELATED, step.decisions, strict=True)) | {AXIAL: decision}
        told = self._by_field_model(days, entry, (ground, sigma), error)
        if AXIAL in told:
            decisions[AXIAL], axial, error = told.pop(AXIAL)
        decisions |= {name: one[0] for name, one in told.items()}
        stated = np.where(self.eight.from_flight, np.sqrt(np.diag(step.covariance)), np.inf)
        parameters = ground.changed(dict(zip(SPIN_RELATED, self.eight.value.tolist(), strict=True)))
        others = self._values_of_held({AXIAL: error, **{name: one[2] for name, one in told.items()}})
        twelve = join_parameters((self.eight.value, stated, parameters), ground, sigma, others)
        used = float(sum(np.isfinite(day["estimate"].values[..., 0]).sum() for day in days))
        # The interval's own offsets 1 and 2, too, are those for the third offset in use.
        estimated = ground.changed(dict(zip(SPIN_RELATED, step.estimate.tolist(), strict=True)))
        own = join_parameters((step.estimate, step.sigma, estimated), ground, sigma, others)
        own_value, own_sigma = np.full(len(PARAMETER_NAMES), np.nan), np.full(len(PARAMETER_NAMES), np.inf)
        conditional = twelve.sigma.copy()
        for order, at in enumerate(_EIGHT):
            if np.isfinite(step.sigma[order]):
                own_value[at], own_sigma[at] = own.value[at], step.sigma[order]
            if np.isfinite(stated[order]):
                conditional[at] = stated[order]
        for name, estimate in {AXIAL: axial, **{name: one[1] for name, one in told.items()}}.items():
            if np.isfinite(estimate.sigma):
                at = PARAMETER_NAMES.index(name)
                own_value[at], own_sigma[at] = estimate.value, estimate.sigma
        full = _full_covariance(twelve, step.covariance, stated, self.correlation)
        sigma_of_all = np.where(np.isfinite(twelve.sigma), np.sqrt(np.diag(full)), twelve.sigma)
        twelve = replace(twelve, sigma=sigma_of_all)
        taught = [day for day in days if np.isfinite(day["sigma"].values[0]).any()]
        if taught:
            # An interval without estimates goes on with values that an earlier one was taught.
            self.learnt = int(taught[0]["start"].values[0]), int(taught[-1]["end"].values[0])
        return _Row(
            start=start,
            end=end,
            learnt=self.learnt,
            twelve=twelve,
            covariance=full,
            conditional=conditional,
            decisions=decisions,
            own=(own_value, own_sigma),
            days=len(days),
            used=used,
            excess=excess,
        )

    def _values_of_held(self, errors: Mapping[str, float]) -> dict[str, ExternalValue]:
        """Return what the flight tells of `HELD`, with the errors to be stated where they are given."""
        sources = {name: (one, FIELD_MODEL) for name, one in self.others.items()}
        return {
            name: ExternalValue(one.value, errors.get(name, one.sigma), source)
            for name, (one, source) in {**sources, AXIAL: (self.axial, self.source)}.items()
            if one.from_flight
        }

    def _by_field_model(
        self,
        days: Sequence[xr.Dataset],
        entry: ModelEffect,
        before: tuple[CalibrationParameters, Mapping[str, float]],
        axial_error: float,
    ) -> dict[str, tuple[Decision, ExternalValue, float]]:
        """Decide on what a field model tells of `HELD`: decision, estimate and the error to be stated.

        The third offset is held at the value in use by its error, and told where it is known much better
        afterwards: zero levels of the solar wind are better than any model.
        """
        if self.external is None:
            return {}
        ground, sigma = before
        at_ground = {name: float(ground.values()[PARAMETER_NAMES.index(name)]) for name in HELD}
        known = {**sigma, AXIAL: axial_error}
        shift = np.array([self.axial.value - at_ground[name] if name == AXIAL else 0.0 for name in HELD])
        found = fit_held(
            np.concatenate([day["near_earth"].values[0] for day in days]),
            shift,
            np.array([known[name] for name in HELD]),
            self.external,
        )
        if found is None:
            return {}
        errors = np.sqrt(np.diag(found.covariance))
        self.correlation = found.covariance / np.outer(errors, errors)
        out = {}
        for name, value, error in zip(HELD, found.value.tolist(), errors.tolist(), strict=True):
            parameter = entry.parameters[name.partition("[")[0]]
            told = parameter.free and parameter.time == "block"
            if not told or error > SPIN_TABLE_SETTINGS.determined_part * known[name]:
                continue
            estimate = ExternalValue(at_ground[name] + value, error, FIELD_MODEL)
            if name == AXIAL:
                decision, self.axial, stated = self.axial.update(estimate.value, error)
                self.source = FIELD_MODEL if decision.verdict == "update" else self.source
            else:
                decision, self.others[name], stated = self.others[name].update(estimate.value, error)
            out[name] = decision, estimate, stated
        return out


def _combine_days(days: Sequence[xr.Dataset], start: Floats, prior: Floats) -> tuple[Floats, Floats, float]:
    """Return values of the eight, their covariance, and the days' scatter over its expectation.

    Parameters
    ----------
    start, prior : ndarray, shape (8,)
        The prior's values and sigmas, which each day's estimate holds, too.
    """
    before = np.diag(prior**-2.0)
    information, right = before.copy(), before @ start
    parts, free = [], 0
    for day in days:
        own = np.linalg.inv(day["covariance"].values[0])
        if not np.isfinite(day["sigma"].values[0]).any():
            continue  # a day without estimates
        # In units of the prior's sigmas: the combinations on which the day adds information.
        weight, vectors = np.linalg.eigh((own - before) * np.outer(prior, prior))
        known = vectors[:, weight > 0.0]
        added = (known * weight[weight > 0.0]) @ known.T / np.outer(prior, prior)
        free += int(np.count_nonzero(weight > 1.0))
        # The day's value less the prior's part in it.
        value_of_day = own @ day["value"].values[0] - before @ start
        value_of_day = known @ (known.T @ (value_of_day * prior)) / prior
        information, right = information + added, right + value_of_day
        parts.append((added, day["value"].values[0]))
    covariance = np.linalg.inv(information)
    value = covariance @ right
    square = sum(float((one - value) @ added @ (one - value)) for added, one in parts)
    free -= int(np.count_nonzero(np.linalg.eigvalsh((information - before) * np.outer(prior, prior)) > 1.0))
    excess = max(1.0, square / free) if free > 0 else 1.0
    return value, np.asarray(covariance * excess), excess


def _axial_offset(zero: xr.Dataset | None, start: int, end: int) -> ExternalValue:
    """Return the offset along the spin axis: of the interval around a window, or of all those in it.

    The mean of several is weighted, its error widened where they scatter beyond theirs. The sigma is
    infinite where there is none.
    """
    unknown = ExternalValue(float("nan"), float("inf"), GROUND)
    if zero is None:
        return unknown
    begins, ends = zero["start"].values, zero["end"].values
    middle = (start + end) // 2
    around = (begins <= middle) & (middle < ends)
    inside = (begins >= start) & (ends <= end)
    taken = np.flatnonzero((inside if inside.sum() > 1 else around) & np.isfinite(zero["sigma"].values))
    if not taken.size:
        return unknown
    value, sigma = (np.asarray(zero[name].values[taken], dtype=np.float64) for name in ("value", "sigma"))
    # Weights relative to the best: the mean of one value is that value to the last digit.
    best = float(sigma.min())
    weight = (best / sigma) ** 2.0
    mean = float(weight @ value / weight.sum())
    scatter = float(weight @ ((value - mean) / best) ** 2) / max(taken.size - 1, 1)
    method = str(zero["method"].values[taken[-1]])
    source = method if taken.size == 1 else f"{method}, mean of {taken.size} windows"
    return ExternalValue(mean, best * float(np.sqrt(max(1.0, scatter) / weight.sum())), source)


def _full_covariance(
    twelve: ParameterTable, covariance: Floats, sigma: Floats, correlation: Floats | None = None
) -> Floats:
    """Return the covariance of the twelve: that of the eight, and that of the others by their correlation.

    The eight change with the errors of what leaves no tone (`inflight.spin.held_slopes`), so that nearly all
    of these cancels in the tones of the product. The `sigma` of the eight is infinite for those that the
    flight has not determined.
    """
    out = np.diag(np.where(np.isfinite(twelve.sigma), twelve.sigma, 0.0) ** 2)
    known = np.isfinite(sigma)
    places, held = _EIGHT[known], np.array([PARAMETER_NAMES.index(name) for name in HELD])
    slopes, errors = held_slopes(twelve.parameters)[known], np.sqrt(out[held, held])
    four = np.outer(errors, errors) * (np.eye(len(HELD)) if correlation is None else correlation)
    out[np.ix_(held, held)] = four
    out[np.ix_(places, places)] = covariance[np.ix_(known, known)] + slopes @ four @ slopes.T
    out[np.ix_(places, held)] = slopes @ four
    out[np.ix_(held, places)] = out[np.ix_(places, held)].T
    return out


def _table(rows: Sequence[_Row], entry: ModelEffect, attributes: Mapping[str, str]) -> xr.Dataset:
    ground, sigma = ground_of(entry, rows[0].start)
    names = [f"{entry.name}.{name}" for name in PARAMETER_NAMES]
    each, one = ("interval", "parameter"), ("interval",)
    from_ground = [[source == GROUND for source in row.twelve.source] for row in rows]
    decided = [[row.decisions.get(name) for name in PARAMETER_NAMES] for row in rows]
    undecided = "nothing in flight tells it: as on the ground"
    verdicts = [[one.verdict if one else "" for one in row] for row in decided]
    reasons = [[one.reason if one else undecided for one in row] for row in decided]
    table = xr.Dataset(
        {
            "value": (each, np.array([row.twelve.value for row in rows])),
            "sigma": (each, np.array([row.twelve.sigma for row in rows])),
            "covariance": ((*each, "other"), np.array([row.covariance for row in rows])),
            "conditional_sigma": (each, np.array([row.conditional for row in rows])),
            "determined": (each, np.array([row.twelve.determined for row in rows])),
            "source": (each, np.where(from_ground, _PRIOR, _DATA).astype(np.int8)),
            "origin": (each, np.array([row.twelve.source for row in rows], dtype=np.str_)),
            "own": (each, np.array([row.own[0] for row in rows])),
            "own_sigma": (each, np.array([row.own[1] for row in rows])),
            "decision": (each, np.array(verdicts, dtype="U8")),
            "reason": (each, np.array(reasons, dtype=np.str_)),
            "prior": ("parameter", ground.values()),
            "prior_sigma": ("parameter", np.array([sigma[name] for name in PARAMETER_NAMES])),
            "units": ("parameter", np.array([PARAMETER_UNITS[name] for name in PARAMETER_NAMES], dtype="U8")),
            "start": (one, np.array([row.start for row in rows], dtype=np.int64), {"scale": "TT2000"}),
            "end": (one, np.array([row.end for row in rows], dtype=np.int64), {"scale": "TT2000"}),
            "blocks": (one, np.array([row.days for row in rows], dtype=np.int64)),
            "count": (one, np.array([row.used for row in rows])),
            "inflation": (one, np.array([row.excess for row in rows])),
        },
        coords={"parameter": names, "other": names},
        attrs=dict(attributes),
    )
    learnt = np.array([row.learnt for row in rows], dtype=np.int64)
    table = with_learnt_spans(table, learnt[:, 0], learnt[:, 1])
    # Values in use stay as they are until an estimate warrants others: the estimates tell the changes.
    own = table["own"].where(np.isfinite(table["own"]), table["value"])
    return with_changes(table, [table.assign(value=own)])


def zero_level_table(
    days: Sequence[xr.Dataset], model: Model, edges: Sequence[np.datetime64], progress: Progress = silent
) -> xr.Dataset:
    """Return the offset along the spin axis in windows of days, from the statistics of natural fluctuations.

    Parameters
    ----------
    days : sequence of Dataset
        With `mean` and `mean_time`.
    edges : sequence of datetime64[D]
        Of the windows.

    Returns
    -------
    xarray.Dataset
        dims interval: `value`, `sigma` (infinite without an estimate) nT, sensor axis 3, in units of the
        reading; `method`, `reason`; `method_value`, `method_sigma` (interval, method) nT and `method_used`,
        intervals of 15 minutes each method took, of each method by itself; `start`, `end` TT2000.
    """
    entry = require_spinning(model)
    rows = []
    for start, end, inside in _windows(days, edges, progress):
        ground, sigma = ground_of(entry, (start + end) // 2)
        rows.append((start, end, _zero_level(inside, ground, SPIN_TABLE_SETTINGS.reach * sigma[AXIAL])))
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
class _ZeroLevel:
    """A window's offset along the spin axis; `each` has value, sigma and intervals of `COMBINED_METHODS`."""

    value: float
    sigma: float
    method: str
    reason: str
    intervals: int
    each: Floats


def _zero_level(days: Sequence[xr.Dataset], ground: CalibrationParameters, bound: float) -> _ZeroLevel:
    """Return a window's offset along the spin axis, of all methods and of each."""
    times = np.concatenate([day["mean_time"].values[0] for day in days])
    means = np.concatenate([day["mean"].values[0] for day in days])
    order = np.argsort(times, kind="stable")
    order = order[np.isfinite(means[order]).all(axis=1)]
    times, means = times[order], means[order]
    each = np.array([[np.nan], [np.inf], [0.0]]) * np.ones(len(COMBINED_METHODS))
    count, start = 0, float(ground.offset[2])
    search = OffsetSearch(free=(False, False, True), bound=bound)
    try:
        intervals = Intervals.of(times, means, SPIN_TABLE_SETTINGS.zero_interval_s)
        count = len(intervals.start)
        if count < SPIN_TABLE_SETTINGS.fewest_intervals:
            why = f"{count} quarter hours, at least {SPIN_TABLE_SETTINGS.fewest_intervals} needed"
            return _ZeroLevel(start, float("inf"), GROUND, why, count, each)
        found = combine_methods(intervals, search)
    except InflightError as error:
        return _ZeroLevel(start, float("inf"), GROUND, error.message, count, each)
    # The methods give the field along the axis, the calibration matrix times the error of the offset.
    gain = float(ground.matrix()[2, 2])
    for one in (one for one in found.methods if one.method in COMBINED_METHODS):
        column = start + one.value[2] / gain, one.sigma[2] / gain, int(one.used.sum())
        each[:, COMBINED_METHODS.index(one.method)] = column
    estimate = found.estimate
    if not estimate.determined[2]:
        return _ZeroLevel(start, float("inf"), GROUND, "; ".join(estimate.reasons), count, each)
    value, sigma = start + float(estimate.value[2]) / gain, float(estimate.sigma[2]) / gain
    return _ZeroLevel(value, sigma, estimate.method, found.summary(), count, each)


TABLES = ("daily", "window", "zero-level")


@dataclass(frozen=True)
class SpinResults:
    """Tables and day results of a spin comparison.

    Attributes
    ----------
    tables : mapping of str to Dataset
        ``daily``, ``window``, ``zero-level``.
    days : list of Dataset
        As `inflight.tasks.pipelines.spin.day.spin_day` makes them, those of the daily table; one a part of a
        day that is cut.
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
        days = set(day_of(tables["daily"]["start"].values).tolist())
        records = [
            day for day in cat.days(equations_of(comparison), states=("published",)) if day.day.item() in days
        ]
        products = [
            day for day in cat.days(product_of(comparison), states=("published",)) if day.day.item() in days
        ]
        parts = parts_of(cat.read(day) for day in records)
        return cls(cat, mission, comparison, tables, parts, records, products)

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
        own = self.tables["daily"]["own"].values[:, _EIGHT]
        value, sigma = np.full(own.shape, np.nan), np.full(own.shape, np.inf)
        rows = self.tables["daily"]["start"].values.tolist()
        for day in self.days:
            # A day of the table may have been removed since.
            row, which = rows.index(int(day["start"].values[0])), _filled(day)
            one = cloud_of(
                *(day[name].values[0][which] for name in ("sub_start", "sub_end", "estimate", "uncertainty"))
            )
            # Estimates go with the pre-flight third offset, the table's offsets with the one in use.
            value[row] = one.value + np.nan_to_num(own[row] - day["value"].values[0])
            sigma[row] = one.sigma
        return value, sigma


def _filled(day: xr.Dataset) -> Bools:
    """Return which of a day's sub-intervals are not padding, (sub,): that has no length."""
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
        expected = float(np.sqrt(np.sum((errors / SPIN_TABLE_SETTINGS.published_sigmas) ** 2)) / mine.size)
        sigma[at] = max(expected, sigma_of_mean(mine))
    return SubintervalEstimates(start, end, estimate, uncertainty, chosen, threshold, value, sigma)


#: Offsets along x and z among the twelve.
_X, _Z = PARAMETER_NAMES.index("offset[1]"), PARAMETER_NAMES.index("offset[3]")


def flipper_table(
    days: Sequence[xr.Dataset], model: Model, edges: Sequence[np.datetime64], mission: Mission
) -> xr.Dataset:
    """Return the offsets of sensors and spacecraft that each flip separates, by the positions around it.

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
    determined = np.where(table["determined"].values, table["value"].values, np.nan)
    # Edges of positions lie within half a day of the flip.
    middle = (table["start"].values + table["end"].values) // 2
    rows: list[tuple[int, int, FlipperSolution]] = []
    missing = []
    for at, flipped in flips_of(mission):
        before, after = np.flatnonzero(middle < at), np.flatnonzero(middle >= at)
        if not before.size or not after.size:
            missing.append(f"{utc_text(at)}: no day on one side")
            continue
        places = np.array([before[-1], after[0]] if flipped else [after[0], before[-1]])
        # The covariance of z and x, plain and flipped: positions are independent of each other.
        covariance = np.zeros((4, 4))
        for place, own in zip(places, (np.array([0, 2]), np.array([1, 3])), strict=True):
            covariance[np.ix_(own, own)] = table["covariance"].values[place][np.ix_([_Z, _X], [_Z, _X])]
        (z, z_flipped), (x, x_flipped) = (determined[places, axis].tolist() for axis in (_Z, _X))
        try:
            found = separate_flipped((z, z_flipped), (x, x_flipped), covariance)
        except CalibrationError as error:
            missing.append(f"{utc_text(at)}: {error.message}")
            continue
        rows.append((max(at, int(table["start"].values[0])), int(table["end"].values[after[0]]), found))
    if not rows:
        raise CalibrationError(
            f"no flip tells sensors and spacecraft apart: {'; '.join(missing)}",
            remedy="take a span with some days of wind in both positions",
        )
    # The offsets of a flip hold until the next one, whatever days its position has.
    ends = [*(later[0] for later in rows[1:]), rows[-1][1]]
    each, one = ("interval", "parameter"), ("interval",)
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
