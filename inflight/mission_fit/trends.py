"""Continuous parameters: one trend in time for a whole mission, without a jump (Yin 2010, ch. 3).

Takes the normal equations of blocks, or a table of daily or 15-day values, whose covariances make normal
equations of it (`equations_of_table`): one way for both. Makes a `TrendFit`. Functions of time are made
orthonormal over the blocks (`Expansion`), so that coefficients are solved for in good units; blocks far
from the trend are weighted down by their score statistic.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NormalEquations, for_given_numbers
from inflight.effects import Parameter
from inflight.errors import CalibrationError
from inflight.lsq import (
    RESIDUAL,
    SOLVER_SETTINGS,
    GramArrays,
    correlated_covariance,
    gram_inverse,
    larger_scatter,
    residual_sum,
    robust_sigma,
    solve,
    solve_scaled,
)
from inflight.model import TimeDependence, TimedValue, component_names
from inflight.time import DAY, Int64, mjd2000


@dataclass(frozen=True, kw_only=True)
class TrendSettings:
    """How blocks are weighted about a trend.

    Attributes
    ----------
    far : float
        Blocks up to so many robust standard deviations from the trend keep their weight; assumed.
    lost : float
        From so many on they have none; assumed.
    at_once : int
        Blocks that are solved together: a matrix of each of three thousand days would fill the memory.
    fewest : int
        Fewest blocks whose scatter shows an outlying one; assumed.
    passes : int
        Passes of weights and fit; assumed.
    """

    far: float = 4.0
    lost: float = 8.0
    at_once: int = 256
    fewest: int = 8
    passes: int = 4


TREND_SETTINGS = TrendSettings()


TREND_KINDS = ("constant", "linear", "parabola", "log", "spline")


def make_trend(
    kind: str, times: Int64, t0: int | None = None, per: int = DAY, knots: int = 5
) -> TimeDependence:
    """Return a kind of trend for a span of times.

    Parameters
    ----------
    kind : str
        constant, linear, parabola (``a + b x + c x^2``, ``x = (t - t0)/per``), log
        (``a + b ln((t - t0)/per)``, Yin 2010 section 3.2) or spline (natural cubic).
    times : ndarray of int64, shape (block,)
        TT2000; a spline has its knots at equal parts of them, so that gaps hold none.
    t0 : int, optional
        Origin; for linear and parabola the middle of the times when absent.

    Raises
    ------
    CalibrationError
        For an unknown kind, a logarithm without an origin before the times, or too few times for a spline.
    """
    if kind not in TREND_KINDS:
        raise CalibrationError(f"trend {kind!r} is unknown", remedy=f"one of {', '.join(TREND_KINDS)}")
    if kind == "constant":
        return TimeDependence()
    if kind == "spline":
        places = np.quantile(times.astype(np.float64), np.linspace(0, 1, knots)).astype(np.int64)
        if np.unique(places).size < max(knots, 2):
            raise CalibrationError(f"{times.size} times make no {knots} knots", remedy="ask for fewer knots")
        return TimeDependence("spline", at=tuple(int(place) for place in places))
    if kind == "log" and (t0 is None or t0 >= times.min()):
        raise CalibrationError(
            "a logarithm of time needs an origin before its first time", remedy="give t0, or have it fitted"
        )
    origin = int(times.min() // 2 + times.max() // 2) if t0 is None else t0
    return TimeDependence(kind, origin, per)


def equations_of_table(table: xr.Dataset) -> NormalEquations:
    """Return the normal equations of a calibration table: generalised least squares.

    An interval with values v and covariance C gives the equations ``|C^-1/2 (p - v)|^2``: a residual of
    unit variance. Values that are NaN or not `determined` (the prior is in them) are left out with
    their part of the covariance.

    Parameters
    ----------
    table : xarray.Dataset
        dims interval, parameter(, other): `value`, `covariance` or `sigma`, `start`, `end` (TT2000), and
        `determined` where known.

    Raises
    ------
    CalibrationError
        When nothing in the table is determined.
    """
    table = for_given_numbers(table)
    value = table["value"].values
    known = np.isfinite(value) & np.isfinite(table["sigma"].values) & (table["sigma"].values > 0)
    if "determined" in table:
        known &= table["determined"].values
    if not known.any():
        raise CalibrationError("the table determines no parameter", remedy="use longer intervals")
    seen = np.where(known, table["sigma"].values, np.nan)
    # A parameter that no interval determines has an empty column, of any unit.
    scale = np.array([np.median(one[np.isfinite(one)]) if np.isfinite(one).any() else 1.0 for one in seen.T])
    centre = np.array(
        [np.median(one[use]) if use.any() else 0.0 for one, use in zip(value.T, known.T, strict=True)]
    )
    grams = np.zeros((len(value), scale.size + 1, scale.size + 1))
    for interval, gram in enumerate(grams):
        use = np.flatnonzero(known[interval])
        if use.size == 0:
            continue
        if "covariance" in table:
            covariance = table["covariance"].values[interval]
        else:
            covariance = np.diag(table["sigma"].values[interval] ** 2)
        unit = scale[use]
        information = gram_inverse(
            covariance[np.ix_(use, use)] / np.outer(unit, unit), SOLVER_SETTINGS.eigen_cut
        )
        away = (value[interval, use] - centre[use]) / unit
        gram[np.ix_(use, use)] = information
        gram[use, -1] = gram[-1, use] = -information @ away
        gram[-1, -1] = away @ information @ away
    # The stated covariances give the scatter of scores within an interval: variance one.
    scatter = grams.copy()
    scatter[:, -1, :] = scatter[:, :, -1] = 0.0
    attributes = {name: table.attrs.get(name, "") for name in ("comparison", "model")}
    blocks = GramArrays(
        (*(str(name) for name in table["parameter"].values), RESIDUAL),
        grams,
        np.asarray(table["start"].values, dtype=np.int64),
        np.asarray(table["end"].values, dtype=np.int64),
        known.sum(axis=1).astype(np.float64),
        np.append(scale, 1.0),
        reference=np.broadcast_to(np.append(centre, 0.0), (len(grams), centre.size + 1)),
        scatter=scatter,
        attributes={**attributes, "filter": "table"},
    )
    return NormalEquations.of_arrays(blocks).filled


def score_statistic(equations: NormalEquations, value: Floats, prior_sigma: Floats) -> Floats:
    """Return how far each block lies from given parameters: by how much its own fit would lower its sum.

    Parameters
    ----------
    value : ndarray, shape (block, column)
        Physical units.
    prior_sigma : ndarray, shape (column,)
        Directions that a block does not determine better than this do not count.

    Returns
    -------
    ndarray, shape (block,)
        Square root of the drop of the sum of squares.
    """
    scale, scores = equations.scale[:-1], equations.scores(value)
    own = equations.squares[:, -1] / np.maximum(equations.count, 1.0)
    variance = max(float(np.median(own)), 1e-30)
    with np.errstate(divide="ignore"):
        precision = variance * (scale / prior_sigma) ** 2
    columns, out = np.arange(scale.size), np.empty(len(scores))
    # Some blocks at a time: see `TrendSettings.at_once`.
    for first in range(0, len(scores), TREND_SETTINGS.at_once):
        part = slice(first, first + TREND_SETTINGS.at_once)
        matrix = equations.rows(columns, columns, part)
        change = solve_scaled(matrix, scores[part], 0.0, precision)
        out[part] = np.sqrt(np.maximum(np.einsum("bi,bi->b", change, scores[part]), 0.0))
    return out


def outlier_weights(distance: Floats) -> Floats:
    """Return a weight a block, 0 to 1, from distances (block,): only far ones are down-weighted.

    The scale is the spread of the distances themselves, so that scatter from day to day is no outlier.
    """
    if distance.size < TREND_SETTINGS.fewest:
        return np.ones_like(distance)
    centre = float(np.median(distance))
    spread = robust_sigma(distance - centre)
    # Distances of few dimensions scatter by at least a part of their size.
    z = (distance - centre) / max(spread, 0.1 * centre, 1e-300)
    return np.asarray(
        np.clip((TREND_SETTINGS.lost - z) / (TREND_SETTINGS.lost - TREND_SETTINGS.far), 0.0, 1.0)
    )


def check_names(equations: NormalEquations, names: Sequence[str]) -> None:
    """Refuse trends of parameters that the equations do not hold.

    Raises
    ------
    CalibrationError
    """
    if stray := [name for name in names if name not in equations.columns]:
        raise CalibrationError(
            f"no parameter {stray[0]!r} among {', '.join(equations.columns)}", remedy="name one of these"
        )


@dataclass(frozen=True)
class Expansion:
    """Functions of time of every parameter, orthonormal over the blocks, and how to return from them.

    Attributes
    ----------
    functions : mapping of str to ndarray, shape (block, function)
        Of parameters that are expanded: not of constants.
    back : ndarray, shape (coefficient, expanded column)
        Coefficients of the trends from those of the orthonormal functions.
    bases : list of ndarray, shape (block, coefficient)
        Trends at the middles of the blocks.
    unit : ndarray, shape (coefficient, parameter)
        Coefficients of a trend that is 1 at all times, for parameters that are expanded.
    """

    trends: dict[str, TimeDependence]
    columns: tuple[str, ...]
    functions: dict[str, Floats]
    back: Floats
    bases: list[Floats]
    unit: Floats

    @classmethod
    def of(cls, times: Int64, trends: dict[str, TimeDependence]) -> Expansion:
        """Make the functions of all parameters for blocks with these middles (block,), TT2000."""
        columns, functions, parts, bases, units = [], {}, [], [], []
        for name, trend in trends.items():
            basis = trend.basis(times, name)
            columns += [f"{name}{suffix}" for suffix in trend.suffixes]
            bases.append(basis)
            if trend.count == 1:
                parts.append(np.eye(1))
                units.append(np.zeros((1, 1)))
                continue
            inverse = _orthonormal(basis, name)
            functions[name] = basis @ inverse
            parts.append(inverse)
            units.append((np.ones(trend.count) if trend.at else np.eye(trend.count)[0])[:, None])
        return cls(
            trends,
            tuple(columns),
            functions,
            scipy.linalg.block_diag(*parts),
            bases,
            scipy.linalg.block_diag(*units),
        )

    @property
    def functions_each(self) -> float:
        """Functions of time of each parameter, on average."""
        return len(self.columns) / max(len(self.trends), 1)

    @property
    def owners(self) -> npt.NDArray[np.int64]:
        """Which parameter each function belongs to; (function,)."""
        return np.repeat(np.arange(len(self.bases)), [basis.shape[1] for basis in self.bases])

    @property
    def values(self) -> Floats:
        """The functions at the blocks, constants 1; (block, function)."""
        pairs = zip(self.trends, self.bases, strict=True)
        return np.concatenate([self.functions.get(name, basis) for name, basis in pairs], axis=1)

    def parameters(self, coefficients: Floats) -> Floats:
        """Return what coefficients of the functions (function,) make of parameters; (block, parameter)."""
        ends = np.cumsum([basis.shape[1] for basis in self.bases])
        whole = self.values * coefficients
        return np.asarray(np.add.reduceat(whole, np.append(0, ends[:-1]), axis=1))


def _orthonormal(basis: Floats, name: str) -> Floats:
    """Return what makes the columns of a basis (block, function) orthogonal with unit rms."""
    size = np.sqrt(np.mean(basis**2, axis=0))
    triangle = np.linalg.qr(basis / size, mode="r")
    own = np.abs(np.diag(triangle))
    if len(basis) < basis.shape[1] or own.min() < 1e-9 * own.max():
        raise CalibrationError(
            f"{len(basis)} blocks do not tell the {basis.shape[1]} coefficients of the trend of '{name}'",
            remedy="use a simpler trend, or a longer span",
        )
    return np.asarray(np.linalg.inv(triangle) * np.sqrt(len(basis)) / size[:, None])


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

    def summary(self) -> str:
        """Return the origin as a sentence."""
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
        The data separate it from all others.
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

    trends: dict[str, TimeDependence]
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

    def index(self, parameter: str) -> slice:
        """Return which of the columns are a parameter's coefficients."""
        begin = 0
        for name, trend in self.trends.items():
            if name == parameter:
                return slice(begin, begin + trend.count)
            begin += trend.count
        raise CalibrationError(f"no parameter {parameter!r}", remedy=f"one of {', '.join(self.trends)}")

    def at(self, times: Int64) -> tuple[Floats, Floats]:
        """Return values and standard deviations at TT2000 times; (time, parameter) each, physical units."""
        covariance = self.full_covariance
        variance = []
        for name in self.trends:
            slope = self.slopes(times, [name])[:, 0]
            coefficients, origin = (
                np.arange(self.value.size)[self.index(name)],
                np.arange(self.value.size, len(covariance)),
            )
            own = np.append(coefficients, origin)
            part = slope[:, own]
            variance.append(np.einsum("ti,ti->t", part @ covariance[np.ix_(own, own)], part))
        return self.values(times), np.sqrt(np.maximum(np.stack(variance, axis=1), 0.0))

    def values(self, times: Int64) -> Floats:
        """Return the parameters at TT2000 times; (time, parameter), physical units."""
        found = [
            trend.basis(times, name) @ self.value[self.index(name)] for name, trend in self.trends.items()
        ]
        return np.stack(found, axis=1)

    @property
    def full_covariance(self) -> Floats:
        """Covariance of the coefficients, and of the origin (days) behind them where it was fitted."""
        found = self.origin
        if found is None or not found.determined:
            return self.covariance
        edge = found.shared[:, None]
        return np.block([[self.covariance, edge], [edge.T, np.array([[found.sigma**2]])]])

    def slopes(self, times: Int64, names: Sequence[str] | None = None) -> Floats:
        """Return what parameters change by for one unit of each unknown of `full_covariance`.

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
        unknowns = len(self.full_covariance)
        out = np.zeros((times.size, len(chosen), unknowns))
        for index, name in enumerate(chosen):
            trend = self.trends[name]
            out[:, index, self.index(name)] = trend.basis(times, name)
            if trend.time == "log" and unknowns > self.value.size:
                out[:, index, -1] = self.origin_derivative(name, times)
        return out

    def origin_derivative(self, name: str, times: Int64) -> Floats:
        """Return the change of a parameter that follows a logarithm for one day of its origin; (time,)."""
        trend = self.trends[name]
        return np.asarray(-self.value[self.index(name)][1] / (mjd2000(times) - float(mjd2000(trend.t0))))

    def table(self) -> xr.Dataset:
        """Return the coefficients: dims parameter (one a coefficient), other; valid from `start` to `end`.

        The attributes hold the origin where it was fitted.
        """
        parameters = [column.split("*", maxsplit=1)[0] for column in self.columns]
        units = [self.units.get(name, "") for name in parameters]
        found = self.origin
        attributes = {} if found is None else {"origin": found.summary(), "origin_mjd": found.mjd}
        return xr.Dataset(
            {
                "value": ("parameter", self.value),
                "sigma": ("parameter", self.sigma),
                "covariance": (("parameter", "other"), self.covariance),
                "determined": ("parameter", self.determined),
                "units": ("parameter", np.array(units, dtype="U16")),
                "time": ("parameter", np.array([self.trends[name].time for name in parameters])),
                "start": ((), np.int64(self.span[0]), {"scale": "TT2000"}),
                "end": ((), np.int64(self.span[1]), {"scale": "TT2000"}),
            },
            coords={"parameter": list(self.columns), "other": list(self.columns)},
            attrs={**attributes, "rms": self.rms, "blocks": self.blocks},
        )

    def to_timed_value(self, key: str, parameter: Parameter, *, free: bool = False) -> TimedValue:
        """Return a parameter of a model, ready for its YAML (`TimedValue.as_yaml`).

        Parameters
        ----------
        key : str
            ``effect.parameter``, such as ``vector_sensor.scale_factor``; all its components have one trend.
        parameter : Parameter
            Its definition by the effect.
        free : bool
            Whether later fits may move it.

        Raises
        ------
        CalibrationError
            When components follow different trends.
        """
        names = component_names(key, parameter)
        first = self.trends[names[0]] if names[0] in self.trends else TimeDependence()
        if any(self.trends.get(name) != first for name in names):
            raise CalibrationError(f"components of '{key}' follow different trends", remedy="fit one for all")
        places = [self.index(name) for name in names]
        return TimedValue(
            parameter=parameter,
            time=first.time,
            value=np.array([self.value[place] for place in places]),
            sigma=np.array([self.sigma[place] for place in places]),
            free=free,
            t0=first.t0,
            per=first.per,
            key=key,
            change_times=first.at,
            interpolation=first.interpolation,
        )


def fit_trends(
    equations: NormalEquations,
    trends: Mapping[str, TimeDependence],
    prior_sigma: Floats,
    weight: Floats | None = None,
    units: Mapping[str, str] | None = None,
) -> TrendFit:
    """Fit trends to the summed equations of all blocks.

    Parameters
    ----------
    equations : NormalEquations
        Of days, or of a table (`inflight.mission_fit.trends.equations_of_table`).
    trends : mapping of str to Dependence
        Parameters that depend on time; the others are constant over the span.
    prior_sigma : ndarray, shape (column,)
        What is known beforehand of each parameter around its reference, physical units; every function of
        time may move it by as much. 0 fixes a parameter.
    weight : ndarray, shape (block,), optional
        Weights; from the blocks themselves when absent: blocks whose own fit is far from the trend's, as
        measured by all blocks' scatter, are down-weighted.

    Raises
    ------
    CalibrationError
        When there are fewer blocks than coefficients of a trend, or a name is unknown.
    """
    check_names(equations, list(trends))
    every = {name: trends.get(name, TimeDependence()) for name in equations.columns}
    # A trend's origin or knots lie anywhere; blocks at one reference make it one linear problem.
    common = equations.at_one_reference()
    expansion = Expansion.of(common.middle, every)
    passes = 1 if weight is not None else TREND_SETTINGS.passes
    used = np.ones(len(common)) if weight is None else weight
    for last in [False] * (passes - 1) + [True]:
        found = _solve(common, used, expansion, prior_sigma, with_covariance=last)
        if not last:
            used = outlier_weights(score_statistic(common, found.parameters(expansion), prior_sigma))
    return TrendFit(
        every,
        expansion.columns,
        found.value,
        found.covariance,
        found.determined,
        used,
        found.rms,
        len(common),
        (int(common.start[0]), int(common.end[-1])),
        dict(units or {}),
    )


@dataclass(frozen=True)
class WeightedFit:
    """One weighted fit, in coefficients of the trends; see `TrendFit`."""

    value: Floats
    covariance: Floats
    determined: np.ndarray
    rms: float

    def parameters(self, expansion: Expansion) -> Floats:
        """Return the parameters at the blocks; (block, parameter)."""
        parts = np.split(self.value, np.flatnonzero(np.diff(expansion.owners)) + 1)
        return np.stack([basis @ part for basis, part in zip(expansion.bases, parts, strict=True)], axis=1)


def _solve(
    equations: NormalEquations,
    weight: Floats,
    expansion: Expansion,
    prior_sigma: Floats,
    with_covariance: bool,
) -> WeightedFit:
    """Fit the functions; the covariance takes longest, and is 0 where it is not asked for."""
    owners, values = expansion.owners, expansion.values
    scale = equations.scale[:-1][owners]
    sigma = prior_sigma[owners] / scale
    sums = equations.weighted(weight)
    total = sums.expanded(values, owners)
    within = equations.weighted_scatter(weight).expanded(values, owners)[:-1, :-1]
    count = float((equations.count * weight).sum())
    nothing = np.zeros_like(sigma)
    solution = solve(total, within, count, nothing, sigma)
    if len(equations) > 1:
        scores = sums.scores(values, owners, expansion.parameters(solution.value))
        between = scores.T @ scores * len(equations) / (len(equations) - 1)
        scatter = larger_scatter(total[:-1, :-1], within, between, sigma)
        solution = solve(total, scatter, count, nothing, sigma)
    covariance = np.zeros((scale.size, scale.size))
    if with_covariance:
        scores = sums.scores(values, owners, expansion.parameters(solution.value))
        matrix, functions = total[:-1, :-1] / solution.variance, expansion.functions_each
        scores /= solution.variance
        covariance = correlated_covariance(scores, matrix, sigma, functions)
    covariance *= np.outer(scale, scale)
    # A function of time counts from 0, a constant from the reference.
    constant = np.array([trend.count == 1 for trend in expansion.trends.values()])[owners]
    value = np.where(constant, equations.first_reference[owners], 0.0) + solution.value * scale
    back = expansion.back
    # Coefficients are determined together: all those of a trend whose every function is.
    undetermined = np.bincount(owners, weights=~solution.determined)
    return WeightedFit(
        back @ value + expansion.unit @ equations.first_reference,
        back @ covariance @ back.T,
        (undetermined == 0)[owners],
        float(np.sqrt(residual_sum(total, solution.value) / max(count, 1.0))),
    )
