"""Whether a correction helps, judged without the truth on readings it was not fitted to.

The ambient field knows nothing of the spacecraft. What a correction c takes off a held-out stretch therefore
shows in the outboard reading itself: regressed on c, the reading has the slope 1 when c is the stray field,
0 when c has nothing to do with it. Taking c off changes the mean square of the error by ``<c^2> - 2 <c s>``
with the stray field s, and ``<c s> = <c B_out>`` but for chance: it helps where the slope is above one half.
Regressed in cells of time and scale, weighted by the quietness of the ambient field there, the slope has an
error that is known; a slope far above one is not that of a stray field either, but of ambient field that
leaked into c.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dual.correction import Correction, no_correction
from inflight.dual.expectation import Expectation, Expected, Seen
from inflight.dual.readings import Readings
from inflight.dual.scales import Cells, cells_of

#: Parts that the record is held out in, one after the other.
FOLDS = 4
#: How many standard deviations the slope must be above zero, and above one half.
SURE, SURE_OF_GAIN = 3.0, 1.64
#: The mean square error that a correction may state for itself, of its own mean square.
OWN_ERROR = 0.25
#: Slopes on single scales differ by so much from the common one: noise and drift of sensors, and no dipole.
_SCATTER = 0.3
#: Contrasts that a cell's variance has beside its own.
_OWN = 1.0
#: The largest slope of a stray field, in a fit as short as it may be.
_STEEPEST = 1.6

#: A slope above this that is less than so many standard deviations: where the stray field hardly shows beside
#: the ambient one, what is too much is ambient field. Clear slopes above one are those of a matrix too small.
_STEEP, _CLEAR = 1.1, 20.0
#: A correction may do harm with this probability.
_CHANCE = 0.005
#: What lowers the mean square error by less than this part of the noise's is not worth it.
_TRIVIAL = 1e-3

#: Corrects readings.
Corrector = Callable[[Readings], Correction]
#: Fits any number of candidates to the rows in use.
Fit = Callable[[npt.NDArray[np.bool_]], Mapping[str, Corrector]]


@dataclass(frozen=True)
class Evidence:
    """What held-out readings say of one correction.

    Attributes
    ----------
    name : str
    slope, sigma : float
        Of the outboard reading on the correction; 1 for the stray field itself.
    gain : float
        Half the fall of the weighted sum of squares that the correction brings.
    benefit, benefit_sigma : float
        Fall of the mean square error, nT^2 summed over axes, as the slopes on each scale tell it.
    size : float
        Mean square of the correction's changes, nT^2 summed over axes.
    error : float
        Mean square of the error that the correction states for itself, likewise.
    seen : Seen
        The slope on each scale.
    chance_of_harm : float
        Probability that the correction makes the error larger, all units being in the body; NaN where the
        body is not known, or the readings say otherwise.
    worth : float
        By which the best of those that help is chosen: expected fall of the mean square error, nT^2, or
        `gain`.
    trivial : bool
        That fall is nothing beside the noise.
    """

    name: str
    slope: float
    sigma: float
    gain: float
    benefit: float
    benefit_sigma: float
    size: float
    error: float
    seen: Seen
    chance_of_harm: float = float("nan")
    worth: float = 0.0
    trivial: bool = False

    def expecting(self, expected: Expected, noise: float) -> Evidence:
        """Return the evidence together with what geometry lets expect, unless the readings refute that.

        `noise` is the mean square of the outboard reading's white noise, nT^2 summed over axes.
        """
        if expected.refuted_by(self.seen):
            return self
        chance = expected.chance_of_harm(self.seen)
        worth = expected.mean_benefit(self.seen)
        return replace(self, chance_of_harm=chance, worth=worth, trivial=worth < _TRIVIAL * noise)

    @property
    def helps(self) -> bool:
        """Whether the correction lowers the error beyond doubt."""
        if np.isfinite(self.chance_of_harm):
            return self.chance_of_harm < _CHANCE and not self.trivial
        low = self.slope > max(SURE * self.sigma, 0.5 + SURE_OF_GAIN * self.sigma)
        return low and not self.holds_ambient and self.sure_of_itself and self.benefit > self.benefit_sigma

    @property
    def holds_ambient(self) -> bool:
        """Whether the slope is above that of a stray field: ambient field leaked into the difference."""
        too_steep = self.slope - SURE * self.sigma >= _STEEPEST
        return too_steep or _STEEP < self.slope < _CLEAR * self.sigma

    @property
    def sure_of_itself(self) -> bool:
        """Whether the correction is well beyond the error that it states for itself."""
        return self.error < OWN_ERROR * self.size

    @property
    def told(self) -> str:
        """Return the sentence that is stored with the correction."""
        seen = f"slope of the outboard reading on it {self.slope:.2f} +- {self.sigma:.2f}, held out"
        if np.isfinite(self.chance_of_harm):
            seen = f"chance of harm {self.chance_of_harm:.2g} with all units in the body, {seen}"
        return f"helps: {seen}" if self.helps else f"left alone, {self._against}: {seen}"

    @property
    def _against(self) -> str:
        if self.trivial:
            return "it takes off hardly anything"
        if np.isfinite(self.chance_of_harm):
            return "it is not sure to help"
        if self.holds_ambient:
            return "it holds ambient field"
        if not self.sure_of_itself:
            return "its own error is as large as what it takes off"
        if self.slope + SURE_OF_GAIN * self.sigma < 0.5:
            return "it would do harm"
        return "these readings do not tell whether it helps"


@dataclass(frozen=True)
class Judgement:
    """The correction to apply and the evidence on every candidate."""

    correction: Correction
    chosen: str
    evidence: Mapping[str, Evidence]


def judge(
    readings: Readings, fit: Fit, folds: int = FOLDS, expectation: Expectation | None = None
) -> Judgement:
    """Choose the correction that helps most on held-out readings, or none.

    Parameters
    ----------
    readings : Readings
        To be corrected; candidates are fitted to all but one part of them and judged on that.
    fit : callable
        From rows in use (time,) to correctors by name, such as `candidates.Candidates.fit`.
    folds : int
        Parts.
    expectation : Expectation, optional
        What geometry lets expect, where sensors and body are known.
    """
    held = _held_out(readings, fit, folds)
    whole = fit(np.ones(len(readings), dtype=bool))
    evidence = {name: evidence_of(name, readings, parts) for name, parts in held.items() if name in whole}
    if expectation is not None:
        noise = expectation.noise.share * float(np.trace(expectation.noise.covariance))
        for name, one in evidence.items():
            expected = expectation.of(readings, whole[name](readings))
            evidence[name] = one.expecting(expected, noise)
    helping = [one for one in evidence.values() if one.helps]
    if not helping:
        told = "; ".join(f"{name}: {one.told}" for name, one in evidence.items())
        return Judgement(
            no_correction(len(readings), told or "no candidate could be fitted"), "none", evidence
        )
    # The careful form where no other is sure to help.
    best = max(helping, key=lambda one: (one.name != "careful", np.isfinite(one.chance_of_harm), one.worth))
    correction = whole[best.name](readings)
    return Judgement(replace(correction, reason=f"{best.name}: {best.told}"), best.name, evidence)


def _held_out(readings: Readings, fit: Fit, folds: int) -> dict[str, list[tuple[slice, Correction]]]:
    """Return corrections of each part by candidates that were fitted to the others."""
    edges = np.linspace(0, len(readings), folds + 1).astype(np.int64)
    found: dict[str, list[tuple[slice, Correction]]] = {}
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        train = np.ones(len(readings), dtype=bool)
        train[first:last] = False
        part = slice(first, last)
        for name, corrector in fit(train).items():
            found.setdefault(name, []).append((part, corrector(readings.part(part))))
    return found


def evidence_of(name: str, readings: Readings, parts: list[tuple[slice, Correction]]) -> Evidence:
    """Return what held-out parts say of a correction; as `judge` makes them."""
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
        return Evidence(name, 0.0, np.inf, 0.0, 0.0, 0.0, 0.0, 0.0, nothing_seen())
    slope = float(of_cross.sum()) / total
    score = np.bincount(block, of_cross - slope * of_square)
    score = score[np.bincount(block) > 0]
    scatter = float(np.sum(score**2)) * score.size / max(score.size - 1, 1)
    sigma = float(np.sqrt(max(total, scatter))) / total
    benefit, benefit_sigma = _benefit(cells, square.sum(axis=1), of_square, of_cross, (slope, sigma))
    gain = float(of_cross.sum()) - 0.5 * total
    wider = max(1.0, sigma**2 * total)
    seen = _seen(cells, of_square, of_cross, wider)
    return Evidence(name, slope, sigma, gain, benefit, benefit_sigma, *_sizes(parts), seen, worth=gain)


def _sizes(parts: list[tuple[slice, Correction]]) -> tuple[float, float]:
    """Return the mean squares of corrections' changes and of their stated errors, summed over axes."""
    changes = error = count = 0.0
    for _, correction in parts:
        known = correction.known
        if known.any():
            changes += float(np.var(correction.field[known], axis=0).sum() * known.sum())
            error += float(np.einsum("tii->", correction.covariance[known]))
            count += float(known.sum())
    return changes / max(count, 1.0), error / max(count, 1.0)


def _cells_with(
    readings: Readings, parts: list[tuple[slice, Correction]], blocks: int = 6
) -> tuple[Cells, np.ndarray]:
    """Return cells of [B_out, c] of every part, and the block of time that each is in."""
    cells, block = [], []
    for number, (rows, correction) in enumerate(parts):
        both = readings.outboard[rows], correction.field
        # Where nothing is known nothing is taken off.
        known = readings.good[rows]
        here = cells_of(both[0][known], np.nan_to_num(both[1][known], nan=0.0))
        cells.append(here)
        block.append(number * blocks + here.row * blocks // max(int(known.sum()), 1))
    return (
        Cells(
            np.concatenate([one.covariance for one in cells]),
            np.concatenate([one.count for one in cells]),
            np.concatenate([one.scale for one in cells]),
            np.concatenate([one.row for one in cells]),
        ),
        np.concatenate(block),
    )


def _benefit(
    cells: Cells, square: Floats, of_square: Floats, of_cross: Floats, common: tuple[float, float]
) -> tuple[float, float]:
    """Return the fall of the mean square error and its standard deviation.

    Each scale has its own slope; where the ambient field hides it, the common one stands for it.
    """
    slope, sigma = common
    benefit = variance = shift = 0.0
    for scale in np.unique(cells.scale):
        here = cells.scale == scale
        power = float(cells.count[here] @ square[here] / cells.count[here].sum()) / (2.0 * float(scale))
        if scale == cells.scale.max():
            # What changes more slowly than any contrast: a step in the record has as much there.
            power *= 2.0
        own = 1.0 / max(float(of_square[here].sum()), 1e-300)
        seen = float(of_cross[here].sum()) * own
        share = _SCATTER**2 / (_SCATTER**2 + own)
        benefit += power * (2.0 * (share * seen + (1.0 - share) * slope) - 1.0)
        variance += 4.0 * power**2 * share * own + 4.0 * power**2 * (1.0 - share) ** 2 * _SCATTER**2
        shift += 2.0 * power * (1.0 - share) * sigma
    return benefit, float(np.sqrt(variance + shift**2))


def _seen(cells: Cells, of_square: Floats, of_cross: Floats, wider: float) -> Seen:
    """Return the slope on each scale; variances are widened by what blocks of time disagree."""
    scales = np.unique(cells.scale)
    slope, variance = np.zeros(scales.size), np.zeros(scales.size)
    for place, scale in enumerate(scales):
        here = cells.scale == scale
        total = max(float(of_square[here].sum()), 1e-300)
        slope[place], variance[place] = float(of_cross[here].sum()) / total, wider / total
    return Seen(scales, slope, variance)


def nothing_seen() -> Seen:
    """Return the slopes of readings that tell none."""
    return Seen(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0))
