"""Bayesian state of each segment.

Which state each segment is in, with probabilities; "none of them" is one of the answers.

Segments follow each other as in a hidden Markov chain whose states are those of the training, those that are
sums of its units, and the unknown one, whose points lie anywhere in a box around the others. A point farther
from all states than their noise allows is unknown, however well it suits otherwise. The drift common to all
segments is carried along by those that are recognised; where it stood at the start is told by trying each
state for the first segment.

Processing: the state of every sample, and the correction that follows from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats

from inflight.arrays import Floats
from inflight.dual.change_points import FALSE_ALARMS, LONGEST, Rows
from inflight.dual.correction import TRANSIENT, UNKNOWN, Correction, no_correction
from inflight.dual.readings import Readings
from inflight.dual.segments import SHORTEST, DriftFilter, Segments, own_drift, segments_of
from inflight.dual.training import Training
from inflight.flags import Flag
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
        track = DriftFilter.start(self.training.drift_rate)
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


#: A state less likely than this is ambiguous.
SURE = 0.95

#: A drift of the difference may be that of a stray field, of which the outboard sensor has up to about this
#: part, or of an offset: the correction does not follow it and its error holds it.
_DRIFT_SHARE = 0.5

#: Rows at which a fallback is compared with the states' corrections.
_COMPARED_ROWS = 20_000


@dataclass(frozen=True)
class _BySegment:
    """Corrections of segments: one row each."""

    field: Floats
    covariance: Floats
    state: npt.NDArray[np.int64]
    probability: Floats
    flag: npt.NDArray[np.uint32]


def correction_by_states(
    readings: Readings,
    training: Training,
    *,
    fallback: Correction | None = None,
    shortest: int = SHORTEST,
    false_alarms: float = FALSE_ALARMS,
    longest: int = LONGEST,
    jumps: Rows | None = None,
    drift_sigma: float = 0.0,
) -> Correction:
    """Return the correction of the outboard sensor by the spacecraft's states.

    Parameters
    ----------
    readings : Readings
    training : Training
    fallback : Correction, optional
        What is used in unknown states and transients, such as a gradiometer's estimate. It is shifted to the
        states' corrections where either does not know the constant part, and its error is widened by how
        badly it reproduces those of known states. Without it unknown states have no correction, and
        transients that of their neighbours.
    shortest, false_alarms, longest, jumps
        See `segments.segments_of`.
    drift_sigma : float
        See `assignment.assign`.

    Returns
    -------
    Correction
        Of method ``states``. Ambiguous states have the mean of all likely ones, weighted by probability, and
        an error that holds their spread.
    """
    if not readings.good.any():
        return no_correction(len(readings), "no sample has both sensors")
    segments = segments_of(
        readings, shortest=shortest, false_alarms=false_alarms, longest=longest, jumps=jumps
    )
    assigned = assign(segments, training, drift_sigma)
    found = _by_segment(segments, training, assigned)
    spans = segments.last - segments.first
    correction = Correction(
        np.repeat(found.field, spans, axis=0),
        np.repeat(found.covariance, spans, axis=0),
        np.repeat(found.state, spans),
        np.repeat(found.probability, spans),
        np.repeat(found.flag, spans),
        "states",
        applied=True,
        reason="the spacecraft's states as trained",
        constant_known=training.constant_known,
    )
    _mark_spikes(correction, readings, segments)
    _lose_long_gaps(correction, readings, shortest)
    if fallback is not None:
        _fall_back(correction, fallback)
    return correction


def _by_segment(segments: Segments, training: Training, assigned: Assignment) -> _BySegment:
    """Return the correction of each segment."""
    count, known = len(segments), len(training)
    share = assigned.probability[:, :known]
    total = np.maximum(share.sum(axis=1), 1e-300)[:, None]
    field = share @ training.correction / total
    apart = training.correction[None] - field[:, None]
    weight = training.sureness * share / total + (1.0 - training.sureness) * _by_time(training)
    covariance = np.einsum("sk,kij->sij", weight, training.covariance)
    covariance += np.einsum("sk,ski,skj->sij", weight, apart, apart)
    covariance[:, range(3), range(3)] += (_DRIFT_SHARE * assigned.drift) ** 2
    best = assigned.best
    probability = assigned.probability[np.arange(count), best] * training.sureness
    lost = best == known
    state = np.where(lost, UNKNOWN, training.number[np.minimum(best, known - 1)])
    flag = np.where(lost, np.uint32(Flag.UNKNOWN_STATE), np.uint32(0)).astype(np.uint32)
    flag[(probability < SURE) & ~segments.transient] |= np.uint32(Flag.AMBIGUOUS_STATE)
    field[lost], covariance[lost] = np.nan, np.nan
    found = _BySegment(field, covariance, state, probability, flag)
    _bridge(found, segments, training, assigned)
    return found


def _by_time(training: Training) -> Floats:
    """Return the part of the time in each state; (state,)."""
    seconds = training.seconds + 1e-9
    return np.asarray(seconds / seconds.sum())


def _bridge(found: _BySegment, segments: Segments, training: Training, assigned: Assignment) -> None:
    """Give transients the mean of their neighbours' corrections, with an error that holds them both."""
    short = np.flatnonzero(segments.transient)
    steady = np.flatnonzero(~segments.transient)
    found.state[short], found.flag[short] = TRANSIENT, np.uint32(Flag.TRANSIENT)
    found.probability[short] = np.nan
    found.field[short], found.covariance[short] = np.nan, np.nan
    place = np.searchsorted(steady, short)
    for one, after in zip(short, place, strict=True):
        near = steady[max(after - 1, 0) : after + 1]
        near = near[np.isfinite(found.field[near, 0])]
        if not near.size:
            continue
        mean = found.field[near].mean(axis=0)
        # What the difference does beyond both neighbours, the outboard reading may do as well.
        beyond = np.abs(segments.level[one] - segments.level[near]).min(axis=0)
        apart = found.field[near] - mean
        found.field[one] = mean
        found.covariance[one] = found.covariance[near].mean(axis=0) + np.diag(beyond**2)
        found.covariance[one] += np.einsum("ni,nj->ij", apart, apart)


def _mark_spikes(correction: Correction, readings: Readings, segments: Segments) -> None:
    """Widen the error of single samples that stand out, by as much as they do: the state is unchanged."""
    rows = segments.spikes
    if not rows.size:
        return
    owner = np.searchsorted(segments.last, rows, side="right")
    beyond = readings.difference[rows] - segments.level[owner]
    correction.covariance[rows] += beyond[:, :, None] * beyond[:, None, :]
    correction.flag[rows] |= np.uint32(Flag.TRANSIENT)


def _lose_long_gaps(correction: Correction, readings: Readings, shortest: int) -> None:
    """Take the state from samples far from any that has both sensors: it may have changed."""
    good = readings.good
    if good.all():
        return
    rows = np.flatnonzero(good)
    missing = np.flatnonzero(~good)
    after = np.searchsorted(rows, missing)
    early = np.where(after > 0, missing - rows[np.maximum(after - 1, 0)], len(readings))
    late = np.where(after < rows.size, rows[np.minimum(after, rows.size - 1)] - missing, len(readings))
    lost = missing[np.minimum(early, late) > shortest]
    correction.field[lost], correction.covariance[lost] = np.nan, np.nan
    correction.state[lost], correction.probability[lost] = UNKNOWN, np.nan
    correction.flag[lost] = np.uint32(Flag.UNKNOWN_STATE)


def _fall_back(correction: Correction, fallback: Correction) -> None:
    """Put the fallback where the state is unknown or passing, joined to the states' corrections."""
    wanted = (correction.state < 0) & fallback.known
    rows = np.flatnonzero((correction.state >= 0) & correction.known & fallback.known)
    shift, spread = np.zeros(3), np.zeros((3, 3))
    if rows.size:
        rows = rows[:: max(1, rows.size // _COMPARED_ROWS)]
        apart = correction.field[rows] - fallback.field[rows]
        if not (correction.constant_known and fallback.constant_known):
            shift = apart.mean(axis=0)
        left = apart - shift
        spread = left.T @ left / len(left)
    correction.field[wanted] = fallback.field[wanted] + shift
    correction.covariance[wanted] = fallback.covariance[wanted] + spread
