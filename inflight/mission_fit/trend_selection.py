"""Which trend in time, and the origin of a logarithm.

Takes normal equations of blocks; makes the fit with the origin as an unknown (`fit_origin`): its interval
by the profile of the sum of squares, or the statement that it is not determined; and the comparison of
kinds of trend on blocks that were not fitted (`compare_trends`), so that no kind is ever forced.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NormalEquations
from inflight.errors import CalibrationError
from inflight.lsq import (
    SOLVER_SETTINGS,
    BlockSums,
    correlated_covariance,
    gram_inverse,
    long_run_covariance,
    residual_sum,
    solve_scaled,
)
from inflight.mission_fit.trends import (
    TREND_KINDS,
    Expansion,
    Origin,
    TrendFit,
    check_names,
    fit_trends,
    make_trend,
    outlier_weights,
    score_statistic,
)
from inflight.model import TimeDependence
from inflight.time import Int64, from_mjd2000, mjd2000


@dataclass(frozen=True, kw_only=True)
class TrendSelectionSettings:
    """How the origin of a logarithm is searched, and which kinds tie.

    Attributes
    ----------
    limit : float
        95 % of a chi square with one degree of freedom.
    nearest_days : float
        Least distance of the origin from the first block, days; assumed.
    spans : float
        The largest, in spans; beyond, the logarithm is a straight line; assumed.
    farthest_days : float
        And as far as stamps reach, days: TT2000 ends 292 years from 2000.
    per_decade : int
        Points of the first search, per decade; assumed.
    tied : float
        Kinds whose held-out sums differ by less than so many sigmas are tied: a level of 5 %.
    """

    limit: float = 3.841
    nearest_days: float = 0.1
    spans: float = 300.0
    farthest_days: float = 9e4
    per_decade: int = 5
    tied: float = 2.0


TREND_SELECTION_SETTINGS = TrendSelectionSettings()


def fit_origin(
    equations: NormalEquations,
    trends: Mapping[str, TimeDependence],
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
    common = equations.at_one_reference()
    sums = common.weighted(given.weight)
    profile = _Profile(common, sums, dict(trends), logs, prior_sigma, given.rms**2)
    grid = profile.grid()
    best = profile.lowest(grid)
    fitted = fit_trends(equations, profile.trends_at(best), prior_sigma, given.weight, units)
    covariance, inflation = _with_unknown_origin(common, sums, fitted, prior_sigma)
    sigma, shared = float(np.sqrt(covariance[-1, -1])), covariance[:-1, -1]
    limit = profile.total(best) + TREND_SELECTION_SETTINGS.limit * inflation * fitted.rms**2
    far, near = profile.crossings(best, grid, limit)
    determined = bool(np.isfinite(far)) and grid[0] < best < 0.99 * grid[-1]
    origin = Origin(
        profile.first - best, sigma, profile.first - far, profile.first - near, determined, shared
    )
    if not determined:
        return replace(given, origin=origin)
    return replace(fitted, covariance=covariance[:-1, :-1], origin=origin)


@dataclass(frozen=True)
class _Profile:
    """The sum of squares as a function of the distance of the origin from the first block, days."""

    equations: NormalEquations
    sums: BlockSums
    trends: dict[str, TimeDependence]
    logs: list[str]
    prior_sigma: Floats
    variance: float

    @property
    def first(self) -> float:
        """MJD of the middle of the first block."""
        return float(mjd2000(self.equations.middle[0]))

    def grid(self) -> Floats:
        """Distances of the first search, days."""
        span = float(mjd2000(self.equations.middle[-1])) - self.first
        most = min(TREND_SELECTION_SETTINGS.spans * span, TREND_SELECTION_SETTINGS.farthest_days)
        return np.geomspace(
            TREND_SELECTION_SETTINGS.nearest_days,
            most,
            int(TREND_SELECTION_SETTINGS.per_decade * np.log10(most / TREND_SELECTION_SETTINGS.nearest_days))
            + 2,
        )

    def trends_at(self, distance: float) -> dict[str, TimeDependence]:
        """Return the trends with their origin so far before the first block; straight lines at infinity."""
        if np.isinf(distance):
            line = make_trend("linear", self.equations.middle)
            return self.trends | dict.fromkeys(self.logs, line)
        t0 = int(from_mjd2000(self.first - distance))
        return self.trends | {name: replace(self.trends[name], t0=t0) for name in self.logs}

    def total(self, distance: float) -> float:
        """Return the least sum of squares with the origin so far before the first block."""
        trends = self.trends_at(distance)
        every = {name: trends.get(name, TimeDependence()) for name in self.equations.columns}
        expansion = Expansion.of(self.equations.middle, every)
        scale = self.equations.scale[:-1]
        return profile_sum(self.sums, expansion, scale, self.prior_sigma, self.variance)

    def lowest(self, grid: Floats) -> float:
        """Return the distance of the least sum of squares."""
        at = int(np.argmin([self.total(distance) for distance in grid]))
        bounds = np.log(grid[max(at - 1, 0)]), np.log(grid[min(at + 1, grid.size - 1)])
        found = scipy.optimize.minimize_scalar(
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
                edge = scipy.optimize.brentq(lambda d: self.total(d) - limit, inner, distance, xtol=1e-3)
                return float(edge)
            inner = float(distance)
        return otherwise


def profile_sum(
    sums: BlockSums, expansion: Expansion, scale: Floats, prior_sigma: Floats, variance: float
) -> float:
    """Return the least sum of squares of all blocks for given functions of time."""
    owners = expansion.owners
    gram = sums.expanded(expansion.values, owners)
    with np.errstate(divide="ignore"):
        precision = variance * (scale / prior_sigma)[owners] ** 2
    return residual_sum(gram, -solve_scaled(gram[:-1, :-1], gram[:-1, -1], 0.0, precision))


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
    # The prior is in the fit already; here the data count alone.
    wide = np.where(fixed, 0.0, 1e6 * fit.rms)
    functions = len(fit.columns) / len(fit.trends) + 1.0 / len(fit.trends)
    variance = fit.rms**2
    covariance = correlated_covariance(scores / variance, matrix / variance, wide, functions)
    covariance /= np.outer(unit, unit)
    free = np.flatnonzero(~fixed)
    white = gram_inverse(matrix[np.ix_(free, free)], SOLVER_SETTINGS.eigen_cut)
    plain = white[-1, -1] * variance / unit[-1] ** 2
    return covariance, max(float(covariance[-1, -1] / plain), 1.0) if plain > 0 else 1.0


def _with_origin_column(equations: NormalEquations, sums: BlockSums, fit: TrendFit) -> tuple[Floats, Floats]:
    """Return the matrix of [coefficients, origin] and the blocks' scores at the fit, the origin in days."""
    times, scale, names = equations.middle, equations.scale[:-1], list(fit.trends)
    logs = [name for name, trend in fit.trends.items() if trend.time == "log"]
    bases = [trend.basis(times, name) for name, trend in fit.trends.items()]
    bases += [fit.origin_derivative(name, times)[:, None] for name in logs]
    owners = np.array([*range(len(names)), *(names.index(name) for name in logs)])
    owners = np.repeat(owners, [basis.shape[1] for basis in bases])
    values = np.concatenate(bases, axis=1) / scale[owners]
    here = equations.change(fit.values(times))
    # The origin is one unknown of all logarithms.
    together = np.eye(len(fit.columns) + 1, owners.size)
    together[-1, len(fit.columns) :] = 1.0
    matrix = together @ sums.expanded(values, owners)[:-1, :-1] @ together.T
    return matrix, sums.scores(values, owners, here) @ together.T


@dataclass(frozen=True)
class RivalTrend:
    """One kind of trend on held-out blocks.

    Attributes
    ----------
    kind : str
    coefficients : int
        Of each parameter that depends on time; one more where the origin is fitted.
    rms : float
        Held-out rms of the residual: nT, or stated sigmas for a table.
    behind, sigma_behind : float
        Mean held-out square less that of the best kind, and its standard deviation over blocks and folds.
    tied : bool
        Within two sigmas of the best.
    """

    kind: str
    coefficients: int
    rms: float
    behind: float
    sigma_behind: float
    tied: bool


@dataclass(frozen=True)
class TrendComparison:
    """Kinds of trend compared on held-out contiguous folds.

    Attributes
    ----------
    rivals : tuple of Rival
        Smallest held-out rms first.
    chosen : str
        Of those tied with the best, the one with the fewest coefficients.
    folds : int
    unit : str
        Of the rms.
    """

    rivals: tuple[RivalTrend, ...]
    chosen: str
    folds: int
    unit: str

    def summary(self) -> str:
        """Return as a sentence which kind does best, and what is tied with it."""
        best, *others = self.rivals
        tied = [one.kind for one in others if one.tied]
        size = f"{best.rms:.5g} {self.unit} on held-out days"
        if not tied:
            return f"{best.kind} does best ({size}); no other kind is within two sigmas"
        return f"{best.kind} ({size}) and {', '.join(tied)} are tied; {self.chosen} has fewest coefficients"

    def table(self) -> xr.Dataset:
        """Return the comparison: dim kind; `value` is the held-out rms, `sigma` that of its square's lag."""
        rows = self.rivals
        return xr.Dataset(
            {
                "value": ("kind", np.array([one.rms for one in rows]), {"units": self.unit}),
                "sigma": ("kind", np.array([one.sigma_behind for one in rows]) / (2 * rows[0].rms)),
                "behind": ("kind", np.array([one.behind for one in rows]), {"units": f"{self.unit}2"}),
                "sigma_behind": ("kind", np.array([one.sigma_behind for one in rows])),
                "tied": ("kind", np.array([one.tied for one in rows])),
                "coefficients": ("kind", np.array([one.coefficients for one in rows])),
                "units": ("kind", np.full(len(rows), self.unit)),
            },
            coords={"kind": [one.kind for one in rows]},
            attrs={"chosen": self.chosen, "folds": self.folds, "told": self.summary()},
        )


def compare_trends(
    equations: NormalEquations,
    names: Sequence[str],
    prior_sigma: Floats,
    kinds: Sequence[str] = TREND_KINDS,
    *,
    t0: int | None = None,
    folds: int = 8,
    knots: int = 5,
) -> TrendComparison:
    """Compare kinds of trend on contiguous held-out folds.

    The first and last folds show how well a kind predicts what lies beyond its data, the others how well
    it bridges a gap. Outlying blocks are left out alike for all kinds: those of the kind whose typical
    block lies nearest to it.

    Parameters
    ----------
    equations : NormalEquations
        Of days, or of a table.
    names : sequence of str
        Parameters that follow the trend; the others are constant.
    prior_sigma : ndarray, shape (column,)
        As in `fit_trends`.
    kinds : sequence of str
        `TREND_KINDS`.
    t0 : int, optional
        TT2000 origin of the logarithm; fitted in every fold when absent.
    folds, knots : int
        Number of folds; knots of the spline.

    Raises
    ------
    CalibrationError
        When there are fewer than two blocks a fold.
    """
    check_names(equations, names)
    if len(equations) < 2 * folds:
        raise CalibrationError(
            f"{len(equations)} blocks make no {folds} folds of two or more", remedy="use fewer folds"
        )
    common = equations.at_one_reference()
    maker = _TrendMaker(list(names), t0, knots, int(common.middle[0]))
    distances = []
    for kind in kinds:
        fit = maker.fit(common, kind, prior_sigma, None)
        distances.append(score_statistic(common, fit.values(common.middle), prior_sigma))
    weight = outlier_weights(min(distances, key=lambda one: float(np.median(one))))
    count = common.count * weight
    held = {kind: _held_out(common, maker, kind, prior_sigma, weight, folds) for kind in kinds}
    whole = {kind: float(one.sums.sum() / count.sum()) for kind, one in held.items()}
    best = min(whole, key=lambda kind: whole[kind])
    rivals = []
    for kind in sorted(whole, key=lambda kind: whole[kind]):
        behind = whole[kind] - whole[best]
        sigma = _sigma_behind(common, held[kind], held[best]) / float(count.sum()) if behind > 0 else 0.0
        size = maker.coefficients(kind)
        tied = kind == best or behind < TREND_SELECTION_SETTINGS.tied * sigma
        rivals.append(RivalTrend(kind, size, float(np.sqrt(whole[kind])), behind, sigma, tied))
    chosen = min((one for one in rivals if one.tied), key=lambda one: one.coefficients).kind
    unit = "sigma" if equations.attributes.get("filter") == "table" else "nT"
    return TrendComparison(tuple(rivals), chosen, folds, unit)


@dataclass(frozen=True)
class _TrendMaker:
    """Makes trends of a kind, and fits them, for parameters by name."""

    names: list[str]
    t0: int | None
    knots: int
    first: int

    def coefficients(self, kind: str) -> int:
        sizes = {"constant": 1, "parabola": 3, "spline": self.knots}
        return sizes.get(kind, 2) + (kind == "log" and self.t0 is None)

    def trends(self, kind: str, times: Int64) -> dict[str, TimeDependence]:
        # Where the origin is fitted, the span before the first block is only where the search starts.
        span = int(times[-1] - times[0])
        t0 = (self.t0 if self.t0 is not None else self.first - span // 4) if kind == "log" else None
        return {name: make_trend(kind, times, t0, knots=self.knots) for name in self.names}

    def fit(
        self, equations: NormalEquations, kind: str, prior_sigma: Floats, weight: Floats | None
    ) -> TrendFit:
        trends = self.trends(kind, equations.middle)
        searched = kind == "log" and self.t0 is None
        fitter: Callable[..., TrendFit] = fit_origin if searched else fit_trends
        return fitter(equations, trends, prior_sigma, weight)


@dataclass(frozen=True)
class _HeldOut:
    """What one kind predicts of the blocks that it was not fitted to.

    `sums` (block,) squared residuals; `value` (block, parameter) what was predicted; `scores`
    (block, parameter), scaled, there; `training` the variance of the sums' total by the fits' own errors.
    """

    sums: Floats
    value: Floats
    scores: Floats
    training: float


def _held_out(
    equations: NormalEquations,
    maker: _TrendMaker,
    kind: str,
    prior_sigma: Floats,
    weight: Floats,
    folds: int,
) -> _HeldOut:
    value = np.zeros((len(equations), len(equations.columns)))
    fits = []
    every = np.arange(len(equations))
    for held, (fitted, rest) in zip(np.array_split(every, folds), equations.split(folds), strict=True):
        fit = maker.fit(fitted, kind, prior_sigma, np.delete(weight, held))
        # Times before the origin of a logarithm are moved to its first day.
        starts = [trend.t0 + trend.per for trend in fit.trends.values() if trend.time == "log"]
        times = np.maximum(rest.middle, max(starts)) if starts else rest.middle
        value[held] = fit.values(times)
        fits.append((held, fit, times))
    sums, scores = weight * equations.squares_at(value), weight[:, None] * equations.scores(value)
    training = 0.0
    for held, fit, times in fits:
        gradient = np.einsum("tp,tpi->i", 2.0 * scores[held] / equations.scale[:-1], fit.slopes(times))
        training += float(gradient @ fit.full_covariance @ gradient)
    return _HeldOut(sums, value, scores, training)


def _sigma_behind(equations: NormalEquations, one: _HeldOut, best: _HeldOut) -> float:
    """Return the standard deviation of the difference of two kinds' sums of squares.

    With D the difference of their predictions, a block's sums differ by ``D A D + 2 s D``: the scores s at
    the best kind are noise, correlated from block to block; the error of its fits comes on top. The errors
    of the other's fits do not count in its favour.
    """
    apart = (one.value - best.value) / equations.scale[:-1]
    noise = 2.0 * np.einsum("bi,bi->b", best.scores, apart)
    return float(np.sqrt(long_run_covariance(noise[:, None])[0, 0] + best.training))
