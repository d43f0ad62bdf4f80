"""Held-out decision: whether a correction helps, decided without the truth, and which part of it.

Takes readings and candidates that are fitted to a part of them; makes the correction to apply, or none. Each
candidate is fitted to all but one *fold* of the record and scored on that. The ambient field is independent
of the spacecraft. What a correction c takes off a held-out stretch therefore shows in the outboard reading
itself: regressed on c, the reading has the slope 1 when c is the stray field, 0 when c is independent of it.
Taking c off changes the mean square of the error by ``<c^2> - 2 <c s>`` with the stray field s, and
``<c s> = <c B_out>`` but for chance: it helps where the slope is above one half.

The slopes are combined as in Bayesian statistics:

- *observation* (`SlopeObservation`): slopes of held-out readings on the correction, scale by scale, in cells
  weighted by how quiet the ambient field is, with errors;
- *prior* (`GeometryPrior`, `SlopePrior`): all units stand in the spacecraft's body. Each place in it takes
  the difference to the outboard sensor by a matrix of its own, which has a slope on the correction. Set
  against it is what of the difference is no stray field (`NonStrayShare`): white noise, slow noise of the
  sensors, ambient field that leaks in;
- *posterior* (`SlopePosterior`): draws of the prior weighted by the likelihood of the observation. The *risk*
  is the posterior probability that taking off a part makes the error larger.

Where the risk of the whole is too large, a share of the correction, or what of it is quick (`AppliedPart`),
may still be applied.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.dual.correction import (
    WHOLE,
    AppliedPart,
    Correction,
    no_correction,
    partial_correction,
    slow_part,
    slow_part_of,
)
from inflight.dual.gradiometer import wiener_shrink
from inflight.dual.mixing import DifferenceNoise
from inflight.dual.noise import SLOW_NOISE_SETTINGS, draw_slow_noise, expected_drift
from inflight.dual.readings import (
    Cells,
    Readings,
    cells_of,
    concatenate_cells,
    contrasts,
    joined_contrasts,
    running_sums,
    scales_of,
)
from inflight.time import SECOND


@dataclass(frozen=True, kw_only=True)
class HeldOutSettings:
    """Numbers of the held-out decision.

    What they make of corrections is measured by `python -m tests.dual_cases --cases 300 --first-seed 160000`
    (none of 300 random cases made worse) and `python -m tests.dual.hard_table --first-seed 400 --seeds 6`
    (none of 132 made worse by more than 2 %); docs/science/two-sensors.md.

    Attributes
    ----------
    folds : int
        Parts that the record is held out in, one after the other. Assumed.
    most_risk : float
        A correction may make the error larger with this probability. Level of significance: once in two
        hundred.
    preferred_risk : float
        Of its parts those are preferred whose risk is lower than this. Level of significance: one in a
        thousand.
    shares : tuple of float
        Shares of a correction that are tried. Derived: half of it lowers the error where the stray field is
        more than a fourth of it.
    least_slope_ratio : float
        A correction expected to be so many times smaller than the stray field is refused: the outboard
        reading that it was fitted to does not hold what the units would make. Assumed.
    trivial_benefit : float
        What lowers the mean square error by less than this part of the noise's is not applied. Assumed.
    own_contrasts : float
        Contrasts that a cell's variance is taken to have in addition to its own. Assumed.
    blocks : int
        Blocks of time of each fold whose scatter widens the error of a slope. Assumed.
    slope_scatter : float
        Slopes of several units on one scale differ by so much from those of one. Assumed.
    rejected : float
        Chance below which held-out readings are not of units in the body. Level of significance.
    least_signal : float
        Least part of a scale that passes as signal. Assumed: bounds a division.
    longest : int
        The longest blocks are this part of the record: one half.
    quick : int
        Blocks of switchings are at most this part of the record. Assumed.
    quiet_quantile, quiet_cells : float, int
        The quiet level of a scale is this quantile over its cells, of which there are so many at least.
        Assumed.
    drift_draws : int
        Draws of the sensors' slow noise for each place. Derived: chances of one in a thousand need some
        hundreds of draws that agree with the held-out readings.
    outboard_drift : (float, float)
        Part of the drift of both sensors that is the outboard one's: mean and standard deviation. Derived:
        two straight lines, each as likely to rise as to fall.
    slow_widths, narrowest : tuple of int, int
        Widths of the slow part that are tried, as parts of the record, and the narrowest such width, samples.
        Assumed: an octave apart.
    rounding : float
        Benefits that differ by less than this part are equal. Assumed: far above rounding, far below any use.
    """

    folds: int = 4
    most_risk: float = 0.005
    preferred_risk: float = 0.001
    shares: tuple[float, ...] = (1.0, 0.85, 0.7, 0.5)
    least_slope_ratio: float = 3.0
    trivial_benefit: float = 1e-3
    own_contrasts: float = 1.0
    blocks: int = 6
    slope_scatter: float = 0.2
    rejected: float = 1e-6
    least_signal: float = 0.01
    longest: int = 2
    quick: int = 64
    quiet_quantile: float = 0.25
    quiet_cells: int = 6
    drift_draws: int = 60
    outboard_drift: tuple[float, float] = (0.5, 0.5)
    slow_widths: tuple[int, ...] = (4, 8, 16, 32, 64, 128, 256)
    narrowest: int = 8
    rounding: float = 1e-9


HELD_OUT_SETTINGS = HeldOutSettings()

#: The form that all others of a gradiometer are special cases of.
_GENERAL = "matrix"

#: Corrects readings.
Corrector = Callable[[Readings], Correction]

#: Fits any number of candidates to the rows in use.
Fit = Callable[[npt.NDArray[np.bool_]], Mapping[str, Corrector]]

#: Corrections of held-out folds, each by candidates that were fitted to the others.
Held = list[tuple[slice, Correction]]


@dataclass(frozen=True)
class HeldOutDecision:
    """The correction to apply, the name of its candidate (or ``none``), and the scores of all candidates."""

    correction: Correction
    chosen: str
    scores: Mapping[str, HeldOutScore]


@dataclass(frozen=True, kw_only=True)
class HeldOutScore:
    """Score of one candidate by held-out readings and geometry.

    Attributes
    ----------
    name : str
    slope, sigma : float
        Of the outboard reading on the correction; 1 for the stray field itself.
    risk : float
        Probability that the correction makes the error larger; NaN where no prior fits the readings.
    benefit : float
        Expected fall of the mean square error, nT^2 summed over axes.
    trivial : bool
        That fall is negligible compared to the noise.
    units : str
        Where the units are taken to stand.
    part : AppliedPart
        Which part of the correction is taken off: the most useful one of low enough risk.
    slope_error : float
        How far its share is from the stray field's part, rms.
    constant_known : bool
        The correction holds the part of the stray field that never changes.
    fast_benefit : float
        The benefit on the scales that held-out readings cover, nT^2: by it the best is chosen.
    """

    name: str
    slope: float
    sigma: float
    risk: float
    benefit: float
    trivial: bool
    units: str
    part: AppliedPart = WHOLE
    slope_error: float = 0.0
    constant_known: bool = False
    fast_benefit: float = 0.0

    @property
    def helps(self) -> bool:
        """Whether the correction lowers the error beyond doubt.

        Where the outboard reading hardly holds the field that geometry predicts, as that of a dead sensor,
        it does not.
        """
        far_too_small = self.slope_error > HELD_OUT_SETTINGS.least_slope_ratio - 1.0
        return self.risk < HELD_OUT_SETTINGS.most_risk and not self.trivial and not far_too_small

    @property
    def reason(self) -> str:
        """The sentence that is stored with a correction that helps."""
        what = "helps" if self.part == WHOLE else f"{self.part} is sure to help"
        return (
            f"{self.name}: {what}: chance of harm {self.risk:.2g} with {self.units}; on stretches it was not "
            f"learnt from the outboard reading has {self.slope:.2f} +- {self.sigma:.2f} of it"
        )

    @property
    def summary(self) -> str:
        """Slope and risk in words."""
        slope = f"held-out slope {self.slope:.2f} +- {self.sigma:.2f}"
        return f"{slope}, chance of harm {self.risk:.2g}" if np.isfinite(self.risk) else slope

    @property
    def objection(self) -> str:
        """Why a correction that does not help is not applied."""
        if not np.isfinite(self.risk):
            return f"no field of {self.units} is like that, so it holds ambient field or another error"
        if self.risk > 0.5:
            return "it would do harm"
        if self.trivial:
            return "it takes off hardly anything"
        if self.risk < HELD_OUT_SETTINGS.most_risk:
            return f"the outboard reading does not hold the field of {self.units}, as if it were dead"
        return "these readings do not tell whether it helps"


def choose_correction(
    readings: Readings, fit: Fit, priors: Sequence[GeometryPrior], folds: int = HELD_OUT_SETTINGS.folds
) -> HeldOutDecision:
    """Choose the correction that helps most on held-out readings, or none.

    Parameters
    ----------
    readings : Readings
        To be corrected; candidates are fitted to all but one fold of them and scored on that.
    fit : callable
        From rows in use (time,) to correctors by name, such as `candidates.Candidates.fit`.
    priors : sequence of GeometryPrior
        By geometry; the first that the readings do not reject is used.
    folds : int
    """
    edges = np.linspace(0, len(readings), folds + 1).astype(np.int64)
    held: dict[str, Held] = {}
    for fold in (slice(first, last) for first, last in pairwise(edges.tolist())):
        use = np.ones(len(readings), dtype=bool)
        use[fold] = False
        for name, corrector in fit(use).items():
            held.setdefault(name, []).append((fold, corrector(readings.select(fold))))
    whole = fit(np.ones(len(readings), dtype=bool))
    scores = {
        name: held_out_score(name, readings, (parts, whole[name](readings)), priors)
        for name, parts in held.items()
        if name in whole
    }
    general = scores.get(_GENERAL)
    if general is not None and not np.isfinite(general.risk):
        # The full matrix follows the readings wherever they lead. Where that is no field of units, the
        # difference holds something else, such as the ambient field that a dead sensor does not measure; a
        # form that is too stiff to show it is no better.
        scores = {name: replace(score, risk=float("nan")) for name, score in scores.items()}
    helping = [score for score in scores.values() if score.helps]
    if not helping:
        objections: dict[str, list[str]] = {}
        for score in scores.values():
            objections.setdefault(score.objection, []).append(f"{score.name} ({score.summary})")
        sentences = (f"{objection}: {', '.join(names)}" for objection, names in objections.items())
        reason = readings.defect or "; ".join(sentences) or "no candidate could be fitted"
        return HeldOutDecision(no_correction(len(readings), reason), "none", scores)
    # Benefits are those of what changes; a known constant comes on top. Forms that come to the same differ by
    # rounding: the first counts.
    most = max((score.constant_known, score.fast_benefit) for score in helping)
    near = most[1] - HELD_OUT_SETTINGS.rounding * abs(most[1])
    best = next(s for s in helping if s.constant_known == most[0] and s.fast_benefit >= near)
    correction = whole[best.name](readings)
    slow = slow_part_of(correction, readings, best.part.seconds)
    correction = partial_correction(correction, best.part, best.slope_error, slow)
    return HeldOutDecision(replace(correction, reason=best.reason), best.name, scores)


def held_out_score(
    name: str, readings: Readings, made: tuple[Held, Correction], priors: Sequence[GeometryPrior]
) -> HeldOutScore:
    """Return the score of a candidate by held-out folds and geometry.

    Parameters
    ----------
    made : (Held, Correction)
        Its corrections of the folds, and of all readings.
    """
    parts, correction = made
    slope, sigma, observation = held_out_slopes(readings, parts)
    for prior in priors:
        posterior = prior.slope_prior(correction).posterior(observation)
        if posterior.rejected:
            continue
        noise = prior.noise.share * float(np.trace(prior.noise.covariance))
        part = best_part(posterior, correction.constant_known)
        benefit = posterior.benefit(part)
        return HeldOutScore(
            name=name,
            slope=slope,
            sigma=sigma,
            risk=posterior.risk(part),
            benefit=benefit,
            trivial=benefit < HELD_OUT_SETTINGS.trivial_benefit * noise,
            units=prior.units,
            part=part,
            slope_error=posterior.slope_error(part),
            constant_known=correction.constant_known,
            fast_benefit=posterior.fast_benefit(part),
        )
    units = priors[-1].units if priors else "units"
    return HeldOutScore(
        name=name, slope=slope, sigma=sigma, risk=float("nan"), benefit=0.0, trivial=False, units=units
    )


def best_part(posterior: SlopePosterior, constant_known: bool) -> AppliedPart:
    """Return the part of a correction that lowers the error most, of all of low risk; else the whole.

    For each width of the slow part that is not taken off, the largest share of low risk counts.
    """
    if constant_known:
        return WHOLE
    widths = (0.0, *posterior.prior.filtered)
    parts = [AppliedPart(share, seconds) for seconds in widths for share in HELD_OUT_SETTINGS.shares]
    risk = {part: posterior.risk(part) for part in parts}
    low = min(risk.values()) < HELD_OUT_SETTINGS.preferred_risk
    most = HELD_OUT_SETTINGS.preferred_risk if low else HELD_OUT_SETTINGS.most_risk
    largest: dict[float, AppliedPart] = {}
    for part in parts:
        if risk[part] < most:
            largest.setdefault(part.seconds, part)
    return max(largest.values(), key=posterior.benefit, default=WHOLE)


@dataclass(frozen=True)
class SlopeObservation:
    """Slopes of held-out outboard readings on a correction, scale by scale.

    Attributes
    ----------
    scale : ndarray of int64, shape (scale,)
    slope, variance : ndarray, shape (scale,)
    ambient : ndarray, shape (scale, axis, axis)
        How much the slope changes with ambient field in the correction, a part of each axis of the field (the
        second axis here) in each of the correction (the first).
    coherent : ndarray, shape (scale, scale)
        Covariance of errors of the slopes that cells do not show, because all tell of the same few
        oscillations.
    """

    scale: npt.NDArray[np.int64]
    slope: Floats
    variance: Floats
    ambient: Floats
    coherent: Floats

    @classmethod
    def none(cls) -> SlopeObservation:
        """Return the observation of no scale."""
        return cls(
            np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0), np.zeros((0, 3, 3)), np.zeros((0, 0))
        )


def held_out_slopes(readings: Readings, parts: Held) -> tuple[float, float, SlopeObservation]:
    """Return the slope of held-out outboard readings on a correction, its sigma, and that on each scale."""
    cells_of_folds, blocks, folds = [], [], []
    for number, (rows, correction) in enumerate(parts):
        # Where a correction is not known nothing is taken off.
        known = readings.good[rows]
        folds.append((readings.outboard[rows][known], np.nan_to_num(correction.field[known], nan=0.0)))
        fold = cells_of(*folds[-1])
        cells_of_folds.append(fold)
        start = number * HELD_OUT_SETTINGS.blocks
        blocks.append(start + fold.row * HELD_OUT_SETTINGS.blocks // max(int(known.sum()), 1))
    cells, block = concatenate_cells(cells_of_folds), np.concatenate(blocks)
    square = np.einsum("cii->ci", cells.covariance[:, 3:, 3:])
    cross = np.einsum("cii->ci", cells.covariance[:, :3, 3:])
    both = np.einsum("cii->ci", cells.covariance[:, :3, :3])
    # Of the reading less half the correction: as far from "take it off" as from "leave it".
    variance = np.maximum(both - cross + 0.25 * square, 0.0)
    floor = np.maximum(np.median(variance[cells.scale == 1], axis=0), 1e-12) if len(cells) else np.ones(3)
    count, own_contrasts = cells.count[:, None], HELD_OUT_SETTINGS.own_contrasts
    weight = count / ((count * variance + own_contrasts * floor) / (count + own_contrasts))
    of_square, of_cross = (weight * square).sum(axis=1), (weight * cross).sum(axis=1)
    total = float(of_square.sum())
    if not total > 0:
        return 0.0, np.inf, SlopeObservation.none()
    slope = float(of_cross.sum()) / total
    score = np.bincount(block, of_cross - slope * of_square)
    score = score[np.bincount(block) > 0]
    scatter = float(np.sum(score**2)) * score.size / max(score.size - 1, 1)
    wider = max(1.0, scatter / total)
    scales, place = np.unique(cells.scale, return_inverse=True)
    own = np.maximum(np.bincount(place, of_square), 1e-300)
    ambient = np.zeros((scales.size, 3, 3))
    np.add.at(ambient, place, weight[:, :, None] * cells.covariance[:, :3, :3])
    observation = SlopeObservation(
        scale=scales,
        slope=np.bincount(place, of_cross) / own,
        variance=wider / own,
        ambient=ambient / own[:, None, None],
        coherent=_coherent_covariance(folds, cells_of_folds, weight, scales, wider / own),
    )
    return slope, float(np.sqrt(wider / total)), observation


def _coherent_covariance(
    folds: Sequence[tuple[Floats, Floats]],
    cells: Sequence[Cells],
    weight: Floats,
    scales: npt.NDArray[np.int64],
    variance: Floats,
) -> Floats:
    """Return the covariance of the slopes' errors that scatter between cells does not show; (scale, scale).

    Of one oscillation all cells tell the same: where currents and ambient field both go with the orbit, or
    torquers answer to the field, their phases agree for a cause. Were it chance, slopes on the scales s and t
    had, over frequencies f, the covariance ``sum a_sf a_tf / 2 C_s C_t`` with ``a = |c| |B|`` summed over
    axes, which have one cause, and ``C = sum |c|^2``. Of that is taken what cells show; a correction c of
    many frequencies, as units make that are switched, leaves hardly any of it.

    Parameters
    ----------
    folds : sequence of (ndarray, ndarray)
        Outboard reading B and correction c of each, one after the other in time; (time, axis).
    cells : sequence of Cells
        Of each fold.
    weight : ndarray, shape (cell, axis)
        Of the cells of all folds.
    variance : ndarray, shape (scale,)
        What cells show.
    """
    reading, taken = zip(*folds, strict=True)
    weights = np.split(weight, np.cumsum([len(one) for one in cells])[:-1])
    # Records of contrasts on all scales are as long as that of samples: bins are the same frequencies.
    amplitude = np.zeros((scales.size, sum(map(len, reading)) + 1))
    power, expected = np.ones(scales.size), np.ones(scales.size)
    for place, scale in enumerate(scales.tolist()):
        here = [one[own.scale == scale] for own, one in zip(cells, weights, strict=True)]
        outboard, correction = (
            np.abs(np.fft.rfft(joined_contrasts(series, scale, here), axis=0)) for series in (reading, taken)
        )
        product = outboard * correction
        amplitude[place, : len(product)] = product.sum(axis=1)
        power[place] = max(float(np.sum(correction**2)), 1e-300)
        # Independent axes with Rayleigh's amplitudes: the mean of the squared sum over that of the squares.
        sizes = np.sqrt(np.mean(product**2, axis=0))
        squares = max(float(np.sum(sizes**2)), 1e-300)
        expected[place] = 1.0 + (np.pi / 4.0) ** 2 * (float(np.sum(sizes)) ** 2 / squares - 1.0)
    scaled = amplitude / power[:, None]
    found = 0.5 * scaled @ scaled.T
    known = expected * variance / np.maximum(np.diag(found), 1e-300)
    hidden = np.sqrt(np.maximum(1.0 - known, 0.0))
    return np.asarray(found * np.outer(hidden, hidden))


@dataclass(frozen=True, kw_only=True)
class SlopePrior:
    """Prior of the slopes of one correction, for units at many places and sensors with slow noise.

    Attributes
    ----------
    scale : ndarray of int64, shape (scale,)
    power : ndarray, shape (scale,)
        Mean square that the correction has there, nT^2 summed over axes.
    slope : ndarray, shape (scale, draw)
        Of the stray field on the correction.
    filtered : mapping
        By the seconds of an `AppliedPart`: the product of the part with the whole correction on each scale,
        and its square, relative to `power`; each (scale,).
    leak : ndarray, shape (draw, axis, axis), optional
        Ambient field that is in the correction because its fitted leak is not right.
    signal_share : ndarray, shape (scale,), optional
        Part g of the difference that is not taken for noise on each scale. By James and Stein's rule signal P
        in noise N leaves g = (P - N) / (P + N), and P / (g (P + N)) = (1 + g) / 2 g is the signal's slope.
    """

    scale: npt.NDArray[np.int64]
    power: Floats
    slope: Floats
    filtered: Mapping[float, tuple[Floats, Floats]] = field(default_factory=dict)
    leak: Floats | None = None
    signal_share: Floats | float = 1.0

    def posterior(self, observation: SlopeObservation) -> SlopePosterior:
        """Return the posterior after an observation."""
        return SlopePosterior(self, observation)

    def powers(self, part: AppliedPart) -> tuple[Floats, Floats]:
        """Return the product of a part with the whole correction, and its square; each (scale,), nT^2."""
        product, square = self.filtered[part.seconds] if part.seconds else (1.0, 1.0)
        return np.asarray(part.share * product * self.power), np.asarray(part.share**2 * square * self.power)

    def benefit(self, part: AppliedPart, scales: npt.NDArray[np.bool_] | slice = slice(None)) -> Floats:
        """Return the fall of the mean square error by a part of the correction; (draw,), nT^2."""
        product, square = self.powers(part)
        return np.asarray(2.0 * product[scales] @ self.slope[scales] - square[scales].sum())


@dataclass(frozen=True)
class SlopePosterior:
    """Posterior of the slopes of one correction: draws of the prior weighted by their likelihood."""

    prior: SlopePrior
    observation: SlopeObservation

    @cached_property
    def misfit(self) -> Floats:
        """The sum of squares of observed slopes less those of each draw, in errors; (draw,)."""
        prior, observation = self.prior, self.observation
        _, own, other = np.intersect1d(prior.scale, observation.scale, return_indices=True)
        variance = observation.variance[other] + HELD_OUT_SETTINGS.slope_scatter**2
        signal = np.broadcast_to(prior.signal_share, prior.scale.shape)[own, None]
        slope, observed = prior.slope[own], observation.slope[other, None]
        if prior.leak is not None:
            # The outboard reading is correlated with its own ambient field, as it is with stray field.
            ambient = observation.ambient[other].reshape(-1, 9)
            observed = observed - signal * (ambient @ prior.leak.reshape(-1, 9).T)
        coherent = observation.coherent[np.ix_(other, other)]
        if coherent.any():
            random, nothing = np.random.default_rng(8), np.zeros(other.size)
            observed = (
                observed - random.multivariate_normal(nothing, coherent, slope.shape[1], method="eigh").T
            )
        # What was taken for noise may be stray field: the correction is then too small by so much.
        most = slope * (1.0 + signal) / (2.0 * np.maximum(signal, HELD_OUT_SETTINGS.least_signal))
        away = observed - np.clip(observed, np.minimum(slope, most), np.maximum(slope, most))
        return np.asarray(np.sum(away**2 / variance[:, None], axis=0))

    @cached_property
    def weights(self) -> Floats:
        """Posterior probability of each draw; (draw,)."""
        weight = np.exp(-0.5 * (self.misfit - self.misfit.min()))
        return np.asarray(weight / weight.sum())

    @property
    def rejected(self) -> bool:
        """Whether no draw of the prior agrees with the observation (chi-square test)."""
        count = self.observation.scale.size
        return (
            bool(count) and float(scipy.stats.chi2.sf(self.misfit.min(), count)) < HELD_OUT_SETTINGS.rejected
        )

    @cached_property
    def effective_draws(self) -> float:
        """Number of draws of equal weight that would have the same precision (Kish)."""
        return 1.0 / float(np.sum(self.weights**2))

    def risk(self, part: AppliedPart = WHOLE) -> float:
        """Return the probability that taking off a part makes the error larger.

        It is not less than one over the effective draws: a single draw proves nothing.
        """
        worse = float(self.weights @ (self.prior.benefit(part) <= 0.0))
        return min(worse + 1.0 / self.effective_draws, 1.0)

    def benefit(self, part: AppliedPart = WHOLE) -> float:
        """Return the mean fall of the mean square error by taking off a part, nT^2."""
        return float(self.prior.benefit(part) @ self.weights)

    def fast_benefit(self, part: AppliedPart = WHOLE) -> float:
        """Return the part of `benefit` on the observed scales, nT^2.

        On slower ones it is not known how much of a correction is the sensors' own.
        """
        own = np.isin(self.prior.scale, self.observation.scale)
        return float(self.prior.benefit(part, own) @ self.weights)

    def slope_error(self, part: AppliedPart = WHOLE) -> float:
        """Return how far a part's share is from the slope of the stray field on it, rms.

        Both without what is slow: that of the stray field stays in the field, too.
        """
        _, square = self.prior.powers(part)
        slope = square @ self.prior.slope / max(float(square.sum()), 1e-300)
        return float(np.sqrt(self.weights @ (slope - part.share) ** 2))


@dataclass(frozen=True)
class NonStrayShare:
    """What of the difference is no stray field: flicker noise, drift, ambient field that leaks in.

    Attributes
    ----------
    share : ndarray, shape (place, draw)
        Of the difference's power.
    added : ndarray, shape (place, draw)
        What the outboard sensor's own noise n adds to the error: the difference holds -n, and a correction
        M d of power P adds <n M n> / P.
    """

    share: Floats
    added: Floats

    def independent(self) -> NonStrayShare:
        """Return the same with other draws: independent of those it had."""
        return NonStrayShare(np.roll(self.share, 1, axis=1), np.roll(self.added, 1, axis=1))

    def reduced(self, slope: Floats) -> Floats:
        """Return slopes (place, 1) reduced by what is no stray field; (place, draw).

        Where the correction is against the units' field, it is no merit that it is for a sensor's noise: that
        would be the inboard reading in the outboard one's place.
        """
        return np.asarray(slope * (1.0 - self.share) - np.abs(slope) * self.added)


@dataclass(frozen=True, kw_only=True)
class GeometryPrior:
    """Prior by geometry: what is known of a correction before the outboard reading is used.

    Attributes
    ----------
    readings : Readings
    matrices : ndarray, shape (place, 3, 3)
        What takes the difference to the outboard sensor, for places all over the body.
    stray : ndarray, shape (time, axis)
        The difference without what it holds of the ambient field, nT; NaN where a sensor is missing.
    noise : DifferenceNoise
        Its white noise, and how much of that is the outboard sensor's.
    leak_covariance : ndarray, shape (9, 9)
        Of the error of the leak.
    units : str
        Where the units are taken to stand.
    drift : float
        How far the sensors drift apart by themselves in an hour, nT.
    """

    readings: Readings
    matrices: Floats
    stray: Floats
    noise: DifferenceNoise
    leak_covariance: Floats
    units: str = "all units in the body"
    drift: float = SLOW_NOISE_SETTINGS.drift_in_hour

    def slope_prior(self, correction: Correction) -> SlopePrior:
        """Return the prior of the slopes of a correction of the readings.

        What comes and goes with the states has the slope of the switchings on all scales: of the sensors'
        slow noise it holds as much as comes into means over each state.
        """
        good = self.readings.good
        taken, state = np.nan_to_num(correction.field[good], nan=0.0), correction.state[good]
        stray, both = self._clear, self._difference
        stepped, both_stepped = means_by_state(state, taken), means_by_state(state, both)
        longest = HELD_OUT_SETTINGS.longest
        cells = cells_of(self.readings.outboard[good], stray, stepped, taken - stepped, longest=longest)
        quick = cells.select(cells.scale <= max(len(taken) // HELD_OUT_SETTINGS.quick, 1))
        switched = self._slopes(quick, slice(6, 9))[:, None]
        if np.any(state >= 0):
            # How much of it comes into the states' means does not depend on the draws of the slow rest.
            other_stepped = {scale: one.independent() for scale, one in self._non_stray(both_stepped).items()}
            other = self._non_stray(both - both_stepped, most=self._quiet)
        else:
            other = other_stepped = self._non_stray_without_states
        scales = np.unique(cells.scale)
        power, slope = np.zeros(scales.size), []
        for place, scale in enumerate(scales.tolist()):
            here = cells.select(cells.scale == scale)
            # Of the correction in contrasts, and of its parts with states and without.
            products = here.covariance[:, 6:, 6:].reshape(-1, 2, 3, 2, 3)
            total, with_states, without = (
                max(float(np.einsum("c,cii->", here.count, one) / here.count.sum()), 1e-300)
                for one in (products.sum(axis=(1, 3)), products[:, 0, :, 0], products[:, 1, :, 1])
            )
            power[place] = total / (2.0 * float(scale))
            rest = other[scale].reduced(self._slopes(here, slice(9, 12))[:, None])
            slope.append((other_stepped[scale].reduced(switched) * with_states + rest * without) / total)
        # What changes more slowly than any contrast.
        power[-1] = max(float(np.var(taken, axis=0).sum() - power[:-1].sum()), 0.0)
        return SlopePrior(
            scale=scales,
            power=power,
            slope=np.reshape(slope, (scales.size, -1)),
            filtered=_filtered(taken, scales, self.readings),
            # States follow the outboard reading's own steps.
            leak=None if correction.method == "states" else self._leaks.reshape(-1, 3, 3),
            signal_share=np.array([self._signal_share[scale] for scale in scales.tolist()]),
        )

    @cached_property
    def _clear(self) -> Floats:
        """The stray part of the difference without white noise where both sensors are; (time, axis), nT.

        Less noise is left in it than was taken out of the stray field: slopes are rather larger.
        """
        return wiener_shrink(self.stray[self.readings.good], self.noise.covariance)[0]

    @cached_property
    def _signal_share(self) -> dict[int, float]:
        """Part of the difference's changes that is not taken for noise, by scale."""
        sums = running_sums(np.concatenate([self.stray[self.readings.good], self._clear], axis=1))
        found = {}
        for scale in scales_of(len(sums) - 1, HELD_OUT_SETTINGS.longest):
            whole, clear = np.split(contrasts(sums, scale)[0], 2, axis=1)
            found[scale] = float(np.sum(whole * clear)) / max(float(np.sum(whole**2)), 1e-300)
        return found

    @cached_property
    def _difference(self) -> Floats:
        """The stray part of the difference, and what else may be in it; (time, column), nT.

        Columns: three axes of the stray part, three of white noise that was left in it, three of the ambient
        field, and the size at the outboard sensor of a line and of draws of a walk and of flicker noise.
        """
        readings, good = self.readings, self.readings.good
        count = int(good.sum())
        noise = self.noise.covariance
        white = np.random.default_rng(6).multivariate_normal(np.zeros(3), noise, count)
        apart = expected_drift((readings.stamps[-1] - readings.stamps[0]) / SECOND, self.drift)
        own = draw_slow_noise(count)
        drift, flicker = (np.sqrt(self._size(one)) for one in (apart**2 * np.eye(3), noise))
        slow = drift * own.line, drift * own.walk, flicker * own.flicker
        left_white = wiener_shrink(white, noise)[0]
        return np.column_stack([self._clear, left_white, readings.outboard[good], *slow])

    @cached_property
    def _draws(self) -> Floats:
        """How large white noise, line, walk and flicker noise are relative to what is usual, in power.

        (4, place, draw).
        """
        shape = (4, len(self.matrices), HELD_OUT_SETTINGS.drift_draws)
        return np.asarray(
            np.random.default_rng(2).standard_t(SLOW_NOISE_SETTINGS.student_freedom, shape) ** 2
        )

    @cached_property
    def _outboard(self) -> Floats:
        """Parts of white noise, line, walk and flicker noise that are the outboard sensor's.

        (4, place, draw).
        """
        drawn = np.random.default_rng(3).normal(
            *HELD_OUT_SETTINGS.outboard_drift, size=(4, *self._draws.shape[1:])
        )
        drawn[[0, 3]] = self.noise.share
        return drawn

    @cached_property
    def _leaks(self) -> Floats:
        """Ambient field in a correction by an error of the leak; (place, draw, axis, axis)."""
        random = np.random.default_rng(7)
        shape = self._draws.shape[1:]
        drawn = random.multivariate_normal(np.zeros(9), self.leak_covariance, shape, method="eigh")
        return np.asarray(np.einsum("ki,...ij->...kj", self._mean_matrix, drawn.reshape(*shape, 3, 3)))

    @cached_property
    def _leak_power(self) -> Floats:
        """Power of ambient field in a correction, for each product of two axes of it; (place, draw, 9)."""
        return np.asarray((np.swapaxes(self._leaks, 2, 3) @ self._leaks).reshape(*self._leaks.shape[:2], 9))

    @cached_property
    def _non_stray_without_states(self) -> dict[int, NonStrayShare]:
        return self._non_stray(self._difference, most=self._quiet)

    def _non_stray(self, both: Floats, most: Mapping[int, float] | None = None) -> dict[int, NonStrayShare]:
        """Return by scale what of the difference is no stray field.

        Parameters
        ----------
        both : ndarray, shape (time, column)
            As `_difference`, or a part of it.
        most : mapping, optional
            The largest power of drift and of flicker noise by scale, nT^2.
        """
        sums, found = running_sums(both), {}
        factor = float(np.sqrt(np.sum(self._mean_matrix**2) / 3.0))
        for scale in scales_of(len(both), HELD_OUT_SETTINGS.longest):
            values = contrasts(sums, scale)[0]
            stray, white, ambient = (
                values[:, rows].T @ values[:, rows] / len(values)
                for rows in (slice(0, 3), slice(3, 6), slice(6, 9))
            )
            line, *others = np.mean(values[:, 9:] ** 2, axis=0)
            walk, flicker = np.reshape(others, (2, SLOW_NOISE_SETTINGS.draws)).mean(axis=1)
            usual = np.array([self._size(white), line, walk, flicker])
            own = usual[:, None, None] * self._draws
            if most is not None:
                # What is left of white noise comes in bursts; the rest is there all the time.
                own[1:] = np.minimum(own[1:], most[scale])
            leaked = self._signal_share[scale] ** 2 * (self._leak_power @ ambient.ravel())
            share = np.concatenate([own, leaked[None]]) / max(self._size(stray), 1e-300)
            share /= np.maximum(share.sum(axis=0), 1.0)
            added = np.sum(self._outboard * share[:4], axis=0) / factor
            found[scale] = NonStrayShare(share.sum(axis=0), added)
        return found

    @cached_property
    def _quiet(self) -> dict[int, float]:
        """Power of the difference in quiet stretches, by scale: sensors drift all the time. nT^2."""
        cells = cells_of(self._difference[:, :3], longest=HELD_OUT_SETTINGS.longest)
        found = {}
        for scale in np.unique(cells.scale).tolist():
            size = [self._size(one) for one in cells.covariance[cells.scale == scale]]
            enough = len(size) >= HELD_OUT_SETTINGS.quiet_cells
            found[scale] = float(np.quantile(size, HELD_OUT_SETTINGS.quiet_quantile)) if enough else np.inf
        return found

    def _slopes(self, cells: Cells, part: slice) -> Floats:
        """Return the slopes of what matrices make of the difference on a part of the correction; (place,)."""
        across = np.einsum("c,cij->ij", cells.count, cells.covariance[:, 3:6, part])
        total = float(np.einsum("c,cii->", cells.count, cells.covariance[:, part, part]))
        return np.asarray(np.einsum("pji,ij->p", self.matrices, across) / max(total, 1e-300))

    @cached_property
    def _mean_matrix(self) -> Floats:
        return np.asarray(self.matrices.mean(axis=0))

    def _size(self, covariance: Floats) -> float:
        """Return the power at the outboard sensor of a covariance of the difference (3, 3)."""
        return float(np.einsum("ki,ij,kj->", self._mean_matrix, covariance, self._mean_matrix))


def means_by_state(state: npt.NDArray[np.int64], values: Floats) -> Floats:
    """Return the part of values (time, column) that is the same whenever a state comes again."""
    known = np.flatnonzero(state >= 0)
    if not known.size:
        return np.zeros_like(values)
    # A transient or unknown state continues the one before it: no steps are made that nobody took.
    last = np.maximum(np.searchsorted(known, np.arange(state.size), side="right") - 1, 0)
    _, place = np.unique(state[known], return_inverse=True)
    count = np.bincount(place)
    mean = [np.bincount(place, column[known]) / count for column in values.T]
    return np.asarray(np.stack(mean, axis=1)[place[last]])


def _filtered(
    taken: Floats, scales: npt.NDArray[np.int64], readings: Readings
) -> dict[float, tuple[Floats, Floats]]:
    """Return `SlopePrior.filtered` of a correction's good rows, for all widths of the slow part."""
    found, sums = {}, running_sums(taken)
    wholes = [contrasts(sums, scale)[0] for scale in scales.tolist()]
    powers = [max(float(np.sum(whole**2)), 1e-300) for whole in wholes]
    for width in (len(taken) // part for part in HELD_OUT_SETTINGS.slow_widths):
        if width < HELD_OUT_SETTINGS.narrowest:
            break
        sums = running_sums(taken - slow_part(taken, width))
        product, square = np.ones((2, scales.size))
        for place, (scale, whole, power) in enumerate(zip(scales.tolist(), wholes, powers, strict=True)):
            quick = contrasts(sums, scale)[0]
            product[place] = float(np.vdot(quick, whole)) / power
            square[place] = float(np.vdot(quick, quick)) / power
        found[width * readings.step / SECOND] = product, square
    return found
