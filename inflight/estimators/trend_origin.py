"""The origin of a logarithm of time, fitted with its interval, or said to be not determined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from inflight.arrays import Floats
from inflight.calibration import NormalEquations
from inflight.calibration.solution import residual_sum
from inflight.errors import CalibrationError
from inflight.estimators.block_sums import BlockSums
from inflight.estimators.days import mjd_of, tt2000_of
from inflight.estimators.trend_equations import at_one_reference, make_trend, middles
from inflight.estimators.trend_functions import Expansion
from inflight.estimators.trends import Origin, TrendFit, fit_trends, sandwich, with_origin
from inflight.model.dependence import Dependence

#: 95 % of a chi square with one degree of freedom.
_LIMIT = 3.841
#: Distances of the origin from the first block, days: the least; the most, in spans and as far as stamps
#: reach; beyond, the logarithm is a straight line. Points of the first search, per decade.
_NEAREST, _SPANS, _FARTHEST, _PER_DECADE = 0.1, 300.0, 9e4, 5


def fit_origin(
    equations: NormalEquations,
    trends: Mapping[str, Dependence],
    prior_sigma: Floats,
    weight: Floats | None = None,
    units: Mapping[str, str] | None = None,
) -> TrendFit:
    """Fit trends with one common origin of all logarithms.

    The sum of squares is profiled over the distance of the origin from the first block; its interval
    is widened by how much more the blocks' scores scatter than white residuals would. Where a straight
    line is within the 95 % interval the origin is not determined, and the fit keeps the one given.

    Parameters
    ----------
    equations, trends, prior_sigma, weight, units
        As in `fit_trends`; at least one trend is a logarithm.

    Returns
    -------
    TrendFit
        Its covariance has the origin as a further unknown where that is determined.

    Raises
    ------
    CalibrationError
        When no trend is a logarithm.
    """
    logs = [name for name, trend in trends.items() if trend.time == "log"]
    if not logs:
        raise CalibrationError("no trend is a logarithm", remedy="leave the origin alone")
    given = fit_trends(equations, trends, prior_sigma, weight, units)
    common = at_one_reference(equations)
    sums = BlockSums(common.dataset["gram"].values, given.weight)
    profile = _Profile(common, sums, dict(trends), logs, prior_sigma, given.rms**2)
    grid = profile.grid()
    best = profile.lowest(grid)
    fitted = fit_trends(equations, profile.moved(best), prior_sigma, given.weight, units)
    covariance, inflation = _with_unknown_origin(common, sums, fitted, prior_sigma)
    sigma, shared = float(np.sqrt(covariance[-1, -1])), covariance[:-1, -1]
    limit = profile.total(best) + _LIMIT * inflation * fitted.rms**2
    far, near = profile.crossings(best, grid, limit)
    determined = bool(np.isfinite(far)) and grid[0] < best < 0.99 * grid[-1]
    origin = Origin(
        profile.first - best, sigma, profile.first - far, profile.first - near, determined, shared
    )
    if not determined:
        return with_origin(given, origin)
    return with_origin(replace(fitted, covariance=covariance[:-1, :-1]), origin)


@dataclass(frozen=True)
class _Profile:
    """The sum of squares as a function of the distance of the origin from the first block, days."""

    equations: NormalEquations
    sums: BlockSums
    trends: dict[str, Dependence]
    logs: list[str]
    prior_sigma: Floats
    variance: float

    @property
    def first(self) -> float:
        """MJD of the middle of the first block."""
        return float(mjd_of(middles(self.equations)[0]))

    def grid(self) -> Floats:
        """Distances of the first search, days."""
        span = float(mjd_of(middles(self.equations)[-1])) - self.first
        most = min(_SPANS * span, _FARTHEST)
        return np.geomspace(_NEAREST, most, int(_PER_DECADE * np.log10(most / _NEAREST)) + 2)

    def moved(self, distance: float) -> dict[str, Dependence]:
        """Return the trends with their origin so far before the first block; straight lines at infinity."""
        if np.isinf(distance):
            line = make_trend("linear", middles(self.equations))
            return self.trends | dict.fromkeys(self.logs, line)
        t0 = int(tt2000_of(self.first - distance))
        return self.trends | {name: replace(self.trends[name], t0=t0) for name in self.logs}

    def total(self, distance: float) -> float:
        """Return the least sum of squares with the origin so far before the first block."""
        expansion = _expansion(self.equations, self.moved(distance))
        scale = self.equations.dataset["scale"].values[:-1]
        return profile_sum(self.sums, expansion, scale, self.prior_sigma, self.variance)

    def lowest(self, grid: Floats) -> float:
        """Return the distance of the least sum of squares."""
        at = int(np.argmin([self.total(distance) for distance in grid]))
        bounds = np.log(grid[max(at - 1, 0)]), np.log(grid[min(at + 1, grid.size - 1)])
        found = optimize.minimize_scalar(
            lambda log: self.total(float(np.exp(log))),
            bounds=bounds,
            method="bounded",
            options={"xatol": 1e-6},
        )
        return float(np.exp(found.x))

    def crossings(self, best: float, grid: Floats, limit: float) -> tuple[float, float]:
        """Return the distances beyond which, and below which, the sum of squares passes a limit.

        Infinity where a straight line does not pass it; zero where the first block is no limit.
        """
        if self.total(float("inf")) <= limit:
            return float("inf"), self._crossing(best, grid[grid < best][::-1], limit, 0.0)
        far = self._crossing(best, grid[grid > best], limit, float(grid[-1]))
        return far, self._crossing(best, grid[grid < best][::-1], limit, 0.0)

    def _crossing(self, inner: float, side: Floats, limit: float, otherwise: float) -> float:
        for distance in side:
            if self.total(distance) > limit:
                edge = optimize.brentq(lambda d: self.total(d) - limit, inner, distance, xtol=1e-3)
                return float(edge)
            inner = float(distance)
        return otherwise


def _expansion(equations: NormalEquations, trends: Mapping[str, Dependence]) -> Expansion:
    every = {name: trends.get(name, Dependence()) for name in equations.columns}
    return Expansion.of(middles(equations), every)


def profile_sum(
    sums: BlockSums, expansion: Expansion, scale: Floats, prior_sigma: Floats, variance: float
) -> float:
    """Return the least sum of squares of all blocks for given functions of time."""
    owners = expansion.owners
    gram = sums.expanded(expansion.values, owners)
    with np.errstate(divide="ignore"):
        held = variance * (scale / prior_sigma)[owners] ** 2
    free = np.flatnonzero(np.isfinite(held))
    matrix = gram[np.ix_(free, free)] + np.diag(held[free])
    change = np.zeros(owners.size)
    change[free] = -np.linalg.solve(matrix, gram[free, -1])
    return residual_sum(gram, change)


def _with_unknown_origin(
    equations: NormalEquations, sums: BlockSums, fit: TrendFit, prior_sigma: Floats
) -> tuple[Floats, float]:
    """Return the covariance of coefficients and origin (days), and the inflation of the origin's variance.

    The inflation is against white residuals.
    """
    matrix, scores = _with_origin_column(equations, sums, fit)
    unit = np.sqrt(np.diag(matrix))
    unit = np.where(unit > 0, unit, 1.0)
    matrix, scores = matrix / np.outer(unit, unit), scores / unit
    owners = [equations.columns.index(column.split("*")[0]) for column in fit.columns]
    fixed = np.append(prior_sigma[owners] <= 0, False)
    # The prior has had its say in the fit; here the data speak alone.
    wide = np.where(fixed, 0.0, 1e6 * fit.rms)
    functions = len(fit.columns) / len(fit.trends) + 1.0 / len(fit.trends)
    covariance = sandwich(scores, matrix / fit.rms**2, fit.rms**2, wide, functions) / np.outer(unit, unit)
    free = np.flatnonzero(~fixed)
    white = np.linalg.pinv(matrix[np.ix_(free, free)], hermitian=True)
    plain = white[-1, -1] * fit.rms**2 / unit[-1] ** 2
    return covariance, max(float(covariance[-1, -1] / plain), 1.0) if plain > 0 else 1.0


def _with_origin_column(equations: NormalEquations, sums: BlockSums, fit: TrendFit) -> tuple[Floats, Floats]:
    """Return the matrix of [coefficients, origin] and the blocks' scores at the fit, the origin in days."""
    times, data = middles(equations), equations.dataset
    scale, names = data["scale"].values[:-1], list(fit.trends)
    logs = [name for name, trend in fit.trends.items() if trend.time == "log"]
    bases = [trend.basis(times, name) for name, trend in fit.trends.items()]
    bases += [fit.by_origin(name, times)[:, None] for name in logs]
    owners = np.array([*range(len(names)), *(names.index(name) for name in logs)])
    owners = np.repeat(owners, [basis.shape[1] for basis in bases])
    values = np.concatenate(bases, axis=1) / scale[owners]
    here = (fit.values(times) - data["reference"].values[:, :-1]) / scale
    # The origin is one unknown of all logarithms.
    together = np.eye(len(fit.columns) + 1, owners.size)
    together[-1, len(fit.columns) :] = 1.0
    matrix = together @ sums.expanded(values, owners)[:-1, :-1] @ together.T
    return matrix, sums.scores(values, owners, here) @ together.T
