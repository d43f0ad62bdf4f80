"""The estimate of an offset, the search it answers, and the solver that all methods share.

Takes: a method's equations, as scores and slopes of every interval (`Equations`). Makes (`solve`,
`estimate_from_scores`): `Estimate`, the offset with its covariance, the axes that are determined, and the
intervals it is from. The offset is where the scores sum to zero; its covariance is the sandwich of the
scores, with their correlation in time. `OffsetSearch` states which axes to estimate, within which bound.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.lsq import long_run_covariance
from inflight.time import Int64
from inflight.zero_level.intervals import AXES, INTERVAL_SETTINGS, Bools, Intervals


@dataclass(frozen=True, kw_only=True)
class SolverSettings:
    """Numbers of the solver and of the covariance.

    Attributes
    ----------
    bound : float
        Offsets are looked for within this many nT of the start unless stated otherwise. Assumed.
    determined : float
        A direction is determined when its information exceeds this many of its own standard deviations. Level
        of significance: 2 %.
    undetermined : float
        Standard deviation given to a direction that is not determined, in bounds. Assumed: large.
    rounds : int
        Most steps. Assumed.
    settled : float
        A solution is settled to so many nT. Assumed.
    stride : float
        Largest step, in bounds. Assumed.
    least_response : float
        Least true slope, in slopes stepped by. Assumed.
    most_share : float
        No interval is taken to hold more than this part of all information when it is left out. Assumed.
    least_freedom : float
        No covariance is taken to have fewer degrees of freedom. Derived: at two the variance of Student's t
        is unbounded.
    """

    bound: float = 10.0
    determined: float = 2.0
    undetermined: float = 1e3
    rounds: int = 60
    settled: float = 1e-4
    stride: float = 0.2
    least_response: float = 0.3
    most_share: float = 0.7
    least_freedom: float = 3.0


SOLVER_SETTINGS = SolverSettings()

#: Every axis.
ALL = (True, True, True)

#: From an offset (3,) to slopes (interval, 3, 3).
Slopes = Callable[[Floats], Floats]

#: From an offset (3,) to the scores (interval, 3) and their slopes (interval, 3, 3), of which
#: ``sum(slopes) @ step = sum(scores)`` is the next step.
Equations = Callable[[Floats], tuple[Floats, Floats]]


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """An offset: the reading in a field of zero, nT, to be subtracted from it.

    Attributes
    ----------
    method : str
    solution : ndarray, shape (3,)
        nT; the start where an axis is not determined.
    covariance : ndarray, shape (3, 3)
        nT^2, with correlation in time; huge in directions that are not determined.
    determined : ndarray of bool, shape (3,)
        Axes of which the data know more than the bound they were given.
    influence : ndarray, shape (interval, 3)
        What each interval adds to the error of the solution, nT.
    used : ndarray of bool, shape (interval,)
        Intervals that took part.
    start, end : ndarray of int64, shape (interval,)
        TT2000 of all intervals given.
    systematic : ndarray, shape (3, 3)
        The part of the covariance that the intervals' scatter does not show, nT^2.
    reasons : tuple of str
        What is not determined and why, what was left out, what may bias it.
    """

    method: str
    solution: Floats
    covariance: Floats
    determined: Bools
    influence: Floats
    used: Bools
    start: Int64
    end: Int64
    systematic: Floats
    reasons: tuple[str, ...] = ()

    @property
    def value(self) -> Floats:
        """The offset, nT; NaN where it is not determined; (3,)."""
        return np.where(self.determined, self.solution, np.nan)

    @property
    def sigma(self) -> Floats:
        """Standard deviations, nT; infinite where not determined; (3,)."""
        return np.where(self.determined, np.sqrt(np.diag(self.covariance)), np.inf)

    def with_systematic(self, shift: Floats, why: str) -> Estimate:
        """Return the same with a systematic error of up to `shift` (3,), nT, in its covariance."""
        sizes = ", ".join(f"{axis} {one:.3f}" for axis, one in zip(AXES, np.abs(shift), strict=True))
        more = np.outer(shift, shift)
        wider = replace(self, covariance=self.covariance + more, systematic=self.systematic + more)
        return wider.with_reasons(f"{why} may pull it by {sizes} nT")

    def with_axes(self, determined: Bools, search: OffsetSearch) -> Estimate:
        """Return the same with only some axes (3,) determined: the others at the search's start."""
        lost = np.where(
            self.determined & ~determined, (SOLVER_SETTINGS.undetermined * search.bound) ** 2, 0.0
        )
        return replace(
            self, determined=determined, solution=np.where(determined, self.solution, search.start),
            covariance=self.covariance + np.diag(lost), systematic=self.systematic + np.diag(lost),
        )  # fmt: skip

    def summary(self) -> str:
        """Return one sentence."""
        parts = [
            f"{axis} {value:.3f} +- {sigma:.3f} nT" if known else f"{axis} cannot be told"
            for axis, value, sigma, known in zip(AXES, self.value, self.sigma, self.determined, strict=True)
        ]
        return f"{self.method}, {int(self.used.sum())} of {self.used.size} intervals: {', '.join(parts)}"

    def with_reasons(self, *reasons: str) -> Estimate:
        """Return the same with more reasons."""
        return replace(self, reasons=(*self.reasons, *reasons))


@dataclass(frozen=True)
class OffsetSearch:
    """Which axes to estimate, within which bound, from where.

    Attributes
    ----------
    free : tuple of bool
        Axes to estimate; the others keep their value of `start`. In despun axes only z.
    start : tuple of float
        Offsets known beforehand, nT.
    bound : float
        The offset lies within this many nT of the start.
    near : tuple of float, optional
        Where methods begin to look, nT; when absent the start and offsets by simpler rules.
    turning : bool
        The sensor turns right round within an interval: its offset lies in the middle of its readings.
    """

    free: tuple[bool, bool, bool] = ALL
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bound: float = SOLVER_SETTINGS.bound
    near: tuple[float, float, float] | None = None
    turning: bool = False

    def starts(self, other: Floats) -> list[Floats]:
        """Return the offsets to begin with: `near`, else the start and another offset."""
        if self.near is not None:
            return [np.asarray(self.near, dtype=np.float64)]
        return [np.asarray(self.start, dtype=np.float64), other]

    def determined(self, covariance: Floats) -> Bools:
        """Return which axes are known better than by the bound, uniform within it; (3,)."""
        known = np.sqrt(np.diag(covariance)) < self.bound / np.sqrt(3.0)
        return np.asarray(known & np.asarray(self.free))

    def select_intervals(
        self, method: str, intervals: Intervals, used: Bools | None, *, above_noise: bool = True
    ) -> Bools:
        """Return the intervals to use, (interval,); raise for too few.

        Parameters
        ----------
        method : str
            For the message.
        used : ndarray of bool, shape (interval,), optional
            Those of the method's kind; all when absent.
        above_noise : bool
            Leave out intervals that hold noise only.

        Raises
        ------
        CalibrationError
            Fewer than eight intervals.
        """
        mask = (intervals.above_noise if above_noise else np.full(len(intervals), True)) & (
            True if used is None else np.asarray(used, dtype=bool)
        )
        if mask.sum() < INTERVAL_SETTINGS.fewest_intervals:
            raise CalibrationError(
                f"{method}: {int(mask.sum())} of {mask.size} intervals are of its kind and above noise, "
                f"{INTERVAL_SETTINGS.fewest_intervals} needed",
                remedy="take a longer span, or another method",
            )
        return mask


def invert_slopes(slopes: Floats, free: Bools, least: float) -> tuple[Floats, Floats]:
    """Return the inverse of the summed slopes in the directions they determine, and the projector on these.

    Parameters
    ----------
    slopes : ndarray, shape (interval, 3, 3)
    free : ndarray of bool, shape (3,)
    least : float
        A direction is determined by so many standard deviations of its own information.

    Returns
    -------
    inverse, projector : ndarray, shape (3, 3) each
    """
    keep = np.eye(3)[:, free]
    total = keep.T @ slopes.sum(axis=0) @ keep
    value, vector = np.linalg.eigh(0.5 * (total + total.T))
    size = np.abs(value)
    known = size > 1e-12 * max(float(size.max()), 1e-300)
    if least > 0.0:
        # Slopes of one sign are no contradiction, however their size varies for hours: compare with the sum
        # of sizes.
        each = np.einsum("ia,kij,ja->ka", keep @ vector, slopes, keep @ vector)
        part = each.sum(axis=0) / np.maximum(np.abs(each).sum(axis=0), 1e-300)
        scatter = long_run_covariance(each - part * np.abs(each))
        known &= size > least * np.sqrt(np.maximum(np.diag(scatter), 0.0))
    good = vector[:, known]
    # The slopes need not be symmetric; in these directions they are inverted as they are.
    inverse = good @ np.linalg.inv(good.T @ total @ good) @ good.T if known.any() else np.zeros_like(total)
    # Exactly one where all are known: what is not known counts a hundred million times (`undetermined`).
    projector = np.eye(len(value)) if known.all() else good @ good.T
    return keep @ inverse @ keep.T, keep @ projector @ keep.T


def solve(
    method: str,
    equations: Equations,
    intervals: Intervals,
    used: Bools,
    search: OffsetSearch,
    true_slopes: Slopes | None = None,
    *,
    first: Floats | None = None,
    signed: bool = False,
    turning: bool = False,
) -> Estimate:
    """Solve a method's equations and give the solution its uncertainty.

    The covariance is the sandwich of the intervals' scores, whose correlation in time is respected.

    Parameters
    ----------
    equations : callable
        Scores and the slopes to step by.
    true_slopes : callable, optional
        Derivatives of the scores that include how weights follow the offset; the slopes when absent.
    first : ndarray, shape (3,), optional
        Where to begin; the search's start when absent.
    signed : bool
        The slopes of intervals may have either sign and cancel: the sum must stand out of their scatter.
    turning : bool
        Readings in turning axes are allowed; else an offset within the readings themselves is none.

    Raises
    ------
    CalibrationError
        When the solution does not settle within the bound.
    """
    free, start = np.asarray(search.free), np.asarray(search.start, dtype=np.float64)
    within = (start - search.bound, start + search.bound)
    begin = start if first is None else first
    offset, settled = np.clip(np.where(free, begin, start), *within), False
    for _ in range(SOLVER_SETTINGS.rounds):
        scores, slopes = equations(offset)
        step = invert_slopes(slopes[used], free, 0.0)[0] @ scores[used].sum(axis=0)
        settled = bool(np.abs(step).max() < SOLVER_SETTINGS.settled)
        # Far from the zero the slopes are those of another field: no step leaves their reach.
        step = step * min(1.0, SOLVER_SETTINGS.stride * search.bound / max(float(np.abs(step).max()), 1e-300))
        offset = np.clip(offset + step, *within)
        if settled:
            break
    inverse, known = invert_slopes(slopes[used], free, SOLVER_SETTINGS.determined if signed else 0.0)
    if true_slopes is not None:
        slopes = true_slopes(offset)
        inverse = inverse_of_true_slopes(inverse, slopes[used].sum(axis=0))
    at_edge = free & (np.abs(offset - start) >= search.bound)
    notes = []
    if at_edge.any() or not settled:
        where = ", ".join(np.array(AXES)[at_edge]) or "all axes"
        notes.append(f"no zero within {search.bound:g} nT of the start ({where})")
        known = np.zeros((3, 3))
    if not turning and intervals.select(used).encloses(offset, search.turning):
        notes.append("the zero found lies within the readings themselves")
        known = np.zeros((3, 3))
    return estimate_from_scores(
        method, offset, (scores, slopes, inverse, known), intervals, used, search, tuple(notes)
    )


def best_estimate(found: Sequence[Estimate], merit: Callable[[Estimate], float]) -> Estimate:
    """Return the estimate that determines most axes, among equals that of the largest merit."""
    return max(found, key=lambda one: (int(one.determined.sum()), merit(one)))


def inverse_of_true_slopes(inverse: Floats, true_slopes: Floats) -> Floats:
    """Return the inverse of the true slopes of the summed scores, in the directions that are determined.

    Weights that follow the offset make the slopes smaller; where chance makes them very small they are taken
    as `SolverSettings.least_response` of the slopes stepped by.

    Parameters
    ----------
    inverse : ndarray, shape (3, 3)
        Of the slopes stepped by (`invert_slopes`).
    true_slopes : ndarray, shape (3, 3)
    """
    size, vector = np.linalg.eigh(0.5 * (inverse + inverse.T))
    known = size > 1e-12 * max(float(size.max()), 1e-300)
    root = vector[:, known] * np.sqrt(size[known])
    ratio, basis = np.linalg.eigh(root.T @ (0.5 * (true_slopes + true_slopes.T)) @ root)
    spread = root @ basis
    return np.asarray((spread / np.maximum(ratio, SOLVER_SETTINGS.least_response)) @ spread.T)


def estimate_from_scores(
    method: str,
    offset: Floats,
    parts: tuple[Floats, Floats, Floats, Floats],
    intervals: Intervals,
    used: Bools,
    search: OffsetSearch,
    reasons: tuple[str, ...],
) -> Estimate:
    """Return the estimate at a solution, its covariance from the scores of the intervals.

    Parameters
    ----------
    offset : ndarray, shape (3,)
        The solution, nT.
    parts : tuple of ndarray
        Scores (interval, 3), their slopes (interval, 3, 3), the inverse of the summed slopes (3, 3), and the
        projector on the directions that are determined (3, 3).
    used : ndarray of bool, shape (interval,)
    reasons : tuple of str
        Why nothing is determined, or what may bias it.
    """
    scores, slopes, inverse, known = parts
    # An interval of much information draws the solution to itself and hides its own error: what counts is by
    # how much the solution moves when the interval is left out.
    share = slopes @ inverse
    own = np.linalg.norm(share, axis=(1, 2), keepdims=True)
    share = share * np.minimum(1.0, SOLVER_SETTINGS.most_share / np.maximum(own, 1e-300))
    alone = np.linalg.solve(np.eye(3) - share, scores[..., None])[..., 0]
    influence = np.where(used[:, None], alone @ inverse.T, 0.0)
    covariance = covariance_of(influence[used])
    unknown = (np.eye(3) - known) * (SOLVER_SETTINGS.undetermined * search.bound) ** 2
    determined = search.determined(covariance + unknown)
    lost = [
        axis for axis, found, free in zip(AXES, determined, search.free, strict=True) if free and not found
    ]
    if lost:
        none = not known.any()
        cause = (
            "nothing in these intervals tells an offset" if none else "the field varies too little along it"
        )
        reasons = (*reasons, f"cannot tell {', '.join(lost)}: {cause}")
    return Estimate(
        method=method,
        solution=np.where(determined, offset, np.asarray(search.start)),
        covariance=covariance + unknown,
        determined=determined,
        influence=influence,
        used=used,
        start=intervals.start,
        end=intervals.end,
        systematic=unknown,
        reasons=reasons,
    )


def covariance_of(influence: Floats) -> Floats:
    """Return the covariance of an offset from what each interval adds to its error, nT^2; (3, 3).

    Where a few intervals hold much of it, it is itself known poorly: with f degrees of freedom the error
    follows Student's t, whose variance is ``f / (f - 2)`` times as large.

    Parameters
    ----------
    influence : ndarray, shape (interval, 3)
        nT, in order of time.
    """
    freedom = freedom_of(influence)
    return np.asarray(long_run_covariance(influence) * freedom / (freedom - 2.0))


def freedom_of(influence: Floats) -> float:
    """Return the degrees of freedom of the covariance of influences (interval, 3).

    The variance of n numbers with the kurtosis k has ``2 n / (k - 1)``: n of Gaussian ones, few where shocks,
    holes and bursts stand out. The kurtosis is the mean of the principal directions'.
    """
    size, vector = np.linalg.eigh(influence.T @ influence)
    seen = size > 1e-12 * max(float(size.max()), 1e-300)
    if not seen.any():
        return SOLVER_SETTINGS.least_freedom
    parts = influence @ (vector[:, seen] / np.sqrt(size[seen]))
    kurtosis = len(influence) * float(np.mean(np.sum(parts**4, axis=0)))
    return max(2.0 * len(influence) / max(kurtosis - 1.0, 1e-300), SOLVER_SETTINGS.least_freedom)
