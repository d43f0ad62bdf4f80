"""Change points of the difference of two sensors: where the spacecraft's state changes.

Takes a series of three components without gaps; makes the rows where it *jumps* (the change points), and the
noise of a *step*, the difference between the means of two neighbouring stretches.

`find_jumps` compares the means of ever longer stretches before and after each row, in all three axes at once.
The noise of such a step is measured at each length from the record itself, which holds for coloured noise as
well; the local median of the steps, which is the drift, is subtracted first; the level of the noise may
change with time. The shortest stretch that shows a jump places it, and longer ones never reach over a jump
found before (narrowest over threshold, Baranowski et al. 2019). The test is Hotelling's, since the noise is
itself measured. The published thresholds are in `benchmarks/thresholds.py`.

`find_spikes`, `winsorise` and `confirm_jumps` deal with noise of heavy tails: single samples far out are
marked; where they are part of the noise, the distance of every sample from the local median is bounded; and a
jump must show in medians, too.

`step_noise` and `level_noise` measure noise only. Steps hold the drift of long stretches, which is right for
finding jumps but not for levels and slopes, whose drift is followed by `segments.DriftFilter`. `level_noise`
compares three neighbouring stretches, ``m[1] - (m[0] + m[2]) / 2``, in which a straight drift cancels.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.compiled import compiled
from inflight.dual.readings import trimmed_covariance, white_covariance
from inflight.lsq import MAD_TO_SIGMA

Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class ChangePointSettings:
    """Numbers of the search for change points.

    Attributes
    ----------
    false_alarms : float
        False jumps expected of a record of white noise, whatever its length. Level of significance; none was
        seen in 80 records of Gaussian noise (docs/science/two-sensors.md, tests/dual/test_dual_jumps.py).
    longest : int
        The longest stretch on either side of a jump, samples. Assumed.
    strides : int
        Steps of a length are taken at distances of the length over this. Assumed: a jump loses an eighth of
        its size at most before `_best_splits` places it.
    local_lengths, local_samples, fewest_steps : int
        A local median of the steps is over so many lengths, so many samples at least, and holds so many
        steps at least. Assumed: drift is slow compared to them.
    positions : int
        Steps by which the noise of a length is measured, at most. Assumed, for speed.
    level_samples : int
        Samples behind one local level of the noise. Assumed.
    least_level : float
        The least local level of the noise (variance) relative to the usual one. Assumed: a quiet stretch does
        not make jumps of what is usual elsewhere.
    clipped_square : float
        Squared second differences (whitened, over six) count no more than this for the level. Derived: three
        sigmas.
    freedom_share : float
        Degrees of freedom of a step that overlaps with none. Assumed: medians and trimming lose a fifth.
    fewest_freedom : float
        Degrees of freedom that measure a noise at least. Assumed.
    """

    false_alarms: float = 0.01
    longest: int = 512
    strides: int = 8
    local_lengths: int = 64
    local_samples: int = 4096
    fewest_steps: int = 24
    positions: int = 40_000
    level_samples: int = 256
    least_level: float = 0.25
    clipped_square: float = 9.0
    freedom_share: float = 0.8
    fewest_freedom: float = 8.0


@dataclass(frozen=True, kw_only=True)
class HeavyTailSettings:
    """Numbers of the treatment of noise with heavy tails.

    With them noise of Student's distribution with three degrees of freedom makes 0.2 false jumps in 20 000
    samples, twice-exponential noise 0.03 (docs/science/two-sensors.md, tests/dual/test_dual_tails.py).

    Attributes
    ----------
    far_square : float
        Squared distance (whitened) from the median of five samples from which a sample is far out. Measured
        on Gaussian numbers: one in 8000 exceeds it.
    far_share : float
        Part of the samples that are far out, alone among their neighbours, from which tails are heavy.
        Assumed: by then two in a row happen by chance.
    bound : float
        Distances from the local median are then bounded to this many sigmas. Measured on Gaussian numbers:
        97 % are nearer.
    median_lengths : tuple of int
        Samples on either side whose medians must differ at a jump, in one of these lengths at least.
        Assumed.
    median_chance : float
        Chance that noise makes such medians differ. Level of significance: 1 %; it need not be small, since
        the means differ already.
    """

    far_square: float = 18.2
    far_share: float = 0.002
    bound: float = 3.0
    median_lengths: tuple[int, ...] = (16, 64, 512)
    median_chance: float = 0.01

    @property
    def median_limit(self) -> float:
        """Squared difference of medians, in errors, at `median_chance`: chi-square of three axes."""
        return float(scipy.stats.chi2.isf(self.median_chance, 3))


@dataclass(frozen=True, kw_only=True)
class LevelNoiseSettings:
    """Numbers of the noise of levels.

    Attributes
    ----------
    positions : int
        Triples of stretches at which the noise of a length is measured, at most. Assumed, for speed.
    strides : int
        Triples are moved by the length over this at least. Assumed.
    fewest_triples : int
        Triples without overlap that measure a noise at least. Assumed.
    """

    positions: int = 20_000
    strides: int = 4
    fewest_triples: int = 16


CHANGE_POINT_SETTINGS = ChangePointSettings()
HEAVY_TAIL_SETTINGS = HeavyTailSettings()
LEVEL_NOISE_SETTINGS = LevelNoiseSettings()


@dataclass(frozen=True)
class StepNoise:
    """Noise of the difference between the means of two neighbouring stretches of equal length.

    Attributes
    ----------
    length : ndarray of int64, shape (scale,)
        Samples in either stretch, increasing by factors of two.
    covariance : ndarray, shape (scale, axis, axis)
        nT^2.
    freedom : ndarray, shape (scale,)
        Degrees of freedom behind it.
    """

    length: Rows
    covariance: Floats
    freedom: Floats

    def of_mean(self, count: npt.ArrayLike) -> Floats:
        """Return the covariance of the mean of `count` samples; (..., axis, axis), nT^2.

        Half that of a step of this length; between two lengths, by the logarithm. A mean of more samples than
        the longest length is taken to be no better than that: slow noise does not average away.
        """
        asked = np.log2(np.maximum(np.asarray(count, dtype=np.float64), 1.0))
        known = np.log2(self.length.astype(np.float64))
        upper = np.clip(np.searchsorted(known, asked), 1, max(known.size - 1, 1))
        if known.size == 1:
            return np.asarray(0.5 * self.covariance[np.zeros_like(upper)])
        share = np.clip((asked - known[upper - 1]) / (known[upper] - known[upper - 1]), 0.0, 1.0)[
            ..., None, None
        ]
        return np.asarray(0.5 * ((1 - share) * self.covariance[upper - 1] + share * self.covariance[upper]))


def find_jumps(values: Floats) -> tuple[Rows, StepNoise]:
    """Return where a series of three components jumps, and the noise of steps in it.

    Parameters
    ----------
    values : ndarray, shape (time, axis)
        nT, finite, in the order of time, without the rows that are missing.

    Returns
    -------
    jumps : ndarray of int64, shape (jump,)
        Rows of the first samples after a jump, increasing.
    noise : StepNoise
        From where there is no jump.
    """
    white = white_covariance(values)
    count = len(values)
    if count < 4 * CHANGE_POINT_SETTINGS.fewest_freedom or not white.max() > 0:
        return np.empty(0, dtype=np.int64), _white_step_noise(white)
    root = np.linalg.cholesky(white + 1e-12 * np.trace(white) * np.eye(3))
    unit = (values - values.mean(axis=0)) @ np.linalg.inv(root).T
    level = _local_levels(unit)
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(unit, axis=0)])
    # Steps of one length at less than about a quarter of it apart are hardly independent tests.
    chance = CHANGE_POINT_SETTINGS.false_alarms / (8.0 * count)
    found = np.empty(0, dtype=np.int64)
    noises: list[tuple[int, Floats, float]] = []
    length = 1
    while length <= CHANGE_POINT_SETTINGS.longest and 2 * length <= count:
        measured = _noise_of_length(sums, level, found, length)
        if measured is None:
            break
        covariance, freedom, drift, block = measured
        noises.append((length, covariance, freedom))
        # Hotelling's: the noise is itself measured, from fewer and fewer stretches.
        limit = 3.0 * (freedom - 1.0) / (freedom - 3.0) * scipy.stats.f.isf(chance, 3, freedom - 3.0)
        at, distance = _over_limit(
            sums,
            level,
            CHANGE_POINT_SETTINGS.level_samples,
            drift,
            block,
            np.asarray(np.linalg.inv(covariance), dtype=np.float64),
            limit,
            length,
            max(1, length // CHANGE_POINT_SETTINGS.strides),
        )
        free = _without_jump(at, found, length)
        order = np.argsort(-distance[free], kind="stable")
        taken = _best_apart(at[free][order], length)
        if taken.size and length > 1:
            # A jump is where the split of its surroundings into two levels fits best.
            others = np.concatenate([[0], np.sort(np.concatenate([found, taken])), [count]])
            where = np.searchsorted(others[1:-1], taken) + 1
            first = np.maximum(others[where - 1], taken - 2 * length)
            last = np.minimum(others[where + 1], taken + 2 * length)
            taken = _best_splits(unit, taken, first, last)
        found = np.unique(np.concatenate([found, taken]))
        length *= 2
    if not noises:
        noises = [(1, 2.0 * np.eye(3), 1.0)]
    lengths, covariances, degrees = zip(*noises, strict=True)
    return found, StepNoise(np.array(lengths), root @ np.array(covariances) @ root.T, np.array(degrees))


def _noise_of_length(
    sums: Floats, level: Floats, jumps: Rows, length: int, white: float = 1.0
) -> tuple[Floats, float, Floats, int] | None:
    """Return covariance and freedom of steps without a jump, their local medians and these' distance.

    None when too few steps of this length are free of jumps.
    """
    count = len(sums) - 1
    stride = max(1, length // CHANGE_POINT_SETTINGS.strides, count // CHANGE_POINT_SETTINGS.positions)
    at = np.arange(length, count - length + 1, stride)
    at = at[_without_jump(at, jumps, length)]
    freedom = CHANGE_POINT_SETTINGS.freedom_share * at.size * stride / (2.0 * length)
    if freedom < CHANGE_POINT_SETTINGS.fewest_freedom:
        return None
    # Mean after less mean before each row.
    step = np.asarray((sums[at + length] - 2.0 * sums[at] + sums[at - length]) / length)
    block = max(CHANGE_POINT_SETTINGS.local_lengths * length, CHANGE_POINT_SETTINGS.local_samples)
    # The median step of each block is the drift's.
    blocks = -(-count // block)
    edges = np.searchsorted(at, np.arange(blocks + 1) * block)
    known = np.flatnonzero(np.diff(edges) >= CHANGE_POINT_SETTINGS.fewest_steps)
    drift = np.zeros((blocks, 3))
    if known.size:
        median = np.array([np.median(step[edges[one] : edges[one + 1]], axis=0) for one in known])
        drift = np.stack([np.interp(np.arange(blocks), known, axis) for axis in median.T], axis=1)
    middle = (np.arange(blocks) + 0.5) * block
    step -= np.stack([np.interp(at, middle, axis) for axis in drift.T], axis=1)
    covariance = trimmed_covariance(step / np.sqrt(level[at // CHANGE_POINT_SETTINGS.level_samples])[:, None])
    # A covariance of few steps may come out too small; white noise is in all of them.
    least = 2.0 * white / length / max(float(covariance.diagonal().min()), 1e-300)
    return covariance * max(1.0, least), freedom, drift, block


def _local_levels(unit: Floats) -> Floats:
    """Return the local variance of whitened noise relative to the usual one; (block,), by `level_samples`.

    The larger of a block's own and its neighbours': a burst may begin inside one.
    """
    count, size = len(unit), CHANGE_POINT_SETTINGS.level_samples
    whole = count // size
    own = np.ones(whole + 1)
    if whole:
        parts = unit[: whole * size].reshape(whole, size, 3)
        # Every third second difference: neighbouring ones are hardly independent.
        second = np.abs(parts[:, :-2:3] - 2.0 * parts[:, 1:-1:3] + parts[:, 2::3]).reshape(whole, -1)
        median = np.partition(second, second.shape[1] // 2, axis=1)[:, second.shape[1] // 2]
        # Of coarse readings the median jumps from step to step; a mean would follow each jump.
        clipped = np.minimum(second**2 / 6.0, CHANGE_POINT_SETTINGS.clipped_square).mean(axis=1)
        own[:whole] = np.maximum((MAD_TO_SIGMA * median) ** 2 / 6.0, clipped)
        own[whole] = own[whole - 1]
    wide = np.pad(own, 1, mode="edge")
    return np.asarray(
        np.maximum(np.maximum.reduce([wide[:-2], own, wide[2:]]), CHANGE_POINT_SETTINGS.least_level)
    )


def _without_jump(at: Rows, jumps: Rows, length: int) -> npt.NDArray[np.bool_]:
    """Return which steps reach over no jump found before."""
    if not jumps.size:
        return np.ones(at.size, dtype=bool)
    inside = np.searchsorted(jumps, at + length) - np.searchsorted(jumps, at - length, side="right")
    return np.asarray(inside == 0)


def _white_step_noise(white: Floats) -> StepNoise:
    """Return the noise of steps in white noise of a covariance."""
    lengths = 2 ** np.arange(int(np.log2(CHANGE_POINT_SETTINGS.longest)) + 1)
    return StepNoise(lengths, 2.0 * white / lengths[:, None, None], np.full(lengths.size, 1.0))


@compiled
def _over_limit(
    sums: Floats,
    level: Floats,
    level_samples: int,
    drift: Floats,
    block: int,
    weight: Floats,
    limit: float,
    length: int,
    stride: int,
) -> tuple[Rows, Floats]:
    """Return rows and squared distances of the steps that are farther from the drift's than a limit."""
    last = drift.shape[0] - 1
    at = np.arange(length, sums.shape[0] - length, stride)
    distance = np.zeros(at.size)
    step = np.empty(3)
    for one in range(at.size):
        row = at[one]
        node = min(max(row / block - 0.5, 0.0), float(last))
        lower = int(node)
        upper, share = min(lower + 1, last), node - lower
        for k in range(3):
            moved = (sums[row + length, k] - 2.0 * sums[row, k] + sums[row - length, k]) / length
            step[k] = moved - (1.0 - share) * drift[lower, k] - share * drift[upper, k]
        for k in range(3):
            distance[one] += step[k] * (
                weight[k, 0] * step[0] + weight[k, 1] * step[1] + weight[k, 2] * step[2]
            )
        distance[one] /= level[row // level_samples]
    over = np.flatnonzero(distance > limit)
    return at[over], distance[over]


def _best_apart(at: Rows, length: int) -> Rows:
    """Return of rows, best first, those that are at least `length` from every better one taken."""
    if at.size == 0:
        return at
    place = (at - at.min()) // length + 1
    return np.sort(at[_is_apart(at, place, length, np.full(place.max() + 2, -1))])


@compiled
def _is_apart(at: Rows, place: Rows, length: int, cell: Rows) -> npt.NDArray[np.bool_]:
    """Return which rows are taken; `cell` holds the row taken at each place, negative where none is yet."""
    taken = np.zeros(at.size, dtype=np.bool_)
    for one in range(at.size):
        row, own = at[one], place[one]
        clear = True
        for near in range(own - 1, own + 2):
            if cell[near] >= 0 and abs(cell[near] - row) < length:
                clear = False
        if clear:
            cell[own] = row
            taken[one] = True
    return taken


@compiled
def _best_splits(unit: Floats, taken: Rows, first: Rows, last: Rows) -> Rows:
    """Return the row between first and last that splits whitened values into the two levels of best fit."""
    best = np.empty_like(taken)
    total, before = np.empty(3), np.empty(3)
    for one in range(taken.size):
        begin, end = first[one], last[one]
        best[one] = taken[one]
        for k in range(3):
            total[k] = before[k] = 0.0
            for row in range(begin, end):
                total[k] += unit[row, k]
        highest = -1.0
        for row in range(begin + 1, end):
            left, right = row - begin, end - row
            apart = 0.0
            for k in range(3):
                before[k] += unit[row - 1, k]
                apart += (before[k] / left - (total[k] - before[k]) / right) ** 2
            gain = apart * left * right / (left + right)
            if gain > highest:
                highest = gain
                best[one] = row
    return best


def find_spikes(values: Floats) -> npt.NDArray[np.bool_]:
    """Return which samples stand out from both neighbours, which agree; (time,).

    Parameters
    ----------
    values : ndarray, shape (time, axis)
        nT, finite.
    """
    found = np.zeros(len(values), dtype=bool)
    white = white_covariance(values)
    if len(values) < 3 or not white.max() > 0:
        return found
    whiten = np.linalg.inv(np.linalg.cholesky(white + 1e-12 * np.trace(white) * np.eye(3))).T
    unit = np.ascontiguousarray(values @ whiten)
    limit = float(scipy.stats.chi2.isf(CHANGE_POINT_SETTINGS.false_alarms / len(values), 3))
    return _stand_out(unit, _local_levels(unit), CHANGE_POINT_SETTINGS.level_samples, limit, found)


@compiled
def _stand_out(
    unit: Floats, level: Floats, level_samples: int, usual: float, found: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Mark samples whose whitened distance from the mean of their neighbours exceeds a limit."""
    for one in range(1, unit.shape[0] - 1):
        limit = usual * level[one // level_samples]
        out, apart = 0.0, 0.0
        for k in range(3):
            out += (unit[one, k] - 0.5 * (unit[one - 1, k] + unit[one + 1, k])) ** 2 / 1.5
            apart += (unit[one + 1, k] - unit[one - 1, k]) ** 2 / 2.0
        # Neighbours across a step differ by more than the sample differs from their mean.
        found[one] = out > limit and apart < max(0.25 * out, 0.5 * limit)
    return found


def winsorise(values: Floats) -> Floats:
    """Return a series whose noise has no heavy tails: the same one unless it has.

    Steps and stretches of three samples or more keep their size.

    Parameters
    ----------
    values : ndarray, shape (time, axis)
        nT, finite.
    """
    white = white_covariance(values)
    if len(values) < 5 or not white.max() > 0:
        return values
    root = np.linalg.cholesky(white + 1e-12 * np.trace(white) * np.eye(3))
    unit = np.ascontiguousarray(values @ np.linalg.inv(root).T)
    median, square = _about_medians(unit)
    far = square > HEAVY_TAIL_SETTINGS.far_square
    alone = far[1:-1] & ~far[:-2] & ~far[2:]
    if np.mean(alone) < HEAVY_TAIL_SETTINGS.far_share:
        return values
    share = np.minimum(1.0, HEAVY_TAIL_SETTINGS.bound / np.sqrt(np.maximum(square, 1e-300)))[:, None]
    return np.asarray((median + share * (unit - median)) @ root.T)


@compiled
def _about_medians(unit: Floats) -> tuple[Floats, Floats]:
    """Return the median of each sample and its four neighbours, by axis, and the squared distance from it."""
    count = unit.shape[0]
    median, square = np.empty_like(unit), np.zeros(count)
    near = np.empty(5)
    for one in range(count):
        first = min(max(one - 2, 0), count - 5)
        for k in range(unit.shape[1]):
            for other in range(5):
                value = unit[first + other, k]
                place = other
                while place > 0 and near[place - 1] > value:
                    near[place] = near[place - 1]
                    place -= 1
                near[place] = value
            median[one, k] = near[2]
            square[one] += (unit[one, k] - near[2]) ** 2
    return median, square


def confirm_jumps(values: Floats, jumps: Rows) -> Rows:
    """Return the jumps at which medians differ, too: a few samples far out shift a mean but no median.

    Parameters
    ----------
    values : ndarray, shape (time, axis)
        nT, finite.
    jumps : ndarray of int64, shape (jump,)
        Increasing rows of the first samples after a jump.
    """
    white = white_covariance(values)
    if not white.max() > 0:
        return jumps
    weight = np.linalg.inv(white + 1e-12 * np.trace(white) * np.eye(3))
    limit = HEAVY_TAIL_SETTINGS.median_limit
    kept = jumps.tolist()
    doubtful = [one for one in kept if _median_distance(values, kept, one, weight) < limit]
    # Without its doubtful neighbours a jump has longer stretches to show itself.
    for one in doubtful:
        if _median_distance(values, kept, one, weight) < limit:
            kept.remove(one)
    return np.array(kept, dtype=np.int64)


def _median_distance(values: Floats, jumps: list[int], one: int, weight: Floats) -> float:
    """Return the largest squared difference, in errors, of the medians on both sides of a jump."""
    index = bisect_left(jumps, one)
    first = jumps[index - 1] if index else 0
    last = jumps[index + 1] if index + 1 < len(jumps) else len(values)
    highest = 0.0
    for length in HEAVY_TAIL_SETTINGS.median_lengths:
        before, after = values[max(first, one - length) : one], values[one : min(last, one + length)]
        step = np.median(after, axis=0) - np.median(before, axis=0)
        # The median of white Gaussian noise; of two samples it is their mean.
        error = 0.5 * np.pi * (1.0 / len(before) + 1.0 / len(after))
        highest = max(highest, float(step @ weight @ step) / error)
    return highest


def step_noise(values: Floats, jumps: Rows) -> StepNoise:
    """Return the noise of steps of a series where known jumps are not; see `find_jumps`.

    Parameters
    ----------
    values : ndarray, shape (time, axis)
        nT, finite. Of a reading this is the noise and what the ambient field does in the meantime.
    jumps : ndarray of int64, shape (jump,)
        Increasing rows of the first samples after a jump.
    """
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(values - values.mean(axis=0), axis=0)])
    level = np.ones(len(values) // CHANGE_POINT_SETTINGS.level_samples + 1)
    noises: list[tuple[int, Floats, float]] = []
    length = 1
    while length <= CHANGE_POINT_SETTINGS.longest and 2 * length <= len(values):
        measured = _noise_of_length(sums, level, jumps, length, white=0.0)
        if measured is None:
            break
        noises.append((length, measured[0], measured[1]))
        length *= 2
    if not noises:
        return _white_step_noise(white_covariance(values))
    lengths, covariances, degrees = zip(*noises, strict=True)
    return StepNoise(np.array(lengths), np.array(covariances), np.array(degrees))


def level_noise(values: Floats, jumps: Rows, steps: StepNoise) -> StepNoise:
    """Return the noise of steps between stretches whose straight drift is known.

    Parameters
    ----------
    values : ndarray, shape (time, axis)
        nT, finite.
    jumps : ndarray of int64, shape (jump,)
        Increasing rows of the first samples after a jump.
    steps : StepNoise
        With the drift.

    Returns
    -------
    StepNoise
        As far as stretches without a jump are long enough; never more than `steps`. White noise has the same
        in both. A random walk has half as much here: it is followed as drift.
    """
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(values - values.mean(axis=0), axis=0)])
    edges = np.concatenate([[0], jumps, [len(values)]])
    found = []
    for length in steps.length.tolist():
        stride = max(1, length // LEVEL_NOISE_SETTINGS.strides, len(values) // LEVEL_NOISE_SETTINGS.positions)
        at = np.arange(0, len(values) - 3 * length + 1, stride)
        inside = np.searchsorted(edges, at + 3 * length) - np.searchsorted(edges, at, side="right")
        at = at[inside == 0]
        if at.size * stride < LEVEL_NOISE_SETTINGS.fewest_triples * 3 * length:
            break
        second = sums[at + 3 * length] - 3.0 * sums[at + 2 * length] + 3.0 * sums[at + length] - sums[at]
        # Six times the variance of one mean; a step has twice.
        found.append(trimmed_covariance(second / length) / 3.0)
    if not found:
        return steps
    count = len(found)
    own = np.array(found)
    share = np.einsum("sii->s", own) / np.einsum("sii->s", steps.covariance[:count])
    kept = np.where((share < 1.0)[:, None, None], own, steps.covariance[:count])
    return StepNoise(steps.length[:count], kept, steps.freedom[:count])
