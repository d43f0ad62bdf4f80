"""Aggregates that the figures and tables of a diagnosis are drawn from.

Takes a finished search and the series of its span; makes means, sums and counts of bounded size, however long
the record: the residual before and after the found effects by time and phase, along the field, around an
event, against channels (`inflight.residual.field_response`); how the held-out error falls effect by effect;
correlations of the parameters' errors, shifts of the calibration, values of candidates that were not taken.
The last are algebra on the Gram blocks of the search; nothing here changes the search.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.diagnosis.residual import (
    DiagnosisData,
    contribution,
    held_out_rms,
    number_contribution,
    remaining_residual,
    with_correctable_rows,
)
from inflight.diagnosis.result import Coefficient
from inflight.diagnosis.search import Option, Search
from inflight.diagnosis.series import Series
from inflight.diagnosis.stepwise import calibration_shifts, estimate, form_disagreement
from inflight.diagnosis.verdict import column_unit
from inflight.lsq import correlation_of, gram_inverse
from inflight.residual import (
    DEPENDENCE_SETTINGS,
    Coordinate,
    Curve,
    FieldResponse,
    axis_response,
    curve_of,
    field_axes,
    field_response,
    measure_dependences,
)
from inflight.time import DAY, SECOND, Int64, to_utc


@dataclass(frozen=True, kw_only=True)
class ViewSettings:
    """Sizes of what is drawn.

    Attributes
    ----------
    map_rows, map_columns, maps : int
        Rows and columns of a heat map at most, and maps that are drawn.
    most_samples : int
        Samples curves are taken from at most.
    reach_s : float
        Seconds on either side over which a channel rises or falls. Assumed.
    histogram, days : int
        Bins of the histogram, and days drawn at most.
    parts : int
        Parts of a bin of time that its error is taken from.
    turned : float
        Least range of a component of the direction that is drawn. Assumed.
    day_blocks : int
        Days of a record whose uncertainties are taken between days. Assumed.
    most_parameters, most_trials : int
        Parameters of a cross-talk matrix at most; candidates whose values are worked out.
    rivals : int
        Rivals of one effect that are drawn at most.
    latitude_deg, local_time_h : float
        Cells of a map of places.
    """

    map_rows: int = 84
    map_columns: int = 72
    maps: int = 2
    most_samples: int = 250_000
    reach_s: float = 120.0
    histogram: int = 120
    days: int = 1000
    parts: int = 8
    turned: float = 0.2
    day_blocks: int = 10
    most_parameters: int = 42
    most_trials: int = 16
    rivals: int = 3
    latitude_deg: float = 5.0
    local_time_h: float = 0.5


VIEW_SETTINGS = ViewSettings()

#: Coordinates of a heat map with unit and whole turn, the most informative first.
_COORDINATES = {
    "orbit_phase": ("deg", 360.0),
    "sun_phase": ("deg", 360.0),
    "local_time": ("h", 24.0),
}

#: Units of time, their seconds, and the shortest row they are used for, seconds.
_CLOCK = (("h", 3600.0, 7200.0), ("min", 60.0, 300.0), ("s", 1.0, 0.0))


@dataclass(frozen=True)
class BeforeAfter:
    """The series with its residual before and after the found effects.

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

    def thinned(self, most: int = VIEW_SETTINGS.most_samples) -> BeforeAfter:
        """Return every n-th sample, so that at most so many stay."""
        step = -(-len(self.before) // most)
        if step == 1:
            return self
        one = self.series
        series = Series(one.tt2000[::step], one.values[::step], one.block[::step], one.features)
        return BeforeAfter(series, self.before[::step], self.after[::step], self.block[::step])


def before_after(search: Search, data: DiagnosisData) -> BeforeAfter:
    """Return the series with its residual before and after what the search took."""
    data = with_correctable_rows(search, data)
    before, after = (remaining_residual(search, data, one) for one in (False, True))
    return with_blocks(data.series, before, after)


def with_blocks(series: Series, before: Floats, after: Floats) -> BeforeAfter:
    """Return a series with its residual (sample, row) before and after, nT, and blocks for its errors."""
    day = (series.tt2000 - series.tt2000[0]) // DAY
    long = day.size > 0 and day[-1] >= VIEW_SETTINGS.day_blocks
    return BeforeAfter(series, before, after, np.asarray(day if long else series.block, dtype=np.int64))


# One effect.


@dataclass(frozen=True)
class EntryCurve:
    """What one effect that was taken looks like: what is measured, what it makes, and what is left with it.

    Attributes
    ----------
    name : str
        Of the effect.
    coordinate, unit, axis : str
        What it is drawn against, and the sensor axis of the field; without an axis it is the residual, drawn
        against what the effect makes of it.
    centre : ndarray, shape (bin,)
        Mean coordinate.
    measured, measured_sigma, made, left, left_sigma : ndarray, shape (bin,)
        nT: measured with all else in the model, made by the effect, left with it in the model, too.
    instead_of : str
        The effect whose place a rival takes; empty for an effect that was taken.
    """

    name: str
    coordinate: str
    unit: str
    axis: str
    centre: Floats
    measured: Floats
    measured_sigma: Floats
    made: Floats
    left: Floats
    left_sigma: Floats
    instead_of: str = ""


def entry_curves(search: Search, data: DiagnosisData, seen: BeforeAfter) -> list[EntryCurve]:
    """Return the curve of each effect that the search took, the strongest first; those of too few bins not.

    Were the effect what is there, what is measured lies on what it makes, and what is left is flat.
    """
    known = with_correctable_rows(search, data)
    out: list[tuple[float, EntryCurve]] = []
    for option in search.accepted:
        size, curve = _curve_with(search, known, seen, option)
        if curve is not None:
            out.append((-size, curve))
    return [curve for _, curve in sorted(out, key=lambda one: one[0])]


def rival_curves(
    search: Search, data: DiagnosisData, seen: BeforeAfter, confusion_set: Sequence[Mapping[str, Any]]
) -> list[EntryCurve]:
    """Return the curves of causes that cannot be told from those taken, each in the place of its rival.

    They look as good as the causes taken, or nearly so: that is what makes them rivals.

    Parameters
    ----------
    confusion_set : sequence of mapping
        Of the verdict: a cause that was taken, then its rivals.
    """
    known, options = with_correctable_rows(search, data), {one.name: one for one in search.options}
    taken = {one.name: one for one in search.accepted}
    out, place, count = [], None, 0
    for one in confusion_set:
        if one["name"] in taken:
            place, count = taken[one["name"]], 0
        elif place is not None and one["name"] in options and count < VIEW_SETTINGS.rivals:
            rival, count = options[one["name"]], count + 1
            others = [rival if each is place else each for each in search.accepted]
            instead = search.with_accepted(others)
            residual = replace(seen, after=remaining_residual(instead, known))
            curve = _curve_with(instead, known, residual, rival)[1]
            if curve is not None:
                out.append(replace(curve, instead_of=place.name))
    return out


def number_curves(
    search: Search, data: DiagnosisData, seen: BeforeAfter, refined: Sequence[Mapping[str, Any]]
) -> list[EntryCurve]:
    """Return the curve of each number of the model's own that is told as wrong; those of too few bins not.

    Measured is the residual with the number as the model states it, everything else fitted anew; left is what
    remains with the number that data give it.

    Parameters
    ----------
    refined : sequence of mapping
        Of the verdict: ``name`` and ``wrong``.
    """
    known, thin = with_correctable_rows(search, data), seen.thinned()
    step = -(-len(seen.before) // len(thin.before))
    wrong = dict.fromkeys(one["name"].partition("[")[0] for one in refined if one["wrong"])
    curves = (_curve_of_sizes(thin, name, number_contribution(search, known, name)[::step]) for name in wrong)
    return [curve for curve in curves if curve is not None]


def _curve_with(
    search: Search, data: DiagnosisData, seen: BeforeAfter, option: Option
) -> tuple[float, EntryCurve | None]:
    """Return the rms of what an option that was taken makes, and its curve when there are bins enough."""
    thin = seen.thinned()
    step = -(-len(seen.before) // len(thin.before))
    made = contribution(search, data, option)[::step]
    curve = _curve_along_axis(thin, option, made) or _curve_of_sizes(thin, option.name, made)
    return float(np.nanstd(made[thin.good])), curve


#: Effects that are fields along fixed axes, by the beginnings of their names: drawn axis by axis.
_FIELDS = ("channel_field", "channel_power", "function_of_channel", "hysteresis", "day_night", "offset_")


def _curve_along_axis(seen: BeforeAfter, option: Option, made: Floats) -> EntryCurve | None:
    """Return the curve of a field against the channel it follows, or time, along its strongest axis."""
    series, good = seen.series, seen.good
    if not (seen.is_scalar and option.name.startswith(_FIELDS)):
        return None
    units = dict(zip(series.features.names, series.features.units, strict=True))
    channel = "time" if option.name.startswith("offset_") else next(iter(option.channels), "")
    channel = channel.partition("@")[0]
    if channel == "time":
        unit, x = "d", (series.tt2000 - series.tt2000[0]) / DAY
    elif len(option.channels) == 1 and channel in series.channels and series[channel].ndim == 1:
        unit, x = units[channel], series[channel]
    else:
        return None
    x = np.where(good, x, np.nan)
    u = series.direction()[:, 0]
    found = [
        axis_response(channel, unit, x, values[:, 0], u, seen.block)
        for values in (seen.after + made, made, seen.after)
    ]
    if any(one is None for one in found):
        return None
    measured, model, left = (one for one in found if one is not None)
    axis = int(np.argmax(np.std(model.field, axis=0)))
    return EntryCurve(
        option.name,
        channel,
        unit,
        "xyz"[axis],
        model.centre,
        measured.field[:, axis],
        measured.sigma[:, axis],
        model.field[:, axis],
        left.field[:, axis],
        left.sigma[:, axis],
    )


def _curve_of_sizes(seen: BeforeAfter, name: str, made: Floats) -> EntryCurve | None:
    """Return the curve of any effect against what it makes of the residual: a straight line."""
    row = seen.row
    x = np.where(seen.good, made[:, row], np.nan)
    against = Coordinate(name, "nT", "", x)
    parts = [
        measure_dependences([against], values[:, row], seen.block)
        for values in (seen.after + made, made, seen.after)
    ]
    if not all(parts):
        return None
    measured, model, left = (part[0] for part in parts)
    return EntryCurve(
        name,
        "",
        "nT",
        "",
        model.centre,
        measured.mean,
        measured.sigma,
        model.mean,
        left.mean,
        left.sigma,
    )


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


def heat_maps(seen: BeforeAfter) -> list[HeatMap]:
    """Return maps of day against orbit phase and Sun phase, local time or what else there is."""
    series = seen.series
    there = [name for name in _COORDINATES if name in series.channels]
    varied = []
    for name in there:
        # A coordinate must run through most of its turn within the record.
        known = series[name][np.isfinite(series[name])] / _COORDINATES[name][1]
        if np.unique((known * 8).astype(np.int64) % 8).size >= 6:
            varied.append(name)
    length = _row_length(series.tt2000)
    place = (series.tt2000 - series.tt2000[0]) // length
    first, rows = int(series.tt2000[0]), int(place[-1]) + 1
    # No more columns than a row has samples, or every other one were empty.
    columns = int(np.clip(length / (SECOND * series.step_s), 4, VIEW_SETTINGS.map_columns))
    span = (first, first + rows * length)
    out = []
    for name in varied[: VIEW_SETTINGS.maps]:
        unit, reach = _COORDINATES[name]
        out.append(_map(seen, (name, unit, reach), series[name], place, span, VIEW_SETTINGS.map_columns))
    if not out:
        name, unit, reach, values = _time_coordinate(series.tt2000, length)
        out.append(_map(seen, (name, unit, reach), values, place, span, columns))
    return out


def _row_length(tt2000: Int64) -> int:
    """Return the length of a map's row, ns: a day or more of a long record, else a part of it."""
    whole = int(tt2000[-1] - tt2000[0]) + 1
    if whole >= 4 * DAY:
        return DAY * -(-whole // (DAY * VIEW_SETTINGS.map_rows))
    return max(-(-whole // 24), 1)


def residual_map(tt2000: Int64, residual: Floats, coordinates: Mapping[str, Floats]) -> HeatMap:
    """Return a map of a residual (sample,) by time and the first coordinate that runs through its turn.

    Parameters
    ----------
    tt2000, residual : ndarray, shape (sample,)
        Sorted times, and nT; NaN where nothing was measured.
    coordinates : mapping of str to ndarray
        By name, as `heat_maps` knows them; the time of day when none serves.

    Returns
    -------
    HeatMap
        With the same values before and after.
    """
    length = _row_length(tt2000)
    place = (tt2000 - tt2000[0]) // length
    rows, first = int(place[-1]) + 1, int(tt2000[0])
    columns = VIEW_SETTINGS.map_columns
    for name, (unit, reach) in _COORDINATES.items():  # noqa: B007 (used below)
        values = coordinates.get(name, np.empty(0))
        if np.unique((values[np.isfinite(values)] / reach * 8).astype(np.int64) % 8).size >= 6:
            break
    else:
        name, unit, reach, values = _time_coordinate(tt2000, length)
        columns = int(np.clip(length / (np.median(np.diff(tt2000)) or SECOND), 4, columns))
    good = np.isfinite(residual) & np.isfinite(values)
    column = np.clip((values[good] % reach / reach * columns).astype(np.int64), 0, columns - 1)
    means = _cell_means(
        place[good] * columns + column, np.ones(int(good.sum())), residual[good], (rows, columns)
    )
    return HeatMap(name, unit, (first, first + rows * length), reach, means, means)


def place_map(latitude: Floats, local_time: Floats, residual: Floats) -> Floats:
    """Return the mean residual (sample,) by latitude and local time, nT; (latitude, local time).

    Parameters
    ----------
    latitude, local_time : ndarray, shape (sample,)
        deg and h. Cells are of `ViewSettings.latitude_deg` and `ViewSettings.local_time_h`, from -90 deg and
        from midnight; NaN where nothing was measured.
    """
    step, hours = VIEW_SETTINGS.latitude_deg, VIEW_SETTINGS.local_time_h
    rows, columns = round(180.0 / step), round(24.0 / hours)
    good = np.isfinite(latitude) & np.isfinite(local_time) & np.isfinite(residual)
    row = np.clip(((latitude[good] + 90.0) / step).astype(np.int64), 0, rows - 1)
    column = np.clip((local_time[good] % 24.0 / hours).astype(np.int64), 0, columns - 1)
    return _cell_means(row * columns + column, np.ones(row.size), residual[good], (rows, columns))


def _cell_means(cell: Int64, weight: Floats, values: Floats, shape: tuple[int, int]) -> Floats:
    """Return the weighted means of values in cells (row, column); NaN where there are none."""
    size = shape[0] * shape[1]
    total = np.bincount(cell, weights=weight, minlength=size)
    summed = np.bincount(cell, weights=weight * values, minlength=size)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(total > 0, summed / total, np.nan).reshape(shape)


def _time_coordinate(tt2000: Int64, length: int) -> tuple[str, str, float, Floats]:
    if length >= DAY:
        utc = to_utc(tt2000)
        return "time of day (UTC)", "h", 24.0, (utc - utc.astype("datetime64[D]")) / np.timedelta64(1, "h")
    unit, size = next(one for one in _CLOCK if length >= one[2] * SECOND)[:2]
    inside = ((tt2000 - tt2000[0]) % length) / (size * SECOND)
    return "time within the row", unit, length / (size * SECOND), inside


def _map(
    seen: BeforeAfter,
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
    means = [
        _cell_means(cell, weight, seen.of_row(which)[good], (rows, columns)) for which in ("before", "after")
    ]
    return HeatMap(name, unit, span, reach, means[0], means[1])


# Curves.


def along_field(seen: BeforeAfter, axis: int = 2) -> dict[str, list[Curve]]:
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
    if not thin.good.any() or np.ptp(part[thin.good]) < VIEW_SETTINGS.turned:
        return {}
    sides = {"all": np.ones(part.size, dtype=bool)}
    if "sunlit" in thin.series.channels:
        lit = thin.series["sunlit"] > 0.5
        if lit.any() and not lit.all():
            sides = {"day": lit, "night": ~lit}
    edges = np.linspace(-1.0, 1.0, 2 * DEPENDENCE_SETTINGS.curve_bins + 1)
    out: dict[str, list[Curve]] = {}
    for which in ("before", "after") if seen.changed else ("before",):
        values = thin.of_row(which)
        out[which] = [curve_of(label, part, values, thin.block, edges, side) for label, side in sides.items()]
    return out


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


def sizes_of(seen: BeforeAfter) -> Sizes:
    """Return distribution and daily rms of all rows together."""
    good = seen.good
    span = int(seen.series.tt2000[-1] - seen.series.tt2000[0]) + 1
    width = DAY * -(-span // (DAY * VIEW_SETTINGS.days)) if span >= 2 * DAY else max(-(-span // 24), 1)
    day = (seen.series.tt2000 - seen.series.tt2000[0]) // width
    count = np.bincount(day[good], minlength=int(day[-1]) + 1)
    wide = 6.0 * float(np.quantile(np.abs(seen.before[good]), 0.8)) if good.any() else 1.0
    edges = np.linspace(-wide, wide, VIEW_SETTINGS.histogram + 1)
    counts, rms = {}, {}
    for which, values in (("before", seen.before), ("after", seen.after)):
        counts[which] = np.histogram(values[good], edges)[0].astype(np.float64)
        square = np.bincount(day[good], weights=np.mean(values[good] ** 2, axis=1), minlength=count.size)
        rms[which] = np.sqrt(np.divide(square, count, out=np.full(count.size, np.nan), where=count > 0))
    middle = seen.series.tt2000[0] + np.arange(count.size) * width + width // 2
    return Sizes(edges, counts, np.asarray(middle, dtype=np.int64), rms)


def superposed_epoch(seen: BeforeAfter, when: int, width: int = 40) -> dict[str, Curve]:
    """Return the mean residual around an event, before and after; the coordinate is days from it."""
    days = (seen.series.tt2000 - when) / DAY
    inside = float(min(max(days[-1], 0.1), max(-days[0], 0.1), 10.0))
    edges = np.linspace(-inside, inside, width + 1)
    near = np.abs(days) < inside
    # A bin of time lies within one block of the search: its error is that between its own parts.
    part = np.floor((days + inside) / (edges[1] - edges[0]) * VIEW_SETTINGS.parts).astype(np.int64)
    return {
        which: curve_of(which, days, seen.of_row(which), part, edges, near) for which in ("before", "after")
    }


@dataclass(frozen=True)
class ErrorContribution:
    """One effect's part in how the held-out error falls.

    Attributes
    ----------
    name, family : str
    before, after : float
        Held-out rms without and with it, in the order the effects were taken, nT.
    first_in, last_in : float
        What it takes off the mean square when it is taken first, and when it is taken last, nT^2.
    """

    name: str
    family: str
    before: float
    after: float
    first_in: float
    last_in: float

    @property
    def removed(self) -> float:
        """What it takes off the mean square in the order the effects were taken, nT^2."""
        return self.before**2 - self.after**2


def error_waterfall(search: Search, data: DiagnosisData) -> list[ErrorContribution]:
    """Return how the held-out error falls with every effect the search took."""
    taken, known = list(search.accepted), with_correctable_rows(search, data)

    def size(options: Sequence[Option]) -> float:
        return held_out_rms(search.with_accepted(options), known)

    sizes = [size(taken[:count]) for count in range(len(taken) + 1)]
    out = []
    for place, option in enumerate(taken):
        first = sizes[0] ** 2 - size([option]) ** 2
        others = [one for one in taken if one is not option]
        last = size(others) ** 2 - sizes[-1] ** 2
        out.append(ErrorContribution(option.name, option.family, sizes[place], sizes[place + 1], first, last))
    return out


# Cross-talk.


@dataclass(frozen=True)
class CrossTalk:
    """How parameters answer for each other.

    Attributes
    ----------
    names : tuple of str
        Calibration, then refined, then found.
    groups : tuple of str
        ``calibration``, ``model`` or ``found`` of each.
    correlation : ndarray, shape (parameter, parameter)
        Of their errors, the whole span as one calibration interval; 0 where the data determine nothing.
    """

    names: tuple[str, ...]
    groups: tuple[str, ...]
    correlation: Floats


def cross_talk(search: Search) -> CrossTalk:
    """Return the signed correlations of the parameters' errors.

    Of many refined parameters only those that are most correlated with the others are kept.
    """
    base, refined = (
        [pair for term in terms for pair in zip(term.columns, term.sigma, strict=True)]
        for terms in (search.library.base, search.fitted_terms)
    )
    found = [(name, np.inf) for option in search.accepted for name in option.columns]
    every = [*base, *refined, *found]
    if not every:
        return CrossTalk((), (), np.zeros((0, 0)))
    names = [name for name, _ in every]
    raw = search.raw
    place = raw.index(names)
    precision = search.precision(raw, names, np.array([sigma for _, sigma in every]))
    covariance = gram_inverse(raw.rows(place, place).sum(axis=0) + np.diag(precision))
    correlation = correlation_of(covariance)
    groups = ["calibration"] * len(base) + ["model"] * len(refined) + ["found"] * len(found)
    fixed = [place for place, group in enumerate(groups) if group != "model"][: VIEW_SETTINGS.most_parameters]
    own = [place for place, group in enumerate(groups) if group == "model"]
    # Of many refined parameters those that are most correlated with the others are kept.
    others = np.abs(correlation - np.diag(np.diag(correlation)))
    strength = others[:, fixed].max(axis=1, initial=0.0)
    chosen = sorted(own, key=lambda place: -strength[place])[: VIEW_SETTINGS.most_parameters - len(fixed)]
    kept = sorted([*fixed, *chosen])
    return CrossTalk(
        tuple(names[one].removeprefix("model:") for one in kept),
        tuple(groups[one] for one in kept),
        correlation[np.ix_(kept, kept)],
    )


@dataclass(frozen=True)
class CalibrationBias:
    """What a found coefficient, ignored, does to the calibration; it is straight in the value.

    Attributes
    ----------
    effect, coefficient, unit : str
    value : float
    shifts : dict of str to float
        Calibration parameter -> its shift in the parameter's own physical unit.
    """

    effect: str
    coefficient: str
    unit: str
    value: float
    shifts: dict[str, float]


def calibration_biases(
    search: Search, option: Option, coefficients: Sequence[Coefficient]
) -> list[CalibrationBias]:
    """Return by how much the calibration shifts for the found value of each coefficient, were it ignored."""
    out = []
    for place, coefficient in enumerate(coefficients):
        gamma = np.zeros(len(option.columns))
        gamma[place] = coefficient.value
        found = calibration_shifts(search, option, gamma)
        out.append(
            CalibrationBias(option.name, coefficient.name, coefficient.unit, coefficient.value, dict(found))
        )
    return out


# Candidates that were not taken.


@dataclass(frozen=True)
class Trial:
    """A candidate put into the model alone.

    Attributes
    ----------
    retained : float
        Part of its variance that the model leaves.
    consistency : float or None
        W / k of the raw and the within-day values.
    values : tuple of (str, float, float, str)
        Coefficient, value, sigma, unit.
    """

    retained: float
    consistency: float | None
    values: tuple[tuple[str, float, float, str], ...]


def trials(search: Search, data: DiagnosisData, names: Sequence[str]) -> dict[str, Trial]:
    """Return the values that candidates would have, each alone added to the model as it was.

    Changes bound to a time and candidates of many columns are skipped: they have no value to print.
    """
    known = {option.name: option for option in search.options}
    out = {}
    for name in list(dict.fromkeys(names))[: VIEW_SETTINGS.most_trials]:
        option = known.get(name)
        if option is None or option.change is not None:
            continue
        alone = search.with_accepted([option])
        found = estimate(alone, option)
        terms = [search.library.by_key[key] for key in option.terms]
        units = {column: column_unit(data.mission, term, column) for term in terms for column in term.columns}
        values = tuple(
            (column.rsplit(".", 1)[-1], float(value), float(sigma), units.get(column, ""))
            for column, value, sigma in zip(found.columns, found.value, found.sigma, strict=True)
        )
        out[name] = Trial(found.retained, form_disagreement(alone, option), values)
    return out


def responses(seen: BeforeAfter, channels: Sequence[str]) -> list[FieldResponse]:
    """Return the response to each channel that varies; those without enough bins are left out."""
    thin = seen.thinned()
    series = thin.series
    direction = np.where(thin.good[:, None, None], series.direction(), 0.0)
    columns = field_axes(direction, thin.is_scalar)
    residuals = {"before": thin.before} | ({"after": thin.after} if thin.changed else {})
    reach = max(1, round(VIEW_SETTINGS.reach_s / series.step_s))
    units = dict(zip(series.features.names, series.features.units, strict=True))
    coordinates = [(name, units[name], series[name]) for name in channels if series[name].ndim == 1]
    found = [field_response(one, residuals, columns, thin.block, thin.good, reach) for one in coordinates]
    return [one for one in found if one is not None]
