"""Continuous parameters: one trend in time for a whole mission, without a jump (Yin 2010, ch. 3).

A trend is fitted to the summed normal equations of all blocks, or to a table of daily or 15-day values,
whose covariances make normal equations of it: one way for both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NormalEquations
from inflight.calibration.equations import larger_scatter
from inflight.calibration.solution import residual_sum, solve
from inflight.effects.base import Parameter
from inflight.errors import CalibrationError
from inflight.estimators.block_sums import BlockSums
from inflight.estimators.days import mjd_of
from inflight.estimators.longrun import long_run_covariance
from inflight.estimators.trend_equations import (
    at_one_reference,
    check_names,
    middles,
    outlier_weights,
    own_wish,
)
from inflight.estimators.trend_functions import Expansion
from inflight.model.dependence import Dependence
from inflight.model.timed import TimedValue, component_names
from inflight.time import Int64

#: Turns of weights and fit.
_TURNS = 4


@dataclass(frozen=True)
class Origin:
    """Origin of a logarithm of time, fitted; days are MJD of 2000-01-01 (UTC).

    Attributes
    ----------
    mjd, sigma : float
        Best value and its standard deviation (Gauss-Newton, between blocks).
    low, high : float
        95 % interval of the profile; minus infinity where a straight line would do as well.
    determined : bool
        False when the interval has no lower end: then the trend keeps the origin it was given.
    shared : ndarray, shape (column,)
        Covariance of the origin with the coefficients.
    """

    mjd: float
    sigma: float
    low: float
    high: float
    determined: bool
    shared: Floats

    def told(self) -> str:
        """Say it in a sentence."""
        if not self.determined:
            return "the origin of the logarithm is NOT DETERMINED: its interval has no lower end"
        return f"origin MJD {self.mjd:.2f} +- {self.sigma:.2g} (95 %: {self.low:.2f} to {self.high:.2f})"


@dataclass(frozen=True)
class TrendFit:
    """Trends of some parameters, fitted together with all others held constant.

    Attributes
    ----------
    trends : mapping of str to Dependence
        For every parameter of the equations, how it depends on time; constant unless asked for.
    columns : tuple of str
        Coefficients, parameter by parameter: ``parameter``, ``parameter*b``, ...
    value, covariance : ndarray, shape (column,), (column, column)
        Physical units; the covariance is the sandwich of the blocks' scores with their correlation in time.
    determined : ndarray of bool, shape (column,)
        The data tell it from all others.
    weight : ndarray, shape (block,)
        1, less for outlying blocks.
    rms : float
        Weighted rms residual: nT, or stated sigmas for a table.
    blocks : int
        Number of blocks.
    span : tuple of int
        TT2000, half-open.
    units : mapping of str to str
        Unit of each parameter.
    origin : Origin, optional
        Present when the origin was fitted.
    """

    trends: dict[str, Dependence]
    columns: tuple[str, ...]
    value: Floats
    covariance: Floats
    determined: np.ndarray
    weight: Floats
    rms: float
    blocks: int
    span: tuple[int, int]
    units: dict[str, str]
    origin: Origin | None = None

    @property
    def sigma(self) -> Floats:
        """Standard deviations of the coefficients; (column,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def place(self, parameter: str) -> slice:
        """Return where a parameter's coefficients stand among the columns."""
        begin = 0
        for name, trend in self.trends.items():
            if name == parameter:
                return slice(begin, begin + trend.count)
            begin += trend.count
        raise CalibrationError(f"no parameter {parameter!r}", remedy=f"one of {', '.join(self.trends)}")

    def at(self, times: Int64) -> tuple[Floats, Floats]:
        """Return values and standard deviations at TT2000 times; (time, parameter) each, physical units."""
        covariance = self.whole_covariance
        variance = []
        for name in self.trends:
            slope = self.slopes(times, [name])[:, 0]
            own = np.append(
                np.arange(self.value.size)[self.place(name)], np.arange(self.value.size, len(covariance))
            )
            part = slope[:, own]
            variance.append(np.einsum("ti,ti->t", part @ covariance[np.ix_(own, own)], part))
        return self.values(times), np.sqrt(np.maximum(np.stack(variance, axis=1), 0.0))

    def values(self, times: Int64) -> Floats:
        """Return the parameters at TT2000 times; (time, parameter), physical units."""
        places = [(trend.basis(times, name), self.place(name)) for name, trend in self.trends.items()]
        return np.stack([basis @ self.value[place] for basis, place in places], axis=1)

    @property
    def whole_covariance(self) -> Floats:
        """Covariance of the coefficients, and of the origin (days) behind them where it was fitted."""
        found = self.origin
        if found is None or not found.determined:
            return self.covariance
        edge = found.shared[:, None]
        return np.block([[self.covariance, edge], [edge.T, np.array([[found.sigma**2]])]])

    def slopes(self, times: Int64, names: Sequence[str] | None = None) -> Floats:
        """Return what parameters change by for one unit of each unknown of `whole_covariance`.

        d/dt0 of ``b ln((t - t0)/per)`` is ``-b / (t - t0)``.

        Parameters
        ----------
        times : ndarray of int64, shape (time,)
            TT2000.
        names : sequence of str, optional
            Parameters; all when absent.

        Returns
        -------
        ndarray, shape (time, parameter, unknown)
        """
        chosen = list(self.trends) if names is None else names
        unknowns = len(self.whole_covariance)
        out = np.zeros((times.size, len(chosen), unknowns))
        for index, name in enumerate(chosen):
            place, trend = self.place(name), self.trends[name]
            out[:, index, place] = trend.basis(times, name)
            if trend.time == "log" and unknowns > self.value.size:
                out[:, index, -1] = self.by_origin(name, times)
        return out

    def by_origin(self, name: str, times: Int64) -> Floats:
        """Return the change of a parameter that follows a logarithm for one day of its origin; (time,)."""
        trend = self.trends[name]
        return np.asarray(-self.value[self.place(name)][1] / (mjd_of(times) - float(mjd_of(trend.t0))))

    def table(self) -> xr.Dataset:
        """Return the coefficients: dims parameter (one a coefficient), other; valid from `start` to `end`.

        The attributes hold the origin where it was fitted.
        """
        units = [self.units.get(column.split("*")[0], "") for column in self.columns]
        found = self.origin
        attributes = {} if found is None else {"origin": found.told(), "origin_mjd": found.mjd}
        return xr.Dataset(
            {
                "value": ("parameter", self.value),
                "sigma": ("parameter", self.sigma),
                "covariance": (("parameter", "other"), self.covariance),
                "determined": ("parameter", self.determined),
                "units": ("parameter", np.array(units, dtype="U16")),
                "time": ("parameter", np.array([self._time_of(column) for column in self.columns])),
                "start": ((), np.int64(self.span[0]), {"scale": "TT2000"}),
                "end": ((), np.int64(self.span[1]), {"scale": "TT2000"}),
            },
            coords={"parameter": list(self.columns), "other": list(self.columns)},
            attrs={**attributes, "rms": self.rms, "blocks": self.blocks},
        )

    def _time_of(self, column: str) -> str:
        return self.trends[column.split("*", maxsplit=1)[0]].time

    def as_timed(self, key: str, parameter: Parameter, *, free: bool = False) -> TimedValue:
        """Return a parameter of a model, ready for its YAML (`TimedValue.as_yaml`).

        Parameters
        ----------
        key : str
            ``effect.parameter``, such as ``vector_sensor.scale_factor``; all its components have one trend.
        parameter : Parameter
            What the effect says of it.
        free : bool
            Whether later fits may move it.

        Raises
        ------
        CalibrationError
            When components follow different trends.
        """
        names = component_names(key, parameter)
        first = self.trends[names[0]] if names[0] in self.trends else Dependence()
        if any(self.trends.get(name) != first for name in names):
            raise CalibrationError(f"components of '{key}' follow different trends", remedy="fit one for all")
        places = [self.place(name) for name in names]
        return TimedValue(
            parameter,
            first.time,
            np.array([self.value[place] for place in places]),
            np.array([self.sigma[place] for place in places]),
            free=free,
            t0=first.t0,
            per=first.per,
            key=key,
            moments=first.at,
            interpolation=first.interpolation,
        )


def fit_trends(
    equations: NormalEquations,
    trends: Mapping[str, Dependence],
    prior_sigma: Floats,
    weight: Floats | None = None,
    units: Mapping[str, str] | None = None,
) -> TrendFit:
    """Fit trends to the summed equations of all blocks.

    Parameters
    ----------
    equations : NormalEquations
        Of days, or of a table (`inflight.estimators.trend_equations.equations_of_table`).
    trends : mapping of str to Dependence
        Parameters that depend on time; the others are constant over the span.
    prior_sigma : ndarray, shape (column,)
        What is known beforehand of each parameter around its reference, physical units; every function of
        time may move it by as much. 0 fixes a parameter.
    weight : ndarray, shape (block,), optional
        Weights; from the blocks themselves when absent: blocks that want parameters far from the
        trend's, as measured by all blocks' own scatter, lose their say.

    Raises
    ------
    CalibrationError
        When there are fewer blocks than coefficients of a trend, or a name is unknown.
    """
    check_names(equations, list(trends))
    every = {name: trends.get(name, Dependence()) for name in equations.columns}
    # A trend's origin or knots lie anywhere; blocks at one reference make it one linear problem.
    common = at_one_reference(equations)
    expansion = Expansion.of(middles(common), every)
    turns = 1 if weight is not None else _TURNS
    held = np.ones(len(common)) if weight is None else weight
    for turn in range(turns):
        found = _solve(common, held, expansion, prior_sigma, sure=turn == turns - 1)
        if turn < turns - 1:
            held = outlier_weights(own_wish(common, found.parameters(expansion), prior_sigma))
    start, end = (int(common.dataset[name].values[i]) for name, i in (("start", 0), ("end", -1)))
    return TrendFit(
        every,
        expansion.columns,
        found.value,
        found.covariance,
        found.determined,
        held,
        found.rms,
        len(common),
        (start, end),
        dict(units or {}),
    )


@dataclass(frozen=True)
class Solved:
    """One weighted fit, in coefficients of the trends; see `TrendFit`."""

    value: Floats
    covariance: Floats
    determined: np.ndarray
    rms: float
    total: float

    def parameters(self, expansion: Expansion) -> Floats:
        """Return the parameters at the blocks; (block, parameter)."""
        out, at = [], 0
        for basis in expansion.bases:
            out.append(basis @ self.value[at : at + basis.shape[1]])
            at += basis.shape[1]
        return np.stack(out, axis=1)


def _solve(
    equations: NormalEquations, weight: Floats, expansion: Expansion, prior_sigma: Floats, sure: bool
) -> Solved:
    """Fit the functions; without a covariance, which takes longest, unless asked to be `sure`."""
    data, owners, values = equations.dataset, expansion.owners, expansion.values
    scale = data["scale"].values[:-1][owners]
    sigma = prior_sigma[owners] / scale
    sums = BlockSums(data["gram"].values, weight)
    total = sums.expanded(values, owners)
    within = BlockSums(data["scatter"].values, weight**2).expanded(values, owners)[:-1, :-1]
    count = float((data["count"].values * weight).sum())
    nothing = np.zeros_like(sigma)
    solution = solve(total, within, count, nothing, sigma)
    if len(equations) > 1:
        scores = sums.scores(values, owners, expansion.parameters(solution.value))
        between = scores.T @ scores * len(equations) / (len(equations) - 1)
        scatter = larger_scatter(total[:-1, :-1], within, between, sigma)
        solution = solve(total, scatter, count, nothing, sigma)
    covariance = np.zeros((scale.size, scale.size))
    if sure:
        scores = sums.scores(values, owners, expansion.parameters(solution.value))
        matrix, functions = total[:-1, :-1] / solution.variance, expansion.functions_each
        covariance = sandwich(scores, matrix, solution.variance, sigma, functions)
    covariance *= np.outer(scale, scale)
    # A function of time counts from 0, a constant from the reference.
    still = np.array([trend.count == 1 for trend in expansion.trends.values()])[owners]
    value = np.where(still, equations.reference[owners], 0.0) + solution.value * scale
    back = expansion.back
    left = residual_sum(total, solution.value)
    return Solved(
        back @ value + expansion.unit @ equations.reference,
        back @ covariance @ back.T,
        _determined(expansion, solution.determined),
        float(np.sqrt(left / max(count, 1.0))),
        left,
    )


def _determined(expansion: Expansion, of_functions: np.ndarray) -> np.ndarray:
    """Return which coefficients are determined: all those of a trend whose every function is."""
    out, at = np.empty(of_functions.size, dtype=bool), 0
    for basis in expansion.bases:
        out[at : at + basis.shape[1]] = of_functions[at : at + basis.shape[1]].all()
        at += basis.shape[1]
    return out


def sandwich(
    scores: Floats, matrix: Floats, variance: float, prior_sigma: Floats, functions: float = 1.0
) -> Floats:
    """Return the covariance of a fit from the scatter of its blocks' scores, correlated in time.

    Parameters
    ----------
    scores : ndarray, shape (block, column)
        At the fit, scaled.
    matrix : ndarray, shape (column, column)
        Information of all blocks together.
    variance : float
        Residual variance.
    prior_sigma : ndarray, shape (column,)
        Scaled; 0 for what is fixed.
    functions : float
        Functions of time of each parameter, on average.
    """
    free = np.flatnonzero(prior_sigma > 0)
    grid, unit = np.ix_(free, free), prior_sigma[free]
    # In units of the prior's sigma: the columns differ by many orders.
    bread = np.linalg.inv(matrix[grid] * np.outer(unit, unit) + np.eye(free.size))
    influence = (scores[:, free] * unit / variance) @ bread
    spread = long_run_covariance(influence, functions) + bread @ bread
    # Fewer blocks than parameters leave scores that are too small: never surer than white residuals are.
    lift = np.sqrt(np.maximum(np.diag(bread) / np.maximum(np.diag(spread), 1e-300), 1.0))
    spread *= np.outer(lift, lift)
    out = np.zeros_like(matrix)
    out[grid] = spread * np.outer(unit, unit)
    return np.asarray(out)


def with_origin(fit: TrendFit, origin: Origin) -> TrendFit:
    """Return a fit that tells the origin of its logarithm."""
    return replace(fit, origin=origin)
