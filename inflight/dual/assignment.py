"""Which state each segment is in, with probabilities; "none of them" is one of the answers.

Segments follow each other as in a hidden Markov chain whose states are those of the training, those that are
sums of its units, and the unknown one, whose points lie anywhere in a box around the others. A point farther
from all states than their noise allows is unknown, however well it suits otherwise. The drift common to all
segments is carried along by those that are recognised; where it stood at the start is told by trying each
state for the first segment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats

from inflight.arrays import Floats
from inflight.dual.drift import Track, own_drift
from inflight.dual.segments import Segments
from inflight.dual.training import Training
from inflight.time import SECOND

#: Prior probabilities of a segment: that no known state is right, and (of the rest) that it is one which is
#: only predicted.
UNKNOWN_SHARE, _PREDICTED_SHARE = 0.01, 0.1
#: What the prior counts beside the passages seen in training.
_PASSAGES = 2.0
#: Chance that one segment of all is taken for unknown by its noise.
_FALSE_UNKNOWN = 1e-3
#: First segments by which beginnings of the drift are compared, and how many sigmas it may have gone.
_COMPARED, _FARTHEST = 60, 4.0


@dataclass(frozen=True)
class Assignment:
    """Probabilities of the states of each segment.

    Attributes
    ----------
    probability : ndarray, shape (segment, state + 1)
        In the order of the training, last the unknown state; rows of transients are zero.
    drift : ndarray, shape (segment, axis)
        Common drift since the start of the training, nT.
    """

    probability: Floats
    drift: Floats

    @property
    def best(self) -> npt.NDArray[np.int64]:
        """Place of the most likely state; the number of states means unknown; (segment,)."""
        return np.asarray(self.probability.argmax(axis=1), dtype=np.int64)


def assign(segments: Segments, training: Training, drift_sigma: float = 0.0) -> Assignment:
    """Return the probabilities of the training's states for each segment.

    Parameters
    ----------
    drift_sigma : float
        How far the difference may have drifted since the training beside what the training saw, nT.
    """
    chain = _Chain(segments, training)
    value, variance = _since_training(segments, training, drift_sigma)
    begins = _beginnings(chain, value, variance)
    if len(begins) > 1:
        likely = [chain.follow(begin, variance, _COMPARED) for begin in begins]
        begins = [begins[int(np.argmax(likely))]]
    chain.follow(begins[0], variance, len(segments))
    probability = np.zeros((len(segments), len(training) + 1))
    probability[chain.steady] = _smoothed(chain.score[chain.steady], training, chain.prior)
    return Assignment(probability, chain.drift)


class _Chain:
    """The densities of segments under each state, the drift followed."""

    def __init__(self, segments: Segments, training: Training) -> None:
        self.segments, self.training = segments, training
        self.steady = np.flatnonzero(~segments.transient)
        self.limit = float(stats.chi2.isf(_FALSE_UNKNOWN / max(self.steady.size, 1), 3))
        self.prior = _prior(training)
        self.spread = training.scatter**2 * np.eye(3)
        self.unknown = _density_anywhere(segments, training)
        self.score = np.full((len(segments), len(training) + 1), -np.inf)
        self.drift = np.zeros((len(segments), 3))

    def point(self, one: int, value: Floats, spread: Floats) -> tuple[Floats, Floats, Floats]:
        """Return a segment's distances from the states (state, axis), their covariances and squares."""
        left = self.segments.begin.mean[one] - value - self.training.centre
        own = own_drift(self.segments, one, self.training.drift_rate)
        total = self.segments.covariance[one] + own + self.spread + spread + self.training.centre_covariance
        return left, total, np.einsum("ki,kij,kj->k", left, np.linalg.inv(total), left)

    def follow(self, begin: Floats, variance: Floats, most: int) -> float:
        """Go through the first segments, the drift from a beginning on; return the log likelihood."""
        track = Track.start(self.training.drift_rate)
        track.value = begin.copy()
        track.covariance[:, 0, 0] = variance
        likelihood, before = 0.0, self.segments.begin.middle[0]
        for one in self.steady[:most].tolist():
            track.forward(float(self.segments.begin.middle[one] - before) / SECOND)
            track.sloping(self.segments.begin.slope[one], self.segments.slope_variance[one])
            left, total, far = self.point(one, track.value, track.spread)
            density = -0.5 * (far + np.linalg.slogdet(total)[1]) - 1.5 * np.log(2.0 * np.pi)
            self.score[one, :-1] = np.where(far <= self.limit, density, -np.inf)
            self.score[one, -1] = self.unknown
            posterior = self.score[one] + np.log(self.prior)
            likelihood += float(np.logaddexp.reduce(posterior))
            state = int(np.argmax(posterior))
            if state < len(self.training):
                track.seen(left[state], np.diag(total[state]))
            self.drift[one] = track.value
            track.through(self.segments, one)
            before = self.segments.finish.middle[one]
        return likelihood


def _prior(training: Training) -> Floats:
    """Return the probabilities of the states and, last, of the unknown one."""
    seen = training.seen
    predicted = _PREDICTED_SHARE if not seen.all() else 0.0
    share = np.where(seen, (1.0 - predicted) / seen.sum(), predicted / max((~seen).sum(), 1))
    return np.append((1.0 - UNKNOWN_SHARE) * share, UNKNOWN_SHARE)


def _density_anywhere(segments: Segments, training: Training) -> float:
    """Return the logarithm of the density of points of an unknown state, 1/nT^3."""
    noise = segments.noise.of_mean(1) + training.scatter**2 * np.eye(3)
    points = np.concatenate([training.centre, segments.level[~segments.transient]])
    wide = 4.0 * np.cov(points.T) + 9.0 * noise
    return float(-0.5 * np.linalg.slogdet(wide)[1] - 1.5 * np.log(2.0 * np.pi))


def _since_training(segments: Segments, training: Training, drift_sigma: float) -> tuple[Floats, Floats]:
    """Return where the drift is expected to stand at the start, and the variance of that; (axis,) each."""
    span = max(training.end - training.start, 1)
    share = float(np.clip((segments.start[0] - training.start) / span, 0.0, 1.0))
    away = max(float(segments.start[0] - training.end), float(training.start - segments.start[0]), 0.0)
    if 0.0 < share < 1.0:
        away = min(share, 1.0 - share) * span
    # Slopes turn round: what the training saw is the most that one expects.
    seconds = min(away, span) / SECOND
    rate = training.drift_rate
    variance = rate.value * away / SECOND + seconds**2 * np.minimum(rate.slope, rate.bend * seconds / 3.0)
    return share * training.drift, variance + drift_sigma**2


def _beginnings(chain: _Chain, value: Floats, variance: Floats) -> list[Floats]:
    """Return where the drift may have stood: as expected, or so that a state fits the first segment."""
    begins = [value]
    if not chain.steady.size or not variance.max() > 0:
        return begins
    first = int(chain.steady[np.argmax(chain.segments.count[chain.steady[:5]])])
    left, total, _ = chain.point(first, value, np.zeros((3, 3)))
    sigma = np.sqrt(variance + np.einsum("kii->ki", total))
    near = (np.abs(left) < _FARTHEST * sigma).all(axis=1) & chain.training.seen
    return begins + [value + one for one in left[near]]


def _smoothed(score: Floats, training: Training, prior: Floats) -> Floats:
    """Return probabilities (segment, state + 1) by the forward and backward recursions of the chain."""
    if not len(score):
        return score
    score = score - score.max(axis=1, keepdims=True)
    density = np.exp(score)
    counts = np.pad(training.transitions, (0, 1))
    total = counts.sum(axis=1) + _PASSAGES
    known = training.seen.sum()
    # Passages among the states seen, and the prior for all others: a full table of predictions is large.
    seen = counts[:known, :known] / total[:known, None]
    forward, backward = np.empty_like(density), np.empty_like(density)
    forward[0] = prior * density[0]
    forward[0] /= forward[0].sum()
    for one in range(1, len(density)):
        expected = prior * float(forward[one - 1] @ (_PASSAGES / total))
        expected[:known] += forward[one - 1, :known] @ seen
        forward[one] = expected * density[one]
        forward[one] /= forward[one].sum()
    backward[-1] = 1.0
    for one in range(len(density) - 2, -1, -1):
        coming = backward[one + 1] * density[one + 1]
        backward[one] = _PASSAGES / total * float(prior @ coming)
        backward[one, :known] += seen @ coming[:known]
        backward[one] /= backward[one].max()
    both = forward * backward
    return np.asarray(both / both.sum(axis=1, keepdims=True))
