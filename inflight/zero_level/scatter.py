"""How the scatter of a recovered offset falls with the hours used."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.zero_level.combined import Method
from inflight.zero_level.estimate import Question
from inflight.zero_level.intervals import AXES, Bools, Intervals

#: Published for the solar wind, (hours, nT): Plaschke, How many solar wind data are sufficient for accurate
#: fluxgate magnetometer offset determinations?, Geosci. Instrum. Method. Data Syst. 8, 285 (2019).
PUBLISHED = ((20.0, 0.3), (40.0, 0.2))
#: Intervals drawn together, seconds: neighbours are alike.
_BLOCK_S = 3600.0


@dataclass(frozen=True)
class Scatter:
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
    told : ndarray, shape (length,)
        Part of the draws that told every axis.
    """

    method: str
    hours: Floats
    scatter: Floats
    stated: Floats
    told: Floats

    def table(self) -> xr.Dataset:
        """Return `value` (the scatter) with the stated sigma along hours and axis."""
        return xr.Dataset(
            {
                "value": (("hours", "axis"), self.scatter, {"units": "nT"}),
                "sigma": (("hours", "axis"), self.stated, {"units": "nT"}),
                "told": ("hours", self.told),
            },
            coords={"hours": self.hours, "axis": list(AXES)},
            attrs={"method": self.method},
        )


def scatter_with_hours(
    intervals: Intervals,
    method: Method,
    used: Bools | None,
    hours: Floats,
    generator: np.random.Generator,
    draws: int = 60,
    question: Question | None = None,
) -> Scatter:
    """Draw sets of whole hours from a record, with repetition, and estimate each.

    Sets longer than the record repeat its hours: they say what more of the *same* weather would give.

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
        No length told an offset in half of its draws.
    """
    block = (intervals.start - intervals.start[0]) // round(_BLOCK_S * 1e9)
    kind = np.ones(len(intervals), dtype=bool) if used is None else used
    members = [np.flatnonzero((block == one) & kind) for one in np.unique(block)]
    rows, name = [], ""
    for length in hours:
        values = []
        for _ in range(draws):
            chosen = generator.integers(0, len(members), max(round(float(length)), 1))
            indices = np.sort(np.concatenate([members[one] for one in chosen]))
            try:
                one = method(intervals.where(indices), None, question)
            except CalibrationError:
                continue
            name = one.method
            if one.determined.all():
                values.append(np.stack([one.solution, one.sigma]))
        rows.append(_row(np.array(values).reshape(-1, 2, 3), draws))
    if all(row[2] < 0.5 for row in rows):
        raise CalibrationError(
            "no number of hours tells an offset in half of its draws", remedy="take a longer record"
        )
    return Scatter(
        name, np.asarray(hours, dtype=np.float64), np.array([row[0] for row in rows]),
        np.array([row[1] for row in rows]), np.array([row[2] for row in rows]),
    )  # fmt: skip


def _row(values: Floats, draws: int) -> tuple[Floats, Floats, float]:
    """Return robust scatter, median stated error, and the part of draws that told."""
    if len(values) < 2:
        return np.full(3, np.nan), np.full(3, np.nan), len(values) / draws
    low, high = np.percentile(values[:, 0], [15.865, 84.135], axis=0)
    return 0.5 * (high - low), np.median(values[:, 1], axis=0), len(values) / draws
