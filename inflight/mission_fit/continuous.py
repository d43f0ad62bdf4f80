"""One fit of a whole mission: continuous scale factors, everything else constant, all together.

Takes the days' wide equations; makes a model, the calibration table with its uncertainty on each day,
and each day's own parameters. The scale factors follow one trend in time (Yin 2010, ch. 3),
chosen on held-out days unless it is stated; angles, offsets and all that the model lets data refine have
one value. `fit_with_auxiliary` fits further columns to all days, with the trends of the continuous fit.
`daily_parameters` solves each day for the nine and for named ones such as the time shift, everything else
at the values of the continuous fit: what changes from day to day once everything else is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import (
    PARAMETER_GROUPS,
    PARAMETER_UNITS,
    VALUE_ORIGINS,
    NormalEquations,
    reference_of,
    vector_sensor_of,
)
from inflight.lsq import MAD_TO_SIGMA, RESIDUAL, SOLVER_SETTINGS, gram_inverse, retained_fraction
from inflight.mission_fit.daily_equations import (
    DayDrift,
    about_offsets,
    free_terms,
    prior_sigma_of,
    scale_factor_rates,
)
from inflight.mission_fit.held_numbers import held_variance
from inflight.mission_fit.trend_selection import TrendComparison, compare_trends, fit_origin
from inflight.mission_fit.trends import TrendFit, check_names, fit_trends, make_trend
from inflight.model import Model


@dataclass(frozen=True, kw_only=True)
class ContinuousSettings:
    """How the trend of all days is chosen, and what a day determines.

    Attributes
    ----------
    folds : int
        Held-out sections of the span; assumed.
    fold_days : int
        Days of a section at least; shorter spans keep a straight line; assumed.
    least_retained : float
        Parameters of which the others leave less than this part are not determined by a day; assumed.
    fewest : int
        Fewest differences of neighbouring days that widen the days' own errors; assumed.
    """

    folds: int = 8
    fold_days: int = 3
    least_retained: float = 1e-6
    fewest: int = 10


CONTINUOUS_SETTINGS = ContinuousSettings()


@dataclass(frozen=True)
class MissionFit:
    """The fit of all days together.

    Attributes
    ----------
    fit : TrendFit
        Coefficients of everything, with their covariance.
    choice : TrendComparison or None
        The kinds of trend on held-out days; None when the kind was stated or the span is short.
    model : Model
        With the fitted values; the scale factors as functions of time.
    equations : NormalEquations
        Those that were fitted, without what drifts within the days.
    """

    fit: TrendFit
    choice: TrendComparison | None
    model: Model
    equations: NormalEquations

    @property
    def kind(self) -> str:
        """The trend of the scale factors."""
        return self.fit.trends[_nine(self.model)[0]].time


def fit_mission(
    equations: NormalEquations,
    model: Model,
    kind: str = "auto",
    origin: int | None = None,
    drift: DayDrift | None = None,
) -> MissionFit:
    """Fit all days together.

    Parameters
    ----------
    equations : NormalEquations
        Wide ones of the days (see `inflight.mission_fit.daily_equations`), with day blocks.
    model : Model
        The one they were made with; its sigmas are what is known beforehand.
    kind : str
        Trend of the scale factors; ``auto`` compares them on held-out days.
    origin : int, optional
        TT2000 of a logarithm's origin; fitted when absent.
    drift : DayDrift, optional
        Of these days: what the trend makes of the scale factors within each day is removed.

    Raises
    ------
    CalibrationError
        When the days do not suffice for the trend.
    """
    sigma = prior_sigma_of(model)
    common = equations.at_one_reference()
    choice = None
    if kind == "auto":
        kind, choice = _select_kind(common, sigma, _nine(model)[:3], origin)
    fit = _fit_trend(common, model, sigma, kind, origin)
    if drift is not None:
        # The first fit determines the rates well enough: they are small themselves.
        equations = drift.remove_drift(equations, scale_factor_rates(fit, equations))
        fit = _fit_trend(equations.at_one_reference(), model, sigma, kind, origin)
    return MissionFit(fit, choice, continuous_model(model, fit), equations)


def _fit_trend(
    equations: NormalEquations, model: Model, sigma: Floats, kind: str, origin: int | None
) -> TrendFit:
    """Fit one kind of trend to days at one reference."""
    names, times = _nine(model)[:3], equations.middle
    units = {
        name: term.entry.parameters[name[len(term.key) + 1 :].split("[")[0]].parameter.unit
        for term in free_terms(model)
        for name in term.columns
    }
    if kind == "log" and origin is None:
        first = int(times[0])
        start = make_trend("log", times, first - (int(times[-1]) - first) // 4)
        return fit_origin(equations, dict.fromkeys(names, start), sigma, units=units)
    trend = make_trend(kind, times, origin if kind == "log" else None)
    return fit_trends(equations, dict.fromkeys(names, trend), sigma, units=units)


def _select_kind(
    equations: NormalEquations, sigma: Floats, names: list[str], origin: int | None
) -> tuple[str, TrendComparison | None]:
    """Return the kind of trend that predicts held-out days best; all but the nine stay at a common fit."""
    if len(equations) < CONTINUOUS_SETTINGS.folds * CONTINUOUS_SETTINGS.fold_days:
        return "linear", None
    wide = fit_trends(equations, dict.fromkeys(names, make_trend("spline", equations.middle)), sigma)
    reference = equations.first_reference.copy()
    for place, name in enumerate(equations.columns):
        if name not in names:
            reference[place] = wide.value[wide.index(name)][0]
    nine = equations.at(reference).select(equations.columns[:9])
    choice = compare_trends(nine, names, sigma[:9], t0=origin, folds=CONTINUOUS_SETTINGS.folds)
    return choice.chosen, choice


def continuous_model(model: Model, fit: TrendFit) -> Model:
    """Return the model with fitted values: no parameter belongs to a block any more."""
    own = vector_sensor_of(model)
    kinds = own.effect.parameters()
    timed = {part: fit.to_timed_value(f"{own.name}.{part}", kinds[part]) for part in PARAMETER_GROUPS}
    out = model.replace(own.with_parameters(dict(own.parameters) | timed))
    out = about_offsets(out, timed["offset"].value[:, 0])
    others = [name for name in fit.columns if not name.startswith(f"{own.name}.")]
    places = [fit.columns.index(name) for name in others]
    value = dict(zip(others, fit.value[places].tolist(), strict=True))
    return out.with_values(value, dict(zip(others, fit.sigma[places].tolist(), strict=True)))


def continuous_table(
    equations: NormalEquations, found: MissionFit, before: Model, noise: Floats
) -> xr.Dataset:
    """Return the calibration table of a continuous fit: one interval a day, without a jump between them.

    Parameters
    ----------
    equations : NormalEquations
        The days', those without data among them, without what drifts within a day.
    found : MissionFit
    before : Model
        What was known before: the prior.
    noise : ndarray, shape (block,)
        Rms residual of the native samples at each day's own fit, nT.

    Returns
    -------
    xarray.Dataset
        As `inflight.calibration.calibration_table`, with `number_shift` and `number_sigma` as
        `with_held_numbers`, and `number_correlation` (number, other_number): these numbers are fitted, too.
    """
    fit, names = found.fit, _nine(found.model)
    prior = reference_of(before, int(equations.middle[0]))
    common = equations.at_one_reference()
    times = common.middle
    order = [list(fit.trends).index(name) for name in names]
    value = fit.values(times)
    slope = fit.slopes(times, names)
    covariance = np.einsum("tpi,ij,tqj->tpq", slope, fit.full_covariance, slope, optimize=True)
    # Rms of each day at the nine it was linearised at, and at the fit of all days; nT.
    count = np.maximum(common.count, 1.0)
    least = common.marginalise(common.columns[:9], least_kept=0.0).squares[:, -1]
    own, after = np.sqrt(np.maximum(least, 0.0) / count), np.sqrt(common.squares_at(value) / count)
    known = np.array([fit.determined[fit.index(name)].all() for name in names])
    numbers = [
        name
        for entry in found.model.effects
        if entry.sensor.role == "vector"
        for timed in entry.parameters.values()
        for name in timed.columns
        if name in fit.columns and name not in names and timed.time == "constant"
    ]
    places = [fit.columns.index(name) for name in numbers if fit.sigma[fit.columns.index(name)] > 0]
    joint = {}
    if places:
        shared = fit.full_covariance[:, places] / fit.sigma[places]
        joint = {
            "number_shift": (("interval", "number", "parameter"), np.einsum("tpi,iq->tqp", slope, shared)),
            "number_sigma": ("number", fit.sigma[places]),
            "number_correlation": (("number", "other_number"), (shared[places].T / fit.sigma[places]).T),
        }
    each, row = ("interval", "parameter"), ("interval",)
    shape = (len(times), len(names))
    return xr.Dataset(
        {
            "value": (each, value[:, order]),
            "sigma": (each, np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))),
            "covariance": ((*each, "other"), covariance),
            "determined": (each, np.broadcast_to(known, shape).copy()),
            "retained": (each, np.ones(shape)),
            "source": (
                each,
                np.broadcast_to(np.where(known, 2, 1).astype(np.int8), shape).copy(),
                {"flag_meanings": " ".join(VALUE_ORIGINS)},
            ),
            "prior": ("parameter", prior.value),
            "prior_sigma": ("parameter", prior.sigma),
            "units": ("parameter", np.array(PARAMETER_UNITS, dtype="U8")),
            "start": (row, common.start, {"scale": "TT2000"}),
            "end": (row, common.end, {"scale": "TT2000"}),
            "blocks": (row, np.ones(len(times), dtype=np.int64)),
            "directions": (row, np.full(len(times), int(known.sum()), dtype=np.int64)),
            "count": (row, common.count),
            "before": (row, own),
            # What the whole mission's fit leaves beyond the day's own, on top of the samples' noise.
            "after": (row, np.sqrt(noise**2 + np.maximum(after**2 - own**2, 0.0))),
            "inflation": (row, np.ones(len(times))),
            **joint,
        },
        coords={"parameter": names, "other": names}
        | ({"number": [fit.columns[place] for place in places]} if places else {}),
        attrs={"comparison": found.model.comparison, "kind": "continuous", "trend": found.kind},
    )


def _nine(model: Model) -> list[str]:
    return free_terms(model)[0].columns


def fit_with_auxiliary(
    wide: NormalEquations, equations: NormalEquations, found: MissionFit, sigma: Floats
) -> TrendFit:
    """Fit all columns to all days, with the trends of the continuous fit and the weights it gave to days.

    Parameters
    ----------
    wide : NormalEquations
        The days' equations with more columns, of all days or some.
    equations : NormalEquations
        Those the continuous fit was made from.
    found : MissionFit
    sigma : ndarray, shape (column,)
        What is known beforehand of each, physical units.
    """
    weights = dict(zip(equations.start.tolist(), found.fit.weight.tolist(), strict=True))
    weight = np.array([weights[start] for start in wide.start.tolist()])
    trends = {name: trend for name, trend in found.fit.trends.items() if trend.count > 1}
    return fit_trends(wide, trends, sigma, weight, found.fit.units)


def shift_columns(model: Model) -> list[str]:
    """Return the columns of a model's time shifts that data may move."""
    return [
        name
        for entry in model.effects
        if entry.effect.name == "time_shift" and entry.parameters["seconds"].free
        for name in entry.parameters["seconds"].columns
    ]


def daily_parameters(equations: NormalEquations, found: MissionFit, names: Sequence[str] = ()) -> xr.Dataset:
    """Solve each day for the nine and for named parameters, everything else at the continuous fit.

    A day's own errors are those of what its bins leave. What is correlated for longer than a bin makes
    neighbouring days differ by more than that: a parameter's errors are widened by as much, where there are
    days enough. The own fit's inflation would be too much: it holds what the continuous fit removed. Errors
    of all else at the continuous fit come on top (`held_variance`): they are much the same on all days.

    Parameters
    ----------
    equations : NormalEquations
        Wide ones of the days.
    found : MissionFit
        Fitted to them.
    names : sequence of str
        Further columns to solve for, such as ``time_shift.seconds``.

    Returns
    -------
    xarray.Dataset
        dims interval, parameter: `value`, `sigma`, `own_sigma` (of the day alone, as it differs from others),
        `continuous` (what the fit of all days has for the day), in `units` (parameter); `determined`;
        `inflation` (parameter), by which errors were widened;
        `start`, `end` TT2000 (interval). NaN where a day does not determine it. No prior enters.

    Raises
    ------
    CalibrationError
        When a name is none of the equations' columns.
    """
    check_names(equations, names)
    nine, fit = equations.columns[:9], found.fit
    columns = [*nine, *(name for name in names if name not in nine)]
    order = [list(fit.trends).index(name) for name in equations.columns]
    common = fit.values(equations.middle)[:, order]
    places = equations.index(columns)
    own = equations.at(common).select(columns)
    grams = own.rows([*columns, RESIDUAL], [*columns, RESIDUAL])
    solved = [_solve_day(gram, rows) for gram, rows in zip(grams, equations.count.tolist(), strict=True)]
    change, sigma = (np.array(part) * own.scale[:-1] for part in zip(*solved, strict=True))
    # By how much more neighbouring days differ than by their errors.
    inflation = np.ones(len(columns))
    for index, standardised in enumerate((change / sigma).T):
        steps = np.abs(np.diff(standardised[np.isfinite(standardised)])) / np.sqrt(2.0)
        if steps.size >= CONTINUOUS_SETTINGS.fewest:
            inflation[index] = max(MAD_TO_SIGMA * float(np.median(steps)), 1.0)
    sigma = sigma * inflation
    others = [name for name in equations.columns if name not in columns]
    slope = fit.slopes(equations.middle, others)
    held = held_variance(equations, columns, others, slope @ fit.full_covariance @ np.swapaxes(slope, 1, 2))
    each = ("interval", "parameter")
    return xr.Dataset(
        {
            "value": (each, common[:, places] + change),
            "sigma": (each, np.sqrt(sigma**2 + np.einsum("tpp->tp", held))),
            "own_sigma": (each, sigma),
            "continuous": (each, common[:, places]),
            "determined": (each, np.isfinite(sigma)),
            "inflation": ("parameter", inflation),
            "units": ("parameter", np.array([fit.units.get(name, "") for name in columns], dtype="U16")),
            "start": ("interval", equations.start, {"scale": "TT2000"}),
            "end": ("interval", equations.end, {"scale": "TT2000"}),
        },
        coords={"parameter": columns},
        attrs={"trend": found.kind},
    )


def _solve_day(gram: Floats, rows: float) -> tuple[Floats, Floats]:
    """Return change and sigma of the columns, scaled; NaN for those that the data do not determine.

    `gram` is the Gram matrix of [columns | residual].
    """
    own, cross = gram[:-1, :-1], gram[:-1, -1]
    change, sigma = np.full((2, len(own)), np.nan)
    kept = np.flatnonzero((np.diag(own) > 0) & (retained_fraction(own) > CONTINUOUS_SETTINGS.least_retained))
    if rows <= kept.size or not kept.size:
        return change, sigma
    inverse = gram_inverse(own[np.ix_(kept, kept)], SOLVER_SETTINGS.eigen_cut)
    change[kept] = -inverse @ cross[kept]
    rest = max(float(gram[-1, -1] + change[kept] @ cross[kept]), 0.0)
    sigma[kept] = np.sqrt(np.diag(inverse) * rest / (rows - kept.size))
    return change, sigma
