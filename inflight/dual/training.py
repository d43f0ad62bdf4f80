"""Training: the states of a spacecraft, and what each adds to the outboard sensor.

Takes readings; makes the table of states with their corrections, and the units behind them.

At a jump of the difference the outboard reading steps, too, and the ambient field continues as before. What
the ambient field does between the two stretches compared is noise of the step; it is measured from the
outboard readings themselves where nothing switches, the best length of stretch is chosen by it, and livelier
times have less weight. The steps are regressed on the units that switch, or on the states where units are not
known (robust weighted least squares).

From steps only differences between states are known, and the correction is relative to the state observed
longest: a stray field that never changes cannot be separated from the ambient field and the offsets. Where
the ambient field is known, the level of each segment gives its stray field, and the corrections are absolute
(Venus Express paper, section 3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dual.change_points import Rows, StepNoise, step_noise
from inflight.dual.readings import Readings
from inflight.dual.segments import SEGMENT_SETTINGS, DriftRate, Segments, segments_of
from inflight.dual.states import Occupancy, States, Units, find_states, find_units, no_units
from inflight.errors import CalibrationError
from inflight.time import SECOND


@dataclass(frozen=True, kw_only=True)
class TrainingSettings:
    """Numbers of the fit of outboard steps.

    Attributes
    ----------
    local_steps : int
        Places in either segment at which the local variance of the ambient field is measured. Assumed.
    usual_steps : float
        Weight of the usual variance relative to them, in steps. Assumed: a prior of four steps.
    huber_limit : float
        Beyond this many standard deviations (of three components) a step has less weight: Huber's. Level of
        significance: 0.9 % of Gaussian steps.
    rounds : int
        Rounds of the robust fit. Assumed.
    prior_size : float
        Prior standard deviation of a unit's field at the outboard sensor over the size of its difference.
        Derived: a dipole whose distance from the inboard sensor is 0.8 of that from the outboard one has
        just that.
    blurred_sigmas : float
        Beyond this many standard deviations the usual sample beside a jump is not on its level. Level of
        significance: three sigmas.
    """

    local_steps: int = 24
    usual_steps: float = 4.0
    huber_limit: float = 3.4
    rounds: int = 5
    prior_size: float = 1.0
    blurred_sigmas: float = 3.0


TRAINING_SETTINGS = TrainingSettings()


@dataclass(frozen=True, kw_only=True)
class Training:
    """States of a spacecraft, observed or predicted, with their corrections; spacecraft axes.

    Attributes
    ----------
    number : ndarray of int64, shape (state,)
        Of each state; it stays with the state through later trainings.
    centre, centre_covariance : ndarray, shape (state, axis) and (state, axis, axis)
        Difference ``B_in - B_out`` in the state, without drift, nT and nT^2.
    correction, covariance : ndarray, shape (state, axis) and (state, axis, axis)
        To take off the outboard reading, nT, and its error's covariance, nT^2.
    segments : ndarray of int64, shape (state,)
        Segments observed; 0 for a combination of units that is only predicted.
    seconds : ndarray, shape (state,)
        Time observed.
    transitions : ndarray, shape (state, state)
        How often one state followed another.
    occupancy : ndarray of int64, shape (state, unit)
        Which units are switched.
    unit, unit_correction : ndarray, shape (unit, axis)
        What each adds to the difference and to the outboard reading, nT.
    unit_covariance : ndarray, shape (unit, axis, axis)
        Of `unit_correction`, nT^2.
    scatter : float
        Of the states' points beyond noise, nT.
    drift : ndarray, shape (axis,)
        Of the difference at `end`, nT, zero at `start`.
    drift_rate : DriftRate
    start, end : int
        TT2000 of the readings behind it.
    constant_known : bool
        The corrections are absolute; else relative to `reference`.
    reference : int
        Number of the state whose correction is zero by definition; -1 for absolute corrections.
    excess : float
        Scatter of the outboard steps over what they state.
    reason : str
        What is known of units.
    design : ndarray, shape (state, parameter)
        How often each fitted stray field is in a state: `occupancy`, or one of its own for each state where
        units are not known.
    value, joint : ndarray, shape (parameter, axis) and (parameter, axis, parameter, axis)
        The fitted stray fields at the outboard sensor, nT, and their covariance, nT^2.
    unit_number : ndarray of int64, shape (unit,)
        Of each unit; it stays with the unit through later trainings, as `number` with the state.
    next_number, next_unit : int
        The first numbers that no training before had.
    carried : bool
        The constant part was known to an earlier training and is taken from there.
    confidence : float
        Probability that the states were not confused by drift; see `states.States`.
    """

    number: npt.NDArray[np.int64]
    centre: Floats
    centre_covariance: Floats
    correction: Floats
    covariance: Floats
    segments: npt.NDArray[np.int64]
    seconds: Floats
    transitions: Floats
    occupancy: Occupancy
    unit: Floats
    unit_correction: Floats
    unit_covariance: Floats
    scatter: float
    drift: Floats
    drift_rate: DriftRate
    start: int
    end: int
    constant_known: bool
    reference: int
    excess: float
    reason: str
    design: Floats
    value: Floats
    joint: Floats
    unit_number: npt.NDArray[np.int64]
    next_number: int
    next_unit: int
    carried: bool = False
    confidence: float = 1.0

    def __len__(self) -> int:
        return int(self.number.size)

    @property
    def observed(self) -> npt.NDArray[np.bool_]:
        """Which states were observed, not only predicted; (state,)."""
        return np.asarray(self.segments > 0)


def train(readings: Readings, *, ambient: Floats | None = None) -> Training:
    """Learn states, units and outboard corrections.

    Parameters
    ----------
    readings : Readings
        Of a commissioning phase, or of any span with switching.
    ambient : ndarray, shape (time, axis), optional
        Known ambient field in the axes of the readings, nT; NaN where it is not known. The outboard sensor's
        offset becomes part of the corrections.

    Raises
    ------
    CalibrationError
        No steady segment: the span is too short or switches all the time.
    """
    segments = segments_of(readings)
    states = find_states(segments)
    if not len(states):
        raise CalibrationError(
            f"no stretch of {SEGMENT_SETTINGS.shortest} samples without a jump in {len(readings)} samples",
            remedy="take a longer span, or a shorter minimum dwell",
        )
    units = find_units(states)
    steps = outboard_steps(readings, segments)
    levels = levels_of(readings, segments, ambient) if ambient is not None else None
    return training_from_steps(segments, states, units, steps, levels)


def training_from_steps(
    segments: Segments, states: States, units: Units, steps: OutboardSteps, levels: Levels | None
) -> Training:
    """Return the training of states and units from outboard steps, which may be some of all.

    The design of states is their occupancy where units are known, else one parameter for each state.
    """
    steady = states.label >= 0
    spent = (segments.end - segments.start)[steady] / SECOND
    seconds = np.bincount(states.label[steady], weights=spent, minlength=len(states)).astype(np.float64)
    reference = int(np.argmax(seconds))
    if not units.consistent:
        units = no_units(states, units.reason)
    shown = len(units)
    unobserved = units.unobserved()
    occupancy = np.concatenate([units.occupancy, unobserved])
    design = occupancy.astype(np.float64) if shown else np.eye(len(states))
    known = levels is not None
    size = np.linalg.norm(units.vector if shown else states.centre - states.centre[reference], axis=1)
    fit = _fit_outboard(states, design[: len(states)], steps, levels, size)
    # Of all states, observed and predicted: with the constant, or relative to the reference.
    of_fit = np.column_stack([design, np.ones(len(design))]) if known else design - design[reference]
    centre, spread = units.centre(unobserved)
    count, new = len(design), len(design) - len(states)
    label = states.label[steady]
    transitions = np.zeros((count, count))
    np.add.at(transitions, (label[:-1], label[1:]), 1.0)
    unit_covariance = np.array([fit.covariance[one, :, one] for one in range(shown)]).reshape(shown, 3, 3)
    return Training(
        number=np.arange(count),
        centre=np.concatenate([states.centre, centre]),
        centre_covariance=np.concatenate([states.covariance, spread]),
        correction=of_fit @ fit.value,
        covariance=np.einsum("sp,piqj,sq->sij", of_fit, fit.covariance, of_fit),
        segments=np.append(states.count, np.zeros(new, dtype=np.int64)),
        seconds=np.append(seconds, np.zeros(new)),
        transitions=transitions,
        occupancy=occupancy,
        unit=units.vector,
        unit_correction=fit.value[:shown],
        unit_covariance=unit_covariance,
        scatter=states.scatter,
        drift=states.drift_end[-1],
        drift_rate=states.drift_rate,
        start=int(segments.start[0]),
        end=int(segments.end[-1]),
        constant_known=known,
        reference=-1 if known else reference,
        excess=fit.excess,
        reason=units.reason,
        design=design,
        value=fit.value[: design.shape[1]],
        joint=fit.covariance[: design.shape[1], :, : design.shape[1]],
        unit_number=np.arange(shown),
        next_number=count,
        next_unit=shown,
        confidence=states.confidence,
    )


def _fit_outboard(
    states: States, design: Floats, steps: OutboardSteps, levels: Levels | None, size: Floats
) -> StrayFit:
    """Fit the units' or states' fields at the outboard sensor, and last the constant where it is known."""
    label = states.label
    rows = design[label[steps.after]] - design[label[steps.before]]
    # A passage from a state to itself has no parameter.
    moved = np.any(rows != 0, axis=1)
    rows, observed, covariance = rows[moved], steps.step[moved], steps.covariance[moved]
    prior = TRAINING_SETTINGS.prior_size * np.maximum(size, 1e-3 * size.max(initial=1e-6))
    if levels is not None:
        rows = np.column_stack([rows, np.zeros(len(rows))])
        own = np.column_stack([design[label[levels.segment]], np.ones(levels.segment.size)])
        rows, observed = np.concatenate([rows, own]), np.concatenate([observed, levels.level])
        covariance = np.concatenate([covariance, levels.covariance])
        prior = np.append(prior, 1e3 * max(float(np.abs(levels.level).max()), 1.0))
    return fit_stray(rows, observed, covariance, prior)


@dataclass(frozen=True)
class OutboardSteps:
    """Steps of the outboard reading from one steady segment to the next.

    Attributes
    ----------
    before, after : ndarray of int64, shape (step,)
        Segments.
    step : ndarray, shape (step, axis)
        nT.
    covariance : ndarray, shape (step, axis, axis)
        Of noise and of what the ambient field does in the meantime, nT^2.
    """

    before: Rows
    after: Rows
    step: Floats
    covariance: Floats


def outboard_steps(readings: Readings, segments: Segments) -> OutboardSteps:
    """Return the outboard steps between neighbouring steady segments.

    The covariance of a step grows with the square of the time between both stretches over that of
    neighbouring ones: for a field smoother than a random walk this is enough, for white noise too much.
    """
    rows = np.flatnonzero(readings.good)
    field = readings.outboard[rows]
    first, last = np.searchsorted(rows, segments.first), np.searchsorted(rows, segments.last)
    noise = step_noise(field, first[1:])
    best = int(np.argmin(np.einsum("sii->s", noise.covariance)))
    steady = np.flatnonzero(~segments.transient)
    before, after = steady[:-1], steady[1:]
    d = readings.difference[rows]
    early = _is_blurred(d[last[before] - 1] - segments.tail.mean[before], segments, before, after)
    late = _is_blurred(d[first[after]] - segments.head.mean[after], segments, before, after)
    first, last = first + late, last - early
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(field - field.mean(axis=0), axis=0)])
    # The longest of the lengths that fits into both segments, up to the best one.
    count = last - first
    fits = np.searchsorted(noise.length, np.minimum(count[before], count[after]), "right")
    scale = np.clip(fits - 1, 0, best)
    width = noise.length[scale]
    step = _mean(sums, first[after], first[after] + width) - _mean(sums, last[before] - width, last[before])
    gap = (segments.start[after] - segments.end[before]) / SECOND
    usual = readings.step / SECOND
    stretch = (1.0 + (np.maximum(gap / usual - 1.0, 0.0) + early + late) / width) ** 2
    variance = np.array(
        [
            _local_variance(sums, first, last, noise, int(k), (int(b), int(a)))
            for k, b, a in zip(scale, before, after, strict=True)
        ]
    )
    covariance = noise.covariance[scale] * (stretch * variance)[:, None, None]
    return OutboardSteps(before, after, step, covariance)


def _is_blurred(beside: Floats, segments: Segments, before: Rows, after: Rows) -> bool:
    """Return whether samples beside jumps are usually on the way from one level to the other.

    Resampled to the other sensor's stamps, a jump takes two samples, and a step of these is half of it.

    Parameters
    ----------
    beside : ndarray, shape (jump, axis)
        Difference in the last sample before each jump, or in the first one after it, less the mean of that
        end of its segment, nT.
    """
    jump = segments.head.mean[after] - segments.tail.mean[before]
    along = np.einsum("ji,ji->j", beside, jump)
    sigma = np.sqrt(np.einsum("ji,ik,jk->j", jump, segments.noise.of_mean(1), jump))
    # The deviation of a median of so many is 1.25 times that of a mean.
    usual = abs(float(np.median(along / sigma))) if len(along) else 0.0
    return usual > TRAINING_SETTINGS.blurred_sigmas * 1.25 / float(np.sqrt(max(len(along), 1)))


def _mean(sums: Floats, first: Rows, last: Rows) -> Floats:
    return np.asarray((sums[last] - sums[first]) / (last - first)[:, None])


def _local_variance(
    sums: Floats, first: Rows, last: Rows, noise: StepNoise, scale: int, pair: tuple[int, int]
) -> float:
    """Return the variance of steps within two segments over the usual one."""
    width = int(noise.length[scale])
    # Those that are nearest to the jump, from both sides.
    at = [last[pair[0]] - width - (width * np.arange(TRAINING_SETTINGS.local_steps)) // 2]
    at.append(first[pair[1]] + width + (width * np.arange(TRAINING_SETTINGS.local_steps)) // 2)
    inside = [
        one[(one - width >= first[own]) & (one + width <= last[own])]
        for one, own in zip(at, pair, strict=True)
    ]
    place = np.concatenate(inside)
    if not place.size:
        return 1.0
    step = (sums[place + width] - 2.0 * sums[place] + sums[place - width]) / width
    square = np.einsum("ti,ij,tj->t", step, np.linalg.inv(noise.covariance[scale]), step) / 3.0
    # Half of the overlapping steps are independent.
    number = 0.5 * place.size
    return float(
        (square.mean() * number + TRAINING_SETTINGS.usual_steps) / (number + TRAINING_SETTINGS.usual_steps)
    )


@dataclass(frozen=True)
class Levels:
    """Stray field and offset of segments where the ambient field is known.

    Attributes
    ----------
    segment : ndarray of int64, shape (level,)
    level : ndarray, shape (level, axis)
        nT.
    covariance : ndarray, shape (level, axis, axis)
        nT^2.
    """

    segment: Rows
    level: Floats
    covariance: Floats


def levels_of(readings: Readings, segments: Segments, ambient: Floats) -> Levels:
    """Return stray field and offset of the segments in which the ambient field is known.

    Raises
    ------
    CalibrationError
        It is nowhere known.
    """
    stray = readings.outboard - ambient
    rows = np.flatnonzero(readings.good & np.isfinite(stray).all(axis=1))
    if not rows.size:
        raise CalibrationError("the ambient field is nowhere known", remedy="leave it out, or give it")
    first, last = np.searchsorted(rows, segments.first), np.searchsorted(rows, segments.last)
    noise = step_noise(stray[rows], first[1:])
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(stray[rows], axis=0)])
    count = last - first
    own = np.flatnonzero(~segments.transient & (count > 0))
    level = (sums[last[own]] - sums[first[own]]) / count[own, None]
    return Levels(own, level, noise.of_mean(count[own]))


@dataclass(frozen=True)
class StrayFit:
    """Weighted least squares of stray fields at the outboard sensor.

    Attributes
    ----------
    value : ndarray, shape (parameter, axis)
        nT.
    covariance : ndarray, shape (parameter, axis, parameter, axis)
        nT^2.
    excess : float
        Scatter of the rows over what they state, in sigmas; the covariance is widened by it where above 1.
    """

    value: Floats
    covariance: Floats
    excess: float


def fit_stray(design: Floats, observed: Floats, covariance: Floats, prior: Floats) -> StrayFit:
    """Fit stray fields to steps and levels, robustly.

    Parameters
    ----------
    design : ndarray, shape (row, parameter)
        Same for all three axes.
    observed : ndarray, shape (row, axis)
        nT.
    covariance : ndarray, shape (row, axis, axis)
        nT^2.
    prior : ndarray, shape (parameter,)
        Standard deviation of each parameter about zero, nT: where nothing is measured.
    """
    width = design.shape[1]
    inverse = np.linalg.inv(covariance)
    ridge = np.diag(np.repeat(1.0 / prior**2, 3))
    weight = np.ones(len(observed))
    freedom = max(3 * (len(observed) - width), 1)
    for _ in range(TRAINING_SETTINGS.rounds):
        weighted = weight[:, None, None] * inverse
        normal = np.einsum("rp,rij,rq->piqj", design, weighted, design).reshape(3 * width, 3 * width)
        right = np.einsum("rp,rij,rj->pi", design, weighted, observed).ravel()
        total = np.linalg.pinv(normal + ridge, hermitian=True)
        value = (total @ right).reshape(width, 3)
        residual = observed - design @ value
        distance = np.einsum("ri,rij,rj->r", residual, inverse, residual)
        weight = np.minimum(1.0, TRAINING_SETTINGS.huber_limit / np.sqrt(np.maximum(distance, 1e-300)))
    excess = float(np.sqrt(np.sum(weight * distance) / freedom)) if len(observed) > width else 1.0
    # The prior's share is not noise, and does not grow with it.
    widened = total * max(1.0, excess) ** 2
    return StrayFit(value, widened.reshape(width, 3, width, 3), excess)


def relative_to(training: Training, reference: int) -> Training:
    """Return a training whose corrections are relative to the state of a number.

    The covariances are those of the differences: what is common to both states is in neither.
    """
    row = int(np.flatnonzero(training.number == reference)[0])
    away = training.design - training.design[row]
    covariance = np.einsum("sp,piqj,sq->sij", away, training.joint, away)
    return replace(
        training,
        correction=away @ training.value,
        covariance=covariance,
        reference=reference,
        constant_known=False,
        carried=False,
    )


def empty_training(readings: Readings, reason: str) -> Training:
    """Return the training of readings that show no states worth the name, and why."""
    nothing, none = np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    return Training(
        number=none,
        centre=nothing,
        centre_covariance=np.zeros((0, 3, 3)),
        correction=nothing,
        covariance=np.zeros((0, 3, 3)),
        segments=none,
        seconds=np.zeros(0),
        transitions=np.zeros((0, 0)),
        occupancy=np.zeros((0, 0), dtype=np.int64),
        unit=nothing,
        unit_correction=nothing,
        unit_covariance=np.zeros((0, 3, 3)),
        scatter=0.0,
        drift=np.zeros(3),
        drift_rate=DriftRate(np.zeros(3), np.zeros(3), np.zeros(3)),
        start=int(readings.stamps[0]),
        end=int(readings.stamps[-1]),
        constant_known=False,
        reference=-1,
        excess=1.0,
        reason=reason,
        design=np.zeros((0, 0)),
        value=nothing,
        joint=np.zeros((0, 3, 0, 3)),
        unit_number=none,
        next_number=0,
        next_unit=0,
    )
