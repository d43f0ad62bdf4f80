r"""All methods on one record: one offset, whether they agree, and whether other offsets are rejected.

Takes: `Intervals` and an `OffsetSearch`. Makes (`combine_methods`): `CombinedEstimate`, the weighted mean of
the methods of `METHODS`, each on the intervals that suit it, with their agreement.

Methods share intervals and fluctuations, so they are not independent. Each is weighted by the inverse of its
own covariance; the error of the mean is that of the weighted influences of every interval, in which what
methods share is counted once. Pairs are compared with the covariance of their *difference*.

Each method solves equations that have several zeros, and its error is that of the zero it found. The
likelihood tests all offsets within the bound, however far apart. In natural fluctuations the size B and the
direction n of the field fluctuate independently of each other; under a wrong offset they do not. With both
Gaussian within an interval of N samples, their variances its own, the likelihood of its *readings* is

.. math:: \ell(c) / N = -\tfrac12 \ln \mathrm{var}(B) - \tfrac12 \ln\det\mathrm{cov}(n) - 2\langle\ln B\rangle

where B and n are those of the reading less c, and the last term is the volume that a step of B and n has. It
holds for rotations and for compressions alike, so that no choice of intervals enters. Neither Gaussian nor
independent samples are relied on: two offsets are compared interval by interval, as models are that are not
nested (Vuong 1989, Econometrica 57, 307). Were they equally good, either would be better in as many
intervals; the sum of the differences d is compared with its scatter in time, and at least with half of ``sum
d^2``, which random signs give. So few intervals hardly reject anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import scipy

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.lsq import long_run_variance
from inflight.zero_level.estimate import SOLVER_SETTINGS, Estimate, OffsetSearch, covariance_of, freedom_of
from inflight.zero_level.intervals import AXES, Intervals
from inflight.zero_level.loops import likelihoods
from inflight.zero_level.methods import (
    COMBINED_METHODS,
    METHODS,
    IntervalKinds,
    classify_intervals,
    least_variance_offset,
    mirror_mode,
)


@dataclass(frozen=True, kw_only=True)
class LikelihoodSettings:
    """Numbers of the comparison of offsets.

    Attributes
    ----------
    rejected : float
        An offset is rejected from so many standard deviations on. Level of significance: 0.3 %.
    rejected_anywhere : float
        The same of offsets anywhere in the cube: of thousands one comes nearer by chance. Assumed.
    steps : int
        Offsets along an axis, from one end of the bound to the other. Assumed.
    cube : int
        Offsets along each axis of the cube. Assumed.
    least_chance : float
        Least variance of a sum of differences, of that of random signs. Assumed.
    least_variance : float
        Least variances, of the variance of all components: readings that stand still determine nothing.
        Assumed.
    """

    rejected: float = 3.0
    rejected_anywhere: float = 4.0
    steps: int = 121
    cube: int = 13
    least_chance: float = 0.5
    least_variance: float = 1e-6


LIKELIHOOD_SETTINGS = LikelihoodSettings()


@dataclass(frozen=True, kw_only=True)
class CombinationSettings:
    """When methods disagree.

    Attributes
    ----------
    disagree : float
        Two methods disagree when chance gives their difference less often than this. Level of significance.
    apart : float
        So rarely that one of the methods must be wrong, and no mean is given. Level of significance.
    rounds : int
        Most rounds of classification and estimate. Assumed.
    same_sigmas : float
        An offset within so many standard deviations of a solution is the same. Assumed.
    """

    disagree: float = 0.01
    apart: float = 1e-4
    rounds: int = 8
    same_sigmas: float = 4.0


COMBINATION_SETTINGS = CombinationSettings()


def log_likelihood(intervals: Intervals, offset: Floats) -> Floats:
    """Return the mean of a sample's log-likelihood in each interval, up to a constant; (..., interval).

    Parameters
    ----------
    intervals : Intervals
    offset : ndarray, shape (..., 3)
        One or many, nT.
    """
    each = np.ascontiguousarray(offset, dtype=np.float64).reshape(-1, 3)
    found = likelihoods(np.ascontiguousarray(intervals.field), each, LIKELIHOOD_SETTINGS.least_variance)
    return found.reshape(*np.shape(offset)[:-1], len(intervals))


def likelihood_ratio(better: Floats, other: Floats) -> Floats:
    """Return by how many standard deviations one offset is more likely than others (Vuong's statistic).

    Intervals that agree on one offset are no contradiction, however their differences vary in size for hours:
    the sum is compared with the scatter about their common part.

    Parameters
    ----------
    better : ndarray, shape (interval,)
        Of `log_likelihood`, in order of time.
    other : ndarray, shape (..., interval)
        Of one other offset, or of many.

    Returns
    -------
    ndarray, shape (...)
    """
    apart = np.asarray(better - other)
    size = np.abs(apart)
    whole, total = size.sum(axis=-1), apart.sum(axis=-1)
    about = apart - (total / np.where(whole > 0.0, whole, 1.0))[..., None] * size
    scatter = long_run_variance(about.reshape(-1, about.shape[-1]).T).reshape(whole.shape)
    chance = np.maximum(LIKELIHOOD_SETTINGS.least_chance * np.sum(apart**2, axis=-1), scatter)
    return np.asarray(np.where(whole > 0.0, total / np.sqrt(np.where(whole > 0.0, chance, 1.0)), 0.0))


def most_likely_offset(intervals: Intervals, through: Floats, search: OffsetSearch) -> Floats:
    """Return the most likely offset within the bound, one axis after the other; (3,), nT.

    Parameters
    ----------
    through : ndarray, shape (3,)
        Where to begin, nT.
    """
    offset = np.asarray(through, dtype=np.float64)
    for axis in np.flatnonzero(search.free):
        line = offsets_along(offset, int(axis), search)
        offset = line[int(np.argmax(log_likelihood(intervals, line).sum(axis=1)))]
    return offset


def offsets_along(through: Floats, axis: int, search: OffsetSearch) -> Floats:
    """Return offsets on a line along an axis, from one end of the bound to the other; (point, 3), nT."""
    line = np.tile(np.asarray(through, dtype=np.float64), (LIKELIHOOD_SETTINGS.steps, 1))
    line[:, axis] = search.start[axis] + np.linspace(-search.bound, search.bound, LIKELIHOOD_SETTINGS.steps)
    return line


def without_ambiguous_axes(intervals: Intervals, found: Estimate, search: OffsetSearch) -> Estimate:
    """Return an estimate without the axes along which other offsets within the bound are as likely.

    Along each axis, the others at their values, the offsets that the readings do not reject must be one
    stretch about the solution that ends before the bound does, and none may be better by as much.

    Parameters
    ----------
    found : Estimate
        Of these intervals.
    """
    own, reasons = log_likelihood(intervals, found.solution), list[str]()
    determined = found.determined.copy()
    for axis in np.flatnonzero(found.determined):
        line = offsets_along(found.solution, int(axis), search)
        ratio = likelihood_ratio(own, log_likelihood(intervals, line))
        why = _rivals(ratio, line[:, axis], float(found.solution[axis]))
        if why:
            determined[axis] = False
            reasons.append(f"cannot tell {AXES[axis]}, {found.solution[axis]:.1f} nT by its methods: {why}")
    return found.with_axes(determined, search).with_reasons(*reasons) if reasons else found


def without_rivals(intervals: Intervals, found: Estimate, search: OffsetSearch) -> Estimate:
    """Return an estimate without the axes along which another offset in the cube of the bound is as likely.

    Lines along the axes do not see a false zero away from all of them: where the field turns by less than ten
    degrees it lies as far away as the field is large, at a stated 0.05 nT (docs/science/zero-level.md).

    Parameters
    ----------
    found : Estimate
        Of these intervals.
    """
    line = np.linspace(-search.bound, search.bound, LIKELIHOOD_SETTINGS.cube)
    axes = [
        line + begin if free else np.array([begin])
        for free, begin in zip(search.free, search.start, strict=True)
    ]
    cube = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    cube = np.concatenate([[found.solution], cube])
    likelihood = log_likelihood(intervals, cube)
    apart = np.abs(cube - found.solution)
    # Nearer than this an offset is the same, whatever the others are where they are not told.
    sigma = np.where(found.determined, found.sigma, 0.0)
    same = np.maximum(line[1] - line[0], COMBINATION_SETTINGS.same_sigmas * sigma)
    near = np.all((apart <= same)[:, found.determined], axis=1)
    own = np.where(near, likelihood.sum(axis=1), -np.inf).argmax()
    possible = likelihood_ratio(likelihood[own], likelihood) < LIKELIHOOD_SETTINGS.rejected_anywhere
    determined, reasons = found.determined.copy(), list[str]()
    for axis in np.flatnonzero(found.determined):
        rivals = cube[possible & (apart[:, axis] > same[axis])]
        if len(rivals):
            determined[axis] = False
            least, most = rivals[:, axis].min(), rivals[:, axis].max()
            reasons.append(
                f"cannot tell {AXES[axis]}, {found.solution[axis]:.1f} nT by its methods: with other offsets "
                f"along the other axes {least:.1f} to {most:.1f} nT are not refused"
            )
    return found.with_axes(determined, search).with_reasons(*reasons) if reasons else found


def _rivals(ratio: Floats, place: Floats, solution: float) -> str:
    """Return which other offsets of a line are not rejected; empty when all are."""
    if ratio.min() < -LIKELIHOOD_SETTINGS.rejected:
        return f"the readings refuse it for {place[int(ratio.argmin())]:.1f} nT"
    possible = ratio < LIKELIHOOD_SETTINGS.rejected
    at = int(np.argmin(np.abs(place - solution)))
    possible[at] = True
    stretch = np.cumsum(np.diff(possible, prepend=False))
    # Counting its edges, a stretch has a number of its own.
    other = possible & (stretch != stretch[at])
    if other.any():
        return f"{place[other].min():.1f} to {place[other].max():.1f} nT are not refused either"
    if possible[0] or possible[-1]:
        own = place[possible]
        return f"nothing from {own.min():.1f} to {own.max():.1f} nT is refused"
    return ""


@dataclass(frozen=True)
class Agreement:
    """Two methods compared along the axes both determine.

    Attributes
    ----------
    first, second : str
    chi2 : float
        Of the difference, with the covariance of the difference.
    axes : int
    chance : float
        How often chance alone gives as much.
    """

    first: str
    second: str
    chi2: float
    axes: int
    chance: float

    @property
    def agrees(self) -> bool:
        """Whether chance may be all."""
        return self.chance >= COMBINATION_SETTINGS.disagree

    def summary(self) -> str:
        """Return one sentence."""
        verb = "agree" if self.agrees else "DISAGREE"
        size = f"chi2 {self.chi2:.1f} of {self.axes} axes, p {self.chance:.2g}"
        return f"{self.first} and {self.second} {verb}: {size}"


@dataclass(frozen=True, kw_only=True)
class CombinedEstimate:
    """The offset of all methods.

    Attributes
    ----------
    estimate : Estimate
        Widened by the root of the largest reduced chi2 where methods disagree by more than chance gives once
        in a hundred; nothing is determined where chance gives it less than once in ten thousand.
    methods : tuple of Estimate
        Of each method, from the intervals that suit it.
    agreement : tuple of Agreement
    kinds : IntervalKinds
        Which intervals are Alfvenic, compressional, neither.
    unusable : tuple of str
        Methods that could not be used, and why.
    """

    estimate: Estimate
    methods: tuple[Estimate, ...]
    agreement: tuple[Agreement, ...]
    kinds: IntervalKinds
    unusable: tuple[str, ...]

    @property
    def agrees(self) -> bool:
        """Whether no two methods disagree."""
        return all(one.agrees for one in self.agreement)

    def summary(self) -> str:
        """Return everything, line by line."""
        lines = [self.estimate.summary(), self.kinds.summary(), *(one.summary() for one in self.methods)]
        return "\n".join([*lines, *(one.summary() for one in self.agreement), *self.unusable])


def combine_methods(
    intervals: Intervals, search: OffsetSearch | None = None, names: Sequence[str] = COMBINED_METHODS
) -> CombinedEstimate:
    """Estimate the offset by every method on the intervals that suit it.

    The methods and their intervals are those of `METHODS`. Which intervals are of which kind depends on the
    offset: both are found in turn until the kinds stay, from several starts. The result is compared with all
    other offsets within the bound, along each free axis and in the cube of several: an axis along which any
    of them is as likely is not determined, however small the error about the zero found.

    Parameters
    ----------
    names : sequence of str
        Of `METHODS`; one alone is held against the same offsets.

    Raises
    ------
    CalibrationError
        No method determines anything, with the reason of each.
    """
    search = search or OffsetSearch()
    # Begun with: what is known, the offset of least variance, the most likely one, and that of mirror modes.
    start = np.asarray(search.start, dtype=np.float64)
    within = start - search.bound, start + search.bound
    least = np.clip(least_variance_offset(intervals, search), *within)
    begins = [start, least, most_likely_offset(intervals, least, search)]
    with suppress(CalibrationError):
        begins.append(mirror_mode(intervals, None, search).solution)
    found, failed = [], []
    for near in begins:
        try:
            found.append(_combine_from(intervals, search, names, near))
        except CalibrationError as error:
            failed.append(error)
    if not found:
        raise failed[0]
    # Under a wrong offset rotation looks like compression and both get mixed: among offsets that are equally
    # likely the right one has methods that agree, and leaves most intervals of one kind.
    likelihoods = [log_likelihood(intervals, one.estimate.solution) for one in found]
    most = max(likelihoods, key=lambda one: float(one.sum()))
    possible = [
        one
        for one, likelihood in zip(found, likelihoods, strict=True)
        if likelihood_ratio(most, likelihood) < LIKELIHOOD_SETTINGS.rejected
    ]
    best = min(possible, key=lambda one: (not one.agrees, int(one.kinds.neither.sum())))
    rivals = [
        one
        for one in found
        if one is not best and (pair := compare_estimates(best.estimate, one.estimate)) and not pair.agrees
    ]
    others = tuple(f"another start leads elsewhere: {one.estimate.summary()}" for one in rivals)
    told = without_ambiguous_axes(intervals, best.estimate, search).with_reasons(*others)
    if sum(search.free) > 1:
        told = without_rivals(intervals, told, search)
    return replace(best, estimate=told)


def _combine_from(
    intervals: Intervals, search: OffsetSearch, names: Sequence[str], near: Floats
) -> CombinedEstimate:
    """Return the result from one offset to begin with."""
    offset, seen = near, set[tuple[bytes, bytes]]()
    for _ in range(COMBINATION_SETTINGS.rounds):
        found = classify_intervals(intervals, offset)
        methods, unusable = _estimate_by_each(intervals, found, names, replace(search, near=tuple(offset)))
        if not methods:
            raise CalibrationError(
                f"no method tells an offset ({found.summary()}): {'; '.join(unusable)}",
                remedy="take a longer span, or one in which the field turns more",
            )
        best = weighted_mean(methods, search)
        kinds = found.alfvenic.tobytes(), found.compressional.tobytes()
        if kinds in seen:
            break
        seen.add(kinds)
        offset = best.solution
    pairs = tuple(
        pair
        for i, one in enumerate(methods)
        for other in methods[i + 1 :]
        if (pair := compare_estimates(one, other)) is not None
    )
    return CombinedEstimate(
        estimate=_widened(best, pairs),
        methods=tuple(methods),
        agreement=pairs,
        kinds=found,
        unusable=tuple(unusable),
    )


def _estimate_by_each(
    intervals: Intervals, found: IntervalKinds, names: Sequence[str], search: OffsetSearch
) -> tuple[list[Estimate], list[str]]:
    """Return the estimates of the methods, and why others give none."""
    methods, unusable = [], []
    for method in (METHODS[name] for name in names):
        try:
            one = method.estimate(intervals, method.suits(found), search)
        except CalibrationError as error:
            unusable.append(str(error))
            continue
        if one.determined.any():
            methods.append(one)
        else:
            unusable.append(f"{one.method}: {'; '.join(one.reasons)}")
    return methods, unusable


def independent_covariance(methods: Sequence[Estimate], search: OffsetSearch) -> Floats:
    """Return the covariance of the product of the methods' likelihoods, as if their data were independent.

    They are not: `weighted_mean` has the same mean, and the error with what the methods share counted once.

    Returns
    -------
    ndarray, shape (3, 3)
        nT^2; 0 along axes that are not free.
    """
    inside = np.ix_(np.asarray(search.free), np.asarray(search.free))
    out = np.zeros((3, 3))
    out[inside] = np.linalg.inv(np.sum([np.linalg.inv(one.covariance[inside]) for one in methods], axis=0))
    return out


def weighted_mean(methods: list[Estimate], search: OffsetSearch) -> Estimate:
    """Return the mean of methods, weighted by their covariances, with the error of what they share.

    It is where the product of their likelihoods, each Gaussian, is largest. Covariances that are by chance
    too small weigh too much, and so the error of the mean is larger than they state: ``1 + 4 sum w (1 - w) /
    f`` times in variance, f being the degrees of freedom of each (Meier 1953).

    Parameters
    ----------
    methods : list of Estimate
        On the same intervals.
    """
    free = np.asarray(search.free)
    inside = np.ix_(free, free)
    each = [np.linalg.inv(one.covariance[inside]) for one in methods]
    whole = independent_covariance(methods, search)[inside]
    shares = [np.zeros((3, 3)) for _ in each]
    for share, one in zip(shares, each, strict=True):
        share[inside] = whole @ one
    start = np.asarray(search.start)
    solution = start + sum(
        (share @ (one.solution - start) for share, one in zip(shares, methods, strict=True)), np.zeros(3)
    )
    influence = np.sum([one.influence @ share.T for share, one in zip(shares, methods, strict=True)], axis=0)
    systematic = np.sum(
        [share @ one.systematic @ share.T for share, one in zip(shares, methods, strict=True)], axis=0
    )
    used = np.any([one.used for one in methods], axis=0)
    part = [float(np.trace(share)) / max(int(free.sum()), 1) for share in shares]
    chance = sum(
        w * (1.0 - w) / freedom_of(one.influence[one.used]) for w, one in zip(part, methods, strict=True)
    )
    covariance = covariance_of(influence[used]) * (1.0 + 4.0 * max(chance, 0.0)) + systematic
    determined = search.determined(covariance)
    first = methods[0]
    names = ", ".join(one.method for one in methods)
    return Estimate(
        method=f"combined ({names})",
        solution=np.where(determined, solution, start),
        covariance=covariance,
        determined=determined,
        influence=influence,
        used=used,
        start=first.start,
        end=first.end,
        systematic=systematic,
        reasons=() if determined[free].all() else ("no method tells every axis",),
    )


def compare_estimates(one: Estimate, other: Estimate) -> Agreement | None:
    """Compare two estimates from the same intervals; None when no axis is determined by both."""
    both = one.determined & other.determined
    if not both.any():
        return None
    apart = (one.solution - other.solution)[both]
    part = one.used | other.used
    shared = covariance_of((one.influence - other.influence)[part])[np.ix_(both, both)]
    covariance = shared + (one.systematic + other.systematic)[np.ix_(both, both)]
    # Two ways to one zero differ by what each was settled to, and by no scatter at all.
    covariance += SOLVER_SETTINGS.settled**2 * np.eye(len(apart))
    chi2 = float(apart @ np.linalg.solve(covariance, apart))
    axes = int(both.sum())
    return Agreement(one.method, other.method, chi2, axes, float(scipy.stats.chi2.sf(chi2, axes)))


def _widened(estimate: Estimate, pairs: tuple[Agreement, ...]) -> Estimate:
    """Return the estimate with errors widened by the disagreement, which is among the reasons."""
    apart = [pair for pair in pairs if not pair.agrees]
    if not apart:
        return estimate
    factor = max(pair.chi2 / pair.axes for pair in apart)
    wider = replace(
        estimate, covariance=factor * estimate.covariance, influence=np.sqrt(factor) * estimate.influence,
        systematic=factor * estimate.systematic,
    )  # fmt: skip
    sentences = tuple(pair.summary() for pair in apart)
    if min(pair.chance for pair in apart) < COMBINATION_SETTINGS.apart:
        undetermined = replace(wider, determined=np.zeros(3, dtype=bool))
        return undetermined.with_reasons(*sentences, "one of these is wrong: no mean is told")
    return wider.with_reasons(*sentences)
