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
    """

    name: str
    slope: float
    sigma: float
    gain: float
    benefit: float
    benefit_sigma: float
    size: float
    error: float

    @property
    def helps(self) -> bool:
        """Whether the correction lowers the error beyond doubt."""
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
        if self.helps:
            return f"helps: {seen}"
        if self.holds_ambient:
            return f"left alone, it holds ambient field: {seen}"
        if not self.sure_of_itself:
            return f"left alone, its own error is as large as what it takes off: {seen}"
        if self.slope + SURE_OF_GAIN * self.sigma < 0.5:
            return f"left alone, it would do harm: {seen}"
        return f"left alone, these readings do not tell whether it helps: {seen}"


@dataclass(frozen=True)
class Judgement:
    """The correction to apply and the evidence on every candidate."""

    correction: Correction
    chosen: str
    evidence: Mapping[str, Evidence]


def judge(readings: Readings, fit: Fit, folds: int = FOLDS) -> Judgement:
    """Choose the correction that helps most on held-out readings, or none.

    Parameters
    ----------
    readings : Readings
        To be corrected; candidates are fitted to all but one part of them and judged on that.
    fit : callable
        From rows in use (time,) to correctors by name, such as `candidates.Candidates.fit`.
    folds : int
        Parts.
    """
    held = _held_out(readings, fit, folds)
    evidence = {name: evidence_of(name, readings, parts) for name, parts in held.items()}
    helping = [one for one in evidence.values() if one.helps]
    if not helping:
        told = "; ".join(f"{name}: {one.told}" for name, one in evidence.items())
        return Judgement(
            no_correction(len(readings), told or "no candidate could be fitted"), "none", evidence
        )
    best = max(helping, key=lambda one: one.gain)
    correction = fit(np.ones(len(readings), dtype=bool))[best.name](readings)
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
        return Evidence(name, 0.0, np.inf, 0.0, 0.0, 0.0, 0.0, 0.0)
    slope = float(of_cross.sum()) / total
    score = np.bincount(block, of_cross - slope * of_square)
    score = score[np.bincount(block) > 0]
    scatter = float(np.sum(score**2)) * score.size / max(score.size - 1, 1)
    sigma = float(np.sqrt(max(total, scatter))) / total
    benefit, benefit_sigma = _benefit(cells, square.sum(axis=1), of_square, of_cross, (slope, sigma))
    gain = float(of_cross.sum()) - 0.5 * total
    return Evidence(name, slope, sigma, gain, benefit, benefit_sigma, *_sizes(parts))


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
