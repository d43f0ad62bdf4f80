r"""The methods of the zero level, one call each: ``method(intervals, used, search) -> Estimate``.

Takes: `Intervals`, which of them are of the method's kind, and an `OffsetSearch`. Makes: `Estimate`. The
table `METHODS` names every method, the intervals that suit it, and whether `inflight.zero_level.combination`
uses it. B is a reading, O the offset, :math:`\bar B` the mean of an interval.

**Kinds** (`classify_intervals`): Alfvenic intervals, in which the field turns; compressional ones, in which
its size varies; and neither. The parts of the variance are those of the field less the present offset; a
wrong offset makes rotation look like compression, so the kinds are found anew after each estimate.

**Davis-Smith** (Davis and Smith 1968; `davis_smith`, `davis_smith_as_published`): the offset that makes the
square of the field vary least. Over an interval :math:`\mathrm{var}(B^2 - 2 B \cdot O)` is least where
:math:`A O = b`, :math:`A = \mathrm{cov}(B, B)`, :math:`b = \mathrm{cov}(B, B^2)/2`; intervals are added, each
less its own mean, so that slow compressions between intervals do not enter. The same equations hold in a
turning frame. White noise adds its variance to A and that times the mean field to b: both are taken off when
the noise is stated. (Estimated from the readings it would hold turbulence, and taking that off biases by more
than the noise does.) Compressions of variance C along the mean field add :math:`C \bar B` to b: the published
method is biased by ``inverse(A) sum(C (mean(B) - O))``, which is why Leinweber et al. (2008) search for pure
rotations. C is known from the corrected field, so the bias is taken off: ``(A - C) O = b - C mean(B)``. That
is minimum correlation over whole intervals, and as blind where compression equals rotation.

**Wang-Pan** (Wang and Pan 2021; `wang_pan`): the tip of a field of constant size moves on a sphere, in one
interval nearly on an arc; any centre on the axis u of the arc explains it. u is the direction of least
variance; across it the best centre solves ``A O = b``. The offset is where the lines of intervals meet:
:math:`\sum w P_u (b - A O) = 0`. A line's weight is how well it keeps the size constant,
``samples / var(B^2/2)``; drifts of the size within an interval are taken off first.

**Mirror mode** (Plaschke and Narita 2016; in 3-D Plaschke et al. 2017; `mirror_mode`): compressions lie along
the field; the cross product of the direction D of most variance and :math:`\bar B - O` is zero. With n the
direction of the corrected mean field the equations are :math:`\sum P_n D (n \cdot D) / |\bar B - O| = 0`:
errors of D enter once and do not bias the offset along the field, as they would with :math:`P_D`. Errors of n
do, by at most ``sum(angle^2 n / |B|)`` over the slopes: the field may turn within an interval. That enters
the covariance.

**Minimum correlation** (Hedgecock 1975; `minimum_correlation`, all axes at once): changes of the field's size
are not correlated with those of its direction n. For successive averages a correction c changes
:math:`dB \to dB + c \cdot dn` and :math:`dn \to dn - P c\, dB/B^2`, P across n:

.. math:: \sum dB\,dn = M c, \quad M = \sum (dn\,dn^T - P\, dB^2/B^2),

which along one axis at the angle :math:`\theta` is
:math:`\mathrm{cov}(dB, d\theta) \sim c \sin\theta\, (\langle dB^2\rangle/B^2 - \langle d\theta^2\rangle)`
(up to its sign). **It is blind where compression equals rotation**: M is zero there. White noise adds as much
to either part and drops out. The offset along the mean direction has least information.

**Hedgecock** (Hedgecock 1975, the tests on IMP-8 and Helios; `hedgecock`, `axis_in_turn`): the same, one axis
after the other. :math:`V(c) = \mathrm{cov}(dB, d\theta)` as a function of a correction c along one axis,
theta the angle
*from* that axis (not a latitude); its zero is the correction. Pairs with both angles between 30 and
150 degrees are used, the same ones while c varies. V also vanishes at large c: c is bounded, and the zero
nearest to the present correction is taken. It creeps where the direction varies little; the joint form does
not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.lsq import biweight, biweight_slope, robust_sigma
from inflight.time import Int64
from inflight.zero_level.estimate import (
    SOLVER_SETTINGS,
    Estimate,
    OffsetSearch,
    best_estimate,
    estimate_from_scores,
    inverse_of_true_slopes,
    invert_slopes,
    solve,
)
from inflight.zero_level.intervals import INTERVAL_SETTINGS, Bools, Intervals
from inflight.zero_level.loops import neighbour_sums

DAVIS_SMITH, WANG_PAN, MIRROR_MODE = "davis-smith", "wang-pan", "mirror mode"

MINIMUM_CORRELATION, HEDGECOCK = "minimum correlation", "hedgecock"


@dataclass(frozen=True, kw_only=True)
class KindSettings:
    """Limits of the kinds of intervals. They decide which intervals a method gets, not its errors.

    Attributes
    ----------
    alfvenic : float
        Alfvenic intervals have less than this part of their variance in the size of the field. Assumed.
    compressional : float
        Compressional ones have more. Derived: twice the third that compression has when all directions are
        alike.
    elongated : float
        The direction of most variance is known when it has this many times the variance of the next. Assumed.
    """

    alfvenic: float = 0.10
    compressional: float = 2.0 / 3.0
    elongated: float = 2.0


KIND_SETTINGS = KindSettings()


@dataclass(frozen=True, kw_only=True)
class IntervalKinds:
    """The kind of fluctuations in each interval; all (interval,).

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
        """Return how many there are of each kind, in words."""
        counts = [int(part.sum()) for part in (self.alfvenic, self.compressional, self.neither)]
        return f"{counts[0]} Alfvenic, {counts[1]} compressional, {counts[2]} neither"


def classify_intervals(intervals: Intervals, offset: Floats) -> IntervalKinds:
    """Return which intervals are Alfvenic and which compressional.

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
    above_noise = intervals.above_noise
    elongated = own[:, 2] > KIND_SETTINGS.elongated * own[:, 1]
    return IntervalKinds(
        compression=part,
        rotation=rotation,
        alfvenic=above_noise & (part < KIND_SETTINGS.alfvenic),
        compressional=above_noise & elongated & (part > KIND_SETTINGS.compressional),
        start=intervals.start,
        end=intervals.end,
    )


def least_variance_equations(intervals: Intervals) -> tuple[Floats, Floats]:
    """Return A (interval, 3, 3), nT^2, and b (interval, 3), nT^3, of Davis-Smith, without white noise."""
    delta, count = intervals.fluctuation, intervals.count
    square = np.nan_to_num(0.5 * np.sum(intervals.field**2, axis=2))
    b = np.einsum("ksi,ks->ki", delta, square) / count[:, None]
    noise = intervals.white**2
    return intervals.covariance - noise * np.eye(3), b - noise * intervals.mean


def compression(intervals: Intervals, offset: Floats) -> Floats:
    """Return the variance of |B - O| in each interval; (interval,), nT^2."""
    return _variance(np.linalg.norm(intervals.field - offset, axis=2), intervals.count)


def _variance(values: Floats, count: Floats) -> Floats:
    """Return the variance of values (interval, sample), NaN where missing, in each interval; (interval,)."""
    mean = np.nansum(values, axis=1) / count
    return np.asarray(np.nansum((values - mean[:, None]) ** 2, axis=1) / count)


def davis_smith(
    intervals: Intervals, used: Bools | None = None, search: OffsetSearch | None = None
) -> Estimate:
    """Estimate the offset by Davis-Smith, with the bias of compressions taken off.

    Parameters
    ----------
    intervals : Intervals
    used : ndarray of bool, shape (interval,), optional
        Alfvenic intervals (`classify_intervals`); all when absent.
    search : OffsetSearch, optional

    Raises
    ------
    CalibrationError
        Too few intervals.
    """
    search = search or OffsetSearch()
    mask = search.select_intervals(DAVIS_SMITH, intervals, used)
    a, b = least_variance_equations(intervals)
    weight = intervals.count[:, None]

    def equations(offset: Floats) -> tuple[Floats, Floats]:
        residual, slope = b - a @ offset, a
        squeezed = np.maximum(compression(intervals, offset) - intervals.white**2, 0.0)
        residual = residual - squeezed[:, None] * (intervals.mean - offset)
        slope = slope - squeezed[:, None, None] * np.eye(3)
        return weight * residual, weight[..., None] * slope

    part = intervals.select(mask)
    each = [
        solve(DAVIS_SMITH, equations, intervals, mask, search, first=first, signed=True)
        for first in search.starts(least_variance_offset(part, search))
    ]
    # The offset under which the size of the field varies least.
    return best_estimate(each, lambda one: -float(np.sum(compression(part, one.solution) * part.count)))


def davis_smith_as_published(
    intervals: Intervals, used: Bools | None = None, search: OffsetSearch | None = None
) -> Estimate:
    """Estimate the offset by Davis-Smith as published; the bias of compressions enters the covariance.

    Linear in the offset, so that readings in turning axes are allowed. Parameters and errors as for
    `davis_smith`.
    """
    search = search or OffsetSearch()
    mask = search.select_intervals(DAVIS_SMITH, intervals, used)
    a, b = least_variance_equations(intervals)
    weight = intervals.count[:, None]

    def equations(offset: Floats) -> tuple[Floats, Floats]:
        return weight * (b - a @ offset), weight[..., None] * a

    found = solve(DAVIS_SMITH, equations, intervals, mask, search, turning=True)
    return found.with_systematic(compression_bias(intervals, found, search), "compressions")


def least_variance_offset(intervals: Intervals, search: OffsetSearch) -> Floats:
    """Return the offset of least variance of the square of all intervals, in closed form; (3,), nT."""
    a, b = least_variance_equations(intervals)
    start, weight = np.asarray(search.start), intervals.count[:, None]
    inverse, _ = invert_slopes(weight[..., None] * a, np.asarray(search.free), 0.0)
    return np.asarray(start + inverse @ np.sum(weight * (b - a @ start), axis=0))


def compression_bias(intervals: Intervals, found: Estimate, search: OffsetSearch) -> Floats:
    """Return the bias of a Davis-Smith offset as published by compressions along the mean field; (3,), nT."""
    part = intervals.select(found.used)
    rest = np.maximum(compression(part, found.solution) - part.white**2, 0.0)
    slopes = part.count[:, None, None] * least_variance_equations(part)[0]
    inverse, _ = invert_slopes(slopes, np.asarray(search.free), 0.0)
    weight = (part.count * rest)[:, None]
    return np.asarray(inverse @ np.sum(weight * (part.mean - found.solution), axis=0))


def compression_over_rotation(intervals: Intervals, offset: Floats) -> Floats:
    """Return compression over rotation, ``<dB^2/B^2> / (<dn^2>/2)``, of all pairs: blind at 1."""
    _, rotation, squeezed, _ = _neighbour_sums(intervals, offset)
    return np.asarray(squeezed.sum() / max(0.5 * float(np.einsum("kii->", rotation)), 1e-300))


def _neighbour_sums(intervals: Intervals, offset: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return `neighbour_sums` under an offset (3,), or (interval, 3) when each interval has its own."""
    each = np.array(np.broadcast_to(offset, (len(intervals), 3)), dtype=np.float64)
    return neighbour_sums(np.ascontiguousarray(intervals.field), intervals.neighbours, each)


def minimum_correlation(
    intervals: Intervals, used: Bools | None = None, search: OffsetSearch | None = None
) -> Estimate:
    """Estimate the offset along all axes at once from uncorrelated changes of size and direction.

    M may be negative: where compression outweighs rotation the offset is determined as well as by rotation
    alone, but intervals of both kinds together cancel; give them separately.

    Parameters
    ----------
    intervals : Intervals
        Of averages over whole spins and whole samples.
    used : ndarray of bool, shape (interval,), optional
        Any kind of interval may take part.
    search : OffsetSearch, optional

    Raises
    ------
    CalibrationError
        Too few intervals.
    """
    search = search or OffsetSearch()
    mask = search.select_intervals(MINIMUM_CORRELATION, intervals, used, above_noise=False)  # noise drops out

    def equations(offset: Floats) -> tuple[Floats, Floats]:
        return joint_equations(intervals, offset)

    part = intervals.select(mask)
    # Correlations vanish far out and within the readings, too: of several zeros that is taken at which
    # compression and rotation differ most.
    found = best_estimate(
        [
            solve(MINIMUM_CORRELATION, equations, intervals, mask, search, first=first, signed=True)
            for first in search.starts(least_variance_offset(part, search))
        ],
        lambda one: abs(float(np.log(compression_over_rotation(part, one.solution)))),
    )
    ratio = float(compression_over_rotation(part, found.solution))
    why = f"compression over rotation is {ratio:.2f}"
    if not found.determined[np.asarray(search.free)].all():
        why += "; the method is blind where it is 1"
    return found.with_reasons(why)


def joint_equations(intervals: Intervals, offset: Floats) -> tuple[Floats, Floats]:
    """Return ``sum dB dn`` (interval, 3) and M (interval, 3, 3) of the pairs of each interval."""
    both, rotation, squeezed, along = _neighbour_sums(intervals, offset)
    return both, rotation - (squeezed[:, None, None] * np.eye(3) - along)


def wang_pan(intervals: Intervals, used: Bools | None = None, search: OffsetSearch | None = None) -> Estimate:
    """Estimate the offset as the meeting point of the intervals' lines.

    Parameters
    ----------
    intervals : Intervals
    used : ndarray of bool, shape (interval,), optional
        Alfvenic intervals; all when absent.
    search : OffsetSearch, optional

    Raises
    ------
    CalibrationError
        Too few intervals.
    """
    search = search or OffsetSearch()
    mask = search.select_intervals(WANG_PAN, intervals, used)
    a, b = least_variance_equations(intervals)
    # The projector across the direction of least variance, along which the intervals' lines lie.
    least = np.linalg.eigh(intervals.covariance)[1][:, :, 0]
    across = np.eye(3) - least[:, :, None] * least[:, None, :]
    slope = across @ a @ across

    def parts(offset: Floats) -> tuple[Floats, Floats]:
        squeezed = np.maximum(compression(intervals, offset) - intervals.white**2, 0.0)
        residual = b - a @ offset - squeezed[:, None] * (intervals.mean - offset)
        variance = _variance(0.5 * np.sum((intervals.field - offset) ** 2, axis=2), intervals.count)
        # No line is known much better than usual: the small variance of some intervals is chance.
        return residual, intervals.count / (variance + np.median(variance[mask]))

    def equations(offset: Floats) -> tuple[Floats, Floats]:
        residual, weight = parts(offset)
        return weight[:, None] * np.einsum("kij,kj->ki", across, residual), weight[:, None, None] * slope

    def true_slopes(offset: Floats) -> Floats:
        residual, weight = parts(offset)
        residual = np.einsum("kij,kj->ki", across, residual)
        follow = (
            (2.0 * weight**2 / intervals.count)[:, None, None] * residual[:, :, None] * residual[:, None, :]
        )
        return np.asarray(weight[:, None, None] * slope - follow)

    found = solve(
        WANG_PAN, equations, intervals, mask, search, true_slopes, first=search.starts(np.zeros(3))[0]
    )
    residual, weight = parts(found.solution)
    along = weight[:, None] * np.einsum("kij,kj->ki", np.eye(3) - across, residual)
    inverse, _ = invert_slopes(equations(found.solution)[1][mask], np.asarray(search.free), 0.0)
    inverse = inverse_of_true_slopes(inverse, true_slopes(found.solution)[mask].sum(axis=0))
    return found.with_systematic(inverse @ along[mask].sum(axis=0), "errors of the lines' directions")


def mirror_mode(
    intervals: Intervals, used: Bools | None = None, search: OffsetSearch | None = None
) -> Estimate:
    """Estimate the offset from the direction of most variance.

    Parameters
    ----------
    intervals : Intervals
    used : ndarray of bool, shape (interval,), optional
        Compressional intervals (`classify_intervals`); all when absent.
    search : OffsetSearch, optional

    Raises
    ------
    CalibrationError
        Too few intervals.
    """
    search = search or OffsetSearch()
    mask = search.select_intervals(MIRROR_MODE, intervals, used)
    direction, mean = np.linalg.eigh(intervals.covariance)[1][:, :, 2], intervals.mean

    def tilts(offset: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        field = mean - offset
        size = np.maximum(np.linalg.norm(field, axis=1), 1e-6)
        unit = field / size[:, None]
        cosine = np.sum(direction * unit, axis=1)
        deviation = direction * np.sign(cosine)[:, None] - unit * np.abs(cosine)[:, None]
        angle = np.linalg.norm(deviation, axis=1)
        # The angles are two-dimensional; their usual size is that of the intervals used.
        scaled = angle / robust_sigma(angle[mask], floor=1e-6)
        across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
        return deviation, scaled, size, np.abs(cosine), across

    def equations(offset: Floats) -> tuple[Floats, Floats]:
        deviation, scaled, size, cosine, across = tilts(offset)
        weight = biweight(scaled)
        # A mean reading that is too large turns away from D: the offset is what it is too large by.
        return -(weight / size)[:, None] * deviation, (weight * cosine / size**2)[:, None, None] * across

    def true_slopes(offset: Floats) -> Floats:
        deviation, scaled, size, cosine, across = tilts(offset)
        along = deviation / np.maximum(np.linalg.norm(deviation, axis=1), 1e-300)[:, None]
        radial = along[:, :, None] * along[:, None, :]
        # Across the deviation the influence keeps its weight, along it the weight changes.
        change = (biweight_slope(scaled) - biweight(scaled))[:, None, None] * radial
        return np.asarray(
            (cosine / size**2)[:, None, None] * (biweight(scaled)[:, None, None] * across + change)
        )

    found = solve(
        MIRROR_MODE, equations, intervals, mask, search, true_slopes, first=search.starts(np.zeros(3))[0]
    )
    deviation, scaled, size, _, _ = tilts(found.solution)
    square = np.sum(deviation**2, axis=1) * biweight(scaled) / size**2
    inverse, _ = invert_slopes(equations(found.solution)[1][mask], np.asarray(search.free), 0.0)
    inverse = inverse_of_true_slopes(inverse, true_slopes(found.solution)[mask].sum(axis=0))
    most = inverse @ np.sum((square[:, None] * (mean - found.solution))[mask], axis=0)
    return found.with_systematic(most / np.sqrt(3.0), "turning of the mean field within intervals")


@dataclass(frozen=True, kw_only=True)
class HedgecockSettings:
    """Numbers of the method one axis after the other.

    Attributes
    ----------
    nearest, farthest : float
        Angles from the axis between which both points of a pair must lie, degrees: those of the report.
    points : int
        Points of V(c) between the bounds, and again around its zero. Assumed.
    settled : float
        A round that moves less than this ends it, nT. Assumed.
    rounds : int
        Most rounds: the ten of the report.
    step : float
        Step of the derivatives for the covariance, nT. Derived: its error is of second order.
    """

    nearest: float = 30.0
    farthest: float = 150.0
    points: int = 41
    settled: float = 1e-3
    rounds: int = 10
    step: float = 1e-3


HEDGECOCK_SETTINGS = HedgecockSettings()


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
    inside = (angle > HEDGECOCK_SETTINGS.nearest) & (angle < HEDGECOCK_SETTINGS.farthest)
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
    rounds: int = HEDGECOCK_SETTINGS.rounds,
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
            if pairs.sum() < INTERVAL_SETTINGS.fewest_samples:
                raise CalibrationError(
                    f"{int(pairs.sum())} pairs 30 to 150 degrees from axis {axis}, "
                    f"{INTERVAL_SETTINGS.fewest_samples} needed",
                    remedy="take a longer span, or another axis",
                )
            step, crossings[axis] = _nearest_zero(field - offset, axis, pairs, bound)
            # The other axes go on with the correction that this one has so far.
            lacking[axis] = not np.isfinite(step)
            offset[axis] += 0.0 if lacking[axis] else step
        history.append(np.where(lacking, np.nan, offset))
        if np.abs(offset - before).max() < HEDGECOCK_SETTINGS.settled:
            settled = not lacking.any()
            break
    return AxisInTurn(history[-1], np.array(history), settled, crossings, used)


def _nearest_zero(field: Floats, axis: int, pairs: Bools, bound: float) -> tuple[float, int]:
    """Return the zero of V nearest to 0 and how many there are within the bound."""
    grid = np.linspace(-bound, bound, HEDGECOCK_SETTINGS.points)
    v = size_angle_covariance(field, axis, grid, pairs)
    where = np.flatnonzero(np.sign(v[1:]) * np.sign(v[:-1]) <= 0)
    if not where.size:
        return float("nan"), 0
    place = where[np.argmin(np.abs(grid[where]))]
    low, high = grid[place], grid[place + 1]
    fine = np.linspace(low, high, HEDGECOCK_SETTINGS.points)
    v = size_angle_covariance(field, axis, fine, pairs)
    at = int(np.flatnonzero(np.sign(v[1:]) * np.sign(v[:-1]) <= 0)[0])
    share = v[at] / (v[at] - v[at + 1]) if v[at] != v[at + 1] else 0.0
    return float(fine[at] + share * (fine[at + 1] - fine[at])), int(where.size)


def hedgecock(
    intervals: Intervals, used: Bools | None = None, search: OffsetSearch | None = None
) -> Estimate:
    """Estimate the offset one axis after the other, as the tests on IMP-8 and Helios did it.

    The covariance is that of the joint equations ``V = 0`` of the free axes at the solution, each with its
    own pairs.

    Parameters
    ----------
    intervals : Intervals
        Of averages over whole spins and whole samples.
    used : ndarray of bool, shape (interval,), optional
        Any kind of interval may take part.
    search : OffsetSearch, optional

    Raises
    ------
    CalibrationError
        Too few intervals, or too few pairs 30 to 150 degrees from an axis.
    """
    search = search or OffsetSearch()
    mask = search.select_intervals(HEDGECOCK, intervals, used, above_noise=False)  # noise drops out
    free, part = np.asarray(search.free), intervals.select(mask)
    axes = tuple(int(axis) for axis in np.flatnonzero(free))
    ends = np.zeros((len(part), 1), dtype=bool)
    joined = np.concatenate([part.neighbours, ends], axis=1).ravel()[:-1]
    start = search.starts(np.zeros(3))[0]
    readings = part.field.reshape(-1, 3) - start
    found = axis_in_turn(readings, joined, bound=search.bound, axes=axes)
    offset = np.where(free, start + np.nan_to_num(found.value), start)
    pairs = {axis: pairs_within(readings - (offset - start), axis, joined) for axis in axes}

    def scores(at: Floats) -> Floats:
        """Return each interval's part of V along the free axes, nT rad; (interval, 3)."""
        out = np.zeros((len(part), 3))
        field = part.field.reshape(-1, 3) - at
        change = np.diff(np.linalg.norm(field, axis=1))
        for axis, chosen in pairs.items():
            turn = np.diff(angles_from(field, axis))
            own = np.where(chosen, (change - change[chosen].mean()) * (turn - turn[chosen].mean()), 0.0)
            out[:, axis] = np.append(own, 0.0).reshape(len(part), -1).sum(axis=1)
        return out

    step = HEDGECOCK_SETTINGS.step
    slopes = np.stack(
        [(scores(offset - step * axis) - scores(offset + step * axis)) / (2.0 * step) for axis in np.eye(3)],
        axis=2,
    )
    whole, slope = np.zeros((len(intervals), 3)), np.zeros((len(intervals), 3, 3))
    whole[mask], slope[mask] = scores(offset), slopes
    inverse, known = invert_slopes(slopes, free, SOLVER_SETTINGS.determined)
    reasons = []
    if not found.settled or np.any(np.abs(offset - np.asarray(search.start)) >= search.bound):
        reasons.append(
            f"no zero within {search.bound:g} nT of the start that {len(found.history)} rounds settle to"
        )
    if part.encloses(offset, search.turning):
        reasons.append("the zero found lies within the readings themselves")
    known = np.zeros((3, 3)) if reasons else known
    return estimate_from_scores(
        HEDGECOCK, offset, (whole, slope, inverse, known), intervals, mask, search, tuple(reasons)
    )


def zero_of_minimum_correlation(intervals: Intervals, search: OffsetSearch) -> Floats:
    """Return the zero of minimum correlation of a short record and its error, without further tests; (2, 3).

    The errors are those of the intervals' scores, taken as independent. NaN where there is no zero within the
    bound. Of several zeros that is taken at which compression and rotation differ most.
    """
    free, found = np.asarray(search.free), list[Floats]()
    for first in search.starts(least_variance_offset(intervals, search)):
        offset, settled = first, False
        for _ in range(SOLVER_SETTINGS.rounds):
            scores, slopes = joint_equations(intervals, offset)
            # A set of little information has a large error, and shows in the scatter of the sets.
            inverse, _ = invert_slopes(slopes, free, 0.0)
            step = inverse @ scores.sum(axis=0)
            step = step * min(
                1.0, SOLVER_SETTINGS.stride * search.bound / max(float(np.abs(step).max()), 1e-300)
            )
            offset = offset + step
            settled = bool(np.abs(step).max() < SOLVER_SETTINGS.settled)
            if settled or np.abs(offset).max() >= search.bound:
                break
        if settled and np.abs(offset).max() < search.bound and not intervals.encloses(offset, search.turning):
            influence = scores @ inverse.T
            found.append(np.stack([offset, np.sqrt(np.sum(influence**2, axis=0)) + 1e-9]))
    if not found:
        return np.full((2, 3), np.nan)
    return max(found, key=lambda one: abs(float(np.log(compression_over_rotation(intervals, one[0])))))


Estimator = Callable[[Intervals, Bools | None, OffsetSearch | None], Estimate]


@dataclass(frozen=True, kw_only=True)
class Method:
    """A method of the zero level.

    Attributes
    ----------
    name : str
        As `Estimate.method` has it.
    estimate : callable
        ``estimate(intervals, used, search) -> Estimate``.
    suits : callable
        From `IntervalKinds` to the intervals it may use, (interval,).
    combined : bool
        Whether `inflight.zero_level.combine_methods` uses it.
    """

    name: str
    estimate: Estimator
    suits: Callable[[IntervalKinds], Bools]
    combined: bool = True


#: Every method by name.
METHODS: Mapping[str, Method] = MappingProxyType(
    {
        one.name: one
        for one in (
            Method(name=DAVIS_SMITH, estimate=davis_smith, suits=lambda kinds: kinds.alfvenic),
            Method(name=WANG_PAN, estimate=wang_pan, suits=lambda kinds: kinds.alfvenic),
            Method(name=MIRROR_MODE, estimate=mirror_mode, suits=lambda kinds: kinds.compressional),
            # Compressional and Alfvenic intervals together would cancel.
            Method(
                name=MINIMUM_CORRELATION,
                estimate=minimum_correlation,
                suits=lambda kinds: ~kinds.compressional,
            ),
            Method(
                name=HEDGECOCK, estimate=hedgecock, suits=lambda kinds: ~kinds.compressional, combined=False
            ),
        )
    }
)

#: Names of the methods that are combined, in order.
COMBINED_METHODS = tuple(name for name, one in METHODS.items() if one.combined)
