"""States of the spacecraft, and the units whose sums make them.

Takes segments; makes *states*, the points in the three-dimensional space of the difference to which segments
return (Venus Express paper, section 2), and *units*, the vectors by which the difference changes when
something is switched. Every change from one state to the next is a signed sum of units (linear
superposition), so that states that were never observed can be predicted.

All segments share a drift (`segments.DriftFilter`), so that a state is recognised after days although its
point has moved. How many states there are, how fast the drift walks and how much the points scatter is chosen
by the probability of all points, in which a state of its own could lie anywhere (Laplace's approximation).

Where all steps of a record are sums of a few vectors, and each vector is added and taken off in turn, the
accumulated steps name the states whatever the drift does (`labels_by_steps`). The chance that a wrong
decoding passes this test halves with every step beyond one for each vector.

What two sensors cannot show: which of a unit's two states is "on", whether a vector is one unit or several
that always switch together, and whether a step common to all later segments is an offset or a new state.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise, product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.dual import drift_loops
from inflight.dual.correction import TRANSIENT
from inflight.dual.segments import DriftFilter, DriftRate, Segments, drift_rate, segment_drift_covariance
from inflight.time import SECOND

Occupancy = npt.NDArray[np.int64]

Labels = npt.NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class StateSettings:
    """Numbers of the search for states.

    Attributes
    ----------
    false_states : float
        Chance that one segment of all is taken for a new state by its noise. Level of significance.
    scatters : tuple of float
        Scatters of the states' points that are tried, in standard deviations of one sample. Assumed: half a
        decade apart.
    drifts : tuple of float
        Walks of the drift over the whole record that are tried besides that of segments, in the same unit.
        Assumed: half a decade apart.
    rounds : int
        Rounds of assignment and new centres at most; they end when labels stay. Assumed.
    anywhere_points, anywhere_noise : float
        Where a state lies before any is observed: the covariance of all points times this, and that of a
        sample times this. Derived: two and three sigmas.
    """

    false_states: float = 1e-3
    scatters: tuple[float, ...] = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)
    drifts: tuple[float, ...] = (1.0, 3.0, 10.0, 30.0)
    rounds: int = 6
    anywhere_points: float = 4.0
    anywhere_noise: float = 9.0


@dataclass(frozen=True, kw_only=True)
class UnitSettings:
    """Numbers of the search for units, and of states proven by steps.

    Attributes
    ----------
    missed : float
        Chance that a change is not recognised as a unit's, or a sum's, by its noise. Level of significance.
    accidents : float
        A sum is accepted when fewer than this many agree by accident. Level of significance.
    together : int
        Units that are taken to switch at once, at most. Assumed.
    proof_steps : int
        Steps beyond one for each vector that prove a decoding. Derived: one wrong decoding in 2^10 passes.
    fewest_switchings : int
        Each vector must be observed so often: else errors may have made two of one. Assumed.
    least_difference : float
        Two vectors differ by no less than this part of the smaller one. Assumed.
    most_vectors : int
        With more distinct steps than this they are no sums of a few vectors. Assumed.
    most_predicted : int
        With more units than this only combinations near to an observed one are predicted. Derived: 256
        combinations at most.
    near_switchings : int
        Units by which such a combination differs from an observed one, at most. Assumed.
    """

    missed: float = 1e-3
    accidents: float = 0.05
    together: int = 3
    proof_steps: int = 10
    fewest_switchings: int = 3
    least_difference: float = 0.1
    most_vectors: int = 24
    most_predicted: int = 8
    near_switchings: int = 2


STATE_SETTINGS = StateSettings()
UNIT_SETTINGS = UnitSettings()


@dataclass(frozen=True, kw_only=True)
class States:
    """States found in segments.

    Attributes
    ----------
    centre : ndarray, shape (state, axis)
        Difference in the state, without the drift, nT; states are numbered as they appear.
    covariance : ndarray, shape (state, axis, axis)
        Of `centre`, nT^2.
    count : ndarray of int64, shape (state,)
        Segments.
    label : ndarray of int64, shape (segment,)
        State of each segment; `TRANSIENT` (-2) for one too short.
    drift, drift_end : ndarray, shape (segment, axis)
        Common drift at the beginning and end of each segment, nT; 0 at the first.
    drift_rate : DriftRate
    scatter : float
        Standard deviation of a state's points beyond noise, nT, any axis.
    occupancy : ndarray of int64, shape (state, unit), optional
        Which units are switched, where the steps prove it.
    confidence : float
        Probability that no doubtful choice of a state misled the drift, and with it later choices.
    """

    centre: Floats
    covariance: Floats
    count: Labels
    label: Labels
    drift: Floats
    drift_end: Floats
    drift_rate: DriftRate
    scatter: float
    occupancy: Occupancy | None = None
    confidence: float = 1.0

    def __len__(self) -> int:
        return len(self.centre)


def find_states(segments: Segments) -> States:
    """Return the states of segments, their number chosen by the data.

    Notes
    -----
    For each of a few scatters and walks of the drift segments are assigned in turn, the drift filtered, until
    labels stay; states closer than their noise allows are merged. The choice of the lowest criterion
    ``sum(r^T S^-1 r + ln det S) + sum(ln det W - ln det C)`` is taken: residuals r and covariances S of
    segments, covariances C of the states' centres and W of their places before any is observed (Laplace's
    approximation of the probability of the points).
    """
    sample = float(np.sqrt(np.trace(segments.noise.of_mean(1)) / 3.0))
    rate = drift_rate(segments)
    length = max(float(segments.end[-1] - segments.start[0]) / SECOND, 1.0)
    rates = [rate]
    for size in STATE_SETTINGS.drifts:
        walk = np.maximum(rate.level_walk, (size * sample) ** 2 / length)
        rates.append(rate._replace(level_walk=walk))
    proven = labels_by_steps(segments, rates, [size * sample for size in STATE_SETTINGS.scatters])
    tried = [
        _cluster(segments, rate, size * sample, proven) for rate in rates for size in STATE_SETTINGS.scatters
    ]
    return min(tried, key=lambda found: found[0])[1]


def _cluster(
    segments: Segments, rate: DriftRate, scatter: float, proven: ProvenStates | None
) -> tuple[float, States]:
    """Return criterion and states of segments for one walk of the drift and one scatter.

    States that the steps prove keep their labels; else labels are found in rounds until they stay.
    """
    found = _Clustering(segments, rate, scatter, None if proven is None else proven.label)
    if not found.steady.size:
        return 0.0, found.states()
    found.assign_all(may_add=True)
    if proven is not None:
        for _ in range(2):
            found.update_centres()
            found.assign_all(may_add=False)
        found.update_centres()
        return found.criterion(), replace(found.states(), occupancy=proven.occupancy)
    for _ in range(STATE_SETTINGS.rounds):
        found.update_centres()
        while found.merge():
            pass
        before = found.label.copy()
        found.assign_all(may_add=False)
        if np.array_equal(before, found.label):
            break
    found.update_centres()
    confidence = float(np.exp(-found.confusion.sum()))
    return found.criterion(), replace(found.states(), confidence=confidence)


class _Clustering:
    """Segments assigned one after the other, with a new state where none fits.

    Attributes
    ----------
    given : ndarray of int64, shape (segment,)
        Labels that are known; `TRANSIENT` where they are not.
    centre, covariance : ndarray, shape (state, axis) and (state, axis, axis)
    label : ndarray of int64, shape (segment,)
    drift, drift_end, drift_covariance : ndarray
        Of the common drift at each segment.
    confusion : ndarray, shape (segment,)
        Probability that the choice was wrong and moved the drift.
    anywhere : float
        Log determinant of the covariance of states' places before any is observed.
    """

    def __init__(
        self, segments: Segments, rate: DriftRate, scatter: float, given: Labels | None = None
    ) -> None:
        self.segments, self.rate, self.scatter = segments, rate, scatter
        self.given = np.full(len(segments), TRANSIENT, dtype=np.int64) if given is None else given
        self.steady = np.flatnonzero(~segments.transient)
        self.spread = scatter**2 * np.eye(3)
        self.limit = float(scipy.stats.chi2.isf(STATE_SETTINGS.false_states / max(self.steady.size, 1), 3))
        self.centre, self.covariance = np.empty((0, 3)), np.empty((0, 3, 3))
        count = len(segments)
        self.label = np.full(count, TRANSIENT, dtype=np.int64)
        self.drift, self.drift_end = np.zeros((count, 3)), np.zeros((count, 3))
        self.drift_covariance = np.zeros((count, 3, 3))
        self.own = self.spread + segment_drift_covariance(segments, rate)
        self.cost = 0.0
        self.confusion = np.zeros(count)
        self.table = _segment_table(segments, self.own)
        wide = STATE_SETTINGS.anywhere_noise * (segments.noise.of_mean(1) + scatter**2 * np.eye(3))
        if self.steady.size >= 2:
            wide = STATE_SETTINGS.anywhere_points * np.cov(segments.level[self.steady].T) + wide
        self.anywhere = float(np.linalg.slogdet(wide)[1])

    def assign_all(self, *, may_add: bool) -> None:
        """Assign all segments once; without `may_add` to the nearest state, however far."""
        room, known = len(self.centre) + (self.steady.size if may_add else 0), len(self.centre)
        centre, covariance = np.zeros((room, 3)), np.zeros((room, 3, 3))
        centre[:known], covariance[:known] = self.centre, self.covariance
        found = drift_loops.Found(
            centre, covariance, self.label, self.drift, self.drift_end, self.drift_covariance, self.confusion
        )
        known, self.cost = drift_loops.assign_segments(
            self.steady,
            self.table,
            DriftFilter.start(self.rate).arrays,
            found,
            known,
            self.given,
            (self.limit, self.anywhere),
            may_add,
        )
        self.centre, self.covariance = centre[:known], covariance[:known]
        if self.steady.size:
            # Transients have the drift of the segment before them.
            last = np.searchsorted(self.steady, np.arange(len(self.segments)), side="right") - 1
            short = self.segments.transient
            own = self.steady[np.maximum(last, 0)[short]]
            self.drift[short] = self.drift_end[short] = self.drift_end[own]

    def update_centres(self) -> None:
        """Estimate the states' centres anew from the segments assigned to them; empty states go."""
        used, label = np.unique(self.label[self.steady], return_inverse=True)
        self.label[self.steady] = label
        weight = np.linalg.inv(self.segments.covariance + self.own + self.drift_covariance)
        point = self.segments.head.mean - self.drift
        centre, covariance = np.empty((used.size, 3)), np.empty((used.size, 3, 3))
        for state in range(used.size):
            own = np.flatnonzero(self.label == state)
            covariance[state] = np.linalg.inv(weight[own].sum(axis=0))
            centre[state] = covariance[state] @ np.einsum("sij,sj->i", weight[own], point[own])
        self.centre, self.covariance = centre, covariance

    def merge(self) -> bool:
        """Merge the two states that are nearest to each other, if one explains both."""
        apart = self.centre[:, None] - self.centre[None]
        total = self.covariance[:, None] + self.covariance[None]
        distance = np.einsum("kli,klij,klj->kl", apart, np.linalg.inv(total), apart)
        np.fill_diagonal(distance, np.inf)
        if not distance.size:
            return False
        # How much better one state for both is than two anywhere: the ratio of the densities.
        distance -= self.anywhere - np.linalg.slogdet(total)[1]
        if distance.min() > 0.0:
            return False
        first, second = sorted(int(one) for one in np.unravel_index(np.argmin(distance), distance.shape))
        self.label[self.label == second] = first
        self.update_centres()
        return True

    def criterion(self) -> float:
        """Return the criterion of `find_states`: cost of the segments, and of where the centres could be."""
        return self.cost + float(np.sum(self.anywhere - np.linalg.slogdet(self.covariance)[1]))

    def states(self) -> States:
        """Return the states as they are assigned now."""
        return States(
            centre=self.centre,
            covariance=self.covariance,
            count=np.bincount(self.label[self.steady], minlength=len(self.centre)),
            label=self.label,
            drift=self.drift,
            drift_end=self.drift_end,
            drift_rate=self.rate,
            scatter=self.scatter,
        )


def _segment_table(segments: Segments, own: Floats) -> drift_loops.SegmentTable:
    """Return what of segments the assignment uses, with what is each segment's own (segment, axis, axis)."""
    steady, gap = np.flatnonzero(~segments.transient), np.zeros(len(segments))
    before = np.append(segments.head.middle[:1], segments.tail.middle[steady[:-1]])[: steady.size]
    gap[steady] = (segments.head.middle[steady] - before) / SECOND
    head, tail = segments.head, segments.tail
    return drift_loops.SegmentTable(
        head_mean=np.ascontiguousarray(head.mean),
        tail_mean=np.ascontiguousarray(tail.mean),
        head_slope=np.ascontiguousarray(head.slope),
        tail_slope=np.ascontiguousarray(tail.slope),
        slope_variance=np.ascontiguousarray(segments.slope_variance),
        covariance=np.ascontiguousarray(segments.covariance),
        own=own,
        seconds=segments.seconds,
        gap=gap,
    )


class ProvenStates(NamedTuple):
    """States that the steps prove.

    Attributes
    ----------
    label : ndarray of int64, shape (segment,)
        State of each segment, numbered as they appear; `TRANSIENT` for those too short.
    occupancy : ndarray of int64, shape (state, unit)
        0 or 1.
    """

    label: Labels
    occupancy: Occupancy


def labels_by_steps(
    segments: Segments, rates: Sequence[DriftRate], scatters: Sequence[float]
) -> ProvenStates | None:
    """Return the states that the steps between segments prove; None where they prove none.

    Parameters
    ----------
    segments : Segments
    rates : sequence of DriftRate
        How fast the difference may drift, the likeliest first.
    scatters : sequence of float
        By how much a state's point may vary beyond noise and drift, nT; the likeliest first.
    """
    if np.count_nonzero(~segments.transient) < UNIT_SETTINGS.proof_steps + 2:
        return None
    for rate in rates:
        step, covariance = steps_between(segments, rate)
        for scatter in scatters:
            found = _decode_steps(segments, step, covariance + 2.0 * scatter**2 * np.eye(3))
            if found is not None:
                return found
    return None


def steps_between(segments: Segments, rate: DriftRate) -> tuple[Floats, Floats]:
    """Return steps from each steady segment to the next, the drift in between subtracted, and covariances.

    Parameters
    ----------
    segments : Segments
    rate : DriftRate

    Returns
    -------
    step, covariance : ndarray, shape (steady segment - 1, axis) and (..., axis, axis)
        nT and nT^2.
    """
    steady = np.flatnonzero(~segments.transient)
    track = DriftFilter.start(rate)
    step, covariance = np.empty((steady.size - 1, 3)), np.empty((steady.size - 1, 3, 3))
    track.observe_slope(segments.head.slope[steady[0]], segments.slope_variance[steady[0]])
    for place, (one, after) in enumerate(pairwise(steady.tolist())):
        track.cross_segment(segments, one)
        seconds = float(segments.head.middle[after] - segments.tail.middle[one]) / SECOND
        value = track.value.copy()
        track.covariance[:, 0, :] = track.covariance[:, :, 0] = 0.0
        track.predict(seconds)
        track.observe_slope(segments.head.slope[after], segments.slope_variance[after])
        step[place] = segments.head.mean[after] - segments.tail.mean[one] - (track.value - value)
        covariance[place] = segments.covariance[one] + segments.covariance[after] + track.spread
    return step, covariance


def _decode_steps(segments: Segments, step: Floats, covariance: Floats) -> ProvenStates | None:
    """Return the states that accumulated steps name; None where these prove nothing."""
    steady = np.flatnonzero(~segments.transient)
    limit = chi2_limit(len(step))
    size = np.einsum("si,sij,sj->s", step, np.linalg.inv(covariance), step)
    real = np.flatnonzero(size > limit)
    # The most precise steps first: others are recognised by them.
    order = real[np.argsort(np.einsum("sii->s", covariance[real]), kind="stable")]
    changes: list[Change] = []
    which: dict[int, tuple[int, int]] = {}
    for one in order.tolist():
        which[one] = match_or_add(changes, Change(step[one], covariance[one], 1), limit)
        if len(changes) > UNIT_SETTINGS.most_vectors:
            return None
    kept, parts = reduce_to_units(changes)
    vectors = np.array([changes[one].vector for one in kept])
    if len(real) - len(kept) < UNIT_SETTINGS.proof_steps:
        return None
    # Two of the vectors that hardly differ, up to their sign, may be one.
    length = np.linalg.norm(vectors, axis=1)
    sums = np.stack([vectors[:, None] - vectors, vectors[:, None] + vectors])
    apart = np.linalg.norm(sums, axis=3).min(axis=0)
    np.fill_diagonal(apart, np.inf)
    if np.any(apart < UNIT_SETTINGS.least_difference * np.minimum(length[:, None], length[None])):
        return None
    toggled = np.zeros((steady.size, len(kept)), dtype=np.int64)
    for one, (change, sign) in which.items():
        for unit, value in parts[change].items():
            toggled[one + 1, unit] = sign * value
    table = simplest_occupancy(np.cumsum(toggled, axis=0))
    seldom = UNIT_SETTINGS.fewest_switchings
    if np.abs(np.diff(table, axis=0)).sum(axis=0).min(initial=seldom) < seldom:
        return None
    if np.ptp(table, axis=0).max(initial=0) > 1:
        return None
    _, first, found = np.unique(table, axis=0, return_index=True, return_inverse=True)
    label = np.full(len(segments), TRANSIENT, dtype=np.int64)
    label[steady] = np.argsort(np.argsort(first))[found.ravel()]
    return ProvenStates(label, table[np.sort(first)])


@dataclass(frozen=True)
class Change:
    """A vector by which states change, up to its sign.

    Attributes
    ----------
    vector : ndarray, shape (axis,)
        nT.
    covariance : ndarray, shape (axis, axis)
        nT^2.
    count : int
        How often it was observed.
    """

    vector: Floats
    covariance: Floats
    count: int


def chi2_limit(tests: int) -> float:
    """Return the squared distance that one of so many right changes exceeds once in a thousand times."""
    return float(scipy.stats.chi2.isf(UNIT_SETTINGS.missed / max(tests, 1), 3))


def squared_distance(vector: Floats, covariance: Floats) -> Floats:
    """Return the squared lengths of vectors (..., axis) in units of their errors (Mahalanobis); (...).

    Parameters
    ----------
    vector : ndarray, shape (..., axis)
    covariance : ndarray, shape (..., axis, axis)
    """
    return np.asarray(np.sum(vector * np.linalg.solve(covariance, vector[..., None])[..., 0], axis=-1))


def match_or_add(changes: list[Change], new: Change, limit: float) -> tuple[int, int]:
    """Return place and sign of the known change that a new one is; it is added where it is none.

    Parameters
    ----------
    changes : list of Change
        Known so far; the one that the new one agrees with is averaged with it.
    new : Change
    limit : float
        Squared distance, in errors, up to which both are one.
    """
    distance, signs = np.full((0, 2), np.inf), (-1, 1)
    if changes:
        vector = np.array([[sign * known.vector for sign in signs] for known in changes])
        spread = new.covariance + np.array([known.covariance for known in changes])
        distance = squared_distance(new.vector - vector, spread[:, None])
    if distance.min(initial=np.inf) > limit:
        changes.append(new)
        return len(changes) - 1, 1
    index, at = divmod(int(distance.argmin()), 2)
    sign = signs[at]
    known = changes[index]
    gain = known.covariance @ np.linalg.inv(new.covariance + known.covariance)
    changes[index] = Change(
        known.vector + gain @ (sign * new.vector - known.vector),
        known.covariance - gain @ known.covariance,
        known.count + new.count,
    )
    return index, sign


def reduce_to_units(changes: list[Change]) -> tuple[list[int], dict[int, dict[int, int]]]:
    """Return which changes are units, and each change as signed units (by place among the units).

    A change observed often is taken for one unit; one that is the sum or difference of two or three others,
    within its uncertainty and not by chance, is taken for several that switched together.
    """
    # Rare and large changes are the sums; frequent and small ones the units.
    order = sorted(
        range(len(changes)), key=lambda one: (changes[one].count, -float(np.linalg.norm(changes[one].vector)))
    )
    kept = set(order)
    made: dict[int, dict[int, int]] = {}
    for one in order:
        sum_of = _as_sum(changes, one, sorted(kept - {one}))
        if sum_of is not None:
            kept.discard(one)
            made[one] = sum_of
    units = sorted(kept)
    place = {one: index for index, one in enumerate(units)}
    parts: dict[int, dict[int, int]] = {one: {place[one]: 1} for one in units}
    for one in reversed([one for one in order if one in made]):
        total: dict[int, int] = {}
        for part, sign in made[one].items():
            for unit, value in parts[part].items():
                total[unit] = total.get(unit, 0) + sign * value
        parts[one] = {unit: value for unit, value in total.items() if value}
    return units, parts


def _as_sum(changes: list[Change], one: int, others: list[int]) -> dict[int, int] | None:
    """Return a change as a signed sum of two or three others; None when it is none."""
    target, limit = changes[one], chi2_limit(1)
    vector = np.array([change.vector for change in changes])
    covariance = np.array([change.covariance for change in changes])
    size = float(np.sqrt(np.mean(np.sum(vector**2, axis=1))))
    for number in range(2, min(UNIT_SETTINGS.together, len(others)) + 1):
        choices = np.array(list(combinations(others, number)))
        signs = np.array(list(product((1, -1), repeat=number)))
        spread = target.covariance + covariance[choices].sum(axis=1)
        # Volume within the limit, over that of the sphere which sums of so many vectors fill.
        room = (size**2 * number / 3.0 * limit) ** 1.5
        volume = limit**1.5 * np.sqrt(np.maximum(np.linalg.det(spread), 0.0)) / room
        told = len(choices) * len(signs) * volume <= UNIT_SETTINGS.accidents
        choices, spread = choices[told], spread[told]
        total = np.einsum("sp,cpi->csi", signs, vector[choices])
        distance = squared_distance(target.vector - total, spread[:, None])
        if distance.min(initial=np.inf) < limit:
            choice, sign = np.unravel_index(distance.argmin(), distance.shape)
            return dict(zip(choices[choice].tolist(), signs[sign].tolist(), strict=True))
    return None


def simplest_occupancy(table: Occupancy) -> Occupancy:
    """Return occupancies of units combined anew, so that as many as possible are on or off and no more.

    Two that often switch together may have been taken for one unit: with the sum ``a + b`` and ``a`` as units
    b alone is "minus one" of them.
    """
    while True:
        span = np.ptp(table, axis=0)
        best: tuple[int, int, int, int] | None = None
        for one, other, sign in product(range(table.shape[1]), range(table.shape[1]), (1, -1)):
            if one == other:
                continue
            gain = int(span[other] - np.ptp(table[:, other] - sign * table[:, one]))
            if gain > 0 and (best is None or gain > best[0]):
                best = gain, one, other, sign
        if best is None:
            return np.asarray(table - table.min(axis=0))
        _, one, other, sign = best
        table[:, other] -= sign * table[:, one]


@dataclass(frozen=True, kw_only=True)
class Units:
    """Units and which of them are switched in each state.

    Attributes
    ----------
    vector : ndarray, shape (unit, axis)
        What switching adds to the difference, nT.
    base : ndarray, shape (axis,)
        Difference with no unit switched, nT.
    covariance : ndarray, shape (unit + 1, axis, unit + 1, axis)
        Of the vectors and, last, of the base, nT^2.
    occupancy : ndarray of int64, shape (state, unit)
        0 or 1; more for units that cannot be distinguished from several alike.
    consistent : bool
        All states are sums of the units within their uncertainties, and fewer units than changes make them.
    reason : str
    """

    vector: Floats
    base: Floats
    covariance: Floats
    occupancy: Occupancy
    consistent: bool
    reason: str

    def __len__(self) -> int:
        return len(self.vector)

    def centre(self, occupancy: Occupancy) -> tuple[Floats, Floats]:
        """Return difference (state, axis) and covariance (state, axis, axis) of any combination of units."""
        design = np.column_stack([occupancy, np.ones(len(occupancy))])
        values = design @ np.vstack([self.vector, self.base])
        return values, np.einsum("sp,piqj,sq->sij", design, self.covariance, design)

    def unobserved(self) -> Occupancy:
        """Return the combinations (state, unit) that no state has: those near to one when units are many."""
        count = len(self)
        observed = {tuple(row) for row in self.occupancy.tolist()}
        if count <= UNIT_SETTINGS.most_predicted:
            possible = set(product((0, 1), repeat=count))
        else:
            possible = set()
            for row in observed:
                for number in range(1, UNIT_SETTINGS.near_switchings + 1):
                    for toggled in combinations(range(count), number):
                        possible.add(tuple(1 - min(v, 1) if i in toggled else v for i, v in enumerate(row)))
        rows = sorted(possible - observed)
        return np.array(rows, dtype=np.int64).reshape(len(rows), count)


def find_units(states: States) -> Units:
    """Return the units that make the states, from the changes between states that follow each other."""
    label = states.label[states.label >= 0]
    # How often two states, the lower number first, follow each other.
    edges = Counter((min(pair), max(pair)) for pair in pairwise(label.tolist()) if pair[0] != pair[1])
    if len(states) < 2 or not edges:
        return no_units(states, "one state only")
    if states.occupancy is not None:
        return _fit_units(states, states.occupancy)
    changes: list[Change] = []
    which = {}
    limit, scatter = chi2_limit(len(edges)), 2.0 * states.scatter**2 * np.eye(3)
    for (one, other), count in edges.most_common():
        vector = states.centre[other] - states.centre[one]
        spread = states.covariance[other] + states.covariance[one] + scatter
        which[one, other] = match_or_add(changes, Change(vector, spread, count), limit)
    kept, parts = reduce_to_units(changes)
    occupancy = _occupancy(len(states), edges, which, parts, len(kept))
    if occupancy is None:
        return no_units(states, "the changes between states contradict each other as sums of units")
    return _fit_units(states, occupancy)


def _occupancy(
    states: int,
    edges: dict[tuple[int, int], int],
    which: dict[tuple[int, int], tuple[int, int]],
    parts: dict[int, dict[int, int]],
    units: int,
) -> Occupancy | None:
    """Return how often each unit is switched in each state, 0 at least; None for a contradiction."""
    near: dict[int, list[tuple[int, npt.NDArray[np.int64]]]] = {state: [] for state in range(states)}
    for one, other in edges:
        change, sign = which[one, other]
        step = np.zeros(units, dtype=np.int64)
        for unit, value in parts[change].items():
            step[unit] = sign * value
        near[one].append((other, step))
        near[other].append((one, -step))
    found: dict[int, npt.NDArray[np.int64]] = {0: np.zeros(units, dtype=np.int64)}
    queue = deque([0])
    while queue:
        state = queue.popleft()
        for other, step in near[state]:
            implied = found[state] + step
            if other not in found:
                found[other] = implied
                queue.append(other)
            elif not np.array_equal(found[other], implied):
                return None
    if len(found) < states:
        return None
    return simplest_occupancy(np.array([found[state] for state in range(states)]))


def _fit_units(states: States, occupancy: Occupancy) -> Units:
    """Return the vectors that fit all states best (weighted least squares), and whether all fit."""
    count, units = occupancy.shape
    design = np.column_stack([occupancy, np.ones(count)])
    if np.linalg.matrix_rank(design) < units + 1:
        return no_units(states, "some units never switch without others: they cannot be separated")
    spread = states.covariance + states.scatter**2 * np.eye(3) / np.maximum(states.count, 1)[:, None, None]
    weight = np.linalg.inv(spread)
    width = 3 * (units + 1)
    normal = np.einsum("sp,sij,sq->piqj", design, weight, design).reshape(width, width)
    right = np.einsum("sp,sij,sj->pi", design, weight, states.centre).ravel()
    covariance = np.linalg.inv(normal)
    value = (covariance @ right).reshape(units + 1, 3)
    residual = states.centre - design @ value
    distance = np.einsum("si,sij,sj->s", residual, weight, residual)
    freedom = 3 * (count - units - 1)
    proven = states.occupancy is not None
    if proven and freedom > 0:
        # What is proven does not become doubtful by levels that drifted farther than they state.
        covariance = covariance * max(1.0, float(distance.sum()) / freedom)
    consistent = proven or (bool(distance.max() < chi2_limit(count)) and freedom > 0)
    if consistent:
        reason = f"{count} states are sums of {units} units"
    elif freedom <= 0:
        reason = f"{count} states show no sum that would prove separate units"
    else:
        reason = f"state {int(distance.argmax())} is no sum of the units that make the others"
    return Units(
        vector=value[:-1],
        base=value[-1],
        covariance=covariance.reshape(units + 1, 3, units + 1, 3),
        occupancy=occupancy,
        consistent=consistent,
        reason=reason,
    )


def no_units(states: States, reason: str) -> Units:
    """Return that states are no sums of units, and why."""
    return Units(
        vector=np.empty((0, 3)),
        base=states.centre[0] if len(states) else np.full(3, np.nan),
        covariance=np.zeros((1, 3, 1, 3)),
        occupancy=np.zeros((len(states), 0), dtype=np.int64),
        consistent=False,
        reason=reason,
    )
