"""Design matrices: columns of the residual, from native samples to the library's cadence.

Takes a day's native rows and the channels on the library's bins; makes `DesignRows` (`coarsen`): means of
the good samples of each bin, spikes and bursts left out. Means of bins keep every linear statement: the mean
residual is the same function of the mean columns. From rows and terms, `design_matrix` makes the columns:
the change of the residual by one unit of each parameter.

Sign: a column is the derivative of the corrected residual by the parameter, so that ``y + X d`` is the
residual after a change d, as in `inflight.calibration.normal_equations`. An effect that adds a field is
evaluated once, for it is linear; one inside an instrument's equation is differenced (central, by the
parameter's step).

A burst is a stretch in which the residual scatters far beyond what is usual, sample by sample: each sample is
held against the straight line through its neighbours (`_second_differences`). A switch, a slow field, a storm
seen through a clock offset deviate from it in at most a few samples. What also shows in both instruments'
readings, or goes with a recorded channel that fluctuates as much, is a signal and stays (`is_signal`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import scipy
import xarray as xr

from inflight.arrays import Floats, sums_of_runs
from inflight.design.terms import Difference, Term, within_span
from inflight.effects import AXES, VECTOR_ROLES, Affine, SpinningSensor, VectorSensor, multiply
from inflight.frames import direction_of
from inflight.lsq import MAD_TO_SIGMA, gram_of, in_turns
from inflight.model import Model, ModelEffect, ResidualRows, RowFilter
from inflight.samples import FIELD_ROLES, PlainSamples
from inflight.time import GAP, SECOND, Int64, utc_text

#: Effects that are the equation of a whole sensor: their matrix acts on what comes before them.
SENSOR_EQUATIONS = (VectorSensor, SpinningSensor, Affine)

#: Effects whose correction is a matrix times the reading and a shift, whatever the samples are.
_AFFINE = (VectorSensor, Affine)

#: Field that shows such a matrix, nT, and the part of the change there that is no more than rounding.
_FIELD = 1e4
_ROUNDING = 1e-9


@dataclass(frozen=True)
class DesignRows:
    """Everything columns are made from, for one block of samples.

    Attributes
    ----------
    samples : xarray.Dataset
        Readings, `field`, `field_direction`, channels and geometry on the library's time base.
    residual : ndarray, shape (time, row)
        nT, at the values the columns are linearised at.
    directions : dict of str to ndarray, shape (time, row, axis)
        Change of each row by a field added at a sensor.
    sensor_matrices : dict of str to ndarray, shape (9,)
        What the sensor's own equation behind an effect does to a change of its reading: K, row by row.
    weight : ndarray, shape (time,)
        Good native samples of each over the usual number; 0 where there are none.
    row_filter : RowFilter, optional
        The filter the residual went through; columns go through it, too.
    averaged : dict of str to ndarray, shape (time, row)
        Columns that were made before rows became means of several: a reading times a direction is another
        thing after it.
    """

    samples: xr.Dataset
    residual: Floats
    directions: Mapping[str, Floats]
    sensor_matrices: Mapping[str, Floats]
    weight: Floats
    row_filter: RowFilter | None = None
    averaged: Mapping[str, Floats] = field(default_factory=dict)

    @cached_property
    def directions_of_readings(self) -> dict[str, Floats]:
        """Change of each row by a change of a sensor's reading before its own equation; as `directions`."""
        found = dict(self.directions)
        for name in set(found) & set(self.sensor_matrices):
            matrix = self.sensor_matrices[name].reshape(3, 3)
            found[name] = np.moveaxis(np.tensordot(matrix.T, np.moveaxis(found[name], -1, 0), 1), 0, -1)
        return found

    def part(self, rows: slice) -> DesignRows:
        """Return some consecutive rows."""
        return replace(
            self,
            samples=self.samples.isel(time=rows),
            residual=self.residual[rows],
            directions={name: one[rows] for name, one in self.directions.items()},
            weight=self.weight[rows],
            averaged={name: one[rows] for name, one in self.averaged.items()},
        )


def sensor_matrices(model: Model, tt2000: int) -> dict[str, Floats]:
    """Return the matrix of every sensor that has an equation, row by row; (9,) each."""
    found = {}
    for entry in model.effects:
        if isinstance(entry.effect, SENSOR_EQUATIONS):
            values = entry.values(tt2000)
            unit, zero = (
                entry.effect.correct(reading, xr.Dataset(), values, entry.sensor)
                for reading in (np.eye(3), np.zeros((3, 3)))
            )
            found[entry.sensor.name] = np.ascontiguousarray((unit - zero).T).reshape(9)
    return found


def term_columns(term: Term, rows: DesignRows) -> Floats:
    """Return the columns of a term; (time, row, column), nT per scaled unit.

    Raises
    ------
    SamplesError
        When a channel is not in the samples.
    """
    return np.stack([column.of(slice(None)).T for column in _columns_of(term, rows)], axis=-1)


class _Column(NamedTuple):
    """A column (time, row), or a direction (time, row) and the series (time,) that is its factor."""

    values: Floats
    series: Floats | None = None

    def of(self, some: slice, out: Floats | None = None) -> Floats:
        """Return, or write, the column at some samples; (row, time)."""
        values = self.values[some].T
        if self.series is not None:
            return np.multiply(values, self.series[some], out=out)
        if out is not None:
            out[:] = values
        return values


def _columns_of(term: Term, rows: DesignRows) -> Iterator[_Column]:
    """Yield the columns of a term one by one."""
    if rows.averaged and term.columns and set(term.columns) <= set(rows.averaged):
        yield from (_Column(rows.averaged[name]) for name in term.columns)
        return
    outside = ~within_span(rows.samples["tt2000"].values, term.span) if term.span else None
    for column in _columns_in_and_out(term, rows):
        found = column if isinstance(column, _Column) else _Column(column)
        yield found if outside is None else _Column(np.where(outside[:, None], 0.0, found.of(slice(None)).T))


def _columns_in_and_out(term: Term, rows: DesignRows) -> Iterator[Floats | _Column]:
    """Yield the columns of a term, whether or not a sample is within its span; (time, row) each."""
    if term.difference is not None:
        yield _of_difference(term.difference, rows)
        return
    entry = term.entry
    kinds = entry.effect.parameters()
    times = rows.samples["tt2000"].values
    values = {name: np.array(value) for name, value in entry.values(times).items()}
    constant = all(value.ndim == 1 for value in values.values())
    for name in term.parameters:
        step = kinds[name].step
        if isinstance(entry.effect, _AFFINE) and constant:
            yield from _affine_columns(term, rows, values, name, step)
        elif entry.is_additive and entry.effect.acts_along_axes():
            series = -step * entry.effect.along_axes(rows.samples, name).reshape(len(times), -1)
            # Each series as one run of memory: it is read once a column.
            series = np.ascontiguousarray(series.T)
            direction = np.moveaxis(_directions_of(entry, rows), -1, 0)
            pairs = [(axis, source) for axis in range(len(AXES)) for source in range(len(series))]
            if entry.effect.source_first:
                pairs.sort(key=lambda pair: pair[1])
            yield from (_Column(direction[axis], series[source]) for axis, source in pairs)
        elif entry.is_additive:
            directions = _directions_of(entry, rows)
            yield from (
                _additive(term, rows, directions, values, name, index, step)
                for index in range(kinds[name].size)
            )
        elif entry.effect.axis_by_axis and kinds[name].size == len(AXES):
            yield from _differenced_by_axis(term, rows, values, name, step)
        else:
            yield from (
                _differenced(term, rows, values, name, index, step) for index in range(kinds[name].size)
            )


def _of_difference(difference: Difference, rows: DesignRows) -> Floats:
    """Column of a number that is held: what the model's effects make with it at two values; (time, row)."""
    times = rows.samples["tt2000"].values
    found = np.zeros(rows.residual.shape)
    for low, high in zip(difference.low, difference.high, strict=True):
        sensor = low.sensor
        if low.is_additive:
            fields = [one.effect.field(rows.samples, one.values(times), sensor) for one in (high, low)]
            found -= np.einsum("tra,ta->tr", _directions_of(high, rows), fields[0] - fields[1])
            continue
        reading = np.asarray(rows.samples[sensor.role].values, dtype=np.float64)
        made = [one.effect.correct(reading, rows.samples, one.values(times), sensor) for one in (high, low)]
        change = made[0] - made[1]
        if sensor.role not in VECTOR_ROLES:
            found -= change[:, None]
            continue
        if sensor.name in rows.sensor_matrices:
            change = multiply(rows.sensor_matrices[sensor.name], change)
        found += np.einsum("tra,ta->tr", rows.directions[sensor.name], change)
    return found


def _directions_of(entry: ModelEffect, rows: DesignRows) -> Floats:
    """Return how a field that an effect adds at its sensor changes the rows; (time, row, axis).

    The field of a dipole is at the other sensors, too.
    """
    found = rows.directions[entry.sensor.name]
    for name, matrix in entry.transfers().items():
        found = found + rows.directions[name] @ matrix
    return found


def _with_step(values: Mapping[str, Floats], name: str, index: int | slice, step: float) -> dict[str, Floats]:
    moved = dict(values)
    moved[name] = np.array(values[name], dtype=np.float64)
    moved[name][..., index] += step
    return moved


def _additive(
    term: Term,
    rows: DesignRows,
    directions: Floats,
    values: Mapping[str, Floats],
    name: str,
    index: int,
    step: float,
) -> Floats:
    """Column of an effect that only adds a field: one evaluation, it is linear."""
    entry = term.entry
    others = {key: value * 0.0 if key in term.parameters else value for key, value in values.items()}
    others[name] = others[name] * 0.0
    field = entry.effect.field(rows.samples, _with_step(others, name, index, step), entry.sensor)
    return np.asarray(-np.einsum("tra,ta->tr", directions, field))


def _differenced(
    term: Term, rows: DesignRows, values: Mapping[str, Floats], name: str, index: int, step: float
) -> Floats:
    """Column of an effect inside an instrument's equation: a central difference of its correction."""
    entry = term.entry
    change = _change_of_reading(term, rows, values, name, index, step)
    if entry.sensor.role not in VECTOR_ROLES:
        return np.asarray(-change[:, None])
    if not isinstance(entry.effect, SENSOR_EQUATIONS) and entry.sensor.name in rows.sensor_matrices:
        change = multiply(rows.sensor_matrices[entry.sensor.name], change)
    return np.asarray(np.einsum("tra,ta->tr", rows.directions[entry.sensor.name], change))


def _differenced_by_axis(
    term: Term, rows: DesignRows, values: Mapping[str, Floats], name: str, step: float
) -> list[Floats]:
    """Columns of a parameter (axis) each of whose components changes its own axis: one difference for all."""
    change = _change_of_reading(term, rows, values, name, slice(None), step)
    direction = rows.directions_of_readings[term.entry.sensor.name]
    return [direction[:, :, axis] * change[:, axis, None] for axis in range(len(AXES))]


def _change_of_reading(
    term: Term,
    rows: DesignRows,
    values: Mapping[str, Floats],
    name: str,
    index: int | slice,
    step: float,
) -> Floats:
    """Return by how much a step of a parameter changes a corrected reading; (time, axis) or (time,), nT."""
    entry = term.entry
    reading = np.asarray(rows.samples[entry.sensor.role].values, dtype=np.float64)
    up, down = (
        entry.effect.correct(
            reading, rows.samples, _with_step(values, name, index, sign * step), entry.sensor
        )
        for sign in (1.0, -1.0)
    )
    return np.asarray((up - down) / 2.0)


def _affine_columns(
    term: Term, rows: DesignRows, values: Mapping[str, Floats], name: str, step: float
) -> list[Floats]:
    """Columns of a parameter of an affine equation ``M E + b``: central differences of M and b.

    A column is the sum of the few products of the field's direction and the reading that M moves.
    """
    entry = term.entry
    reading = np.asarray(rows.samples[entry.sensor.role].values, dtype=np.float64)
    direction = rows.directions[entry.sensor.name]
    later = None
    if not isinstance(entry.effect, SENSOR_EQUATIONS):
        later = rows.sensor_matrices.get(entry.sensor.name)
    # A field along each axis, and none: what the equation makes of them is M and b.
    units = np.vstack([_FIELD * np.eye(3), np.zeros(3)])
    out = []
    for index in range(entry.effect.parameters()[name].size):
        up, down = (
            entry.effect.correct(
                units, xr.Dataset(), _with_step(values, name, index, sign * step), entry.sensor
            )
            for sign in (1.0, -1.0)
        )
        change = (up - down) / 2.0
        if later is not None:
            change = multiply(later, change)
        shift = change[3]
        matrix = (change[:3] - shift).T / _FIELD
        # Of differences of rounded numbers nothing is made.
        matrix[np.abs(matrix) * _FIELD < _ROUNDING * np.abs(change).max()] = 0.0
        column = np.zeros(direction.shape[:2])
        for axis, other in zip(*np.nonzero(matrix), strict=True):
            column += direction[:, :, axis] * (matrix[axis, other] * reading[:, other])[:, None]
        for axis in np.flatnonzero(shift):
            column += direction[:, :, axis] * shift[axis]
        out.append(column)
    return out


def design_matrix(terms: Sequence[Term], rows: DesignRows) -> Floats:
    """Return the columns of terms side by side; (time, row, column), 0 where a sample has no weight.

    Values that are not there are 0: a channel's gap must not cost the samples of all others.
    """
    if not terms:
        return np.zeros((*rows.residual.shape, 0))
    # Columns lie one after another: each is written, and later multiplied, as one run of memory.
    times, count = rows.residual.shape
    found = np.empty((sum(len(term.columns) for term in terms), count, times))
    unused = np.flatnonzero(rows.weight <= 0)
    for place, column in enumerate(_all_columns(terms, rows)):
        own = found[place]
        column.of(slice(None), out=own)
        own[:, unused] = 0.0
        if not np.isfinite(own.sum()):
            own[~np.isfinite(own)] = 0.0
    made = found.transpose(2, 1, 0)
    if rows.row_filter is None:
        return made
    return np.nan_to_num(rows.row_filter.keep(made, rows.samples["tt2000"].values, rows.weight > 0))


def _all_columns(terms: Sequence[Term], rows: DesignRows) -> Iterator[_Column]:
    # Effects only look variables up: a thousand columns would spend their time in a Dataset's indexing.
    light = replace(rows, samples=cast("xr.Dataset", PlainSamples.of(rows.samples)))
    return (column for term in terms for column in _columns_of(term, light))


#: Samples whose columns are made and multiplied at a time: they fit a cache.
_AT_ONCE = 16_384


def design_gram(terms: Sequence[Term], rows: DesignRows, parts: Sequence[slice]) -> Floats:
    """Return the Gram matrices of [columns | residual] in parts of the rows; (part, column, column), nT^2.

    They are those of `design_matrix` and `inflight.lsq.gram_of`, for samples of a day at their own cadence:
    its columns are never all there at once.

    Parameters
    ----------
    parts : sequence of slice
        Of the time.

    Raises
    ------
    SamplesError
        When a channel is not in the samples.
    """
    if rows.row_filter is not None:
        return gram_of(design_matrix(terms, rows), rows.residual[:, :, None], rows.weight, parts)
    columns = [*_all_columns(terms, rows), _Column(rows.residual)]
    out = np.zeros((len(parts), len(columns), len(columns)))
    for index, part in enumerate(parts):
        for some in in_turns(part, _AT_ONCE):
            out[index] += _gram_of_some(columns, rows.weight, some)
    return out


def _gram_of_some(columns: Sequence[_Column], weight: Floats, some: slice) -> Floats:
    """Return the Gram matrix of columns at some samples; (column, column)."""
    made = np.empty((len(columns), columns[0].values.shape[1], some.stop - some.start))
    for column, own in zip(columns, made, strict=True):
        column.of(some, out=own)
    root = np.sqrt(np.clip(weight[some], 0.0, None))
    made[:, :, root == 0.0] = 0.0
    if not np.all((root == 0.0) | (root == 1.0)):
        made *= root
    flat = made.reshape(len(columns), -1)
    gram = flat @ flat.T
    if not np.isfinite(np.diagonal(gram)).all():
        flat[~np.isfinite(flat)] = 0.0
        gram = flat @ flat.T
    return np.asarray(gram)


@dataclass(frozen=True, kw_only=True)
class BurstSettings:
    """What a burst is.

    Attributes
    ----------
    scatter : float
        A burst scatters this many times as much as usual; a channel that makes one changes so much more;
        assumed: far from any storm.
    largest_share : float
        Part of a span that is left out as bursts at most; more of it is no outlier; assumed.
    around : int
        Samples the scatter is the median of, odd; assumed.
    deviation : float
        How far a sample must deviate from its neighbours to be in a burst, in usual scatters; assumed.
    fewest : int
        Samples a record needs: fewer have no usual scatter; assumed.
    listed, named : int
        Bursts listed of a block, and of a span.
    active : float
        An instrument without bursts of its own is active when it fluctuates so many times as much as usual;
        assumed.
    """

    scatter: float = 10.0
    largest_share: float = 0.02
    around: int = 11
    deviation: float = 6.0
    fewest: int = 100
    listed: int = 20
    named: int = 12
    active: float = 2.0


@dataclass(frozen=True, kw_only=True)
class BinSettings:
    """How samples become bins.

    Attributes
    ----------
    spike : float
        A sample is a spike when it is this many sigma from the median of its neighbours, sigma being that
        of the record or of the samples around, whichever is larger: chance makes one of 4e11 good samples.
    neighbours, around : int, int
        Samples of that median, and of that sigma; assumed.
    fewest : float
        A bin needs this part of the usual number of good samples; assumed.
    bridged : int
        Gaps of a channel up to so many bins are bridged by a straight line; assumed.
    """

    spike: float = 7.0
    neighbours: int = 9
    around: int = 61
    fewest: float = 0.3
    bridged: int = 10


BURST_SETTINGS = BurstSettings()
BIN_SETTINGS = BinSettings()


class Burst(NamedTuple):
    """A burst: the samples from `first` to before `last`, and its median scatter over the usual one."""

    first: int
    last: int
    times_usual: float


@dataclass(frozen=True)
class OutlierReport:
    """Outliers that a pass left out, over the whole span.

    Attributes
    ----------
    spikes, burst_samples, burst_count : int
    share : float
        Part of the usable samples that bursts hold.
    kept : bool
        True when the bursts hold too much of the span to be left out; they are in the Gram blocks then.
    bursts : tuple of dict
        ``start``, ``end`` (UTC), ``samples``, ``times_usual`` of the first ones.
    """

    spikes: int = 0
    burst_samples: int = 0
    burst_count: int = 0
    share: float = 0.0
    kept: bool = False
    bursts: tuple[dict[str, Any], ...] = ()

    @classmethod
    def of(cls, reports: Sequence[Mapping[str, Any]], kept: bool) -> OutlierReport:
        """Return the outliers of blocks' reports, in order of time."""
        samples = sum(int(one["burst_samples"]) for one in reports)
        good = sum(float(one["count"]) for one in reports)
        first = [burst for one in reports for burst in one["bursts"]][: BURST_SETTINGS.named]
        return cls(
            sum(int(one["spikes"]) for one in reports),
            samples,
            sum(int(one["burst_count"]) for one in reports),
            samples / max(good + (0.0 if kept else samples), 1.0),
            kept,
            tuple(
                {
                    "start": utc_text(int(start)),
                    "end": utc_text(int(end)),
                    "samples": int(count),
                    "times_usual": float(times),
                }
                for start, end, count, times in first
            ),
        )

    def as_json(self) -> dict[str, Any]:
        """Return the fields by name, and `samples`, all that was left out."""
        return {"samples": self.spikes + (0 if self.kept else self.burst_samples), **vars(self)}


def find_bursts(residual: Floats, stamps: Int64, usable: npt.NDArray[np.bool_]) -> list[Burst]:
    """Return the bursts of a residual (time, row), whatever made them, in order.

    The usual scatter is the record's median one, so that a residual that always fluctuates has none.

    Parameters
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000.
    usable : ndarray of bool, shape (time,)
    """
    place = np.flatnonzero(usable)
    if place.size < BURST_SETTINGS.fewest:
        return []
    size = _second_differences(residual[place], stamps[place])
    local = np.stack(
        [scipy.ndimage.median_filter(row, size=BURST_SETTINGS.around, mode="nearest") for row in size.T],
        axis=1,
    )
    usual = np.array([np.median(row[row > 0]) if (row > 0).any() else np.inf for row in local.T])
    times = (local / usual).max(axis=1)
    deviating = np.asarray((size > BURST_SETTINGS.deviation * usual).any(axis=1))
    return [
        Burst(int(place[first]), int(place[last - 1]) + 1, float(np.median(times[first:last])))
        for first, last in _runs_around(times > BURST_SETTINGS.scatter, deviating, stamps[place])
    ]


def _second_differences(values: Floats, stamps: Int64) -> Floats:
    """Return how far each sample is from the line through its neighbours, in units of noise; (time, row)."""
    seconds = (stamps - stamps[0]) / SECOND
    part = ((seconds[1:-1] - seconds[:-2]) / (seconds[2:] - seconds[:-2]))[:, None]
    off = values[1:-1] - (1.0 - part) * values[:-2] - part * values[2:]
    out = np.abs(off) / np.sqrt(1.0 + part**2 + (1.0 - part) ** 2)
    # Across a gap the line has no meaning.
    wide = np.diff(seconds) > BURST_SETTINGS.around * np.median(np.diff(seconds))
    out[wide[1:] | wide[:-1]] = 0.0
    return np.asarray(np.pad(out, ((1, 1), (0, 0)), mode="edge"))


def _runs_around(
    far: npt.NDArray[np.bool_], deviating: npt.NDArray[np.bool_], stamps: Int64
) -> list[tuple[int, int]]:
    """Return first and last+1 of the stretches around far samples, from first to last deviating sample."""
    if not far.any():
        return []
    core = np.flatnonzero(far)
    step = float(np.median(np.diff(stamps)))
    apart = (np.diff(core) > 2 * BURST_SETTINGS.around) | (
        np.diff(stamps[core]) > 2 * BURST_SETTINGS.around * step
    )
    out = []
    for group in np.split(core, np.flatnonzero(apart) + 1):
        low, high = (
            max(int(group[0]) - BURST_SETTINGS.around, 0),
            min(int(group[-1]) + BURST_SETTINGS.around + 1, far.size),
        )
        near = np.abs(stamps[low:high] - stamps[group[0]]) <= stamps[group[-1]] - stamps[group[0]] + (
            BURST_SETTINGS.around * step
        )
        inside = low + np.flatnonzero(deviating[low:high] & near)
        if inside.size:
            out.append((int(inside[0]), int(inside[-1]) + 1))
    return out


def is_signal(
    burst: Burst,
    others: Sequence[Burst],
    rows: ResidualRows,
    stamps: Int64,
    channels: Mapping[str, Floats],
    edges: Int64,
) -> bool:
    """Return True when a burst is more than outlying readings of one instrument.

    Both instruments fluctuate more than usual, and their difference is not far beyond what they share: the
    field itself fluctuates. Or a recorded channel changes there as it does nowhere else: it was switched on.

    Parameters
    ----------
    others : sequence of Burst
        Every burst of the record.
    stamps : ndarray of int64, shape (time,)
        TT2000 of the samples.
    channels : mapping of str to ndarray, shape (bin, ...)
        As they were recorded, on bins.
    edges : ndarray of int64, shape (bin + 1,)
        TT2000 of the bins.
    """
    return _both_fluctuate(burst, others, rows, stamps) or _follows_channel(
        burst, others, stamps, channels, edges
    )


def _both_fluctuate(burst: Burst, others: Sequence[Burst], rows: ResidualRows, stamps: Int64) -> bool:
    """Return True when the readings of both instruments fluctuate, and their difference does not more."""
    if rows.residual.shape[1] == 1:
        strength = np.linalg.norm(rows.field, axis=1, keepdims=True)
        pair = [strength, strength - rows.residual]
    else:
        pair = list(rows.fields.values())
    quiet = np.ones(len(stamps), dtype=bool)
    for one in others:
        quiet[max(one.first - 2, 0) : one.last + 2] = False
    inside = np.zeros(len(stamps), dtype=bool)
    inside[burst.first : burst.last] = True
    active, sizes = True, []
    for values in (*pair, rows.residual):
        fluctuation = _fourth_differences(values, stamps, rows.good)
        there, usual = _median_square(fluctuation[inside]), _median_square(fluctuation[quiet])
        sizes.append(max(there - usual, 0.0))
        active &= there > BURST_SETTINGS.active**2 * usual
    return active and BURST_SETTINGS.scatter**2 * min(sizes[:-1]) > sizes[-1]


def _fourth_differences(values: Floats, stamps: Int64, good: npt.NDArray[np.bool_]) -> Floats:
    """Return fourth differences, in units of noise; (time,), NaN where neighbours are missing.

    Second differences of the field along an orbit are as large as noise; hardly anything of it remains here.
    """
    known = np.where(good[:, None], values, np.nan)
    out = np.full(len(values), np.nan)
    if len(values) < 5:
        return out
    off = known[2:-2] - (4.0 * (known[1:-3] + known[3:-1]) - known[:-4] - known[4:]) / 6.0
    even = np.abs(np.diff(stamps) / np.median(np.diff(stamps)) - 1.0) < 0.1
    off[~(even[:-3] & even[1:-2] & even[2:-1] & even[3:])] = np.nan
    out[2:-2] = np.linalg.norm(off, axis=1) / np.sqrt(1.0 + 34.0 / 36.0)
    return out


def _median_square(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known) ** 2) if known.size else 0.0


def _follows_channel(
    burst: Burst, others: Sequence[Burst], stamps: Int64, channels: Mapping[str, Floats], edges: Int64
) -> bool:
    """Return True when some channel fluctuates all through the burst and not elsewhere, or is on for it."""
    between, width = edges[1:-1], int(edges[1] - edges[0])
    quiet = np.ones(between.size, dtype=bool)
    for one in others:
        quiet &= (between < stamps[one.first] - width) | (between > stamps[one.last - 1] + width)
    start, end = int(stamps[burst.first]), int(stamps[burst.last - 1])
    inside = (between >= start - width) & (between <= end + width)
    ends = [np.abs(between - at) <= width for at in (start, end)]
    if not inside.any() or not quiet.any():
        return False
    # One change in the midst of a long burst is chance.
    short = end - start <= 2 * width
    for values in channels.values():
        change = np.linalg.norm(np.diff(values.reshape(len(values), -1), axis=0), axis=1)
        change = np.where(np.isfinite(change), change, 0.0)
        least = max(BURST_SETTINGS.scatter * float(np.sqrt(np.mean(change[quiet] ** 2))), 1e-300)
        through = change[inside].max() if short else float(np.median(change[inside]))
        if through > least or min(change[at].max(initial=0.0) for at in ends) > least:
            return True
    return False


def burst_report(found: Sequence[Burst], stamps: Int64, usable: npt.NDArray[np.bool_]) -> dict[str, Any]:
    """Return the part of a block's report that lists its bursts: how many, how long, and the first ones."""
    samples = [int(usable[one.first : one.last].sum()) for one in found]
    return {
        "burst_samples": sum(samples),
        "burst_count": len(found),
        "bursts": [
            [int(stamps[one.first]), int(stamps[one.last - 1]), count, round(one.times_usual, 1)]
            for one, count in zip(found[: BURST_SETTINGS.listed], samples, strict=False)
        ],
    }


def bin_edges(first: int, last: int, cadence_ns: int) -> Int64:
    """Return the edges of the bins that cover the half-open span from `first` to `last`; TT2000."""
    count = max(1, -(-(last - first) // cadence_ns))
    return first + cadence_ns * np.arange(count + 1, dtype=np.int64)


@dataclass(frozen=True)
class Bins:
    """Bins of equal width, and the samples in them.

    Attributes
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000 of the samples, rising.
    edges : ndarray of int64, shape (bin + 1,)
    """

    stamps: Int64
    edges: Int64

    def __len__(self) -> int:
        return self.edges.size - 1

    @cached_property
    def _place(self) -> Int64 | None:
        """Bin of each sample, where none holds more than one; else None."""
        width = int(self.edges[1] - self.edges[0])
        place = (self.stamps - self.edges[0]) // width
        return place if np.all(np.diff(place) > 0) and np.all(np.diff(self.edges) == width) else None

    @cached_property
    def _is_full(self) -> bool:
        """Whether each bin holds one sample, and no sample is outside."""
        place = self._place
        return place is not None and place.size == len(self) and place[0] == 0 and place[-1] == len(self) - 1

    @cached_property
    def _starts(self) -> npt.NDArray[np.int64]:
        return np.searchsorted(self.stamps, self.edges)

    def times(self, good: npt.NDArray[np.bool_]) -> Int64:
        """Return when the bins' means are: their middles, less what good samples usually come before them.

        Samples at the beginnings of their spacing come half of it before; a line's phase would be as far off.
        """
        width = int(self.edges[1] - self.edges[0])
        middle = self.edges[:-1] + width // 2
        inside = (self.stamps >= self.edges[0]) & (self.stamps < self.edges[-1])
        mean, count = self.means((self.stamps - self.edges[0]).astype(np.float64), good & inside)
        full = (count > 0) & (count == count.max(initial=0.0))
        off = np.median(mean[full] - (middle - self.edges[0])[full]) if full.any() else 0.0
        return np.asarray(middle + round(float(off)))

    def means(self, values: Floats, good: npt.NDArray[np.bool_]) -> tuple[Floats, Floats]:
        """Return means (bin, ...) and counts (bin,) of the good samples of each bin; NaN for none."""
        if self._place is not None:
            # The one sample of a bin is its mean.
            if self._is_full:
                seen = good.reshape(-1, *(1,) * (values.ndim - 1))
                return np.where(seen, values, np.nan), good.astype(np.float64)
            inside = slice(*np.searchsorted(self._place, (0, len(self))))
            place, lost = self._place[inside], ~good[inside]
            mean, number = np.full((*values.shape[1:], len(self)), np.nan), np.zeros(len(self))
            # One component after the other: eight times as fast as all of a sample together.
            for component in np.ndindex(values.shape[1:]):
                mean[component][place] = values[(inside, *component)]
            mean[..., place[lost]], number[place] = np.nan, ~lost
            return np.moveaxis(mean, -1, 0), number
        # Stamps rise, so that a bin is a run of samples: sums of runs read the values once.
        starts = self._starts
        inside = slice(int(starts[0]), int(starts[-1]))
        used = good[inside]
        count, flat = used.astype(np.float64), values[inside].reshape(used.size, -1)
        if not used.all():
            flat = np.where(used[:, None], flat, 0.0)
        total = sums_of_runs(flat, starts - starts[0])
        number = sums_of_runs(count[:, None], starts - starts[0])
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = total / number
        return mean.reshape(len(self), *values.shape[1:]), number[:, 0]


def bin_means(
    values: Floats, stamps: Int64, edges: Int64, good: npt.NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """Return means (bin, ...) and counts (bin,) of the good samples in each bin; see `Bins.means`."""
    return Bins(stamps, edges).means(values, good)


def find_spikes(residual: Floats) -> npt.NDArray[np.bool_]:
    """Return which samples stand out from their neighbours; (time,) of a residual (time, row).

    The measure is local, so that no effect, however large, is taken for an outlier, nor an hour of large
    fluctuations for a series of them.
    """
    if len(residual) < BIN_SETTINGS.neighbours:
        return np.zeros(len(residual), dtype=bool)
    filled = np.where(np.isfinite(residual), residual, 0.0)
    known = np.asarray(np.isfinite(residual).all(axis=1))
    return np.asarray(np.any([_is_spike(row, known) for row in filled.T], axis=0))


def _is_spike(row: Floats, known: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return which samples of one row (time,) stand out from their neighbours.

    On a slope every sample is the median of its neighbours: there the noise is that of second differences.
    """
    off = np.abs(row - scipy.ndimage.median_filter(row, size=BIN_SETTINGS.neighbours, mode="nearest"))
    second = np.zeros(row.size)
    second[1:-1] = np.abs(row[1:-1] - 0.5 * (row[:-2] + row[2:])) * np.sqrt(2.0 / 3.0)
    least = 1e-6
    for size in (off, second):
        usual = float(np.median(size[known])) if known.any() else 1.0
        least = max(least, MAD_TO_SIGMA * usual)
    # The scatter around is looked at only where the usual one leaves a doubt.
    found = off > BIN_SETTINGS.spike * least
    places = np.flatnonzero(found)
    for size in (off, second):
        around = MAD_TO_SIGMA * _local_median(size, places)
        found[places] &= off[places] > BIN_SETTINGS.spike * around
    return np.asarray(found)


def _local_median(values: Floats, places: npt.NDArray[np.intp]) -> Floats:
    """Return the median of the samples around some places; (place,)."""
    width = min(BIN_SETTINGS.around, values.size)
    if places.size * width > values.size or width % 2 == 0:
        filtered = scipy.ndimage.median_filter(values, size=width, mode="nearest")
        return np.asarray(filtered[places])
    padded = np.pad(values, width // 2, mode="edge")
    return np.asarray(np.median(padded[places[:, None] + np.arange(width)], axis=1))


def bin_channel(values: Floats, stamps: Int64, edges: Int64, cadence_ns: int) -> Floats:
    """Put a channel on the bins: means where it is faster, straight lines where it is slower; (bin, ...)."""
    width = int(edges[1] - edges[0])
    flat = np.asarray(values, dtype=np.float64)
    good = np.asarray(np.isfinite(flat.reshape(len(flat), -1)).all(axis=1))
    if not good.any():
        return np.full((edges.size - 1, *flat.shape[1:]), np.nan)
    if cadence_ns <= width:
        return bridge_gaps(bin_means(flat, stamps, edges, good)[0])
    centre = edges[:-1] + width // 2
    own, known = stamps[good], flat[good].reshape(int(good.sum()), -1)
    out = np.stack([np.interp(centre, own, column) for column in known.T], axis=-1)
    reach = GAP * cadence_ns
    if centre[0] < own[0] - reach or centre[-1] > own[-1] + reach or np.any(np.diff(own) > 2 * reach):
        after = np.clip(np.searchsorted(own, centre), 1, max(own.size - 1, 1))
        late = np.abs(own[np.minimum(after, own.size - 1)] - centre)
        out[np.minimum(np.abs(centre - own[after - 1]), late) > reach] = np.nan
    return out.reshape(edges.size - 1, *flat.shape[1:])


def bridge_gaps(values: Floats) -> Floats:
    """Return the series with its short gaps bridged by straight lines; (bin, ...)."""
    flat = values.reshape(len(values), -1).copy()
    known = np.isfinite(flat).all(axis=1)
    if known.all() or not known.any():
        return values
    place, own = np.flatnonzero(~known), np.flatnonzero(known)
    after = np.searchsorted(own, place)
    inside = (after > 0) & (after < own.size)
    place, after = place[inside], after[inside]
    short = place[own[after] - own[after - 1] <= BIN_SETTINGS.bridged + 1]
    for column in flat.T:
        column[short] = np.interp(short, own, column[own])
    return flat.reshape(values.shape)


def coarsen(
    samples: xr.Dataset,
    rows: ResidualRows,
    edges: Int64,
    channels: Mapping[str, xr.Variable],
    matrices: Mapping[str, Floats],
    recorded: Mapping[str, Floats] | None = None,
    keep_bursts: bool = False,
) -> tuple[DesignRows, dict[str, Any]]:
    """Put a day's rows on the library's bins.

    Parameters
    ----------
    samples : xarray.Dataset
        Native samples the rows were made from.
    rows : inflight.model.rows.ResidualRows
    edges : ndarray of int64
        Of the bins.
    channels : mapping of str to Variable
        Channels and geometry that are on the bins already.
    matrices : mapping
        Sensor matrices, see `DesignRows`.
    recorded : mapping of str to ndarray, optional
        Every channel of the mission as it was recorded, on the bins: what follows one is no outlier.
    keep_bursts : bool
        Count bursts and leave them in.

    Returns
    -------
    DesignRows, dict
        The rows, and sums over the native samples of bins that have a weight: ``count``, ``square`` of the
        residual, ``inside``, the scatter within bins, of one row, nT^2; ``spikes``, and of `burst_report`.
    """
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    usable = rows.good & np.isfinite(rows.residual).all(axis=1)
    single, burst, report = _find_outliers(rows, usable, stamps, edges, recorded or {})
    out = single if keep_bursts else single | burst
    good = usable & ~out
    bins = Bins(stamps, edges)
    residual, count = bins.means(rows.residual, good)
    usual = max(1.0, round((edges[1] - edges[0]) / SECOND / rows.step_s))
    weight = np.where(count >= BIN_SETTINGS.fewest * usual, np.minimum(count / usual, 1.0), 0.0)
    if "weight" in samples:
        of_samples = np.asarray(samples["weight"].values, dtype=np.float64)
        weight = np.where(weight > 0, weight * bins.means(of_samples, good)[0], 0.0)
    seen = weight > 0
    # Each axis as one run of memory, as of all vectors that columns are made from.
    directions = {
        name: np.asfortranarray(bins.means(np.asarray(one), good)[0]) for name, one in rows.directions.items()
    }
    residual = np.where(seen[:, None], residual, 0.0)
    # Of bins with a weight: what lies in one with too few samples is nowhere else.
    square = float(count[seen] @ bins.means(np.sum(rows.residual**2, axis=1), good)[0][seen])
    inside = square - float(count[seen] @ np.sum(residual[seen] ** 2, axis=1))
    sums = {
        "count": float(count[seen].sum()),
        "square": square,
        # A row's own, as all other sizes are.
        "inside": max(inside, 0.0) / rows.residual.shape[1],
        "spikes": float((usable & single).sum()),
    } | report
    binned = _binned(samples, rows, bins, channels, good)
    return DesignRows(binned, residual, directions, matrices, weight, rows.kept), sums


def _binned(
    samples: xr.Dataset,
    rows: ResidualRows,
    bins: Bins,
    channels: Mapping[str, xr.Variable],
    good: npt.NDArray[np.bool_],
) -> xr.Dataset:
    """Return readings and field on the bins, with the channels that are there already."""
    data: dict[str, xr.Variable] = dict(channels)
    data["tt2000"] = xr.Variable("time", bins.times(good))
    for role in FIELD_ROLES:
        if role in samples:
            means, _ = bins.means(samples[role].values, good)
            data[role] = xr.Variable(samples[role].dims, np.asfortranarray(means))
    field = np.asfortranarray(bins.means(rows.field, good)[0])
    direction = direction_of(field)
    if rows.residual.shape[1] == 1:
        # A row is the field's strength. The mean of a vector that turns within a bin, as a spacecraft that
        # slews makes it, is too short: its rate of change would be thousands of nT from one bin to the next.
        strength, _ = bins.means(np.sqrt(np.einsum("ta,ta->t", rows.field, rows.field)), good)
        field = np.asfortranarray(direction * strength[:, None])
    data["field"] = xr.Variable(("time", "axis"), field, {"units": "nT"})
    data["field_direction"] = xr.Variable(("time", "axis"), direction, {"units": "1"})
    return xr.Dataset(data)


def _find_outliers(
    rows: ResidualRows,
    usable: npt.NDArray[np.bool_],
    stamps: Int64,
    edges: Int64,
    recorded: Mapping[str, Floats],
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_], dict[str, Any]]:
    """Return which samples are spikes and which in bursts; (time,), no sample in both; and their report."""
    none = np.zeros(len(stamps), dtype=bool)
    if rows.kept is not None:
        # A filtered residual has no single outliers any more.
        return none, none, burst_report([], stamps, none)
    single = find_spikes(np.where(usable[:, None], rows.residual, np.nan))
    bursts = find_bursts(rows.residual, stamps, usable & ~single)
    outlying = [burst for burst in bursts if not is_signal(burst, bursts, rows, stamps, recorded, edges)]
    inside = none.copy()
    for burst in outlying:
        inside[burst.first : burst.last] = True
    return single & ~inside, inside, burst_report(outlying, stamps, usable)
