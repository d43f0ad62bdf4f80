r"""Published studies of zero levels: averaging over spins, sets of averages (IMP-8), scatter with hours.

Takes: readings of a spinning or a stabilised spacecraft. Makes:

- `average_spans`, and the rule it must obey (`check_averaging`). In despun axes a field fixed to the
  spacecraft, or an offset in the spin plane, turns once a spin. The mean of N samples T_s apart leaves the
  part :math:`|\sin(\pi N T_s/T) / (N \sin(\pi T_s/T))|` of it (`remaining_part`): five whole spins of 1 s
  leave a third when they are sampled every 1.5 s, because 3.33 samples are no whole number. `largest_leak` is
  table 1 of Hedgecock's tests on IMP-8 and Helios; its last number of the second part is a misprint (0.93 for
  0.644).
- `correlation_sets`: the corrections of sets of successive averages by minimum correlation, their mean and
  trend (IMP-8: 72 sets of 1440, table 3).
- `scatter_with_hours`: how the scatter of a recovered offset falls with the hours used (Plaschke 2019).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.lsq import long_run_covariance, robust_fit, robust_sigma
from inflight.time import DAY, SECOND, Int64
from inflight.zero_level import (
    MINIMUM_CORRELATION,
    Bools,
    Estimate,
    Estimator,
    Intervals,
    OffsetSearch,
    zero_of_minimum_correlation,
)

#: Averages of a set (IMP-8).
SET = 1440

#: Published for the solar wind, (hours, nT): Plaschke, How many solar wind data are sufficient for accurate
#: fluxgate magnetometer offset determinations?, Geosci. Instrum. Method. Data Syst. 8, 285 (2019).
PUBLISHED = ((20.0, 0.3), (40.0, 0.2))


@dataclass(frozen=True, kw_only=True)
class StudySettings:
    """Numbers of the studies.

    Attributes
    ----------
    parts : int
        Parts of a set whose scatter gives its error. Assumed.
    fewest : int
        Fewest sets of a mean or a trend. Assumed.
    block_s : float
        Intervals drawn together, s: neighbours are correlated. Assumed.
    tolerance : float
        An average that leaves more than this part of a turning field is no average over spins. Derived: 2 nT
        of spin-plane offset leave 0.1 nT, the accuracy sought.
    windows : int
        Averages among which the largest leak is found. Assumed.
    """

    parts: int = 12
    fewest: int = 3
    block_s: float = 3600.0
    tolerance: float = 0.05
    windows: int = 4000


STUDY_SETTINGS = StudySettings()


@dataclass(frozen=True)
class OffsetSets:
    """Offsets of sets, one after the other.

    Attributes
    ----------
    value, sigma : ndarray, shape (set, 3)
        nT; the error from the parts of the set. NaN for a set without a zero within the bound.
    start, end : ndarray of int64, shape (set,)
        TT2000.
    """

    value: Floats
    sigma: Floats
    start: Int64
    end: Int64

    @property
    def determined(self) -> Bools:
        """Sets that determine an offset; (set,)."""
        return np.asarray(np.isfinite(self.value).all(axis=1))

    def mean(self) -> Estimate:
        """Return the mean of the sets, its covariance from their scatter; outlying sets are down-weighted.

        Raises
        ------
        CalibrationError
            Fewer than three sets determine an offset.
        """
        used = self._sufficient()
        value, sigma = self.value[used], self.sigma[used]
        fits = [robust_fit(np.ones((len(value), 1)), value[:, i], sigma[:, i] ** 2, 1.0) for i in range(3)]
        mean = np.array([fit.value[0] for fit in fits])
        weight = np.stack([fit.robust_weight for fit in fits], axis=1) / (
            sigma**2 + [fit.scatter**2 for fit in fits]
        )
        influence = np.zeros_like(self.value)
        influence[used] = weight * (value - mean) / weight.sum(axis=0)
        spread = np.sqrt([fit.covariance[0, 0] for fit in fits])
        shared = long_run_covariance(influence[used])
        size = np.sqrt(np.maximum(np.diag(shared), 1e-300))
        covariance = shared * np.outer(spread / size, spread / size)
        lost = int((~used).sum() + sum(fit.outlying for fit in fits))
        why = f"{lost} of {used.size} sets have no zero nearby, or one far from those of the others"
        return Estimate(
            method=f"{MINIMUM_CORRELATION}, sets",
            solution=mean,
            covariance=covariance,
            determined=np.full(3, True),
            influence=influence,
            used=used,
            start=self.start,
            end=self.end,
            systematic=np.zeros((3, 3)),
            reasons=(why,) if lost else (),
        )

    def trend(self) -> SetTrend:
        """Return the line c = a t + b of each axis, t in days from the middle, with robust weights.

        Raises
        ------
        CalibrationError
            Fewer than three sets determine an offset.
        """
        used = self._sufficient()
        middle = (self.start // 2 + self.end // 2)[used]
        centre = round(float(np.mean(middle - middle[0]))) + int(middle[0])
        days = (middle - centre) / DAY
        columns = np.column_stack([days, np.ones_like(days)])
        value, variance = self.value[used], self.sigma[used] ** 2
        fits = [robust_fit(columns, value[:, i], variance[:, i], 2.0) for i in range(3)]
        line = np.array([fit.value for fit in fits]).T
        error = np.sqrt([np.diag(fit.covariance) for fit in fits]).T
        scatter = np.array([robust_sigma(fit.residual) for fit in fits])
        return SetTrend(line[0], error[0], line[1], error[1], scatter, centre, int(used.sum()))

    def _sufficient(self) -> Bools:
        used = self.determined
        if used.sum() < STUDY_SETTINGS.fewest:
            raise CalibrationError(
                f"{int(used.sum())} of {used.size} sets tell an offset, {STUDY_SETTINGS.fewest} needed",
                remedy="take a longer span, or larger sets",
            )
        return used


@dataclass(frozen=True)
class SetTrend:
    """c = a t + b; all (3,), and errors from the scatter of the sets.

    Attributes
    ----------
    slope, sigma_slope : ndarray
        a, nT/day.
    level, sigma_level : ndarray
        b, nT, at the middle.
    scatter : ndarray
        Robust standard deviation of a set about the line, nT.
    middle : int
        TT2000.
    sets : int
    """

    slope: Floats
    sigma_slope: Floats
    level: Floats
    sigma_level: Floats
    scatter: Floats
    middle: int
    sets: int


def correlation_sets(
    tt2000: Int64,
    averages: Floats,
    size: int = SET,
    good: Bools | None = None,
    bound: float = OffsetSearch.bound,
    free: tuple[bool, bool, bool] = (True, True, True),
) -> OffsetSets:
    """Find the offset of each set of successive averages by minimum correlation along all axes at once.

    Parameters
    ----------
    tt2000 : ndarray of int64, shape (time,)
    averages : ndarray, shape (time, 3)
        nT, over whole spins.
    size : int
        Averages of a set.
    good : ndarray of bool, shape (time,), optional
    bound : float
        A set whose zero lies further out, or nowhere, determines nothing; nT.
    free : tuple of bool
        Axes to estimate; the others are 0.

    Raises
    ------
    CalibrationError
        No whole set.
    """
    cadence = float(np.median(np.diff(tt2000))) / SECOND
    parts = max(size // STUDY_SETTINGS.parts, 16)
    intervals = Intervals.of(tt2000, averages, parts * cadence, good, fewest=STUDY_SETTINGS.parts // 2)
    number = (intervals.start - intervals.start[0]) // round(parts * cadence * SECOND) // STUDY_SETTINGS.parts
    rows = [np.flatnonzero(number == one) for one in np.unique(number)]
    rows = [row for row in rows if row.size >= STUDY_SETTINGS.parts // 2]
    search = OffsetSearch(free, bound=bound)
    found = np.array([zero_of_minimum_correlation(intervals.select(row), search) for row in rows]).reshape(
        -1, 2, 3
    )
    start = np.array([intervals.start[row[0]] for row in rows], dtype=np.int64)
    end = np.array([intervals.end[row[-1]] for row in rows], dtype=np.int64)
    return OffsetSets(found[:, 0], found[:, 1], start, end)


@dataclass(frozen=True)
class ScatterWithHours:
    """Scatter of a method's offset against hours of record.

    Attributes
    ----------
    method : str
    hours : ndarray, shape (length,)
        Of record, whether or not its intervals were of the method's kind.
    scatter : ndarray, shape (length, 3)
        Standard deviation of the draws, robust, nT.
    stated : ndarray, shape (length, 3)
        Median of the errors that the draws state, nT.
    determined_part : ndarray, shape (length,)
        Part of the draws that determined every axis.
    """

    method: str
    hours: Floats
    scatter: Floats
    stated: Floats
    determined_part: Floats


def scatter_with_hours(
    intervals: Intervals,
    method: Estimator,
    used: Bools | None,
    hours: Floats,
    generator: np.random.Generator,
    draws: int = 60,
    search: OffsetSearch | None = None,
) -> ScatterWithHours:
    """Draw sets of whole hours from a record, with repetition, and estimate each.

    Sets longer than the record repeat its hours: they show what more of the *same* weather would give.

    Parameters
    ----------
    intervals : Intervals
    method : callable
        Such as `davis_smith`.
    used : ndarray of bool, shape (interval,), optional
        Intervals of the method's kind.
    hours : ndarray, shape (length,)
    draws : int

    Raises
    ------
    CalibrationError
        No length determined an offset in half of its draws.
    """
    block = (intervals.start - intervals.start[0]) // round(STUDY_SETTINGS.block_s * 1e9)
    kind = np.ones(len(intervals), dtype=bool) if used is None else used
    members = [np.flatnonzero((block == one) & kind) for one in np.unique(block)]
    rows, name = [], ""
    for length in hours:
        values = []
        for _ in range(draws):
            chosen = generator.integers(0, len(members), max(round(float(length)), 1))
            indices = np.sort(np.concatenate([members[one] for one in chosen]))
            try:
                one = method(intervals.select(indices), None, search)
            except CalibrationError:
                continue
            name = one.method
            if one.determined.all():
                values.append(np.stack([one.solution, one.sigma]))
        found, part = np.array(values).reshape(-1, 2, 3), len(values) / draws
        if len(found) < 2:
            rows.append((np.full(3, np.nan), np.full(3, np.nan), part))
            continue
        low, high = np.percentile(found[:, 0], [15.865, 84.135], axis=0)
        rows.append((0.5 * (high - low), np.median(found[:, 1], axis=0), part))
    if all(row[2] < 0.5 for row in rows):
        raise CalibrationError(
            "no number of hours tells an offset in half of its draws", remedy="take a longer record"
        )
    return ScatterWithHours(
        name, np.asarray(hours, dtype=np.float64), np.array([row[0] for row in rows]),
        np.array([row[1] for row in rows]), np.array([row[2] for row in rows]),
    )  # fmt: skip


class AveragingWarning(UserWarning):
    """An average leaves part of the field that turns with the spacecraft."""


def remaining_part(spin_period: float, sampling: float, samples: int) -> float:
    """Return which part of a field that turns with the spin the mean of some samples leaves, 0 to 1.

    Parameters
    ----------
    spin_period, sampling : float
        s.
    samples : int
        In the mean.
    """
    angle = np.pi * sampling / spin_period
    below = samples * np.sin(angle)
    if abs(below) < 1e-12 * samples:
        return 1.0  # every sample at the same phase
    return float(abs(np.sin(samples * angle) / below))


@dataclass(frozen=True)
class AveragingRule:
    """How an averaging time fits the spin and the samples.

    Attributes
    ----------
    spins, samples : float
        In an average.
    remaining : float
        Largest part of a turning field that stays.
    """

    spins: float
    samples: float
    remaining: float

    @property
    def kept(self) -> bool:
        """Whether no more than `StudySettings.tolerance` stays."""
        return self.remaining <= STUDY_SETTINGS.tolerance

    def summary(self) -> str:
        """Return what stays and why, in words."""
        parts = [
            f"{number:.3f} {name}"
            for number, name in ((self.spins, "spins"), (self.samples, "samples"))
            if abs(number - round(number)) > 1e-6
        ]
        why = f" ({' and '.join(parts)})" if parts else ""
        return f"averages leave {100 * self.remaining:.1f} % of a field that turns with the spacecraft{why}"


def check_averaging(
    spin_period: float, sampling: float, averaging: float, *, strict: bool = False
) -> AveragingRule:
    """Check an averaging time against spin and samples; warn when a turning field stays.

    Parameters
    ----------
    spin_period, sampling, averaging : float
        s.
    strict : bool
        Raise in place of warning.

    Raises
    ------
    CalibrationError
        Periods that are not positive, or, if strict, an average that leaves more than
        `StudySettings.tolerance`.
    """
    if min(spin_period, sampling, averaging) <= 0 or averaging < sampling:
        raise CalibrationError(
            f"spin {spin_period:g} s, samples {sampling:g} s, averages {averaging:g} s found: no averages",
            remedy="give positive times, averages no shorter than samples",
        )
    samples = averaging / sampling
    low = int(np.floor(samples + 1e-9))
    counts = {low, low if abs(samples - low) < 1e-6 else low + 1}
    rule = AveragingRule(
        averaging / spin_period, samples, max(remaining_part(spin_period, sampling, one) for one in counts)
    )
    if not rule.kept:
        remedy = "take a whole multiple of both the spin period and the sampling time"
        if strict:
            raise CalibrationError(rule.summary(), remedy=remedy)
        warnings.warn(f"{rule.summary()}; {remedy}", AveragingWarning, stacklevel=2)
    return rule


def largest_leak(
    spin_period: float, sampling: float, averaging: float, turning: tuple[float, float]
) -> float:
    """Return the largest component that averages of a turning field leave, nT.

    The samples k T_s in [j dt, (j + 1) dt) are averaged; the field is
    ``(c1 cos - c2 sin, c1 sin + c2 cos)``, the largest over j and both components.

    Parameters
    ----------
    spin_period, sampling, averaging : float
        s.
    turning : tuple of float
        c1, c2, nT.
    """
    time = sampling * np.arange(round(STUDY_SETTINGS.windows * averaging / sampling))
    window = np.floor(time / averaging + 1e-9).astype(np.int64)
    phase = 2.0 * np.pi * np.fmod(time, spin_period) / spin_period
    field = (turning[0] + 1j * turning[1]) * np.exp(1j * phase)
    count = np.bincount(window)
    means = [np.bincount(window, part)[:-1] / count[:-1] for part in (field.real, field.imag)]
    return float(np.abs(means).max())


def average_spans(
    tt2000: Int64, field: Floats, averaging: float, good: Bools | None = None, coverage: float = 1.0
) -> tuple[Int64, Floats]:
    """Return middles and means of successive spans of a despun field.

    Parameters
    ----------
    tt2000 : ndarray of int64, shape (time,)
        Rising.
    field : ndarray, shape (time, 3)
        nT, despun.
    averaging : float
        s; see `check_averaging`.
    good : ndarray of bool, shape (time,), optional
    coverage : float
        Spans with fewer than this part of the samples that fit are NaN: a hole in a span breaks the rule.

    Returns
    -------
    tt2000 : ndarray of int64, shape (span,)
    mean : ndarray, shape (span, 3)
    """
    use = np.isfinite(field).all(axis=1) & (True if good is None else good)
    length = round(averaging * SECOND)
    span = (tt2000 - tt2000[0]) // length
    size = int(span[-1]) + 1
    count = np.bincount(span[use], minlength=size)
    sums = np.stack([np.bincount(span[use], column, minlength=size) for column in field[use].T], axis=1)
    cadence = float(np.median(np.diff(tt2000)))
    edges = np.ceil(np.arange(size + 1) * length / cadence - 0.5)
    kept = (count >= np.maximum(coverage * np.diff(edges), 1))[:, None]
    mean = np.divide(sums, count[:, None], out=np.full_like(sums, np.nan), where=kept)
    return tt2000[0] + np.arange(size) * length + length // 2, mean
