"""Change points of a vector series.

Change points of the difference of two sensors: where the spacecraft's state changes.

The means of ever longer stretches before and after each moment are compared, in all three axes at once. The
noise of such a step is measured at each length from the record itself, which holds for coloured noise as
well; the local median of the steps, which is the drift, is taken off first; the level of the noise may change
with time. The shortest stretch that shows a jump places it, and longer ones never reach over a jump found
before (narrowest over threshold, Baranowski et al. 2019). The published way is in `thresholds`.

Noise with heavy tails: single samples far out, so many that two in a row would look like a state.

Rare ones are told one by one (`jumps.spikes`). Where they are part of the noise, every sample's distance from
the median of its surroundings is bounded, in the whole record alike: steps and stretches of three samples or
more keep their size, and means are again as sure as their scatter says.

Noise of the level of a stretch, without the drift: what the mean of so many samples is sure to.

The noise of steps (`jumps.step_noise`) holds the drift of long stretches, which is right for telling jumps
but not for levels and slopes, whose drift is carried along (`states.Track`). Here three neighbouring
stretches are compared, ``m[1] - (m[0] + m[2]) / 2``, in which a straight drift cancels.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt
from scipy import stats

from inflight.arrays import Floats
from inflight.dual.readings import trimmed_covariance, white_covariance
from inflight.lsq import TO_SIGMA

Rows = npt.NDArray[np.int64]

#: False jumps expected of a record of white noise, whatever its length.
FALSE_ALARMS = 0.01

#: The longest stretch on either side of a jump, samples.
LONGEST = 512

#: Windows of the longer stretches are moved by this part of their length.
_STRIDES = 8

#: Stretches behind one local median of the steps, the fewest samples of one, and the fewest positions.
_LOCAL, _DRIFT, _FEWEST = 64, 4096, 24

#: The noise of a length is measured at this many positions.
_POSITIONS = 40_000

#: Samples behind one local level of the noise, and the least level beside the usual one (variance).
_BLOCK, _LEAST = 256, 0.25

#: Squares of second differences (whitened) count no more than this for it.
_CLIPPED = 9.0

#: Degrees of freedom behind each window free of others, and the fewest that make a noise.
_EFFICIENCY, _FEWEST_FREE = 0.8, 8.0


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
        wanted = np.log2(np.maximum(np.asarray(count, dtype=np.float64), 1.0))
        known = np.log2(self.length.astype(np.float64))
        upper = np.clip(np.searchsorted(known, wanted), 1, max(known.size - 1, 1))
        if known.size == 1:
            return np.asarray(0.5 * self.covariance[np.zeros_like(upper)])
        share = np.clip((wanted - known[upper - 1]) / (known[upper] - known[upper - 1]), 0.0, 1.0)[
            ..., None, None
        ]
        return np.asarray(0.5 * ((1 - share) * self.covariance[upper - 1] + share * self.covariance[upper]))


def find_jumps(
    values: Floats, *, false_alarms: float = FALSE_ALARMS, longest: int = LONGEST
) -> tuple[Rows, StepNoise]:
    """Return where a series of three components jumps, and the noise of steps in it.

    Parameters
    ----------
    values : ndarray, shape (time, axis)
        nT, finite, in the order of time; what is missing has been left out.
    false_alarms : float
        Expected number of false jumps in the whole record.
    longest : int
        Longest stretch before and after a jump, samples.

    Returns
    -------
    places : ndarray of int64, shape (jump,)
        Rows of the first samples after a jump, increasing.
    noise : StepNoise
        From where there is no jump.
    """
    white = white_covariance(values)
    count = len(values)
    if count < 4 * _FEWEST_FREE or not white.max() > 0:
        return np.empty(0, dtype=np.int64), _white_noise(white, longest)
    back = np.linalg.cholesky(white + 1e-12 * np.trace(white) * np.eye(3))
    unit = (values - values.mean(axis=0)) @ np.linalg.inv(back).T
    level = _local_levels(unit)
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(unit, axis=0)])
    found, noise = _all_lengths(unit, sums, level, false_alarms, longest)
    length, covariance, freedom = noise
    return found, StepNoise(length, back @ covariance @ back.T, freedom)


def step_noise(values: Floats, jumps: Rows, *, longest: int = LONGEST) -> StepNoise:
    """Return the noise of steps of a series where known jumps are not; see `find_jumps`.

    Parameters
    ----------
    values : ndarray, shape (time, axis)
        nT, finite. Of a reading this is the noise and what the ambient field does in the meantime.
    jumps : ndarray of int64, shape (jump,)
        Increasing rows of the first samples after a jump.
    """
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(values - values.mean(axis=0), axis=0)])
    level = np.ones(len(values) // _BLOCK + 1)
    noises: list[tuple[int, Floats, float]] = []
    length = 1
    while length <= longest and 2 * length <= len(values):
        measured = _noise_of(sums, level, jumps, length, white=0.0)
        if measured is None:
            break
        noises.append((length, measured[0], measured[1]))
        length *= 2
    if not noises:
        return _white_noise(white_covariance(values), longest)
    return StepNoise(*_stacked(noises))


def _all_lengths(
    unit: Floats, sums: Floats, level: Floats, false_alarms: float, longest: int
) -> tuple[Rows, tuple[Rows, Floats, Floats]]:
    """Return the jumps and the noise of whitened values, from the shortest stretch to the longest."""
    # Windows of one length at less than about a quarter of it apart are hardly independent tests.
    chance = false_alarms / (8.0 * len(unit))
    found = np.empty(0, dtype=np.int64)
    noises: list[tuple[int, Floats, float]] = []
    length = 1
    while length <= longest and 2 * length <= len(unit):
        measured = _noise_of(sums, level, found, length)
        if measured is None:
            break
        covariance, freedom, centre, block = measured
        noises.append((length, covariance, freedom))
        # Hotelling's: the noise is itself measured, from fewer and fewer stretches.
        limit = 3.0 * (freedom - 1.0) / (freedom - 3.0) * stats.f.isf(chance, 3, freedom - 3.0)
        stride = max(1, length // _STRIDES)
        at, pull = _over(
            sums,
            level,
            centre,
            block,
            np.asarray(np.linalg.inv(covariance), dtype=np.float64),
            limit,
            length,
            stride,
        )
        free = _free(at, found, length)
        order = np.argsort(-pull[free], kind="stable")
        taken = _apart(at[free][order], length)
        if taken.size:
            found = np.unique(np.concatenate([found, _placed(unit, taken, found, length)]))
        length *= 2
    if not noises:
        return found, (np.array([1]), 2.0 * np.eye(3)[None], np.array([1.0]))
    return found, _stacked(noises)


def _stacked(noises: list[tuple[int, Floats, float]]) -> tuple[Rows, Floats, Floats]:
    length, covariance, freedom = zip(*noises, strict=True)
    return np.array(length), np.array(covariance), np.array(freedom)


def _noise_of(
    sums: Floats, level: Floats, found: Rows, length: int, white: float = 1.0
) -> tuple[Floats, float, Floats, int] | None:
    """Return covariance and freedom of steps where nothing jumps, their local medians and these' distance.

    None when too few windows of this length are free of jumps.
    """
    count = len(sums) - 1
    stride = max(1, length // _STRIDES, count // _POSITIONS)
    at = np.arange(length, count - length + 1, stride)
    at = at[_free(at, found, length)]
    freedom = _EFFICIENCY * at.size * stride / (2.0 * length)
    if freedom < _FEWEST_FREE:
        return None
    step = _steps(sums, at, length)
    block = max(_LOCAL * length, _DRIFT)
    nodes = _local_medians(step, at, block, count)
    middle = (np.arange(len(nodes)) + 0.5) * block
    step -= np.stack([np.interp(at, middle, axis) for axis in nodes.T], axis=1)
    covariance = trimmed_covariance(step / np.sqrt(level[at // _BLOCK])[:, None])
    # A median of few windows may come out too small; white noise is in all of them.
    least = 2.0 * white / length / max(float(covariance.diagonal().min()), 1e-300)
    return covariance * max(1.0, least), freedom, nodes, block


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
    back = np.linalg.inv(np.linalg.cholesky(white + 1e-12 * np.trace(white) * np.eye(3))).T
    unit = np.ascontiguousarray(values @ back)
    limit = float(stats.chi2.isf(FALSE_ALARMS / len(values), 3))
    return _stand_out(unit, _local_levels(unit), limit, found)


@numba.njit(cache=True, nogil=True)
def _stand_out(
    unit: Floats, level: Floats, usual: float, found: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Mark samples whose whitened distance from the mean of their neighbours exceeds a limit."""
    for one in range(1, unit.shape[0] - 1):
        limit = usual * level[one // _BLOCK]
        out, apart = 0.0, 0.0
        for k in range(3):
            out += (unit[one, k] - 0.5 * (unit[one - 1, k] + unit[one + 1, k])) ** 2 / 1.5
            apart += (unit[one + 1, k] - unit[one - 1, k]) ** 2 / 2.0
        # Neighbours across a step differ by more than the sample differs from their mean.
        found[one] = out > limit and apart < max(0.25 * out, 0.5 * limit)
    return found


def _white_noise(white: Floats, longest: int) -> StepNoise:
    lengths = 2 ** np.arange(int(np.log2(max(longest, 1))) + 1)
    return StepNoise(lengths, 2.0 * white / lengths[:, None, None], np.full(lengths.size, 1.0))


def _steps(sums: Floats, at: Rows, length: int) -> Floats:
    """Return mean after less mean before each place; (place, axis)."""
    return np.asarray((sums[at + length] - 2.0 * sums[at] + sums[at - length]) / length)


def _free(at: Rows, found: Rows, length: int) -> npt.NDArray[np.bool_]:
    """Return which windows hold no jump found before."""
    if not found.size:
        return np.ones(at.size, dtype=bool)
    inside = np.searchsorted(found, at + length) - np.searchsorted(found, at - length, side="right")
    return np.asarray(inside == 0)


def _local_medians(step: Floats, at: Rows, block: int, count: int) -> Floats:
    """Return the median step in each block of samples, the drift's part of it; (block, axis)."""
    blocks = -(-count // block)
    edges = np.searchsorted(at, np.arange(blocks + 1) * block)
    known = np.flatnonzero(np.diff(edges) >= _FEWEST)
    if not known.size:
        return np.zeros((blocks, 3))
    centre = np.array([np.median(step[edges[one] : edges[one + 1]], axis=0) for one in known])
    every = np.arange(blocks)
    return np.stack([np.interp(every, known, axis) for axis in centre.T], axis=1)


def _local_levels(unit: Floats) -> Floats:
    """Return the local variance of whitened noise beside the usual one; (block,), by 256 samples.

    The larger of a block's own and its neighbours': a burst may begin inside one.
    """
    count = len(unit)
    whole = count // _BLOCK
    own = np.ones(whole + 1)
    if whole:
        parts = unit[: whole * _BLOCK].reshape(whole, _BLOCK, 3)
        # Every third second difference: neighbouring ones tell nearly the same.
        bend = np.abs(parts[:, :-2:3] - 2.0 * parts[:, 1:-1:3] + parts[:, 2::3]).reshape(whole, -1)
        middle = np.partition(bend, bend.shape[1] // 2, axis=1)[:, bend.shape[1] // 2]
        # Of coarse readings the median jumps from step to step; a mean would follow each jump.
        clipped = np.minimum(bend**2 / 6.0, _CLIPPED).mean(axis=1)
        own[:whole] = np.maximum((TO_SIGMA * middle) ** 2 / 6.0, clipped)
        own[whole] = own[whole - 1]
    wide = np.pad(own, 1, mode="edge")
    return np.asarray(np.maximum(np.maximum.reduce([wide[:-2], own, wide[2:]]), _LEAST))


@numba.njit(cache=True, nogil=True)
def _over(
    sums: Floats,
    level: Floats,
    centre: Floats,
    block: int,
    weight: Floats,
    limit: float,
    length: int,
    stride: int,
) -> tuple[Rows, Floats]:
    """Return places and pulls of the steps whose squared distance from the drift's exceeds a limit."""
    last = centre.shape[0] - 1
    at = np.arange(length, sums.shape[0] - length, stride)
    pulls = np.zeros(at.size)
    step = np.empty(3)
    for one in range(at.size):
        place = at[one]
        node = min(max(place / block - 0.5, 0.0), float(last))
        lower = int(node)
        upper, share = min(lower + 1, last), node - lower
        for k in range(3):
            moved = (sums[place + length, k] - 2.0 * sums[place, k] + sums[place - length, k]) / length
            step[k] = moved - (1.0 - share) * centre[lower, k] - share * centre[upper, k]
        for k in range(3):
            pulls[one] += step[k] * (weight[k, 0] * step[0] + weight[k, 1] * step[1] + weight[k, 2] * step[2])
        pulls[one] /= level[place // _BLOCK]
    over = np.flatnonzero(pulls > limit)
    return at[over], pulls[over]


@numba.njit(cache=True, nogil=True)
def _apart(at: Rows, length: int) -> Rows:
    """Return of places, best first, those that no better one taken is nearer to than `length`."""
    if at.size == 0:
        return at
    lowest = at.min()
    cell = np.full((at.max() - lowest) // length + 3, -1, dtype=np.int64)
    kept = np.empty(at.size, dtype=np.int64)
    number = 0
    for place in at:
        own = (place - lowest) // length + 1
        clear = True
        for near in (own - 1, own, own + 1):
            if cell[near] >= 0 and abs(cell[near] - place) < length:
                clear = False
        if clear:
            cell[own] = place
            kept[number] = place
            number += 1
    return np.sort(kept[:number])


def _placed(unit: Floats, taken: Rows, found: Rows, length: int) -> Rows:
    """Return where exactly each jump is: the split of its surroundings into two levels that fits best."""
    if length == 1:
        return taken
    others = np.concatenate([[0], np.sort(np.concatenate([found, taken])), [len(unit)]])
    where = np.searchsorted(others[1:-1], taken) + 1
    return _best_splits(
        unit,
        taken,
        np.maximum(others[where - 1], taken - 2 * length),
        np.minimum(others[where + 1], taken + 2 * length),
    )


@numba.njit(cache=True, nogil=True)
def _best_splits(unit: Floats, taken: Rows, first: Rows, last: Rows) -> Rows:
    """Return the row between first and last that splits whitened values into the two levels of best fit."""
    best = taken.copy()
    for one in range(taken.size):
        begin, end = first[one], last[one]
        total = np.zeros(3)
        for row in range(begin, end):
            total += unit[row]
        before = np.zeros(3)
        highest = -1.0
        for row in range(begin + 1, end):
            before += unit[row - 1]
            left, right = row - begin, end - row
            gain = np.sum((before / left - (total - before) / right) ** 2) * left * right / (left + right)
            if gain > highest:
                highest = gain
                best[one] = row
    return best


#: Squared distances from the median of five (whitened) that one in 8000 samples of Gaussian noise exceeds.
_FAR = 18.2

#: Part of the samples beyond that, alone among their neighbours, which makes tails heavy: by then two in a
#: row happen by chance.
_HEAVY = 0.002

#: Distances are then bounded to this many standard deviations; 97 % of Gaussian noise is within.
_BOUND = 3.0

#: Samples on either side whose medians must differ at a jump, in one of these lengths at least, and the
#: chance that noise does so: it need not be small, as the means differ already.
_MEDIANS = (16, 64, 512)

_UNLIKE = float(stats.chi2.isf(0.01, 3))


def confirm_jumps(values: Floats, places: Rows) -> Rows:
    """Return the jumps at which medians differ, too: a few samples far out make a mean but no median.

    Parameters
    ----------
    values : ndarray, shape (time, axis)
        nT, finite.
    places : ndarray of int64, shape (jump,)
        Increasing rows of the first samples after a jump.
    """
    white = white_covariance(values)
    if not white.max() > 0:
        return places
    weight = np.linalg.inv(white + 1e-12 * np.trace(white) * np.eye(3))
    left = places.tolist()
    doubtful = [one for one in left if _unlikeness(values, left, one, weight) < _UNLIKE]
    # Without its doubtful neighbours a jump has longer stretches to show itself.
    for one in doubtful:
        if _unlikeness(values, left, one, weight) < _UNLIKE:
            left.remove(one)
    return np.array(left, dtype=np.int64)


def _unlikeness(values: Floats, places: list[int], one: int, weight: Floats) -> float:
    """Return the largest squared difference, in errors, of the medians on both sides of a jump."""
    index = bisect_left(places, one)
    first = places[index - 1] if index else 0
    last = places[index + 1] if index + 1 < len(places) else len(values)
    highest = 0.0
    for length in _MEDIANS:
        before, after = values[max(first, one - length) : one], values[one : min(last, one + length)]
        step = np.median(after, axis=0) - np.median(before, axis=0)
        # The median of white Gaussian noise; of two samples it is their mean.
        error = 0.5 * np.pi * (1.0 / len(before) + 1.0 / len(after))
        highest = max(highest, float(step @ weight @ step) / error)
    return highest


def winsorise(values: Floats) -> Floats:
    """Return a series whose noise has no heavy tails: the same one unless it has.

    Parameters
    ----------
    values : ndarray, shape (time, axis)
        nT, finite.
    """
    white = white_covariance(values)
    if len(values) < 5 or not white.max() > 0:
        return values
    back = np.linalg.cholesky(white + 1e-12 * np.trace(white) * np.eye(3))
    unit = np.ascontiguousarray(values @ np.linalg.inv(back).T)
    middle, square = _about_medians(unit)
    far = square > _FAR
    alone = far[1:-1] & ~far[:-2] & ~far[2:]
    if np.mean(alone) < _HEAVY:
        return values
    share = np.minimum(1.0, _BOUND / np.sqrt(np.maximum(square, 1e-300)))[:, None]
    return np.asarray((middle + share * (unit - middle)) @ back.T)


@numba.njit(cache=True, nogil=True)
def _about_medians(unit: Floats) -> tuple[Floats, Floats]:
    """Return the median of each sample and its four neighbours, by axis, and the squared distance from it."""
    count = unit.shape[0]
    middle, square = np.empty_like(unit), np.zeros(count)
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
            middle[one, k] = near[2]
            square[one] += (unit[one, k] - near[2]) ** 2
    return middle, square


#: Noise is measured at this many positions of each length, at least so many apart as part of the length.
_LEVEL_POSITIONS, _LEVEL_STRIDES = 20_000, 4

#: The fewest independent triples that tell a noise.
_FEWEST_TRIPLES = 16


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
        in both. A random walk has half as much here: it is to be carried along as drift.
    """
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(values - values.mean(axis=0), axis=0)])
    edges = np.concatenate([[0], jumps, [len(values)]])
    told = []
    for length in steps.length.tolist():
        covariance = _of_triples(sums, edges, length)
        if covariance is None:
            break
        told.append(covariance)
    if not told:
        return steps
    count = len(told)
    own = np.array(told)
    share = np.einsum("sii->s", own) / np.einsum("sii->s", steps.covariance[:count])
    kept = np.where((share < 1.0)[:, None, None], own, steps.covariance[:count])
    return StepNoise(steps.length[:count], kept, steps.freedom[:count])


def _of_triples(sums: Floats, edges: Rows, length: int) -> Floats | None:
    """Return the covariance of a step of this length by three stretches in a row; None for too few."""
    count = len(sums) - 1
    stride = max(1, length // _LEVEL_STRIDES, count // _LEVEL_POSITIONS)
    at = np.arange(0, count - 3 * length + 1, stride)
    inside = np.searchsorted(edges, at + 3 * length) - np.searchsorted(edges, at, side="right")
    at = at[inside == 0]
    if at.size * stride < _FEWEST_TRIPLES * 3 * length:
        return None
    bend = sums[at + 3 * length] - 3.0 * sums[at + 2 * length] + 3.0 * sums[at + length] - sums[at]
    # Six times the variance of one mean; a step has twice.
    return np.asarray(trimmed_covariance(bend / length) / 3.0)
