"""Aggregates for figures (to become residual/dependence).

Aggregates of the series before and after the found effects: what a report's figures are drawn from.

All are means, sums or counts of bounded size, however long the record.

What a diagnosis rests on besides its table: every step's worth, cross-talk, values of what was not taken.

All of it is algebra on the evidence of a finished search; nothing here changes the search.

What the residual follows: the field along each sensor axis as a function of a channel, and chance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.diagnosis.residual import Context, held_out_rms, remaining_residual, with_correctable_rows
from inflight.diagnosis.result import Coefficient
from inflight.diagnosis.search import Option, Search
from inflight.diagnosis.series import Series
from inflight.diagnosis.stepwise import calibration_shifts, estimate, form_disagreement
from inflight.effects import coefficient_unit
from inflight.lsq import correlation_of, gram_inverse, jackknife
from inflight.residual import MIN_BLOCKS, bin_edges
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


def seen_of(search: Search, material: Context) -> Seen:
    """Return the series with what is left before and after what the search took."""
    material = with_correctable_rows(search, material)
    series = material.series
    before, after = (remaining_residual(search, material, one) for one in (False, True))
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


#: Parameters of a cross-talk matrix at most; candidates whose values are worked out.
MOST_PARAMETERS, MOST_TRIALS = 42, 16


@dataclass(frozen=True)
class Step:
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


def waterfall(search: Search, material: Context) -> list[Step]:
    """Return how the held-out error falls with every effect the search took."""
    taken, known = list(search.accepted), with_correctable_rows(search, material)

    def size(options: Sequence[Option]) -> float:
        return held_out_rms(search.holding(options), known)

    sizes = [size(taken[:count]) for count in range(len(taken) + 1)]
    out = []
    for place, option in enumerate(taken):
        first = sizes[0] ** 2 - size([option]) ** 2
        others = [one for one in taken if one is not option]
        last = size(others) ** 2 - sizes[-1] ** 2
        out.append(Step(option.name, option.family, sizes[place], sizes[place + 1], first, last))
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
        Of their errors, the whole span as one calibration interval; 0 where data say nothing.
    """

    names: tuple[str, ...]
    groups: tuple[str, ...]
    correlation: Floats


def cross_talk(search: Search) -> CrossTalk:
    """Return the signed correlations of the parameters' errors.

    Of many refined parameters only those that are most correlated with the others are kept.
    """
    base = [(name, sigma) for term in search.library.base for name, sigma in _known(term.columns, term.sigma)]
    refined = [
        (name, sigma) for term in search.library.refined for name, sigma in _known(term.columns, term.sigma)
    ]
    found = [(name, np.inf) for option in search.accepted for name in option.columns]
    every = [*base, *refined, *found]
    if not every:
        return CrossTalk((), (), np.zeros((0, 0)))
    names = [name for name, _ in every]
    raw = search.raw
    place = raw.index(names)
    precision = search.precision(raw, names, np.array([sigma for _, sigma in every]))
    covariance = gram_inverse(raw.total[np.ix_(place, place)] + np.diag(precision))
    correlation = correlation_of(covariance)
    groups = ["calibration"] * len(base) + ["model"] * len(refined) + ["found"] * len(found)
    kept = _most_correlated(correlation, groups)
    return CrossTalk(
        tuple(names[one].removeprefix("model:") for one in kept),
        tuple(groups[one] for one in kept),
        correlation[np.ix_(kept, kept)],
    )


def _known(columns: Sequence[str], sigma: Sequence[float]) -> list[tuple[str, float]]:
    return list(zip(columns, sigma, strict=True))


def _most_correlated(correlation: Floats, groups: Sequence[str]) -> list[int]:
    fixed = [place for place, group in enumerate(groups) if group != "model"][:MOST_PARAMETERS]
    room = MOST_PARAMETERS - len(fixed)
    own = [place for place, group in enumerate(groups) if group == "model"]
    apart = np.abs(correlation - np.diag(np.diag(correlation)))
    strength = apart[:, fixed].max(axis=1, initial=0.0)
    chosen = sorted(own, key=lambda place: -strength[place])[:room]
    return sorted([*fixed, *chosen])


@dataclass(frozen=True)
class Shift:
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


def shifts_of(search: Search, option: Option, coefficients: Sequence[Coefficient]) -> list[Shift]:
    """Return by how much the calibration shifts for the found value of each coefficient, were it ignored."""
    out = []
    for place, coefficient in enumerate(coefficients):
        gamma = np.zeros(len(option.columns))
        gamma[place] = coefficient.value
        found = calibration_shifts(search, option, gamma)
        out.append(Shift(option.name, coefficient.name, coefficient.unit, coefficient.value, dict(found)))
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


def trials(search: Search, material: Context, names: Sequence[str]) -> dict[str, Trial]:
    """Return the values that candidates would have, each alone beside the model as it was.

    Changes bound to a time and candidates of many columns are left out: they have no value to print.
    """
    known = {option.name: option for option in search.options}
    out = {}
    for name in list(dict.fromkeys(names))[:MOST_TRIALS]:
        option = known.get(name)
        if option is None or option.change is not None:
            continue
        alone = search.holding([option])
        found = estimate(alone, option)
        values = tuple(
            (column.rsplit(".", 1)[-1], float(value), float(sigma), _unit(search, material, option, column))
            for column, value, sigma in zip(found.columns, found.value, found.sigma, strict=True)
        )
        out[name] = Trial(found.retained, form_disagreement(alone, option), values)
    return out


def _unit(search: Search, material: Context, option: Option, column: str) -> str:
    for key in option.terms:
        term = search.library.by_key[key]
        if column in term.columns:
            kind = type(term.entry.effect).parameters()[column[len(term.key) + 1 :].split("[", maxsplit=1)[0]]
            channel = term.entry.effect.channels[0] if term.entry.effect.channels else ""
            return coefficient_unit(kind, material.mission, channel) if channel else kind.unit
    return ""


#: A bin whose field is known worse than this (condition of its equations) is left out.
_CONDITION = 1e4

#: Shifts of a channel that its envelope of chance is taken from, in days.
_SHIFTS = (1.27, 1.61, 2.37, 2.74, 3.43, 3.83)


@dataclass(frozen=True)
class Response:
    """The field along each sensor axis that would make the residual follow a channel.

    Attributes
    ----------
    axes : tuple of str
        ``x``, ``y``, ``z``; ``B`` alone, along the field, where its direction hardly turns.
    branches : dict of str to list of Curve
        ``rising``, ``falling`` (or ``all`` of a channel that hardly turns), by axis, and ``after`` when
        something was found.
    low, high : list of ndarray, shape (bin,)
        Envelope, by axis, of what the channel at other times explains: what chance does.
    """

    channel: str
    unit: str
    axes: tuple[str, ...]
    branches: dict[str, list[Curve]]
    centre: Floats
    low: list[Floats]
    high: list[Floats]

    def stands_out(self, axis: int) -> bool:
        """Return True when some bin lies beyond chance by three sigma."""
        return any(
            bool(np.any(np.isfinite(one.mean) & (np.abs(one.mean) - 3.0 * one.sigma > reach)))
            for name, curves in self.branches.items()
            if name != "after"
            for one, reach in [(curves[axis], self._reach(axis))]
        )

    def _reach(self, axis: int) -> float:
        ends = np.concatenate([self.low[axis], self.high[axis]])
        known = ends[np.isfinite(ends)]
        return float(np.abs(known).max()) if known.size else 0.0


def responses(seen: Seen, channels: Sequence[str]) -> list[Response]:
    """Return the response to each channel that varies; those without enough bins are left out."""
    thin = seen.thinned()
    u, axes = _directions(thin)
    return [found for name in channels for found in [_response(thin, u, axes, name)] if found is not None]


def _directions(seen: Seen) -> tuple[Floats, tuple[str, ...]]:
    """Return the direction of each row (sample, row, axis), and what its axes are called."""
    u = np.where(seen.good[:, None, None], seen.series.direction(), 0.0)
    if not seen.is_scalar or np.linalg.cond(np.einsum("tra,trb->ab", u, u)) < _CONDITION:
        return u, ("x", "y", "z")
    return np.ones((len(u), 1, 1)), ("B",)


def _response(seen: Seen, u: Floats, axes: tuple[str, ...], name: str) -> Response | None:
    series = seen.series
    x = series[name]
    if x.ndim != 1:
        return None
    good = seen.good & np.isfinite(x)
    edges = bin_edges(x[good], BINS)
    blocks = np.unique(seen.block[good])
    if edges is None or blocks.size < MIN_BLOCKS:
        return None
    place = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, edges.size - 2)
    before, after = seen.before, seen.after
    rising = _rising(x, series)
    branches = {}
    if rising is None:
        branches["all"] = _fields("all", x, place, before, u, seen.block, [good])[0]
    else:
        both = [good & (rising > 0), good & (rising < 0)]
        found = _fields("rising", x, place, before, u, seen.block, both)
        branches["rising"] = found[0]
        branches["falling"] = [Curve("falling", one.centre, one.mean, one.sigma) for one in found[1]]
    if seen.changed:
        branches["after"] = _fields("after", x, place, after, u, seen.block, [good])[0]
    chance = list(_chance(seen, u, x, edges, good))
    low = [np.min([one[axis].mean for one in chance], axis=0) for axis in range(len(axes))]
    high = [np.max([one[axis].mean for one in chance], axis=0) for axis in range(len(axes))]
    unit = series.features.units[series.features.names.index(name)]
    return Response(name, unit, axes, branches, chance[0][0].centre, low, high)


def _rising(x: Floats, series: Series) -> Floats | None:
    """Return +1 where a channel rises, -1 where it falls, 0 between; None when it turns too seldom."""
    reach = max(1, round(120.0 / series.step_s))
    change = np.zeros_like(x)
    if x.size <= 2 * reach:
        return None
    change[reach:-reach] = x[2 * reach :] - x[: -2 * reach]
    change = np.nan_to_num(change)
    spread = float(np.nanstd(x))
    sign = np.where(np.abs(change) > 0.02 * spread, np.sign(change), 0.0)
    return sign if min((sign > 0).mean(), (sign < 0).mean()) > 0.1 else None


def _chance(
    seen: Seen, u: Floats, x: Floats, edges: Floats, good: npt.NDArray[np.bool_]
) -> Iterator[list[Curve]]:
    """Yield the response to the channel of another time, which the residual cannot follow."""
    series = seen.series
    per_day = DAY / (SECOND * series.step_s)
    for shift in _SHIFTS:
        samples = round(shift * per_day)
        if samples >= 0.6 * x.size:
            samples = round(x.size * (0.2 + 0.6 * (shift % 1.0)))
        moved = np.roll(x, samples)
        place = np.clip(np.searchsorted(edges, moved, side="right") - 1, 0, edges.size - 2)
        inside = good & np.isfinite(moved)
        yield _fields("chance", moved, place, seen.before, u, np.zeros_like(seen.block), [inside])[0]


def _fields(
    label: str,
    x: Floats,
    place: Int64,
    residual: Floats,
    u: Floats,
    block: Int64,
    sides: Sequence[npt.NDArray[np.bool_]],
) -> list[list[Curve]]:
    """Return, a side, the field along each axis in bins, all less one common mean field.

    The residual of a sample is ``u @ f`` of its row; each bin is a least-squares fit of f.
    """
    bins = int(place.max()) + 1
    inside = np.any(sides, axis=0)
    side = np.argmax(sides, axis=0)[inside]
    _, which = np.unique(block[inside], return_inverse=True)
    shape = (int(which.max()) + 1, len(sides) * bins)
    cell = which * shape[1] + side * bins + place[inside]
    y, rows = residual[inside], u[inside]
    axes = u.shape[2]
    gram, right = np.empty((*shape, axes, axes)), np.empty((*shape, axes))

    def summed(values: Floats) -> Floats:
        found = np.bincount(cell, weights=values, minlength=shape[0] * shape[1])
        return np.asarray(found, dtype=np.float64).reshape(shape)

    for i in range(axes):
        right[..., i] = summed(np.einsum("tr,tr->t", rows[:, :, i], y))
        for j in range(i, axes):
            gram[..., i, j] = gram[..., j, i] = summed(np.einsum("tr,tr->t", rows[:, :, i], rows[:, :, j]))
    count = summed(np.ones(len(y))).sum(axis=0)
    centre = np.divide(summed(x[inside]).sum(axis=0), count, out=np.full(shape[1], np.nan), where=count > 0)
    mean, sigma = _solved(gram, right, count)
    return [
        [Curve(label, centre[part], mean[part, axis], sigma[part, axis]) for axis in range(axes)]
        for part in (slice(one * bins, (one + 1) * bins) for one in range(len(sides)))
    ]


def _solved(gram: Floats, right: Floats, count: Floats) -> tuple[Floats, Floats]:
    """Return each cell's field less the common mean, and its jackknife error over blocks; (cell, axis)."""
    whole, total, eye = gram.sum(axis=0), right.sum(axis=0), np.eye(right.shape[-1])
    met = (count >= FEWEST) & (np.linalg.cond(whole + 1e-12 * eye) < _CONDITION)
    if not met.any():
        nothing = np.full(total.shape, np.nan)
        return nothing, nothing
    share = np.where(met, count, 0.0) / count[met].sum()
    ridge = 1e-9 * np.maximum(np.trace(whole, axis1=1, axis2=2), 1e-9)[:, None, None] * eye
    field = np.linalg.solve(whole + ridge, total[..., None])[..., 0]
    field = np.where(met[:, None], field - share @ np.where(met[:, None], field, 0.0), np.nan)
    if len(gram) < 2:
        return field, np.full_like(field, np.nan)
    without = np.linalg.solve(whole - gram + ridge, (total - right)[..., None])[..., 0]
    without = np.where(met[None, :, None], without, 0.0)
    without -= np.einsum("c,bca->ba", share, without)[:, None, :]
    return field, np.where(met[:, None], jackknife(without), np.nan)
