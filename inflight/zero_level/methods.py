r"""Davis-Smith, Hedgecock, Wang-Pan, mirror mode.

Davis and Smith (1968): the offset that makes the square of the field vary least.

With readings B and offset O the square is :math:`|B - O|^2 = B^2 - 2 B \cdot O + O^2`. Over an interval
:math:`\mathrm{var}(B^2 - 2 B \cdot O)` is least where :math:`A O = b`, :math:`A = \mathrm{cov}(B, B)`,
:math:`b = \mathrm{cov}(B, B^2)/2`; intervals are added, each less its own mean, so that slow compressions
between intervals do not enter. The same equations hold in a turning frame: O is in the sensor's axes.

White noise adds its variance to A and that times the mean field to b, which pulls the offset towards the
mean field: both are taken off when the noise is stated. (Estimated from the readings it would hold
turbulence, and taking that off pulls by more than the noise does.) Compressions of variance C along the
field B_0 add C B_0 to b. The method as published is pulled by ``inverse(A) sum(C B_0)``, whence Leinweber
et al. (2008) search for pure rotations. C is seen in the corrected field, so the pull is taken off here:
``(A - C) O = b - C mean(B)``. That is minimum correlation over whole intervals, and as blind where
compression equals rotation.

Minimum correlation (Hedgecock 1975): changes of the field's size are unrelated to those of its direction.

For successive averages with size B and direction n, an offset c of the reading changes
:math:`dB \to dB + c \cdot dn` and :math:`dn \to dn - P c\, dB/B^2`, P across n. All three directions at once:

.. math:: \sum dB\,dn = M c, \quad M = \sum (dn\,dn^T - P\, dB^2/B^2),

which along one axis at the angle :math:`\theta` is
:math:`\mathrm{cov}(dB, d\theta) \sim c \sin\theta\, (\langle dB^2\rangle/B^2 - \langle d\theta^2\rangle)`
(up to its sign). **It is blind where compression equals rotation**: M is zero there. White noise adds as
much to either part and drops out. The offset along the mean direction has least information, because n
hardly moves along itself.

Wang and Pan (2021): every Alfvenic interval has a line of offsets that keep the field's size constant.

The tip of a field of constant size moves on a sphere, in one interval nearly on an arc: any centre on the
axis of the arc explains it. The axis is the direction of least variance u; across it the best centre
solves ``A O = b`` (`inflight.zero_level.methods`). The offset is where the lines of intervals with
different u meet: :math:`\sum w P_u (b - A O) = 0`. A line's weight is how well it keeps the size constant,
``samples / var(B^2/2)``, so a compressed interval has little say; drifts of the size within an interval
are taken off first.

Mirror modes (Plaschke and Narita 2016; in 3-D Plaschke et al. 2017): compressions lie along the field.

In a mirror mode the direction D of most variance is that of the mean field: the cross product of D and
:math:`\bar B - O` is zero. One interval tells the offset across D; intervals with different D tell all of
it: O_z = mean B_z less the mean in the spin plane times the tangent of D's elevation is
what is left when x and y are known. With b the direction of the corrected mean field the equations are
:math:`\sum P_b D (b \cdot D) / |\bar B - O| = 0`: errors of D enter once, and do not pull the offset along
the field as they would when P_D stood there. Errors of b do, by at most ``sum(angle^2 b / |B|)`` over the
slopes: the field may turn within an interval. That enters the covariance; longer intervals lessen it.

Minimum correlation one axis after the other, as Hedgecock (1975) and the tests on IMP-8 and Helios did it.

V(c) = cov(dB, dtheta) of successive averages as a function of a correction c along one axis, theta the angle
*from* that axis; its zero is the correction. Pairs with both angles between 30 and 150 degrees are used, the
same ones while c varies. V also vanishes at large c: c is bounded, and the zero nearest to the present
correction is taken. Taking the axes in turn creeps when the direction varies little: the joint form
(`inflight.zero_level.methods`) does not.

Which intervals are Alfvenic (the field turns), which compressional (its size varies), and which neither.

The parts of the variance are those of the field less the present offset; a wrong offset makes turning
look like compression. The kinds are therefore found anew after each estimate until they stay
(`inflight.zero_level.combination`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.lsq import biweight, biweight_slope, robust_sigma
from inflight.time import Int64
from inflight.zero_level.estimate import (
    Estimate,
    Question,
    best_estimate,
    inverse_of_true_slopes,
    invert_slopes,
    solve,
)
from inflight.zero_level.intervals import FEWEST_SAMPLES, Bools, Intervals

DAVIS_SMITH = "davis-smith"


def least_variance_equations(intervals: Intervals) -> tuple[Floats, Floats]:
    """Return A (interval, 3, 3), nT^2, and b (interval, 3), nT^3, without the white noise stated."""
    delta, count = intervals.fluctuation, intervals.count
    square = np.nan_to_num(0.5 * np.sum(intervals.field**2, axis=2))
    b = np.einsum("ksi,ks->ki", delta, square) / count[:, None]
    noise = intervals.white**2
    return intervals.covariance - noise * np.eye(3), b - noise * intervals.mean


def compression(intervals: Intervals, offset: Floats) -> Floats:
    """Return the variance of |B - O| in each interval; (interval,), nT^2."""
    size = np.linalg.norm(intervals.field - offset, axis=2)
    mean = np.nansum(size, axis=1) / intervals.count
    return np.asarray(np.nansum((size - mean[:, None]) ** 2, axis=1) / intervals.count)


def davis_smith(
    intervals: Intervals, used: Bools | None = None, question: Question | None = None, corrected: bool = True
) -> Estimate:
    """Estimate the offset from the least variance of the square of the field.

    Parameters
    ----------
    intervals : Intervals
    used : ndarray of bool, shape (interval,), optional
        Alfvenic intervals (`inflight.zero_level.methods`); all when absent.
    question : Question, optional
    corrected : bool
        Whether the pull of compressions is taken off; else it is told and enters the covariance.

    Returns
    -------
    Estimate

    Raises
    ------
    CalibrationError
        Too few intervals.
    """
    question = question or Question()
    mask = question.select_intervals(DAVIS_SMITH, intervals, used)
    a, b = least_variance_equations(intervals)
    weight = intervals.count[:, None]

    def equations(offset: Floats) -> tuple[Floats, Floats]:
        left, slope = b - a @ offset, a
        if corrected:
            squeezed = np.maximum(compression(intervals, offset) - intervals.white**2, 0.0)
            left = left - squeezed[:, None] * (intervals.mean - offset)
            slope = slope - squeezed[:, None, None] * np.eye(3)
        return weight * left, weight[..., None] * slope

    if not corrected:
        found = solve(DAVIS_SMITH, equations, intervals, mask, question, turning=True)
        return found.with_systematic(compression_pull(intervals, found, question), "compressions")
    part = intervals.where(mask)
    each = [
        solve(DAVIS_SMITH, equations, intervals, mask, question, first=first, signed=True)
        for first in question.starts(least_variance_offset(part, question))
    ]
    # The offset under which the size of the field varies least.
    return best_estimate(each, lambda one: -float(np.sum(compression(part, one.solution) * part.count)))


def least_variance_offset(intervals: Intervals, question: Question) -> Floats:
    """Return the offset of least variance of the square of all intervals, in closed form; (3,), nT."""
    a, b = least_variance_equations(intervals)
    start, weight = np.asarray(question.start), intervals.count[:, None]
    inverse, _ = invert_slopes(weight[..., None] * a, np.asarray(question.free), 0.0)
    return np.asarray(start + inverse @ np.sum(weight * (b - a @ start), axis=0))


def compression_pull(intervals: Intervals, found: Estimate, question: Question) -> Floats:
    """Return what compressions along the mean field do to a Davis-Smith offset; (3,), nT."""
    part = intervals.where(found.used)
    rest = np.maximum(compression(part, found.solution) - part.white**2, 0.0)
    slopes = part.count[:, None, None] * least_variance_equations(part)[0]
    inverse, _ = invert_slopes(slopes, np.asarray(question.free), 0.0)
    weight = (part.count * rest)[:, None]
    return np.asarray(inverse @ np.sum(weight * (part.mean - found.solution), axis=0))


MINIMUM_CORRELATION = "minimum correlation"


def compression_over_rotation(intervals: Intervals, offset: Floats) -> Floats:
    """Return compression over rotation, ``<dB^2/B^2> / (<dn^2>/2)``, of all pairs: blind at 1."""
    change, turn, size, pair = pair_changes(intervals, offset)
    squeezed = np.sum((change / size) ** 2, where=pair)
    return np.asarray(squeezed / max(0.5 * float(np.sum(turn**2, where=pair[..., None])), 1e-300))


def pair_changes(intervals: Intervals, offset: Floats) -> tuple[Floats, Floats, Floats, Bools]:
    """Return dB (interval, pair), dn (interval, pair, 3), B of the pair, and which pairs there are.

    The offset has shape (3,), or (interval, 3) when each interval has its own.
    """
    field = intervals.field - _each(offset)
    size = np.linalg.norm(field, axis=2)
    pair = intervals.neighbours & (size[:, 1:] > 0) & (size[:, :-1] > 0)
    safe = np.where(np.isfinite(size) & (size > 0), size, 1.0)
    unit = np.nan_to_num(field) / safe[..., None]
    change = np.where(pair, np.diff(safe, axis=1), 0.0)
    turn = np.where(pair[..., None], np.diff(unit, axis=1), 0.0)
    return change, turn, np.sqrt(safe[:, 1:] * safe[:, :-1]), pair


def minimum_correlation(
    intervals: Intervals, used: Bools | None = None, question: Question | None = None
) -> Estimate:
    """Estimate the offset along all axes at once from uncorrelated changes of size and direction.

    M may be negative: compression that outweighs rotation tells as well as rotation alone, but intervals
    of both kinds together cancel; give them apart.

    Parameters
    ----------
    intervals : Intervals
        Of averages over whole spins (`inflight.zero_level.published`).
    used : ndarray of bool, shape (interval,), optional
        Any kind of interval may take part.
    question : Question, optional

    Raises
    ------
    CalibrationError
        Too few intervals.
    """
    question = question or Question()
    mask = question.select_intervals(
        MINIMUM_CORRELATION, intervals, used, above_noise=False
    )  # noise drops out

    def equations(offset: Floats) -> tuple[Floats, Floats]:
        return joint_equations(intervals, offset)

    part = intervals.where(mask)
    # Correlations vanish far out and within the readings, too: of several zeros that is taken at which
    # compression and rotation differ most.
    found = best_estimate(
        [
            solve(MINIMUM_CORRELATION, equations, intervals, mask, question, first=first, signed=True)
            for first in question.starts(least_variance_offset(part, question))
        ],
        lambda one: abs(float(np.log(compression_over_rotation(part, one.solution)))),
    )
    ratio = float(compression_over_rotation(part, found.solution))
    told = f"compression over rotation is {ratio:.2f}"
    if not found.determined[np.asarray(question.free)].all():
        told += "; the method is blind where it is 1"
    return found.with_reasons(told)


def joint_equations(intervals: Intervals, offset: Floats) -> tuple[Floats, Floats]:
    """Return ``sum dB dn`` (interval, 3) and M (interval, 3, 3) of the pairs of each interval."""
    change, turn, size, pair = pair_changes(intervals, offset)
    middle = np.nan_to_num(0.5 * (intervals.field[:, 1:] + intervals.field[:, :-1]) - _each(offset))
    unit = middle / np.maximum(np.linalg.norm(middle, axis=2, keepdims=True), 1e-300)
    squeezed = np.where(pair, (change / size) ** 2, 0.0)
    scores = np.einsum("kp,kpi->ki", change, turn)
    rotation = np.einsum("kpi,kpj->kij", turn, turn)
    along = np.einsum("kp,kpi,kpj->kij", squeezed, unit, unit, optimize=True)
    across = squeezed.sum(axis=1)[:, None, None] * np.eye(3) - along
    return scores, rotation - across


def _each(offset: Floats) -> Floats:
    return offset[:, None, :] if offset.ndim == 2 else offset


WANG_PAN = "wang-pan"


def interval_lines(intervals: Intervals) -> tuple[Floats, Floats]:
    """Return the direction (interval, 3) of each line and the projector across it (interval, 3, 3)."""
    _, vectors = np.linalg.eigh(intervals.covariance)
    least = vectors[:, :, 0]
    return least, np.eye(3) - least[:, :, None] * least[:, None, :]


def wang_pan(intervals: Intervals, used: Bools | None = None, question: Question | None = None) -> Estimate:
    """Estimate the offset as the meeting point of the intervals' lines.

    Parameters
    ----------
    intervals : Intervals
    used : ndarray of bool, shape (interval,), optional
        Alfvenic intervals; all when absent.
    question : Question, optional

    Raises
    ------
    CalibrationError
        Too few intervals.
    """
    question = question or Question()
    mask = question.select_intervals(WANG_PAN, intervals, used)
    a, b = least_variance_equations(intervals)
    across = interval_lines(intervals)[1]
    slope = across @ a @ across

    def parts(offset: Floats) -> tuple[Floats, Floats]:
        squeezed = np.maximum(compression(intervals, offset) - intervals.white**2, 0.0)
        left = b - a @ offset - squeezed[:, None] * (intervals.mean - offset)
        unrest = _unrest(intervals, offset)
        # No line is known much better than usual: the little unrest of some intervals is chance.
        return left, intervals.count / (unrest + np.median(unrest[mask]))

    def equations(offset: Floats) -> tuple[Floats, Floats]:
        left, weight = parts(offset)
        return weight[:, None] * np.einsum("kij,kj->ki", across, left), weight[:, None, None] * slope

    def answer(offset: Floats) -> Floats:
        left, weight = parts(offset)
        left = np.einsum("kij,kj->ki", across, left)
        follow = (2.0 * weight**2 / intervals.count)[:, None, None] * left[:, :, None] * left[:, None, :]
        return np.asarray(weight[:, None, None] * slope - follow)

    found = solve(
        WANG_PAN, equations, intervals, mask, question, answer, first=question.starts(np.zeros(3))[0]
    )
    left, weight = parts(found.solution)
    along = weight[:, None] * np.einsum("kij,kj->ki", np.eye(3) - across, left)
    inverse, _ = invert_slopes(equations(found.solution)[1][mask], np.asarray(question.free), 0.0)
    inverse = inverse_of_true_slopes(inverse, answer(found.solution)[mask].sum(axis=0))
    return found.with_systematic(inverse @ along[mask].sum(axis=0), "errors of the lines' directions")


def _unrest(intervals: Intervals, offset: Floats) -> Floats:
    """Return the variance of half the square of the corrected field; (interval,), nT^4."""
    half = 0.5 * np.sum((intervals.field - offset) ** 2, axis=2)
    rest = np.nan_to_num(half - (np.nansum(half, axis=1) / intervals.count)[:, None])
    return np.asarray(np.sum(rest**2, axis=1) / intervals.count)


MIRROR_MODE = "mirror mode"


def direction_of_most_variance(intervals: Intervals) -> Floats:
    """Return the direction of most variance of each interval; (interval, 3)."""
    _, vectors = np.linalg.eigh(intervals.covariance)
    return np.asarray(vectors[:, :, 2])


def mirror_mode(
    intervals: Intervals, used: Bools | None = None, question: Question | None = None
) -> Estimate:
    """Estimate the offset from the direction of most variance.

    Parameters
    ----------
    intervals : Intervals
    used : ndarray of bool, shape (interval,), optional
        Compressional intervals (`inflight.zero_level.methods`); all when absent.
    question : Question, optional

    Raises
    ------
    CalibrationError
        Too few intervals.
    """
    question = question or Question()
    mask = question.select_intervals(MIRROR_MODE, intervals, used)
    direction, mean = direction_of_most_variance(intervals), intervals.mean

    def leaning(offset: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        field = mean - offset
        size = np.maximum(np.linalg.norm(field, axis=1), 1e-6)
        unit = field / size[:, None]
        lean = np.sum(direction * unit, axis=1)
        miss = direction * np.sign(lean)[:, None] - unit * np.abs(lean)[:, None]
        angle = np.linalg.norm(miss, axis=1)
        # The angles are two-dimensional; their usual size is that of what is used.
        pull = angle / robust_sigma(angle[mask], floor=1e-6)
        across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
        return miss, pull, size, np.abs(lean), across

    def equations(offset: Floats) -> tuple[Floats, Floats]:
        miss, pull, size, lean, across = leaning(offset)
        say = biweight(pull)
        # A mean reading that is too large turns away from D: the offset is what it is too large by.
        return -(say / size)[:, None] * miss, (say * lean / size**2)[:, None, None] * across

    def answer(offset: Floats) -> Floats:
        miss, pull, size, lean, across = leaning(offset)
        along = miss / np.maximum(np.linalg.norm(miss, axis=1), 1e-300)[:, None]
        radial = along[:, :, None] * along[:, None, :]
        # Across the miss the influence keeps its weight, along it the weight gives way.
        given = (biweight_slope(pull) - biweight(pull))[:, None, None] * radial
        return np.asarray((lean / size**2)[:, None, None] * (biweight(pull)[:, None, None] * across + given))

    found = solve(
        MIRROR_MODE, equations, intervals, mask, question, answer, first=question.starts(np.zeros(3))[0]
    )
    miss, pull, size, _, _ = leaning(found.solution)
    square = np.sum(miss**2, axis=1) * biweight(pull) / size**2
    inverse, _ = invert_slopes(equations(found.solution)[1][mask], np.asarray(question.free), 0.0)
    inverse = inverse_of_true_slopes(inverse, answer(found.solution)[mask].sum(axis=0))
    most = inverse @ np.sum((square[:, None] * (mean - found.solution))[mask], axis=0)
    return found.with_systematic(most / np.sqrt(3.0), "turning of the mean field within intervals")


#: Angles from the axis, degrees.
NEAREST, FARTHEST = 30.0, 150.0

#: Points of V(c), and a round that moves less than this ends it, nT.
_POINTS, _SETTLED = 41, 1e-3


@dataclass(frozen=True)
class AxisInTurn:
    """Corrections round by round.

    Attributes
    ----------
    value : ndarray, shape (3,)
        Offset, nT; NaN along an axis without a zero.
    history : ndarray, shape (round, 3)
        After each round.
    settled : bool
        The last round moved less than 1e-3 nT, and every axis has a zero.
    crossings : ndarray of int, shape (3,)
        Zeros of V within the bound in the last round; more than one is ambiguous.
    pairs : ndarray of int, shape (3,)
        Pairs used in the last round.
    """

    value: Floats
    history: Floats
    settled: bool
    crossings: np.ndarray
    pairs: np.ndarray


def angles_from(field: Floats, axis: int) -> Floats:
    """Return the angle of the field from an axis, radians; field (..., 3)."""
    other = [one for one in range(3) if one != axis]
    return np.arctan2(np.hypot(field[..., other[0]], field[..., other[1]]), field[..., axis])


def pairs_within(field: Floats, axis: int, joined: Bools) -> Bools:
    """Return pairs (time - 1,) whose both directions are 30 to 150 degrees from an axis."""
    angle = np.degrees(angles_from(field, axis))
    inside = (angle > NEAREST) & (angle < FARTHEST)
    return np.asarray(inside[1:] & inside[:-1] & joined)


def size_angle_covariance(field: Floats, axis: int, corrections: Floats, pairs: Bools) -> Floats:
    """Return V(c) = cov(dB, dtheta), nT rad, for corrections (c,) taken off along an axis.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
    pairs : ndarray of bool, shape (time - 1,)
    """
    first, second = field[:-1][pairs], field[1:][pairs]
    shift = np.zeros((corrections.size, 1, 3))
    shift[:, 0, axis] = corrections
    first, second = first - shift, second - shift
    change = np.linalg.norm(second, axis=2) - np.linalg.norm(first, axis=2)
    turn = angles_from(second, axis) - angles_from(first, axis)
    centred = change - change.mean(axis=1, keepdims=True)
    return np.asarray(np.mean(centred * turn, axis=1))


def axis_in_turn(
    field: Floats,
    joined: Bools | None = None,
    *,
    bound: float = 3.0,
    rounds: int = 10,
    axes: tuple[int, ...] = (0, 1, 2),
) -> AxisInTurn:
    """Find the corrections axis by axis.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        Successive averages, nT; NaN where missing. 1440 of them are usual.
    joined : ndarray of bool, shape (time - 1,), optional
        Pairs without a gap between.
    bound : float
        Largest correction a round may make, nT.
    rounds : int
        At least 1.
    axes : tuple of int

    Raises
    ------
    CalibrationError
        Too few pairs.
    """
    there = np.asarray(np.isfinite(field).all(axis=1))
    pairs_there = there[1:] & there[:-1]
    joined = np.asarray(pairs_there if joined is None else pairs_there & joined)
    offset, history = np.zeros(3), []
    crossings, used = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
    settled, lacking = False, np.zeros(3, dtype=np.bool_)
    for _ in range(rounds):
        before = offset.copy()
        for axis in axes:
            pairs = pairs_within(field - offset, axis, joined)
            used[axis] = pairs.sum()
            if pairs.sum() < FEWEST_SAMPLES:
                raise CalibrationError(
                    f"{int(pairs.sum())} pairs 30 to 150 degrees from axis {axis}, {FEWEST_SAMPLES} needed",
                    remedy="take a longer span, or another axis",
                )
            step, crossings[axis] = _zero(field - offset, axis, pairs, bound)
            # The other axes go on beside the correction that this one has so far.
            lacking[axis] = not np.isfinite(step)
            offset[axis] += 0.0 if lacking[axis] else step
        history.append(np.where(lacking, np.nan, offset))
        if np.abs(offset - before).max() < _SETTLED:
            settled = not lacking.any()
            break
    return AxisInTurn(history[-1], np.array(history), settled, crossings, used)


def _zero(field: Floats, axis: int, pairs: Bools, bound: float) -> tuple[float, int]:
    """Return the zero of V nearest to 0 and how many there are within the bound."""
    grid = np.linspace(-bound, bound, _POINTS)
    v = size_angle_covariance(field, axis, grid, pairs)
    where = np.flatnonzero(np.sign(v[1:]) * np.sign(v[:-1]) <= 0)
    if not where.size:
        return float("nan"), 0
    place = where[np.argmin(np.abs(grid[where]))]
    low, high = grid[place], grid[place + 1]
    fine = np.linspace(low, high, _POINTS)
    v = size_angle_covariance(field, axis, fine, pairs)
    at = int(np.flatnonzero(np.sign(v[1:]) * np.sign(v[:-1]) <= 0)[0])
    share = v[at] / (v[at] - v[at + 1]) if v[at] != v[at + 1] else 0.0
    return float(fine[at] + share * (fine[at + 1] - fine[at])), int(where.size)


#: Of the variance of an interval, compression is a third when all directions are alike. Alfvenic intervals
#: have less than a tenth, compressional ones more than twice the third: limits chosen here. They decide which
#: intervals a method sees; its errors come from what these show.
ALFVENIC, COMPRESSIONAL = 0.10, 2.0 / 3.0

#: The direction of most variance is told from the next when it has this many times its variance.
_ELONGATED = 2.0


@dataclass(frozen=True)
class IntervalKinds:
    """What fluctuates in each interval; all (interval,).

    Attributes
    ----------
    compression : ndarray
        Variance of the size over that of the vector, 0 to 1.
    rotation : ndarray
        Root mean square of the turning over that of the field: radians while it is small.
    alfvenic, compressional : ndarray of bool
    start, end : ndarray of int64
        TT2000.
    """

    compression: Floats
    rotation: Floats
    alfvenic: Bools
    compressional: Bools
    start: Int64
    end: Int64

    @property
    def neither(self) -> Bools:
        """Intervals of no kind."""
        return ~(self.alfvenic | self.compressional)

    def summary(self) -> str:
        """Say how many there are of each kind."""
        counts = [int(part.sum()) for part in (self.alfvenic, self.compressional, self.neither)]
        return f"{counts[0]} Alfvenic, {counts[1]} compressional, {counts[2]} neither"

    def table(self) -> xr.Dataset:
        """Return everything along interval; `value` is the compression, its sigma is not known (NaN)."""
        return xr.Dataset(
            {
                "value": ("interval", self.compression),
                "sigma": ("interval", np.full(self.compression.size, np.nan)),
                "rotation": ("interval", self.rotation, {"units": "rad"}),
                "alfvenic": ("interval", self.alfvenic),
                "compressional": ("interval", self.compressional),
                "start": ("interval", self.start, {"scale": "TT2000"}),
                "end": ("interval", self.end, {"scale": "TT2000"}),
            }
        )


def classify_intervals(intervals: Intervals, offset: Floats) -> IntervalKinds:
    """Tell Alfvenic from compressional intervals.

    Parameters
    ----------
    intervals : Intervals
    offset : ndarray, shape (3,)
        The present offset, nT.
    """
    covariance = intervals.covariance - intervals.white**2 * np.eye(3)
    own = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    total = np.maximum(own.sum(axis=1), 1e-300)
    mean = np.linalg.norm(intervals.mean - offset, axis=1)
    squeezed = np.maximum(compression(intervals, offset) - intervals.white**2, 0.0)
    part = np.minimum(squeezed / total, 1.0)
    rotation = np.sqrt(np.maximum(total - squeezed, 0.0) / (mean**2 + total))
    lively = intervals.above_noise
    elongated = own[:, 2] > _ELONGATED * own[:, 1]
    return IntervalKinds(
        part, rotation, lively & (part < ALFVENIC), lively & elongated & (part > COMPRESSIONAL),
        intervals.start, intervals.end,
    )  # fmt: skip
