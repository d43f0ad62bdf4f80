"""Processing: the state of every sample, and the correction that follows from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dual.assignment import Assignment, assign
from inflight.dual.correction import TRANSIENT, UNKNOWN, Correction, no_correction
from inflight.dual.jumps import FALSE_ALARMS, LONGEST, Places
from inflight.dual.readings import Readings
from inflight.dual.segments import SHORTEST, Segments, segments_of
from inflight.dual.training import Training
from inflight.flags import Flag

#: A state less likely than this is ambiguous.
SURE = 0.95
#: A drift of the difference may be that of a stray field, of which the outboard sensor has up to about this
#: part, or of an offset: the correction does not follow it and its error holds it.
_DRIFT_SHARE = 0.5
#: Rows at which a fallback is compared with the states' corrections.
_COMPARED = 20_000


@dataclass(frozen=True)
class _BySegment:
    """Corrections of segments: one row each."""

    field: Floats
    covariance: Floats
    state: npt.NDArray[np.int64]
    probability: Floats
    flag: npt.NDArray[np.uint32]


def process(
    readings: Readings,
    training: Training,
    *,
    fallback: Correction | None = None,
    shortest: int = SHORTEST,
    false_alarms: float = FALSE_ALARMS,
    longest: int = LONGEST,
    jumps: Places | None = None,
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
        rows = rows[:: max(1, rows.size // _COMPARED)]
        apart = correction.field[rows] - fallback.field[rows]
        if not (correction.constant_known and fallback.constant_known):
            shift = apart.mean(axis=0)
        left = apart - shift
        spread = left.T @ left / len(left)
    correction.field[wanted] = fallback.field[wanted] + shift
    correction.covariance[wanted] = fallback.covariance[wanted] + spread
