"""Which state each segment is in, with probabilities, and the correction that follows from it.

Takes readings and a training; makes the correction by states. Segments follow each other as in a hidden
Markov chain whose states are those of the training, those that are sums of its units, and the unknown one,
whose points lie anywhere in a box around the others. The probabilities are those of the forward and backward
recursions. A point farther from all states than their noise allows is unknown, however likely it is
otherwise. The drift common to all segments is filtered by those that are recognised; its value at the start
is chosen by trying each state for the first segment.

This is the "processing" of the Venus Express paper (section 3), which takes the nearest state.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.dual.correction import TRANSIENT, UNKNOWN, Correction, no_correction
from inflight.dual.readings import Readings
from inflight.dual.segments import (
    SEGMENT_SETTINGS,
    DriftFilter,
    Segments,
    segment_drift_covariance,
    segments_of,
)
from inflight.dual.training import Training
from inflight.flags import Flag
from inflight.time import SECOND


@dataclass(frozen=True, kw_only=True)
class AssignmentSettings:
    """Numbers of the assignment of segments to states, and of their correction.

    Attributes
    ----------
    least_probability : float
        A state less likely than this is ambiguous. Level of significance; in 36 records with drifting offsets
        or small units no wrong state had it (docs/science/two-sensors.md).
    unknown_prior : float
        Prior probability that no known state is right. Assumed.
    predicted_prior : float
        Of the rest, that the state was predicted only, never observed. Assumed.
    prior_passages : float
        Passages from one state to the next that the prior adds to those observed in training. Assumed.
    false_unknown : float
        Chance that one segment of all is taken for unknown by its noise. Level of significance.
    compared_segments : int
        First segments by which starting values of the drift are compared. Assumed, for speed.
    start_sigmas : float
        Standard deviations that the drift may have gone since the training. Level of significance.
    anywhere_points, anywhere_noise : float
        Where an unknown state lies: the covariance of all points times this, and that of a sample times this.
        Derived: two and three sigmas.
    drift_share : float
        Part of the drift, and of the scatter of a state's segments, that the outboard sensor may share: the
        correction does not follow it and its error holds it. Assumed: the ratio of a stray field at both
        sensors; an offset has none.
    compared_rows : int
        Rows at which a fallback is compared with the states' corrections, at most. Assumed, for speed.
    """

    least_probability: float = 0.95
    unknown_prior: float = 0.01
    predicted_prior: float = 0.1
    prior_passages: float = 2.0
    false_unknown: float = 1e-3
    compared_segments: int = 60
    start_sigmas: float = 4.0
    anywhere_points: float = 4.0
    anywhere_noise: float = 9.0
    drift_share: float = 0.5
    compared_rows: int = 20_000


ASSIGNMENT_SETTINGS = AssignmentSettings()


def correction_by_states(
    readings: Readings, training: Training, *, fallback: Correction | None = None
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

    Returns
    -------
    Correction
        Of method ``states``. Ambiguous states have the mean of all likely ones, weighted by probability, and
        an error that holds their spread.
    """
    good = readings.good
    if not good.any():
        return no_correction(len(readings), "no sample has both sensors")
    segments = segments_of(readings)
    found = _correction_of_segments(segments, training, assign(segments, training))
    samples = segments.last - segments.first
    correction = replace(
        found,
        field=np.repeat(found.field, samples, axis=0),
        covariance=np.repeat(found.covariance, samples, axis=0),
        state=np.repeat(found.state, samples),
        probability=np.repeat(found.probability, samples),
        flag=np.repeat(found.flag, samples),
    )
    # A spike does not change the state: the error grows by as much as the sample stands out.
    spikes = segments.spikes
    beyond = (
        readings.difference[spikes] - segments.level[np.searchsorted(segments.last, spikes, side="right")]
    )
    correction.covariance[spikes] += beyond[:, :, None] * beyond[:, None, :]
    correction.flag[spikes] |= np.uint32(Flag.TRANSIENT)
    # Far from any sample with both sensors the state may have changed.
    rows, missing = np.flatnonzero(good), np.flatnonzero(~good)
    after = np.searchsorted(rows, missing)
    early = np.where(after > 0, missing - rows[np.maximum(after - 1, 0)], len(readings))
    late = np.where(after < rows.size, rows[np.minimum(after, rows.size - 1)] - missing, len(readings))
    lost = missing[np.minimum(early, late) > SEGMENT_SETTINGS.shortest]
    correction.field[lost], correction.covariance[lost] = np.nan, np.nan
    correction.state[lost], correction.probability[lost] = UNKNOWN, np.nan
    correction.flag[lost] = np.uint32(Flag.UNKNOWN_STATE)
    if fallback is not None:
        _fill_unknown(correction, fallback)
    return correction


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


def assign(segments: Segments, training: Training) -> Assignment:
    """Return the probabilities of the training's states for each segment.

    The drift at the start is the predicted one, or that by which a state fits the longest of the first
    segments: whichever makes the first segments most likely.
    """
    chain = _StateChain(segments, training)
    value, variance = _drift_since_training(segments, training)
    starts = [value]
    if chain.steady.size and variance.max() > 0:
        first = int(chain.steady[np.argmax(segments.count[chain.steady[:5]])])
        residual, total, _ = chain.residuals(first, value, np.zeros((3, 3)))
        sigma = np.sqrt(variance + np.einsum("kii->ki", total))
        near = (np.abs(residual) < ASSIGNMENT_SETTINGS.start_sigmas * sigma).all(axis=1) & training.observed
        starts += [value + one for one in residual[near]]
    if len(starts) > 1:
        likelihood = [
            chain.filter_drift(start, variance, chain.steady[: ASSIGNMENT_SETTINGS.compared_segments])
            for start in starts
        ]
        starts = [starts[int(np.argmax(likelihood))]]
    chain.filter_drift(starts[0], variance, chain.steady)
    probability = np.zeros((len(segments), len(training) + 1))
    probability[chain.steady] = _smoothed(chain.score[chain.steady], training, chain.prior)
    return Assignment(probability, chain.drift)


class _StateChain:
    """The likelihood of each segment under each state, with the drift filtered.

    Attributes
    ----------
    prior : ndarray, shape (state + 1,)
        Probabilities of the states and, last, of the unknown one.
    score : ndarray, shape (segment, state + 1)
        Log likelihood; last of the unknown state.
    drift : ndarray, shape (segment, axis)
        nT.
    """

    def __init__(self, segments: Segments, training: Training) -> None:
        self.segments, self.training = segments, training
        self.steady = np.flatnonzero(~segments.transient)
        self.limit = float(
            scipy.stats.chi2.isf(ASSIGNMENT_SETTINGS.false_unknown / max(self.steady.size, 1), 3)
        )
        observed, unknown = training.observed, ASSIGNMENT_SETTINGS.unknown_prior
        predicted = ASSIGNMENT_SETTINGS.predicted_prior if not observed.all() else 0.0
        share = np.where(observed, (1.0 - predicted) / observed.sum(), predicted / max((~observed).sum(), 1))
        self.prior = np.append((1.0 - unknown) * share, unknown)
        self.spread = training.scatter**2 * np.eye(3)
        # The logarithm of the density of points of an unknown state, 1/nT^3.
        noise = segments.noise.of_mean(1) + training.scatter**2 * np.eye(3)
        points = np.concatenate([training.centre, segments.level[~segments.transient]])
        wide = (
            ASSIGNMENT_SETTINGS.anywhere_points * np.cov(points.T)
            + ASSIGNMENT_SETTINGS.anywhere_noise * noise
        )
        self.unknown = float(-0.5 * np.linalg.slogdet(wide)[1] - 1.5 * np.log(2.0 * np.pi))
        self.score = np.full((len(segments), len(training) + 1), -np.inf)
        self.drift = np.zeros((len(segments), 3))
        self.own = segment_drift_covariance(segments, training.drift_rate)

    def residuals(self, one: int, value: Floats, spread: Floats) -> tuple[Floats, Floats, Floats]:
        """Return a segment's residuals from the states (state, axis), their covariances and squares."""
        residual = self.segments.head.mean[one] - value - self.training.centre
        total = (
            self.segments.covariance[one]
            + self.own[one]
            + self.spread
            + spread
            + self.training.centre_covariance
        )
        return residual, total, np.einsum("ki,kij,kj->k", residual, np.linalg.inv(total), residual)

    def filter_drift(self, start: Floats, variance: Floats, steady: npt.NDArray[np.int64]) -> float:
        """Filter the drift through steady segments from a starting value on; return the log likelihood."""
        track = DriftFilter.start(self.training.drift_rate)
        track.value = start.copy()
        track.covariance[:, 0, 0] = variance
        likelihood, before = 0.0, self.segments.head.middle[0]
        for one in steady.tolist():
            track.predict(float(self.segments.head.middle[one] - before) / SECOND)
            track.observe_slope(self.segments.head.slope[one], self.segments.slope_variance[one])
            residual, total, distance = self.residuals(one, track.value, track.spread)
            density = -0.5 * (distance + np.linalg.slogdet(total)[1]) - 1.5 * np.log(2.0 * np.pi)
            self.score[one, :-1] = np.where(distance <= self.limit, density, -np.inf)
            self.score[one, -1] = self.unknown
            posterior = self.score[one] + np.log(self.prior)
            likelihood += float(np.logaddexp.reduce(posterior))
            state = int(np.argmax(posterior))
            if state < len(self.training):
                track.observe_value(residual[state], np.diag(total[state]))
            self.drift[one] = track.value
            track.cross_segment(self.segments, one)
            before = self.segments.tail.middle[one]
        return likelihood


def _drift_since_training(segments: Segments, training: Training) -> tuple[Floats, Floats]:
    """Return the predicted drift at the start, nT, and the variance of that, nT^2; (axis,) each."""
    span = max(training.end - training.start, 1)
    share = float(np.clip((segments.start[0] - training.start) / span, 0.0, 1.0))
    away = max(float(segments.start[0] - training.end), float(training.start - segments.start[0]), 0.0)
    if 0.0 < share < 1.0:
        away = min(share, 1.0 - share) * span
    # Slopes reverse: the duration of the training bounds how long one lasts.
    seconds = min(away, span) / SECOND
    rate = training.drift_rate
    variance = rate.level_walk * away / SECOND + seconds**2 * np.minimum(
        rate.slope, rate.slope_walk * seconds / 3.0
    )
    return share * training.drift, variance


def _smoothed(score: Floats, training: Training, prior: Floats) -> Floats:
    """Return probabilities (segment, state + 1) by the forward and backward recursions of the chain."""
    if not len(score):
        return score
    score = score - score.max(axis=1, keepdims=True)
    density = np.exp(score)
    counts = np.pad(training.transitions, (0, 1))
    passages = ASSIGNMENT_SETTINGS.prior_passages
    total = counts.sum(axis=1) + passages
    known = training.observed.sum()
    # Passages among observed states, and the prior for all others: a full table of predictions is large.
    observed = counts[:known, :known] / total[:known, None]
    forward, backward = np.empty_like(density), np.empty_like(density)
    forward[0] = prior * density[0]
    forward[0] /= forward[0].sum()
    for one in range(1, len(density)):
        predicted = prior * float(forward[one - 1] @ (passages / total))
        predicted[:known] += forward[one - 1, :known] @ observed
        forward[one] = predicted * density[one]
        forward[one] /= forward[one].sum()
    backward[-1] = 1.0
    for one in range(len(density) - 2, -1, -1):
        coming = backward[one + 1] * density[one + 1]
        backward[one] = passages / total * float(prior @ coming)
        backward[one, :known] += observed @ coming[:known]
        backward[one] /= backward[one].max()
    both = forward * backward
    return np.asarray(both / both.sum(axis=1, keepdims=True))


def _correction_of_segments(segments: Segments, training: Training, assigned: Assignment) -> Correction:
    """Return the correction with one row a segment: the mean over its states, weighted by probability.

    Transients have the mean of their neighbours' corrections, with an error that holds them both.
    """
    count, known = len(segments), len(training)
    share = assigned.probability[:, :known]
    total = np.maximum(share.sum(axis=1), 1e-300)[:, None]
    field = share @ training.correction / total
    apart = training.correction[None] - field[:, None]
    # Where states may have been confused in training any state may be right, as often as it was held.
    seconds = training.seconds + 1e-9
    by_time = np.asarray(seconds / seconds.sum())
    weight = training.confidence * share / total + (1.0 - training.confidence) * by_time
    covariance = np.einsum("sk,kij->sij", weight, training.covariance)
    covariance += np.einsum("sk,ski,skj->sij", weight, apart, apart)
    # A state's field is not quite the same each time: the scatter of its segments beyond noise, as trained.
    beyond = assigned.drift**2 + training.scatter**2
    covariance[:, range(3), range(3)] += ASSIGNMENT_SETTINGS.drift_share**2 * beyond
    best = assigned.best
    probability = assigned.probability[np.arange(count), best] * training.confidence
    unknown = best == known
    state = np.where(unknown, UNKNOWN, training.number[np.minimum(best, known - 1)])
    flag = np.where(unknown, np.uint32(Flag.UNKNOWN_STATE), np.uint32(0)).astype(np.uint32)
    flag[(probability < ASSIGNMENT_SETTINGS.least_probability) & ~segments.transient] |= np.uint32(
        Flag.AMBIGUOUS_STATE
    )
    field[unknown], covariance[unknown] = np.nan, np.nan
    short, steady = np.flatnonzero(segments.transient), np.flatnonzero(~segments.transient)
    state[short], flag[short], probability[short] = TRANSIENT, np.uint32(Flag.TRANSIENT), np.nan
    field[short], covariance[short] = np.nan, np.nan
    for one, after in zip(short, np.searchsorted(steady, short), strict=True):
        near = steady[max(after - 1, 0) : after + 1]
        near = near[np.isfinite(field[near, 0])]
        if not near.size:
            continue
        mean = field[near].mean(axis=0)
        # What the difference does beyond both neighbours, the outboard reading may do as well.
        beyond = np.abs(segments.level[one] - segments.level[near]).min(axis=0)
        apart = field[near] - mean
        field[one] = mean
        covariance[one] = covariance[near].mean(axis=0) + np.diag(beyond**2)
        covariance[one] += np.einsum("ni,nj->ij", apart, apart)
    return Correction(
        field=field,
        covariance=covariance,
        state=state,
        probability=probability,
        flag=flag,
        method="states",
        reason="the spacecraft's states as trained",
        constant_known=training.constant_known,
    )


def _fill_unknown(correction: Correction, fallback: Correction) -> None:
    """Put the fallback where the state is unknown or transient, joined to the states' corrections."""
    filled = (correction.state < 0) & fallback.known
    rows = np.flatnonzero((correction.state >= 0) & correction.known & fallback.known)
    shift, spread = np.zeros(3), np.zeros((3, 3))
    if rows.size:
        rows = rows[:: max(1, rows.size // ASSIGNMENT_SETTINGS.compared_rows)]
        apart = correction.field[rows] - fallback.field[rows]
        if not (correction.constant_known and fallback.constant_known):
            shift = apart.mean(axis=0)
        residual = apart - shift
        spread = residual.T @ residual / len(residual)
    correction.field[filled] = fallback.field[filled] + shift
    correction.covariance[filled] = fallback.covariance[filled] + spread
