"""Which trend in time: compared on days that were not fitted, so that no kind is ever forced."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NormalEquations
from inflight.errors import CalibrationError
from inflight.estimators.longrun import long_run_covariance
from inflight.estimators.trend_equations import (
    TREND_KINDS,
    at_one_reference,
    check_names,
    make_trend,
    middles,
    outlier_weights,
    own_wish,
)
from inflight.estimators.trend_origin import fit_origin
from inflight.estimators.trends import TrendFit, fit_trends
from inflight.model.dependence import Dependence
from inflight.time import Int64

#: Kinds whose held-out sums differ by less than this many sigmas are tied.
_TIED = 2.0


@dataclass(frozen=True)
class Rival:
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

    rivals: tuple[Rival, ...]
    chosen: str
    folds: int
    unit: str

    def told(self) -> str:
        """Say in a sentence which kind does best, and what is tied with it."""
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
            attrs={"chosen": self.chosen, "folds": self.folds, "told": self.told()},
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

    The first and last folds ask how well a kind foretells what lies beyond its data, the others how well
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
    common = at_one_reference(equations)
    maker = _Maker(list(names), t0, knots, int(middles(common)[0]))
    weight = _shared_weight(common, maker, kinds, prior_sigma)
    count = common.dataset["count"].values * weight
    held = {kind: _held_out(common, maker, kind, prior_sigma, weight, folds) for kind in kinds}
    whole = {kind: float(one.sums.sum() / count.sum()) for kind, one in held.items()}
    best = min(whole, key=lambda kind: whole[kind])
    rivals = []
    for kind in sorted(whole, key=lambda kind: whole[kind]):
        behind = whole[kind] - whole[best]
        sigma = _sigma_behind(common, held[kind], held[best]) / float(count.sum()) if behind > 0 else 0.0
        size = maker.coefficients(kind)
        tied = kind == best or behind < _TIED * sigma
        rivals.append(Rival(kind, size, float(np.sqrt(whole[kind])), behind, sigma, tied))
    chosen = min((one for one in rivals if one.tied), key=lambda one: one.coefficients).kind
    unit = "sigma" if equations.dataset.attrs.get("filter") == "table" else "nT"
    return TrendComparison(tuple(rivals), chosen, folds, unit)


@dataclass(frozen=True)
class _Maker:
    """Makes trends of a kind, and fits them, for parameters by name."""

    names: list[str]
    t0: int | None
    knots: int
    first: int

    def coefficients(self, kind: str) -> int:
        sizes = {"constant": 1, "parabola": 3, "spline": self.knots}
        return sizes.get(kind, 2) + (kind == "log" and self.t0 is None)

    def trends(self, kind: str, times: Int64) -> dict[str, Dependence]:
        # Where the origin is fitted, the span before the first block is only where the search starts.
        span = int(times[-1] - times[0])
        t0 = (self.t0 if self.t0 is not None else self.first - span // 4) if kind == "log" else None
        return {name: make_trend(kind, times, t0, knots=self.knots) for name in self.names}

    def fit(
        self, equations: NormalEquations, kind: str, prior_sigma: Floats, weight: Floats | None
    ) -> TrendFit:
        trends = self.trends(kind, middles(equations))
        searched = kind == "log" and self.t0 is None
        fitter: Callable[..., TrendFit] = fit_origin if searched else fit_trends
        return fitter(equations, trends, prior_sigma, weight)


def _shared_weight(
    equations: NormalEquations, maker: _Maker, kinds: Sequence[str], prior_sigma: Floats
) -> Floats:
    distances = []
    for kind in kinds:
        fit = maker.fit(equations, kind, prior_sigma, None)
        distances.append(own_wish(equations, fit.values(middles(equations)), prior_sigma))
    return outlier_weights(min(distances, key=lambda one: float(np.median(one))))


@dataclass(frozen=True)
class _HeldOut:
    """What one kind foretells of the blocks that it was not fitted to.

    `sums` (block,) squared residuals; `value` (block, parameter) what was foretold; `scores`
    (block, parameter), scaled, there; `training` the variance of the sums' total by the fits' own errors.
    """

    sums: Floats
    value: Floats
    scores: Floats
    training: float


def _held_out(
    equations: NormalEquations,
    maker: _Maker,
    kind: str,
    prior_sigma: Floats,
    weight: Floats,
    folds: int,
) -> _HeldOut:
    value = np.zeros((len(equations), len(equations.columns)))
    fits = []
    every = np.arange(len(equations))
    for held, (fitted, left) in zip(np.array_split(every, folds), equations.split(folds), strict=True):
        fit = maker.fit(fitted, kind, prior_sigma, np.delete(weight, held))
        value[held] = _foretold(fit, middles(left))
        fits.append((held, fit))
    sums, scores = squares_at(equations, value)
    sums, scores = weight * sums, weight[:, None] * scores
    training = sum(_training(equations, scores, held, fit) for held, fit in fits)
    return _HeldOut(sums, value, scores, training)


def _training(equations: NormalEquations, scores: Floats, held: np.ndarray, fit: TrendFit) -> float:
    """Return the variance of a fold's sum of squares by the errors of the fit that foretold it."""
    times = _inside(fit, middles(equations)[held])
    scale = equations.dataset["scale"].values[:-1]
    slope = 2.0 * scores[held] / scale
    gradient = np.einsum("tp,tpi->i", slope, fit.slopes(times))
    return float(gradient @ fit.whole_covariance @ gradient)


def _inside(fit: TrendFit, times: Int64) -> Int64:
    """Return times, those before the origin of a logarithm moved to its first day."""
    starts = [trend.t0 + trend.per for trend in fit.trends.values() if trend.time == "log"]
    return np.maximum(times, max(starts)) if starts else times


def _foretold(fit: TrendFit, times: Int64) -> Floats:
    return fit.values(_inside(fit, times))


def squares_at(equations: NormalEquations, value: Floats) -> tuple[Floats, Floats]:
    """Return what the blocks leave at parameters of their own.

    Parameters
    ----------
    value : ndarray, shape (block, parameter)
        Physical units.

    Returns
    -------
    sums : ndarray, shape (block,)
        Sum of squared residuals, nT^2.
    scores : ndarray, shape (block, parameter)
        Half its slope, nT^2 per scaled unit.
    """
    data = equations.dataset
    change = (value - data["reference"].values[:, :-1]) / data["scale"].values[:-1]
    turned = np.concatenate([change, np.ones((len(change), 1))], axis=1)
    slopes = np.einsum("bij,bj->bi", data["gram"].values, turned)
    return np.einsum("bi,bi->b", turned, slopes), slopes[:, :-1]


def _sigma_behind(equations: NormalEquations, one: _HeldOut, best: _HeldOut) -> float:
    """Return the standard deviation of the difference of two kinds' sums of squares.

    With D the difference of what they foretell, a block's sums differ by ``D A D + 2 s D``: the scores s at
    the best kind are noise, correlated from block to block; the error of its fits comes on top. What the
    other's fits err by is its own fault, and no excuse.
    """
    apart = (one.value - best.value) / equations.dataset["scale"].values[:-1]
    noise = 2.0 * np.einsum("bi,bi->b", best.scores, apart)
    return float(np.sqrt(long_run_covariance(noise[:, None])[0, 0] + best.training))
