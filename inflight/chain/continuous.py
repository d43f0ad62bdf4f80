"""One fit of a whole mission: continuous scale factors, everything else constant, all together.

The scale factors follow one trend in time (Yin 2010, ch. 3), chosen on held-out days unless it is stated;
angles, offsets and all that the model lets data refine have one value. The result is a model and the
calibration table that says how sure it is on each day.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NormalEquations
from inflight.calibration.sensor import PARTS, UNITS, reference_of, vector_sensor_of
from inflight.calibration.solution import residual_sum
from inflight.calibration.table import SOURCES
from inflight.chain.wide import about_offsets, terms_of
from inflight.chain.within import DayDrift, rates
from inflight.estimators.trend_choice import TrendComparison, compare_trends
from inflight.estimators.trend_equations import at_one_reference, make_trend, middles
from inflight.estimators.trend_origin import fit_origin
from inflight.estimators.trends import TrendFit, fit_trends
from inflight.model import Model

#: Trends that are compared, the ones a model's file can hold.
KINDS = ("constant", "linear", "parabola", "log", "spline")
#: Days of a fold at least; spans with fewer keep to what two numbers can say.
_FOLDS, _FOLD_DAYS = 8, 3


@dataclass(frozen=True)
class Continuous:
    """What all days together say.

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
) -> Continuous:
    """Fit all days together.

    Parameters
    ----------
    equations : NormalEquations
        Wide ones of the days (see `inflight.chain.wide`), with day blocks.
    model : Model
        The one they were made with; its sigmas are what is known beforehand.
    kind : str
        Trend of the scale factors; ``auto`` compares them on held-out days.
    origin : int, optional
        TT2000 of a logarithm's origin; fitted when absent.
    drift : DayDrift, optional
        Of these days: what the trend makes of the scale factors within each day is taken out of it.

    Raises
    ------
    CalibrationError
        When the days do not suffice for the trend.
    """
    sigma = np.array([one for term in terms_of(model) for one in term.sigma])
    common = at_one_reference(equations)
    choice = None
    if kind == "auto":
        kind, choice = _choose(common, sigma, _nine(model)[:3], origin)
    fit = _fitted(common, model, sigma, kind, origin)
    if drift is not None:
        # The first fit tells the rates to a part of what they are; they are small themselves.
        equations = drift.taken_out(equations, rates(fit, equations))
        fit = _fitted(at_one_reference(equations), model, sigma, kind, origin)
    return Continuous(fit, choice, continuous_model(model, fit), equations)


def _fitted(
    equations: NormalEquations, model: Model, sigma: Floats, kind: str, origin: int | None
) -> TrendFit:
    """Fit one kind of trend to days at one reference."""
    names, units, times = _nine(model)[:3], _units(model), middles(equations)
    if kind == "log" and origin is None:
        first = int(times[0])
        start = make_trend("log", times, first - (int(times[-1]) - first) // 4)
        return fit_origin(equations, dict.fromkeys(names, start), sigma, units=units)
    trend = make_trend(kind, times, origin if kind == "log" else None)
    return fit_trends(equations, dict.fromkeys(names, trend), sigma, units=units)


def _choose(
    equations: NormalEquations, sigma: Floats, names: list[str], origin: int | None
) -> tuple[str, TrendComparison | None]:
    """Return the kind of trend that foretells held-out days best; all but the nine stay at a common fit."""
    if len(equations) < _FOLDS * _FOLD_DAYS:
        return "linear", None
    wide = fit_trends(equations, dict.fromkeys(names, make_trend("spline", middles(equations))), sigma)
    common = [name for name in equations.columns if name not in names]
    at = equations.reference.copy()
    for name in common:
        at[equations.columns.index(name)] = wide.value[wide.place(name)][0]
    own = equations.columns[:9]
    small = equations.at(at).select(own)
    choice = compare_trends(small, names, sigma[:9], KINDS, t0=origin, folds=_FOLDS)
    return choice.chosen, choice


def continuous_model(model: Model, fit: TrendFit) -> Model:
    """Return the model with fitted values: no parameter belongs to a block any more."""
    own = vector_sensor_of(model)
    kinds = own.effect.parameters()
    timed = {part: fit.as_timed(f"{own.name}.{part}", kinds[part]) for part in PARTS}
    out = model.replace(own.with_parameters(dict(own.parameters) | timed))
    out = about_offsets(out, timed["offset"].value[:, 0])
    others = [name for name in fit.columns if not name.startswith(f"{own.name}.")]
    places = [fit.columns.index(name) for name in others]
    value = dict(zip(others, fit.value[places].tolist(), strict=True))
    return out.with_values(value, dict(zip(others, fit.sigma[places].tolist(), strict=True)))


def continuous_table(
    equations: NormalEquations, found: Continuous, before: Model, noise: Floats
) -> xr.Dataset:
    """Return the calibration table of a continuous fit: one interval a day, without a jump between them.

    Parameters
    ----------
    equations : NormalEquations
        The days', those that tell nothing among them, without what drifts within a day.
    found : Continuous
    before : Model
        What was known before: the prior.
    noise : ndarray, shape (block,)
        Rms residual of the native samples at each day's own fit, nT.

    Returns
    -------
    xarray.Dataset
        As `inflight.calibration.calibration_table`.
    """
    fit, names = found.fit, _nine(found.model)
    prior = reference_of(before, int(middles(equations)[0]))
    common = at_one_reference(equations)
    data, times = common.dataset, middles(common)
    order = [list(fit.trends).index(name) for name in names]
    value = fit.values(times)
    slope = fit.slopes(times, names)
    covariance = np.einsum("tpi,ij,tqj->tpq", slope, fit.whole_covariance, slope, optimize=True)
    own, after = _left(common, value)
    known = np.array([fit.determined[fit.place(name)].all() for name in names])
    each, row = ("interval", "parameter"), ("interval",)
    count = data["count"].values
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
                {"flag_meanings": " ".join(SOURCES)},
            ),
            "prior": ("parameter", prior.value),
            "prior_sigma": ("parameter", prior.sigma),
            "units": ("parameter", np.array(UNITS, dtype="U8")),
            "start": (row, data["start"].values, {"scale": "TT2000"}),
            "end": (row, data["end"].values, {"scale": "TT2000"}),
            "blocks": (row, np.ones(len(times), dtype=np.int64)),
            "directions": (row, np.full(len(times), int(known.sum()), dtype=np.int64)),
            "count": (row, count),
            "before": (row, own),
            # What the whole mission's fit leaves beyond the day's own, on top of the samples' noise.
            "after": (row, np.sqrt(noise**2 + np.maximum(after**2 - own**2, 0.0))),
            "inflation": (row, np.ones(len(times))),
        },
        coords={"parameter": names, "other": names},
        attrs={"comparison": found.model.comparison, "kind": "continuous", "trend": found.kind},
    )


def _left(equations: NormalEquations, value: Floats) -> tuple[Floats, Floats]:
    """Return each block's rms at the nine it was linearised at and at values (block, parameter); nT."""
    scale, gram = equations.dataset["scale"].values[:-1], equations.dataset["gram"].values
    count = np.maximum(equations.dataset["count"].values, 1.0)
    change = (value - equations.reference) / scale
    after = np.array([residual_sum(one, step) for one, step in zip(gram, change, strict=True)])
    least = np.array([_least(one) for one in gram])
    return np.sqrt(least / count), np.sqrt(after / count)


def _least(gram: Floats) -> float:
    """Return what the best nine parameters of a block leave of its square, nT^2."""
    inner, cross = gram[:9, :9], gram[:9, -1]
    size = np.sqrt(np.maximum(np.diag(inner), 1e-300))
    found = np.linalg.lstsq(inner / np.outer(size, size), cross / size)[0]
    return float(max(gram[-1, -1] - found @ (cross / size), 0.0))


def _nine(model: Model) -> list[str]:
    return terms_of(model)[0].columns


def _units(model: Model) -> dict[str, str]:
    return {
        name: term.entry.parameters[name[len(term.key) + 1 :].split("[")[0]].parameter.unit
        for term in terms_of(model)
        for name in term.columns
    }
