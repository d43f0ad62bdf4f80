"""The residual by rows, as all pictures of the loop are drawn from it, and the rows that are selected.

Takes the means of products (`inflight.tasks.pipelines.CompareResult.data`), or the residual before and after
a change of the model (`BeforeAfter`); makes `ResidualRows`. A `Selection` is what is brushed in any picture:
it restricts all of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.diagnosis import BeforeAfter, HeatMap, place_map, residual_map
from inflight.explorer.session import Days
from inflight.frames import GEOMETRY
from inflight.residual import (
    Coordinate,
    Dependence,
    FieldResponse,
    Line,
    SpectrumSum,
    field_axes,
    field_response,
    measure_dependences,
    record_lines,
    record_power,
)
from inflight.tasks.pipelines import CompareResult, blocks_of
from inflight.time import SECOND, Int64, day_bounds

Rows = npt.NDArray[np.bool_]

#: Columns of a product's rows that the residual does not follow.
_NO_COORDINATE = ("tt2000", "before", "after", "low", "high")
#: Seconds on either side over which a channel rises or falls; assumed.
_REACH_S = 120.0


@dataclass(frozen=True)
class Selection:
    """What was brushed, beside days: ranges of coordinates by name, both ends included."""

    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of_text(cls, text: str) -> Selection:
        """Read what `text` gives, as it stands in an address; what is no range is left out."""
        ranges = {}
        for part in text.split(";"):
            name, _, ends = part.partition("=")
            low, _, high = ends.partition("~")
            try:
                ranges[name] = float(low), float(high)
            except ValueError:
                continue
        return cls(ranges)

    @property
    def text(self) -> str:
        """The ranges as one word of an address."""
        return ";".join(f"{name}={low:.6g}~{high:.6g}" for name, (low, high) in self.ranges.items())

    def with_range(self, name: str, low: float, high: float) -> Selection:
        """Return it with a range of a coordinate, in place of that coordinate's own."""
        return Selection({**self.ranges, name: (low, high)})


@dataclass(frozen=True, kw_only=True)
class ResidualRows:
    """A residual and what it may follow, row by row.

    Attributes
    ----------
    tt2000 : ndarray of int64, shape (row,)
    before, after : ndarray, shape (row, component)
        nT, NaN where it is not known; `after` is None of one model alone.
    direction : ndarray, shape (row, component, 3)
        Field's direction that each component is the projection on, sensor axes.
    coordinates, units : mapping of str
        Values (row,) and units of all it may follow, by name.
    block : ndarray of int, shape (row,)
        Between which uncertainties are taken.
    step_s : float
        Seconds between rows.
    low, high : ndarray, shape (row,)
        Extremes of the samples that a row is the mean of, nT; of a change those of its rows themselves.
    """

    tt2000: Int64
    before: Floats
    after: Floats | None
    direction: Floats
    coordinates: Mapping[str, Floats]
    units: Mapping[str, str]
    block: Int64
    step_s: float
    low: Floats | None = None
    high: Floats | None = None

    @classmethod
    def of_products(cls, rows: Mapping[str, Floats], units: Mapping[str, str], days: int) -> ResidualRows:
        """Return the rows of products; coordinates are those with a unit.

        Parameters
        ----------
        rows : mapping of str to ndarray, shape (row,)
            As `inflight.tasks.pipelines.base.rows_of_day` makes them.
        days : int
            How many days there are products of.
        """
        tt2000 = np.asarray(rows["tt2000"], dtype=np.int64)
        direction = np.stack([rows[f"field direction {axis}"] for axis in "xyz"], axis=1)
        known = {name: rows[name] for name in rows if name in units and name not in _NO_COORDINATE}
        step = float(np.median(np.diff(tt2000))) / SECOND if tt2000.size > 1 else 1.0
        return cls(
            tt2000=tt2000,
            before=rows["after"][:, None],
            after=None,
            direction=direction[:, None, :],
            coordinates=known,
            units=units,
            block=blocks_of(rows["tt2000"], days)[0],
            step_s=step,
            low=rows["low"],
            high=rows["high"],
        )

    @classmethod
    def of_change(cls, seen: BeforeAfter) -> ResidualRows:
        """Return the rows of a residual before and after a change of the model."""
        series, good = seen.series, seen.good[:, None]
        features = series.features
        widths = dict(zip(features.names, features.widths, strict=True))
        units = dict(zip(features.names, features.units, strict=True))
        names = [name for name in series.channels if widths[name] == 1]
        titles = {name: name.replace("_", " ") if name in GEOMETRY else name for name in names}
        return cls(
            tt2000=series.tt2000,
            before=np.where(good, seen.before, np.nan),
            after=np.where(good, seen.after, np.nan),
            direction=series.direction(),
            coordinates={titles[name]: series[name] for name in names},
            units={titles[name]: units[name] for name in names},
            block=seen.block,
            step_s=series.step_s,
        )

    @property
    def is_scalar(self) -> bool:
        """True when the residual is one number a time."""
        return bool(self.before.shape[1] == 1)

    @property
    def known(self) -> Rows:
        """Rows with a residual; (row,)."""
        finite = np.isfinite(self.before).all(axis=1)
        return np.asarray(finite & np.isfinite(self.direction).all(axis=(1, 2)))

    def selected(self, selection: Selection, days: Days | None = None) -> ResidualRows:
        """Return the rows with no residual outside of a selection; a range of nothing known selects none."""
        inside = np.ones(len(self.tt2000), dtype=bool)
        for name, (low, high) in selection.ranges.items():
            values = self.coordinates.get(name, np.full(inside.shape, np.nan))
            inside &= (values >= low) & (values <= high)
        if days is not None:
            first, last = day_bounds(days.first)[0], day_bounds(days.last)[1]
            inside &= (self.tt2000 >= first) & (self.tt2000 < last)
        if inside.all():
            return self
        masked = [np.where(inside[:, None], one, np.nan) for one in self._states]
        return replace(self, before=masked[0], after=None if self.after is None else masked[1])

    @property
    def _states(self) -> list[Floats]:
        return [self.before] if self.after is None else [self.before, self.after]

    @property
    def sizes(self) -> list[float]:
        """Rms of each state, nT; NaN where nothing is known."""
        known = self.known
        squares = [float(np.mean(one[known] ** 2)) if known.any() else np.nan for one in self._states]
        return [float(np.sqrt(one)) for one in squares]

    def traces(self) -> dict[str, tuple[Int64, Floats, Floats, Floats]]:
        """Return times, mean, least and largest residual of each state, nT; (row,) each."""
        names = ("residual",) if self.after is None else ("before", "after")
        out = {}
        for name, state in zip(names, self._states, strict=True):
            mean = state[:, self._row()]
            low, high = (mean if one is None else one for one in (self.low, self.high))
            known = np.isfinite(mean)
            ends = np.where(known, low, np.nan), np.where(known, high, np.nan)
            out[name] = (self.tt2000, mean, *ends)
        return out

    def holds(self, tt2000: Int64) -> Rows:
        """Return which samples (sample,) lie in a row that is selected, the nearest one."""
        middle = self.tt2000[:-1] + np.diff(self.tt2000) // 2
        return self.known[np.searchsorted(middle, tt2000)]

    def _row(self) -> int:
        """Return the component that is largest."""
        return int(np.argmax(np.nansum(self.before**2, axis=0)))

    def map(self) -> HeatMap:
        """Return the residual by time and orbit phase, or what else there is."""
        turns = {name.replace(" ", "_"): values for name, values in self.coordinates.items()}
        made = [residual_map(self.tt2000, one[:, self._row()], turns) for one in self._states]
        return replace(made[0], after=made[-1].before)

    def places(self) -> tuple[Floats, ...] | None:
        """Return maps by latitude and local time of each state; None of a mission without positions."""
        latitude, local_time = (self.coordinates.get(name) for name in ("latitude", "local time"))
        if latitude is None or local_time is None or not (np.isfinite(latitude) & self.known).any():
            return None
        return tuple(place_map(latitude, local_time, one[:, self._row()]) for one in self._states)

    def response(self, name: str, axes: bool) -> FieldResponse | None:
        """Return how the residual follows a coordinate, with errors and what chance makes of it.

        Parameters
        ----------
        axes : bool
            As a field along each axis; else the mean residual itself, of each component.
        """
        if name not in self.coordinates:
            return None
        known = self.known
        if axes:
            columns = field_axes(np.where(known[:, None, None], self.direction, 0.0), self.is_scalar)
        else:
            count = self.before.shape[1]
            each = np.broadcast_to(np.eye(count), (len(known), count, count))
            columns = each, ("residual",) if count == 1 else tuple("xyz"[:count])
        residuals = {"before": self.before} | ({} if self.after is None else {"after": self.after})
        coordinate = name, self.units.get(name, ""), self.coordinates[name]
        reach = max(1, round(_REACH_S / self.step_s))
        return field_response(coordinate, residuals, columns, self.block, known, reach)

    def amplitude(self, name: str) -> Dependence | None:
        """Return the dependence on a coordinate in numbers, of the last state's largest component."""
        state = self._states[-1]
        against = Coordinate(name, self.units.get(name, ""), "", self.coordinates[name])
        return next(iter(measure_dependences([against], state[:, self._row()], self.block)), None)

    def spectra(self, known: Mapping[str, float]) -> tuple[list[SpectrumSum], list[Line]]:
        """Return the spectrum of each state and the lines in the last; none of a record that is too short.

        Parameters
        ----------
        known : mapping of str to float
            Periods that need no explanation, by name, s.
        """
        seconds = (self.tt2000 - self.tt2000[0]) / SECOND
        last, lines = record_lines((seconds, self._states[-1], self.direction), self.step_s, known)
        if last is None or len(self._states) == 1:
            return [last] if last else [], lines
        first = record_power(seconds, self.before, self.direction, self.step_s)
        return [one for one in (first, last) if one is not None], lines


def product_rows(measured: CompareResult[Any]) -> ResidualRows | None:
    """Return the rows of a comparison's products; None where the residual is not one a sample."""
    if measured.data is None:
        return None
    units = {one.coordinate: one.unit for one in measured.data.found}
    return ResidualRows.of_products(measured.data.rows, units, len(measured.report.by_day))
