"""The spacecraft's states: which stretches of the difference have the same level, drift aside.

Every segment is a point in the space of the difference (Venus Express paper, section 2). All points share a
slow drift c(t), of the sensors' offsets or of units that warm up: within a segment it is seen, between two
segments it is a random walk, so that it is carried along by a Kalman filter and a state is recognised after
days although its point has moved. How many states there are is chosen by the probability of all points, in
which a state of its own could lie anywhere, and so is a scatter of the states' points beyond noise.

A step common to all later segments, of an offset for instance, cannot be told from new states.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import stats

from inflight.arrays import Floats
from inflight.dual.changes import Occupancy
from inflight.dual.correction import TRANSIENT
from inflight.dual.drift import DriftRate, Track, drift_rate, own_drift
from inflight.dual.segments import Segments
from inflight.dual.switching import Proven, labels_by_steps
from inflight.time import SECOND

Labels = npt.NDArray[np.int64]

#: Chance that one segment of all is taken for a new state by its noise.
_FALSE_STATES = 1e-3
#: Scatters of the states' points that are tried, in standard deviations of one sample.
_SCATTERS = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)
#: Drifts over the whole record that are tried beside what segments show, in the same unit.
_WANDERS = (1.0, 3.0, 10.0, 30.0)
_TURNS = 6


@dataclass(frozen=True)
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
    sureness : float
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
    sureness: float = 1.0

    def __len__(self) -> int:
        return len(self.centre)


def find_states(segments: Segments) -> States:
    """Return the states that the segments tell, their number chosen by the data.

    Notes
    -----
    For each of a few scatters segments are assigned in turn, the drift carried along, until labels stay;
    states closer than their noise allows are merged. The scatter of the lowest criterion
    ``sum(r^T S^-1 r + ln det S) + sum(ln det W - ln det C)`` is taken: residuals r and covariances S of
    segments, covariances C of the states' centres and W of their places before any is seen (Laplace's
    approximation of the probability of the points).
    """
    sample = float(np.sqrt(np.trace(segments.noise.of_mean(1)) / 3.0))
    rate = drift_rate(segments)
    length = max(float(segments.end[-1] - segments.start[0]) / SECOND, 1.0)
    rates = [rate]
    for part in _WANDERS:
        rates.append(rate._replace(value=np.maximum(rate.value, (part * sample) ** 2 / length)))
    given = labels_by_steps(segments, rates, [part * sample for part in _SCATTERS])
    tried = []
    for one in rates:
        for part in _SCATTERS:
            if given is None:
                tried.append(_with_scatter(segments, one, part * sample))
            else:
                tried.append(_with_labels(segments, one, part * sample, given))
    return min(tried, key=lambda one: one[0])[1]


class _Clustering:
    """Segments assigned in turn, a new state where none fits."""

    def __init__(self, segments: Segments, rate: DriftRate, scatter: float) -> None:
        self.segments, self.rate = segments, rate
        self.steady = np.flatnonzero(~segments.transient)
        self.spread = scatter**2 * np.eye(3)
        self.limit = float(stats.chi2.isf(_FALSE_STATES / max(self.steady.size, 1), 3))
        self.centre, self.covariance = np.empty((0, 3)), np.empty((0, 3, 3))
        count = len(segments)
        self.label = np.full(count, TRANSIENT, dtype=np.int64)
        self.drift, self.drift_end = np.zeros((count, 3)), np.zeros((count, 3))
        self.drift_covariance = np.zeros((count, 3, 3))
        self.own = np.array([self.spread + own_drift(segments, one, rate) for one in range(count)])
        self.cost = 0.0
        self.given: Labels | None = None
        self.misled = np.zeros(count)
        self.anywhere = _anywhere(segments, self.steady, scatter)

    def prior(self) -> float:
        """Return twice the logarithm of how many places each state could have had instead of its own."""
        return float(np.sum(self.anywhere - np.linalg.slogdet(self.covariance)[1]))

    def run(self, *, may_add: bool) -> None:
        """Assign all segments once; without `may_add` to the nearest state, however far."""
        track = Track.start(self.rate)
        self.cost = 0.0
        before = self.segments.begin.middle[0] if len(self.segments) else 0
        for one in self.steady.tolist():
            track.forward(float(self.segments.begin.middle[one] - before) / SECOND)
            track.sloping(self.segments.begin.slope[one], self.segments.slope_variance[one])
            spread = self.segments.covariance[one] + self.own[one]
            self._assign(one, spread, track, may_add)
            self.drift[one], self.drift_covariance[one] = track.value, track.spread
            track.through(self.segments, one)
            self.drift_end[one] = track.value
            before = self.segments.finish.middle[one]
        self._follow_transients()

    def _assign(self, one: int, spread: Floats, track: Track, may_add: bool) -> None:
        left = self.segments.begin.mean[one] - track.value - self.centre
        total = spread + track.spread + self.covariance
        far = np.einsum("ki,kij,kj->k", left, np.linalg.inv(total), left) if len(left) else np.empty(0)
        if self._is_new(one, far, may_add):
            self.label[one] = len(self.centre)
            self.centre = np.append(self.centre, [self.segments.begin.mean[one] - track.value], axis=0)
            self.covariance = np.append(self.covariance, [spread + track.spread], axis=0)
            return
        state = self._nearest(far, total) if self.given is None else int(self.given[one])
        self.label[one] = state
        self.misled[one] = self._doubt(far, total, state) * float(
            (track.spread @ np.linalg.inv(total[state])).diagonal().max()
        )
        self.cost += far[state] + float(np.linalg.slogdet(spread + track.spread)[1])
        if may_add:
            gain = self.covariance[state] @ np.linalg.inv(total[state])
            self.centre[state] += gain @ left[state]
            self.covariance[state] -= gain @ self.covariance[state]
        track.seen(left[state], np.diag(total[state]))

    def _doubt(self, far: Floats, total: Floats, state: int) -> float:
        """Return the probability that another state is right, or a new one, which could lie anywhere."""
        likely = -0.5 * np.append(far + np.linalg.slogdet(total)[1], self.anywhere)
        return float(1.0 - np.exp(likely[state] - np.logaddexp.reduce(likely)))

    def _is_new(self, one: int, far: Floats, may_add: bool) -> bool:
        if self.given is not None:
            return int(self.given[one]) == len(far)
        return not far.size or bool(may_add and far.min() > self.limit)

    def _nearest(self, far: Floats, total: Floats) -> int:
        likely = far + np.linalg.slogdet(total)[1]
        # Far beyond its noise a wide state must not win by its width alone.
        return int(np.argmin(np.where(far <= max(self.limit, far.min()), likely, np.inf)))

    def _follow_transients(self) -> None:
        known = self.steady
        if known.size:
            last = np.maximum(np.searchsorted(known, np.arange(len(self.segments)), side="right") - 1, 0)
            short = self.segments.transient
            self.drift[short] = self.drift_end[short] = self.drift_end[known[last[short]]]

    def centres(self) -> None:
        """Take the states' centres anew from the segments assigned to them; empty states go."""
        used, label = np.unique(self.label[self.steady], return_inverse=True)
        self.label[self.steady] = label
        weight = np.linalg.inv(self.segments.covariance + self.own + self.drift_covariance)
        point = self.segments.begin.mean - self.drift
        centre, covariance = np.empty((used.size, 3)), np.empty((used.size, 3, 3))
        for state in range(used.size):
            own = np.flatnonzero(self.label == state)
            covariance[state] = np.linalg.inv(weight[own].sum(axis=0))
            centre[state] = covariance[state] @ np.einsum("sij,sj->i", weight[own], point[own])
        self.centre, self.covariance = centre, covariance

    def merge(self) -> bool:
        """Make one of the two states that are nearest to each other, if one explains both."""
        apart = self.centre[:, None] - self.centre[None]
        total = self.covariance[:, None] + self.covariance[None]
        far = np.einsum("kli,klij,klj->kl", apart, np.linalg.inv(total), apart)
        np.fill_diagonal(far, np.inf)
        if not far.size:
            return False
        # How much better one state for both is than two anywhere: the ratio of the densities.
        far -= self.anywhere - np.linalg.slogdet(total)[1]
        if far.min() > 0.0:
            return False
        first, second = sorted(int(one) for one in np.unravel_index(np.argmin(far), far.shape))
        self.label[self.label == second] = first
        self.centres()
        return True


def _anywhere(segments: Segments, steady: Labels, scatter: float) -> float:
    """Return the logarithm of the determinant of the covariance of states' places before any is seen."""
    noise = segments.noise.of_mean(1) + scatter**2 * np.eye(3)
    points = segments.level[steady]
    wide = 9.0 * noise if len(points) < 2 else 4.0 * np.cov(points.T) + 9.0 * noise
    return float(np.linalg.slogdet(wide)[1])


def _with_scatter(segments: Segments, rate: DriftRate, scatter: float) -> tuple[float, States]:
    found = _Clustering(segments, rate, scatter)
    if not found.steady.size:
        nothing = np.empty(0, dtype=np.int64)
        zero = np.zeros((len(segments), 3))
        return 0.0, States(
            np.empty((0, 3)), np.empty((0, 3, 3)), nothing, found.label, zero, zero, rate, scatter
        )
    found.run(may_add=True)
    for _ in range(_TURNS):
        found.centres()
        while found.merge():
            pass
        before = found.label.copy()
        found.run(may_add=False)
        if np.array_equal(before, found.label):
            break
    found.centres()
    cost, states = _told(found, scatter)
    return cost, replace(states, sureness=float(np.exp(-found.misled.sum())))


def _with_labels(segments: Segments, rate: DriftRate, scatter: float, given: Proven) -> tuple[float, States]:
    """Return cost and states of known labels, which are numbered as they appear."""
    found = _Clustering(segments, rate, scatter)
    found.given = given.label
    found.run(may_add=True)
    for _ in range(2):
        found.centres()
        found.run(may_add=False)
    found.centres()
    cost, states = _told(found, scatter)
    return cost, replace(states, occupancy=given.occupancy)


def _told(found: _Clustering, scatter: float) -> tuple[float, States]:
    cost = found.cost + found.prior()
    count = np.bincount(found.label[found.steady], minlength=len(found.centre))
    return cost, States(
        found.centre, found.covariance, count, found.label, found.drift, found.drift_end, found.rate, scatter
    )
