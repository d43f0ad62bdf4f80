"""Held-out decision: prior, posterior, judge.

The slopes of the stray field on a correction: as expected, as readings show them, and after both.

What geometry lets expect of a correction, before the outboard reading is asked.

All units stand in the spacecraft's body. Each place in it takes the difference of both sensors to the
outboard sensor by a matrix of its own; none of them makes a stray field that a correction of about the right
size would not lower. What is not a spacecraft's field in the difference is set against it: white noise, what
the sensors wander by themselves, and ambient field that leaks in.

Whether a correction helps, judged without the truth on readings it was not fitted to.

The ambient field knows nothing of the spacecraft. What a correction c takes off a held-out stretch therefore
shows in the outboard reading itself: regressed on c, the reading has the slope 1 when c is the stray field,
0 when c has nothing to do with it. Taking c off changes the mean square of the error by ``<c^2> - 2 <c s>``
with the stray field s, and ``<c s> = <c B_out>`` but for chance: it helps where the slope is above one half.
Regressed in cells of time and scale, weighted by the quietness of the ambient field there, the slope has an
error that is known. Where the ambient field is restless it tells little; what dipoles in the spacecraft's
body can do is known beforehand (`expectation`), and both together say how likely harm is. Where it is not
sure that all of a correction helps, a share of it may be, or what of it is quick (`slow_part`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

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
from inflight.dual.noise import DRAWS, DRIFT, TAIL, draw_slow_noise, expected_drift
from inflight.dual.readings import (
    Cells,
    Readings,
    cells_of,
    concatenate_cells,
    contrasts,
    running_sums,
    scales_of,
)
from inflight.time import SECOND

#: Slopes of several units on one scale differ by so much from those of one.
SCATTER = 0.2

#: Chance below which held-out readings are not of units in the body.
_REFUTED = 1e-6

#: Least part of a scale that passes as no noise.
_PASSED = 0.01


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
    """

    scale: npt.NDArray[np.int64]
    slope: Floats
    variance: Floats
    ambient: Floats

    @classmethod
    def nothing(cls) -> SlopeObservation:
        """Return what readings say that say nothing."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0), np.zeros((0, 3, 3)))


@dataclass(frozen=True)
class SlopePrior:
    """What geometry lets expect of one correction, for units at many places and sensors that wander.

    Attributes
    ----------
    scale : ndarray of int64, shape (scale,)
    power : ndarray, shape (scale,)
        Mean square that the correction has there, nT^2 summed over axes.
    slope : ndarray, shape (scale, draw)
        Of the stray field on the correction.
    kept : mapping
        By the seconds of a `AppliedPart`: the product of the part with the whole correction on each scale, and its
        square, beside `power`; each (scale,).
    leak : ndarray, shape (draw, axis, axis), optional
        Ambient field that is in the correction because its fitted leak is not right.
    passed : ndarray, shape (scale,), optional
        Part g of the difference that is not taken for noise on each scale. By James and Stein's rule signal P
        in noise N leaves g = (P - N) / (P + N), and P / (g (P + N)) = (1 + g) / 2 g is the signal's slope.
    """

    scale: npt.NDArray[np.int64]
    power: Floats
    slope: Floats
    kept: Mapping[float, tuple[Floats, Floats]] = field(default_factory=dict)
    leak: Floats | None = None
    passed: Floats | float = 1.0

    def after(self, seen: SlopeObservation) -> SlopePosterior:
        """Return what to expect after held-out readings."""
        return SlopePosterior(self, seen)

    def parts(self, part: AppliedPart) -> tuple[Floats, Floats]:
        """Return the product of a part with the whole correction, and its square; each (scale,), nT^2."""
        product, square = self.kept[part.seconds] if part.seconds else (1.0, 1.0)
        return np.asarray(part.share * product * self.power), np.asarray(part.share**2 * square * self.power)

    def benefit(self, part: AppliedPart, scales: npt.NDArray[np.bool_] | slice = slice(None)) -> Floats:
        """Return the fall of the mean square error by a part of the correction; (draw,), nT^2."""
        product, square = self.parts(part)
        return np.asarray(2.0 * product[scales] @ self.slope[scales] - square[scales].sum())


@dataclass(frozen=True)
class SlopePosterior:
    """What to expect of a correction after held-out readings."""

    expected: SlopePrior
    seen: SlopeObservation

    @cached_property
    def misfit(self) -> Floats:
        """The sum of squares of what held-out readings say less what is expected, (draw,)."""
        expected, seen = self.expected, self.seen
        _, own, other = np.intersect1d(expected.scale, seen.scale, return_indices=True)
        variance = seen.variance[other] + SCATTER**2
        passed = np.broadcast_to(expected.passed, expected.scale.shape)[own, None]
        slope, found = expected.slope[own], seen.slope[other, None]
        if expected.leak is not None:
            # The outboard reading goes with its own ambient field: that looks like stray field.
            found = found - passed * np.einsum("dij,sij->sd", expected.leak, seen.ambient[other])
        # What was taken for noise may be stray field: the correction is then too small by so much.
        most = slope * (1.0 + passed) / (2.0 * np.maximum(passed, _PASSED))
        away = found - np.clip(found, np.minimum(slope, most), np.maximum(slope, most))
        return np.asarray(np.sum(away**2 / variance[:, None], axis=0))

    @cached_property
    def weights(self) -> Floats:
        """How likely each draw is; (draw,)."""
        weight = np.exp(-0.5 * (self.misfit - self.misfit.min()))
        return np.asarray(weight / weight.sum())

    @property
    def refuted(self) -> bool:
        """Whether no place in the body makes what held-out readings say."""
        count = self.seen.scale.size
        return bool(count) and float(chi2.sf(self.misfit.min(), count)) < _REFUTED

    @cached_property
    def draws(self) -> float:
        """How many draws of the same weight tell as much."""
        return 1.0 / float(np.sum(self.weights**2))

    def chance_of_harm(self, part: AppliedPart = WHOLE) -> float:
        """Return the probability that taking off a part makes the error larger.

        It is not less than one in so many draws as are left: where hardly one is, nothing is sure.
        """
        harm = float(self.weights @ (self.expected.benefit(part) <= 0.0))
        return min(harm + 1.0 / self.draws, 1.0)

    def benefit(self, part: AppliedPart = WHOLE) -> float:
        """Return the mean fall of the mean square error by taking off a part, nT^2."""
        return float(self.expected.benefit(part) @ self.weights)

    def quick_benefit(self, part: AppliedPart = WHOLE) -> float:
        """Return the part of `benefit` on the scales that are seen, nT^2.

        On slower ones it is not told how much of a correction is the sensors' own.
        """
        own = np.isin(self.expected.scale, self.seen.scale)
        return float(self.expected.benefit(part, own) @ self.weights)

    def away(self, part: AppliedPart = WHOLE) -> float:
        """Return how far a part's share is from the slope of the stray field on it, rms.

        Both without what is slow: that of the stray field is left alone, too.
        """
        _, square = self.expected.parts(part)
        slope = square @ self.expected.slope / max(float(square.sum()), 1e-300)
        return float(np.sqrt(self.weights @ (slope - part.share) ** 2))


#: The longest blocks are this part of the record; cells that tell the quiet level of a scale.
_LONGEST, _QUIET_CELLS = 2, 6

#: Blocks of switchings are at most this part of the record.
_QUICK = 64

_QUIET = 0.25

#: Draws of the sensors' wandering for each place: chances of one in a thousand are told from some hundreds of
#: draws that held-out readings leave.
_TURNS = 60

#: Part of the drift of both sensors that is the outboard one's: two straight lines, each as likely to rise as
#: to fall; mean and standard deviation.
_OUTBOARD = (0.5, 0.5)

#: Parts of the record that corrections are cut at, and the narrowest such width, samples.
CUTS, _NARROWEST = (4, 8, 16, 32, 64, 128, 256), 8


@dataclass(frozen=True)
class NonStrayShare:
    """What of the difference is no stray field: flicker noise, drift, ambient field that leaks in.

    Attributes
    ----------
    part : ndarray, shape (place, turn)
        Of the difference's power.
    added : ndarray, shape (place, turn)
        What the outboard sensor's own noise n adds to the error: the difference holds -n, and a correction
        M d of power P adds <n M n> / P.
    """

    part: Floats
    added: Floats

    def apart(self) -> NonStrayShare:
        """Return the same with other turns: what it is tells nothing of those that had them."""
        return NonStrayShare(np.roll(self.part, 1, axis=1), np.roll(self.added, 1, axis=1))

    def less(self, slope: Floats) -> Floats:
        """Return what is left of slopes (place, 1); (place, turn).

        Where the correction is against the units' field, it is no merit that it is for a sensor's noise: that
        would be the inboard reading in the outboard one's place.
        """
        return np.asarray(slope * (1.0 - self.part) - np.abs(slope) * self.added)


@dataclass(frozen=True)
class GeometryPrior:
    """What is known before the outboard reading is asked.

    Attributes
    ----------
    readings : Readings
    matrices : ndarray, shape (place, 3, 3)
        What takes the difference to the outboard sensor, for places all over the body.
    stray : ndarray, shape (time, axis)
        The difference without what it holds of the ambient field, nT; NaN where a sensor is missing.
    noise : Noise
        Its white noise, and how much of that is the outboard sensor's.
    leak_covariance : ndarray, shape (9, 9)
        Of what is not known of the leak.
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
    drift: float = DRIFT

    def of(self, correction: Correction) -> SlopePrior:
        """Return what to expect of a correction of the readings.

        What comes and goes with the states has the slope of the switchings on all scales: of what the
        sensors wander by themselves it holds as much as comes into means over each state.
        """
        good = self.readings.good
        taken, state = np.nan_to_num(correction.field[good], nan=0.0), correction.state[good]
        stray, both = self._clear, self._difference
        stepped, both_stepped = means_by_state(state, taken), means_by_state(state, both)
        cells = cells_of(self.readings.outboard[good], stray, stepped, taken - stepped, longest=_LONGEST)
        quick = cells.part(cells.scale <= max(len(taken) // _QUICK, 1))
        switched = self._slopes(quick, slice(6, 9))[:, None]
        if np.any(state >= 0):
            # How much of it comes into the states' means, their quick scales do not tell of the slow rest.
            lost_stepped = {scale: one.apart() for scale, one in self._lost(both_stepped).items()}
            lost = self._lost(both - both_stepped, most=self._quiet)
        else:
            lost = lost_stepped = self._lost_without_states
        scales = np.unique(cells.scale)
        power, slope = np.zeros(scales.size), []
        for place, scale in enumerate(scales.tolist()):
            here = cells.part(cells.scale == scale)
            total, *parts = _powers(here)
            power[place] = total / (2.0 * float(scale))
            rest = lost[scale].less(self._slopes(here, slice(9, 12))[:, None])
            slope.append((lost_stepped[scale].less(switched) * parts[0] + rest * parts[1]) / total)
        # What changes more slowly than any contrast.
        power[-1] = max(float(np.var(taken, axis=0).sum() - power[:-1].sum()), 0.0)
        drawn = np.reshape(slope, (scales.size, -1))
        passed = np.array([self._passed[scale] for scale in scales.tolist()])
        # States follow the outboard reading's own steps.
        leak = None if correction.method == "states" else self._leaks.reshape(-1, 3, 3)
        return SlopePrior(scales, power, drawn, _kept(taken, scales, self.readings), leak, passed)

    @cached_property
    def _clear(self) -> Floats:
        """The stray part of the difference without white noise where both sensors are; (time, axis), nT.

        Less noise is left in it than was taken out of the stray field: slopes are rather larger.
        """
        return wiener_shrink(self.stray[self.readings.good], self.noise.covariance)[0]

    @cached_property
    def _passed(self) -> dict[int, float]:
        """Part of the difference's changes that is not taken for noise, by scale."""
        sums = running_sums(np.concatenate([self.stray[self.readings.good], self._clear], axis=1))
        found = {}
        for scale in scales_of(len(sums) - 1, _LONGEST):
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
        far = expected_drift((readings.stamps[-1] - readings.stamps[0]) / SECOND, self.drift)
        own = draw_slow_noise(count)
        drift, flicker = (np.sqrt(self._size(one)) for one in (far**2 * np.eye(3), noise))
        wander = drift * own.line, drift * own.walk, flicker * own.flicker
        left = wiener_shrink(white, noise)[0]
        return np.column_stack([self._clear, left, readings.outboard[good], *wander])

    @cached_property
    def _turns(self) -> Floats:
        """How large white noise, line, walk and flicker noise are beside what is usual, in power.

        (4, place, turn).
        """
        shape = (4, len(self.matrices), _TURNS)
        return np.asarray(np.random.default_rng(2).standard_t(TAIL, shape) ** 2)

    @cached_property
    def _outboard(self) -> Floats:
        """Parts of white noise, line, walk and flicker noise that are the outboard sensor's.

        (4, place, turn).
        """
        drawn = np.random.default_rng(3).normal(*_OUTBOARD, size=(4, *self._turns.shape[1:]))
        drawn[[0, 3]] = self.noise.share
        return drawn

    @cached_property
    def _leaks(self) -> Floats:
        """Ambient field in a correction by an error of the leak; (place, turn, axis, axis)."""
        random = np.random.default_rng(7)
        shape = self._turns.shape[1:]
        drawn = random.multivariate_normal(np.zeros(9), self.leak_covariance, shape, method="eigh")
        return np.asarray(np.einsum("ki,...ij->...kj", self._middle, drawn.reshape(*shape, 3, 3)))

    @cached_property
    def _lost_without_states(self) -> dict[int, NonStrayShare]:
        return self._lost(self._difference, most=self._quiet)

    def _lost(self, both: Floats, most: Mapping[int, float] | None = None) -> dict[int, NonStrayShare]:
        """Return by scale what of the difference is no stray field.

        Parameters
        ----------
        both : ndarray, shape (time, column)
            As `_difference`, or a part of it.
        most : mapping, optional
            The largest power of drift and of flicker noise by scale, nT^2.
        """
        sums, found = running_sums(both), {}
        for scale in scales_of(len(both), _LONGEST):
            values = contrasts(sums, scale)[0]
            stray, white, ambient = (
                values[:, rows].T @ values[:, rows] / len(values)
                for rows in (slice(0, 3), slice(3, 6), slice(6, 9))
            )
            line, *others = np.mean(values[:, 9:] ** 2, axis=0)
            walk, flicker = np.reshape(others, (2, DRAWS)).mean(axis=1)
            usual = np.array([self._size(white), line, walk, flicker])
            own = usual[:, None, None] * self._turns
            if most is not None:
                # What is left of white noise comes in bursts; the rest goes on all the time.
                own[1:] = np.minimum(own[1:], most[scale])
            leaks = self._passed[scale] * self._leaks
            through = np.einsum("ptki,ij,ptkj->pt", leaks, ambient, leaks)
            lost = np.concatenate([own, through[None]]) / max(self._size(stray), 1e-300)
            lost /= np.maximum(lost.sum(axis=0), 1.0)
            added = np.sum(self._outboard * lost[:4], axis=0) / self._factor
            found[scale] = NonStrayShare(lost.sum(axis=0), added)
        return found

    @cached_property
    def _quiet(self) -> dict[int, float]:
        """Power of the difference in quiet stretches, by scale: sensors wander all the time. nT^2."""
        cells = cells_of(self._difference[:, :3], longest=_LONGEST)
        found = {}
        for scale in np.unique(cells.scale).tolist():
            size = [self._size(one) for one in cells.covariance[cells.scale == scale]]
            found[scale] = float(np.quantile(size, _QUIET)) if len(size) >= _QUIET_CELLS else np.inf
        return found

    def _slopes(self, cells: Cells, part: slice) -> Floats:
        """Return the slopes of what matrices make of the difference on a part of the correction; (place,)."""
        across = np.einsum("c,cij->ij", cells.count, cells.covariance[:, 3:6, part])
        total = float(np.einsum("c,cii->", cells.count, cells.covariance[:, part, part]))
        return np.asarray(np.einsum("pji,ij->p", self.matrices, across) / max(total, 1e-300))

    @cached_property
    def _middle(self) -> Floats:
        """The mean matrix."""
        return np.asarray(self.matrices.mean(axis=0))

    @property
    def _factor(self) -> float:
        """Size of the mean matrix."""
        return float(np.sqrt(np.sum(self._middle**2) / 3.0))

    def _size(self, covariance: Floats) -> float:
        """Return the power at the outboard sensor of a covariance of the difference (3, 3)."""
        return float(np.einsum("ki,ij,kj->", self._middle, covariance, self._middle))


def _powers(cells: Cells) -> list[float]:
    """Return the power of a correction in contrasts, and of its parts with states and without, nT^2."""
    taken = cells.covariance[:, 6:, 6:].reshape(-1, 2, 3, 2, 3)
    parts = taken.sum(axis=(1, 3)), taken[:, 0, :, 0], taken[:, 1, :, 1]
    return [max(float(np.einsum("c,cii->", cells.count, one) / cells.count.sum()), 1e-300) for one in parts]


def _kept(
    taken: Floats, scales: npt.NDArray[np.int64], readings: Readings
) -> dict[float, tuple[Floats, Floats]]:
    """Return what is left on each scale of a correction's good rows when slow parts are left alone."""
    found = {}
    for width in (len(taken) // part for part in CUTS):
        if width < _NARROWEST:
            break
        sums = running_sums(np.concatenate([taken, taken - slow_part(taken, width)], axis=1))
        product, square = np.ones((2, scales.size))
        for place, scale in enumerate(scales.tolist()):
            whole, quick = np.split(contrasts(sums, scale)[0], 2, axis=1)
            power = max(float(np.sum(whole**2)), 1e-300)
            product[place] = float(np.sum(quick * whole)) / power
            square[place] = float(np.sum(quick**2)) / power
        found[width * readings.step / SECOND] = product, square
    return found


def means_by_state(state: npt.NDArray[np.int64], values: Floats) -> Floats:
    """Return the part of values (time, column) that is the same whenever a state comes again."""
    told = np.flatnonzero(state >= 0)
    if not told.size:
        return np.zeros_like(values)
    # While a state passes or is unknown that before it goes on: no steps are made that nobody took.
    last = np.maximum(np.searchsorted(told, np.arange(state.size), side="right") - 1, 0)
    _, place = np.unique(state[told], return_inverse=True)
    count = np.bincount(place)
    mean = [np.bincount(place, column[told]) / count for column in values.T]
    return np.asarray(np.stack(mean, axis=1)[place[last]])


#: Parts that the record is held out in, one after the other.
FOLDS = 4

#: A correction may do harm with this probability.
CHANCE = 0.005

#: Of its parts those are preferred that do harm with no more than this probability.
SURE = 0.001

#: Parts of a correction that are tried: half of it does no harm where the stray field is a fourth of it.
SHARES = (1.0, 0.85, 0.7, 0.5)

#: A correction that is expected to be so many times smaller than the stray field is refuted by itself: the
#: outboard reading that it was fitted to does not hold what the units would make.
_FAR_TOO_SMALL = 3.0

#: The form that all others of a gradiometer are special cases of.
_GENERAL = "matrix"

#: What lowers the mean square error by less than this part of the noise's is not worth it.
_TRIVIAL = 1e-3

#: Contrasts that a cell's variance has beside its own.
_OWN = 1.0

#: Corrects readings.
Corrector = Callable[[Readings], Correction]

#: Fits any number of candidates to the rows in use.
Fit = Callable[[npt.NDArray[np.bool_]], Mapping[str, Corrector]]


@dataclass(frozen=True)
class HeldOutScore:
    """What held-out readings and geometry say of one correction.

    Attributes
    ----------
    name : str
    slope, sigma : float
        Of the outboard reading on the correction; 1 for the stray field itself.
    chance_of_harm : float
        Probability that the correction makes the error larger; NaN where no expectation fits the readings.
    benefit : float
        Expected fall of the mean square error, nT^2 summed over axes.
    trivial : bool
        That fall is nothing beside the noise.
    units : str
        Where the units are taken to stand.
    part : Part
        What of the correction is taken off: as much as is sure to help.
    away : float
        How far its share is from the stray field's part, rms.
    constant_known : bool
        The correction holds the part of the stray field that never changes.
    quick : float
        The benefit on the scales that held-out readings tell of, nT^2: by it the best is chosen.
    """

    name: str
    slope: float
    sigma: float
    chance_of_harm: float
    benefit: float
    trivial: bool
    units: str
    part: AppliedPart = WHOLE
    away: float = 0.0
    constant_known: bool = False
    quick: float = 0.0

    @property
    def helps(self) -> bool:
        """Whether the correction lowers the error beyond doubt."""
        return self.chance_of_harm < CHANCE and not self.trivial and not self._far_too_small

    @property
    def _far_too_small(self) -> bool:
        """Whether the outboard reading hardly holds the field that geometry expects: a dead sensor."""
        return self.away > _FAR_TOO_SMALL - 1.0

    @property
    def told(self) -> str:
        """Return the sentence that is stored with a correction that helps."""
        what = "helps" if self.part == WHOLE else f"{self.part} is sure to help"
        return (
            f"{self.name}: {what}: chance of harm {self.chance_of_harm:.2g} with {self.units}, slope of the "
            f"outboard reading on it {self.slope:.2f} +- {self.sigma:.2f}, held out"
        )

    @property
    def numbers(self) -> str:
        """Return slope and chance of harm in words."""
        slope = f"held-out slope {self.slope:.2f} +- {self.sigma:.2f}"
        return (
            f"{slope}, chance of harm {self.chance_of_harm:.2g}"
            if np.isfinite(self.chance_of_harm)
            else slope
        )

    @property
    def against(self) -> str:
        """Return what speaks against a correction that does not help."""
        if not np.isfinite(self.chance_of_harm):
            return f"no field of {self.units} is like that, so it holds ambient field or another error"
        if self.chance_of_harm > 0.5:
            return "it would do harm"
        if self.trivial:
            return "it takes off hardly anything"
        if self.chance_of_harm < CHANCE:
            return f"the outboard reading does not hold the field of {self.units}, as if it were dead"
        return "these readings do not tell whether it helps"


@dataclass(frozen=True)
class HeldOutDecision:
    """The correction to apply and the evidence on every candidate."""

    correction: Correction
    chosen: str
    evidence: Mapping[str, HeldOutScore]


def decide(
    readings: Readings, fit: Fit, expectations: Sequence[GeometryPrior], folds: int = FOLDS
) -> HeldOutDecision:
    """Choose the correction that helps most on held-out readings, or none.

    Parameters
    ----------
    readings : Readings
        To be corrected; candidates are fitted to all but one part of them and judged on that.
    fit : callable
        From rows in use (time,) to correctors by name, such as `candidates.Candidates.fit`.
    expectations : sequence of Expectation
        What geometry lets expect; the first that the readings do not refute.
    folds : int
        Parts.
    """
    held = _held_out(readings, fit, folds)
    whole = fit(np.ones(len(readings), dtype=bool))
    evidence = {
        name: held_out_score(name, readings, (parts, whole[name](readings)), expectations)
        for name, parts in held.items()
        if name in whole
    }
    evidence = _none_where_the_general_form_is_refuted(evidence)
    helping = [one for one in evidence.values() if one.helps]
    if not helping:
        reason = readings.broken or _why_none(evidence.values())
        return HeldOutDecision(no_correction(len(readings), reason), "none", evidence)
    # What changes is judged; the constant comes on top.
    best = max(helping, key=lambda one: (one.constant_known, one.quick))
    correction = whole[best.name](readings)
    slow = slow_part_of(correction, readings, best.part.seconds)
    correction = partial_correction(correction, best.part, best.away, slow)
    return HeldOutDecision(replace(correction, reason=best.told), best.name, evidence)


def _why_none(evidence: Iterable[HeldOutScore]) -> str:
    """Return why no correction is applied, candidates of the same fault together."""
    faults: dict[str, list[str]] = {}
    for one in evidence:
        faults.setdefault(one.against, []).append(f"{one.name} ({one.numbers})")
    told = (f"{fault}: {', '.join(names)}" for fault, names in faults.items())
    return "; ".join(told) or "no candidate could be fitted"


def _none_where_the_general_form_is_refuted(evidence: Mapping[str, HeldOutScore]) -> dict[str, HeldOutScore]:
    """Return the evidence, all of it refuted where that of the full matrix is.

    The full matrix follows the readings wherever they lead. Where that is no field of units, the difference
    holds something else, such as the ambient field that a dead sensor does not see; a form that is too stiff
    to show it is no better.
    """
    general = evidence.get(_GENERAL)
    if general is None or np.isfinite(general.chance_of_harm):
        return dict(evidence)
    return {name: replace(one, chance_of_harm=float("nan")) for name, one in evidence.items()}


#: Corrections of held-out parts, each by candidates that were fitted to the others.
Held = list[tuple[slice, Correction]]


def _held_out(readings: Readings, fit: Fit, folds: int) -> dict[str, Held]:
    """Return corrections of each part by candidates that were fitted to the others."""
    edges = np.linspace(0, len(readings), folds + 1).astype(np.int64)
    found: dict[str, Held] = {}
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        train = np.ones(len(readings), dtype=bool)
        train[first:last] = False
        part = slice(first, last)
        for name, corrector in fit(train).items():
            found.setdefault(name, []).append((part, corrector(readings.part(part))))
    return found


def held_out_score(
    name: str, readings: Readings, made: tuple[Held, Correction], expectations: Sequence[GeometryPrior]
) -> HeldOutScore:
    """Return what held-out parts and geometry say of a correction; `made` are those of parts and of all."""
    parts, correction = made
    slope, sigma, seen = held_out_slopes(readings, parts)
    units = expectations[-1].units if expectations else "units"
    for one in expectations:
        after = one.of(correction).after(seen)
        if not after.refuted:
            noise = one.noise.share * float(np.trace(one.noise.covariance))
            part = best_part(after, correction.constant_known)
            benefit = after.benefit(part)
            told = (after.chance_of_harm(part), benefit, benefit < _TRIVIAL * noise, one.units, part)
            rest = (after.away(part), correction.constant_known, after.quick_benefit(part))
            return HeldOutScore(name, slope, sigma, *told, *rest)
    return HeldOutScore(name, slope, sigma, float("nan"), 0.0, False, units)


def best_part(after: SlopePosterior, constant_known: bool) -> AppliedPart:
    """Return the part of a correction that lowers the error most, of all that are sure to; else the whole.

    Whatever is left alone because it is slow, of the rest as large a share is taken as is sure.
    """
    if constant_known:
        return WHOLE
    parts = [AppliedPart(share, seconds) for seconds in (0.0, *after.expected.kept) for share in SHARES]
    chance = {part: after.chance_of_harm(part) for part in parts}
    most = SURE if min(chance.values()) < SURE else CHANCE
    largest: dict[float, AppliedPart] = {}
    for part in parts:
        if chance[part] < most:
            largest.setdefault(part.seconds, part)
    return max(largest.values(), key=after.benefit, default=WHOLE)


def held_out_slopes(readings: Readings, parts: Held) -> tuple[float, float, SlopeObservation]:
    """Return the slope of held-out outboard readings on a correction, its sigma, and that on each scale."""
    cells, block = _cells_with(readings, parts)
    square = np.einsum("cii->ci", cells.covariance[:, 3:, 3:])
    cross = np.einsum("cii->ci", cells.covariance[:, :3, 3:])
    both = np.einsum("cii->ci", cells.covariance[:, :3, :3])
    # Of the reading less half the correction: as far from "take it off" as from "leave it".
    variance = np.maximum(both - cross + 0.25 * square, 0.0)
    floor = np.maximum(np.median(variance[cells.scale == 1], axis=0), 1e-12) if len(cells) else np.ones(3)
    count = cells.count[:, None]
    weight = count / ((count * variance + _OWN * floor) / (count + _OWN))
    of_square, of_cross = (weight * square).sum(axis=1), (weight * cross).sum(axis=1)
    total = float(of_square.sum())
    if not total > 0:
        return 0.0, np.inf, SlopeObservation.nothing()
    slope = float(of_cross.sum()) / total
    score = np.bincount(block, of_cross - slope * of_square)
    score = score[np.bincount(block) > 0]
    scatter = float(np.sum(score**2)) * score.size / max(score.size - 1, 1)
    wider = max(1.0, scatter / total)
    scales, place = np.unique(cells.scale, return_inverse=True)
    own = np.maximum(np.bincount(place, of_square), 1e-300)
    ambient = np.zeros((scales.size, 3, 3))
    np.add.at(ambient, place, weight[:, :, None] * cells.covariance[:, :3, :3])
    seen = SlopeObservation(
        scales, np.bincount(place, of_cross) / own, wider / own, ambient / own[:, None, None]
    )
    return slope, float(np.sqrt(wider / total)), seen


def _cells_with(readings: Readings, parts: Held, blocks: int = 6) -> tuple[Cells, np.ndarray]:
    """Return cells of [B_out, c] of every part, and the block of time that each is in."""
    cells, block = [], []
    for number, (rows, correction) in enumerate(parts):
        # Where nothing is known nothing is taken off.
        known = readings.good[rows]
        here = cells_of(readings.outboard[rows][known], np.nan_to_num(correction.field[known], nan=0.0))
        cells.append(here)
        block.append(number * blocks + here.row * blocks // max(int(known.sum()), 1))
    return concatenate_cells(cells), np.concatenate(block)
