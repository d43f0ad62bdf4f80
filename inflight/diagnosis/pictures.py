"""Aggregates of the series before and after the found effects: what a report's figures are drawn from.

All are means, sums or counts of bounded size, however long the record.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dependence import jackknife
from inflight.diagnosis.material import Material, left_of, of_known_rows
from inflight.diagnosis.search import Search
from inflight.diagnosis.series import Series
from inflight.time import DAY, SECOND, Int64, to_utc

#: Rows and columns of a heat map at most, and coordinates that are drawn.
MAP_ROWS, MAP_COLUMNS, _MAPS = 84, 72, 2
#: Bins of curves; the fewest samples of a bin; samples curves are taken from at most.
BINS, FEWEST, MOST_SAMPLES = 12, 12, 250_000
#: Bins of the histogram, and days drawn at most.
_HISTOGRAM, _DAYS = 120, 1000
#: Parts of a bin of time that its error is taken from; the least range of a direction that is drawn.
_PARTS, _TURNED = 8, 0.2
#: Coordinates of a heat map with unit and whole turn, the one that tells most first.
_COORDINATES = {
    "orbit_phase": ("deg", 360.0),
    "sun_phase": ("deg", 360.0),
    "local_time": ("h", 24.0),
}
#: Units of time, their seconds, and the shortest row they are used for, seconds.
_CLOCK = (("h", 3600.0, 7200.0), ("min", 60.0, 300.0), ("s", 1.0, 0.0))
#: Days of a record whose uncertainties are taken between days.
_DAY_BLOCKS = 10


@dataclass(frozen=True)
class Seen:
    """The series with what is left of it before and after the found effects.

    Attributes
    ----------
    before, after : ndarray, shape (sample, row)
        nT, the calibration fitted in both.
    block : ndarray of int, shape (sample,)
        Days of a long record, else the blocks of the search: what uncertainties are taken from.
    """

    series: Series
    before: Floats
    after: Floats
    block: npt.NDArray[np.int64]

    @property
    def good(self) -> npt.NDArray[np.bool_]:
        """Samples with a residual; (sample,)."""
        finite = np.isfinite(self.before).all(axis=1) & np.isfinite(self.after).all(axis=1)
        finite &= np.isfinite(self.series.direction()).all(axis=(1, 2))
        return np.asarray((self.series["weight"] > 0) & finite)

    @property
    def changed(self) -> bool:
        """True when something was found: else there is no after."""
        same: bool = np.array_equal(self.before, self.after, equal_nan=True)
        return not same

    @property
    def row(self) -> int:
        """The row of the residual that is largest: the only one of a scalar comparison."""
        return int(np.argmax(np.sum(self.before[self.good] ** 2, axis=0)))

    @property
    def is_scalar(self) -> bool:
        """True when the residual is one number a time."""
        return bool(self.before.shape[1] == 1)

    def of_row(self, which: str) -> Floats:
        """Return ``before`` or ``after`` of the largest row; (sample,), NaN where there is none."""
        values = self.before if which == "before" else self.after
        return np.where(self.good, values[:, self.row], np.nan)

    def thinned(self, most: int = MOST_SAMPLES) -> Seen:
        """Return every n-th sample, so that at most so many stay."""
        step = -(-len(self.before) // most)
        if step == 1:
            return self
        one = self.series
        series = Series(one.tt2000[::step], one.values[::step], one.block[::step], one.features)
        return Seen(series, self.before[::step], self.after[::step], self.block[::step])


def seen_of(search: Search, material: Material) -> Seen:
    """Return the series with what is left before and after what the search took."""
    material = of_known_rows(search, material)
    series = material.series
    before, after = (left_of(search, material, one) for one in (False, True))
    day = (series.tt2000 - series.tt2000[0]) // DAY
    long = day.size > 0 and day[-1] >= _DAY_BLOCKS
    return Seen(series, before, after, np.asarray(day if long else series.block, dtype=np.int64))


# Heat maps.


@dataclass(frozen=True)
class HeatMap:
    """Mean residual by time and a coordinate.

    Attributes
    ----------
    coordinate, unit : str
    span : tuple of int
        TT2000 of the lower edge of the first row and the upper edge of the last.
    reach : float
        Upper end of the coordinate; the lower one is 0.
    before, after : ndarray, shape (row, column)
        nT; NaN where nothing was measured.
    """

    coordinate: str
    unit: str
    span: tuple[int, int]
    reach: float
    before: Floats
    after: Floats


def heat_maps(seen: Seen) -> list[HeatMap]:
    """Return maps of day against orbit phase and Sun phase, local time or what else there is."""
    series = seen.series
    there = [name for name in _COORDINATES if name in series.channels]
    varied = [name for name in there if _covers(series[name], _COORDINATES[name][1])]
    length = _row_length(series.tt2000)
    place = (series.tt2000 - series.tt2000[0]) // length
    first, rows = int(series.tt2000[0]), int(place[-1]) + 1
    # No more columns than a row has samples, or every other one were empty.
    columns = int(np.clip(length / (SECOND * series.step_s), 4, MAP_COLUMNS))
    span = (first, first + rows * length)
    out = []
    for name in varied[:_MAPS]:
        unit, reach = _COORDINATES[name]
        out.append(_map(seen, (name, unit, reach), series[name], place, span, MAP_COLUMNS))
    if not out:
        name, unit, reach, values = _time_coordinate(series.tt2000, length)
        out.append(_map(seen, (name, unit, reach), values, place, span, columns))
    return out


def _covers(values: Floats, reach: float) -> bool:
    """Return True when a coordinate runs through most of its turn within the record."""
    known = values[np.isfinite(values)]
    return known.size > 0 and np.unique((known / reach * 8).astype(np.int64) % 8).size >= 6


def _row_length(tt2000: Int64) -> int:
    """Return the length of a row, ns: a day or more of a long record, else a part of it."""
    span = int(tt2000[-1] - tt2000[0]) + 1
    if span >= 4 * DAY:
        return DAY * -(-span // (DAY * MAP_ROWS))
    return max(-(-span // 24), 1)


def _time_coordinate(tt2000: Int64, length: int) -> tuple[str, str, float, Floats]:
    if length >= DAY:
        utc = to_utc(tt2000)
        return "time of day (UTC)", "h", 24.0, (utc - utc.astype("datetime64[D]")) / np.timedelta64(1, "h")
    unit, size = next(one for one in _CLOCK if length >= one[2] * SECOND)[:2]
    inside = ((tt2000 - tt2000[0]) % length) / (size * SECOND)
    return "time within the row", unit, length / (size * SECOND), inside


def _map(
    seen: Seen,
    axis: tuple[str, str, float],
    values: Floats,
    place: Int64,
    span: tuple[int, int],
    columns: int,
) -> HeatMap:
    name, unit, reach = axis
    good = seen.good & np.isfinite(values)
    column = np.clip((values[good] % reach / reach * columns).astype(np.int64), 0, columns - 1)
    rows = int(place[-1]) + 1
    cell = place[good] * columns + column
    weight = seen.series["weight"][good]
    total = np.bincount(cell, weights=weight, minlength=rows * columns)
    means = []
    for which in ("before", "after"):
        summed = np.bincount(cell, weights=weight * seen.of_row(which)[good], minlength=total.size)
        with np.errstate(invalid="ignore", divide="ignore"):
            means.append(np.where(total > 0, summed / total, np.nan).reshape(rows, columns))
    return HeatMap(name, unit, span, reach, means[0], means[1])


# Curves.


@dataclass(frozen=True)
class Curve:
    """Means in bins of a coordinate; (bin,), `sigma` between blocks, NaN where there is none."""

    label: str
    centre: Floats
    mean: Floats
    sigma: Floats


def along_field(seen: Seen, axis: int = 2) -> dict[str, list[Curve]]:
    """Return the mean residual against a component of the field's direction, by day and by night.

    A field fixed in the sensor is a straight line through this figure: its component is the slope.

    Returns
    -------
    dict of str to list of Curve
        ``before``, and ``after`` when something was found; empty when the residual has several rows, or
        the field's direction hardly turns.
    """
    if not seen.is_scalar:
        return {}
    thin = seen.thinned()
    part = thin.series.direction()[:, 0, axis]
    if not thin.good.any() or np.ptp(part[thin.good]) < _TURNED:
        return {}
    sides = {"all": np.ones(part.size, dtype=bool)}
    if "sunlit" in thin.series.channels:
        lit = thin.series["sunlit"] > 0.5
        if lit.any() and not lit.all():
            sides = {"day": lit, "night": ~lit}
    edges = np.linspace(-1.0, 1.0, 2 * BINS + 1)
    out: dict[str, list[Curve]] = {}
    for which in ("before", "after") if seen.changed else ("before",):
        values = thin.of_row(which)
        out[which] = [_means(label, part, values, thin.block, edges, side) for label, side in sides.items()]
    return out


def _means(
    label: str, x: Floats, y: Floats, block: Int64, edges: Floats, side: npt.NDArray[np.bool_]
) -> Curve:
    good = side & np.isfinite(x) & np.isfinite(y)
    size = edges.size - 1
    bins = np.clip(np.searchsorted(edges, x[good], side="right") - 1, 0, size - 1)
    _, which = np.unique(block[good], return_inverse=True)
    shape = (int(which.max(initial=0)) + 1, size)
    cell = which * size + bins
    count = np.bincount(cell, minlength=shape[0] * size).reshape(shape).astype(np.float64)
    total = np.bincount(cell, weights=y[good], minlength=count.size).reshape(shape)
    whole = count.sum(axis=0)
    met = (whole >= FEWEST) & ((count > 0).sum(axis=0) >= min(3, shape[0]))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(met, total.sum(axis=0) / whole, np.nan)
        left = whole - count
        without = np.where(left > 0, (total.sum(axis=0) - total) / np.maximum(left, 1.0), mean)
    sigma = jackknife(np.nan_to_num(without)) if shape[0] > 1 else np.full(size, np.nan)
    return Curve(label, 0.5 * (edges[1:] + edges[:-1]), mean, np.where(met, sigma, np.nan))


# Sizes.


@dataclass(frozen=True)
class Sizes:
    """Distribution and daily rms of the residual before and after.

    Attributes
    ----------
    edges, counts : ndarray, dict of str to ndarray
        Of the histograms, nT.
    day : ndarray of int64
        TT2000 of the middle of each day (of several days in a very long record).
    rms : dict of str to ndarray
        nT.
    """

    edges: Floats
    counts: dict[str, Floats]
    day: Int64
    rms: dict[str, Floats]


def sizes_of(seen: Seen) -> Sizes:
    """Return distribution and daily rms of all rows together."""
    good = seen.good
    span = int(seen.series.tt2000[-1] - seen.series.tt2000[0]) + 1
    width = DAY * -(-span // (DAY * _DAYS)) if span >= 2 * DAY else max(-(-span // 24), 1)
    day = (seen.series.tt2000 - seen.series.tt2000[0]) // width
    count = np.bincount(day[good], minlength=int(day[-1]) + 1)
    wide = 6.0 * float(np.quantile(np.abs(seen.before[good]), 0.8)) if good.any() else 1.0
    edges = np.linspace(-wide, wide, _HISTOGRAM + 1)
    counts, rms = {}, {}
    for which, values in (("before", seen.before), ("after", seen.after)):
        counts[which] = np.histogram(values[good], edges)[0].astype(np.float64)
        square = np.bincount(day[good], weights=np.mean(values[good] ** 2, axis=1), minlength=count.size)
        rms[which] = np.sqrt(np.divide(square, count, out=np.full(count.size, np.nan), where=count > 0))
    middle = seen.series.tt2000[0] + np.arange(count.size) * width + width // 2
    return Sizes(edges, counts, np.asarray(middle, dtype=np.int64), rms)


def epoch(seen: Seen, when: int, width: int = 40) -> dict[str, Curve]:
    """Return the mean residual around an event, before and after; the coordinate is days from it."""
    days = (seen.series.tt2000 - when) / DAY
    inside = float(min(max(days[-1], 0.1), max(-days[0], 0.1), 10.0))
    edges = np.linspace(-inside, inside, width + 1)
    near = np.abs(days) < inside
    # A bin of time lies within one block of the search: its error is that between its own parts.
    part = np.floor((days + inside) / (edges[1] - edges[0]) * _PARTS).astype(np.int64)
    return {
        which: _means(which, days, seen.of_row(which), part, edges, near) for which in ("before", "after")
    }
