"""Published studies of zero levels: averaging over spins, scatter with hours.

Takes: readings of a spinning or a stabilised spacecraft. Makes:

- `largest_leak`: table 1 of Hedgecock's tests on IMP-8 and Helios, of averages that are not over whole spins
  and samples (`inflight.zero_level.averaging`); its last number of the second part is a misprint (0.93 for
  0.644).
- `scatter_with_hours`: how the scatter of a recovered offset falls with the hours used (Plaschke 2019).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.zero_level import Bools, Estimator, Intervals, OffsetSearch

#: Published for the solar wind, (hours, nT): Plaschke, How many solar wind data are sufficient for accurate
#: fluxgate magnetometer offset determinations?, Geosci. Instrum. Method. Data Syst. 8, 285 (2019).
PUBLISHED = ((20.0, 0.3), (40.0, 0.2))


@dataclass(frozen=True, kw_only=True)
class StudySettings:
    """Numbers of the studies.

    Attributes
    ----------
    block_s : float
        Intervals drawn together, s: neighbours are correlated. Assumed.
    windows : int
        Averages among which the largest leak is found. Assumed.
    """

    block_s: float = 3600.0
    windows: int = 4000


STUDY_SETTINGS = StudySettings()


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
