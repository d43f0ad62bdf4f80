"""Whether a correction helps, judged without the truth on readings it was not fitted to.

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
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from inflight.dual.correction import Correction, no_correction
from inflight.dual.expectation import Expectation
from inflight.dual.expected import Posterior, Seen
from inflight.dual.readings import Readings
from inflight.dual.scales import Cells, cells_of, joined_cells
from inflight.dual.slow_part import WHOLE, Part, partly, slow_of

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
class Evidence:
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
    part: Part = WHOLE
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
class Judgement:
    """The correction to apply and the evidence on every candidate."""

    correction: Correction
    chosen: str
    evidence: Mapping[str, Evidence]


def judge(readings: Readings, fit: Fit, expectations: Sequence[Expectation], folds: int = FOLDS) -> Judgement:
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
        name: evidence_of(name, readings, (parts, whole[name](readings)), expectations)
        for name, parts in held.items()
        if name in whole
    }
    evidence = _none_where_the_general_form_is_refuted(evidence)
    helping = [one for one in evidence.values() if one.helps]
    if not helping:
        reason = readings.broken or _why_none(evidence.values())
        return Judgement(no_correction(len(readings), reason), "none", evidence)
    # What changes is judged; the constant comes on top.
    best = max(helping, key=lambda one: (one.constant_known, one.quick))
    correction = whole[best.name](readings)
    slow = slow_of(correction, readings, best.part.seconds)
    correction = partly(correction, best.part, best.away, slow)
    return Judgement(replace(correction, reason=best.told), best.name, evidence)


def _why_none(evidence: Iterable[Evidence]) -> str:
    """Return why no correction is applied, candidates of the same fault together."""
    faults: dict[str, list[str]] = {}
    for one in evidence:
        faults.setdefault(one.against, []).append(f"{one.name} ({one.numbers})")
    told = (f"{fault}: {', '.join(names)}" for fault, names in faults.items())
    return "; ".join(told) or "no candidate could be fitted"


def _none_where_the_general_form_is_refuted(evidence: Mapping[str, Evidence]) -> dict[str, Evidence]:
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


def evidence_of(
    name: str, readings: Readings, made: tuple[Held, Correction], expectations: Sequence[Expectation]
) -> Evidence:
    """Return what held-out parts and geometry say of a correction; `made` are those of parts and of all."""
    parts, correction = made
    slope, sigma, seen = slopes_of(readings, parts)
    units = expectations[-1].units if expectations else "units"
    for one in expectations:
        after = one.of(correction).after(seen)
        if not after.refuted:
            noise = one.noise.share * float(np.trace(one.noise.covariance))
            part = best_part(after, correction.constant_known)
            benefit = after.benefit(part)
            told = (after.chance_of_harm(part), benefit, benefit < _TRIVIAL * noise, one.units, part)
            rest = (after.away(part), correction.constant_known, after.quick_benefit(part))
            return Evidence(name, slope, sigma, *told, *rest)
    return Evidence(name, slope, sigma, float("nan"), 0.0, False, units)


def best_part(after: Posterior, constant_known: bool) -> Part:
    """Return the part of a correction that lowers the error most, of all that are sure to; else the whole.

    Whatever is left alone because it is slow, of the rest as large a share is taken as is sure.
    """
    if constant_known:
        return WHOLE
    parts = [Part(share, seconds) for seconds in (0.0, *after.expected.kept) for share in SHARES]
    chance = {part: after.chance_of_harm(part) for part in parts}
    most = SURE if min(chance.values()) < SURE else CHANCE
    largest: dict[float, Part] = {}
    for part in parts:
        if chance[part] < most:
            largest.setdefault(part.seconds, part)
    return max(largest.values(), key=after.benefit, default=WHOLE)


def slopes_of(readings: Readings, parts: Held) -> tuple[float, float, Seen]:
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
        return 0.0, np.inf, Seen.nothing()
    slope = float(of_cross.sum()) / total
    score = np.bincount(block, of_cross - slope * of_square)
    score = score[np.bincount(block) > 0]
    scatter = float(np.sum(score**2)) * score.size / max(score.size - 1, 1)
    wider = max(1.0, scatter / total)
    scales, place = np.unique(cells.scale, return_inverse=True)
    own = np.maximum(np.bincount(place, of_square), 1e-300)
    ambient = np.zeros((scales.size, 3, 3))
    np.add.at(ambient, place, weight[:, :, None] * cells.covariance[:, :3, :3])
    seen = Seen(scales, np.bincount(place, of_cross) / own, wider / own, ambient / own[:, None, None])
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
    return joined_cells(cells), np.concatenate(block)
