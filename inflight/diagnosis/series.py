"""The coarse series of a pass: what pictures, signatures and refined forms are made from.

Takes a pass's rows (`thin_rows`, `pack_blocks`); makes one array (block, sample, feature) of float32, whose
first feature is the time within the block, and reads it back as one `Series` in order of time. A channel is
stored as NaN where it was not recorded; a series that is read has its usual value there, and `missing` says
where.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.design import DesignRows
from inflight.frames import direction_of
from inflight.model import RowFilter
from inflight.samples import Folding, PlainSamples
from inflight.time import SECOND, Int64

_ROLES = ("vector", "scalar", "inboard", "outboard")
#: Beginning of the names of features that are columns, means of rows like everything else.
_COLUMN = "column:"


@dataclass(frozen=True)
class Features:
    """Names, widths and units of what the series holds; `sensors` are those the directions belong to."""

    names: tuple[str, ...]
    widths: tuple[int, ...]
    units: tuple[str, ...]
    sensors: tuple[str, ...]
    rows: int

    def place(self, name: str) -> slice:
        """Return the columns of a feature."""
        at = self.names.index(name)
        first = sum(self.widths[:at])
        return slice(first, first + self.widths[at])

    @property
    def channels(self) -> list[str]:
        """Names of channels and geometry."""
        fixed, made = {"seconds", "residual", "weight", "field", *_ROLES}, ("direction:", _COLUMN)
        return [name for name in self.names if name not in fixed and not name.startswith(made)]

    @property
    def columns(self) -> list[str]:
        """Names of the columns that were made before rows became means of several."""
        return [name.removeprefix(_COLUMN) for name in self.names if name.startswith(_COLUMN)]

    def as_json(self) -> dict[str, object]:
        """Return what `of_json` reads."""
        return {
            name: list(value) if isinstance(value, tuple) else value for name, value in vars(self).items()
        }

    @classmethod
    def of_json(cls, stored: dict[str, Any]) -> Features:
        """Return the features in a store's attributes."""
        widths = tuple(int(one) for one in stored["widths"])
        lists = {name: tuple(map(str, stored[name])) for name in ("names", "units", "sensors")}
        return cls(lists["names"], widths, lists["units"], lists["sensors"], int(stored["rows"]))


def features_of(rows: DesignRows, channels: Sequence[str]) -> Features:
    """Return what the series of some rows holds: residual, directions, readings, field, weight, channels.

    Columns that `rows` has made already are among it.
    """
    count, held = rows.residual.shape[1], rows.samples.variables
    names = ["seconds", "residual", "weight", "field"]
    widths = [1, count, 1, 3]
    for sensor in rows.directions:
        names.append(f"direction:{sensor}")
        widths.append(3 * count)
    for name in rows.averaged:
        names.append(f"{_COLUMN}{name}")
        widths.append(count)
    for name in (*[role for role in _ROLES if role in held], *channels):
        if name in held and name not in names:
            names.append(name)
            widths.append(int(np.prod(held[name].shape[1:], dtype=int)))
    units = tuple(str(held[name].attrs.get("units", "1")) if name in held else "1" for name in names)
    return Features(tuple(names), tuple(widths), units, tuple(rows.directions), count)


def thin_rows(rows: DesignRows, features: Features, step: int) -> tuple[Int64, Floats]:
    """Return stamps (sample,) and features (sample, feature): weighted means of every `step` bins.

    In a scalar comparison the field has the mean strength of the bins: the mean of a vector that turns
    meanwhile is too short.
    """
    count = len(rows.weight) // step * step
    weight = rows.weight[:count].reshape(-1, step)
    total = weight.sum(axis=1)
    factor = np.where(total[:, None] > 0, weight / np.maximum(total[:, None], 1e-12), 1.0 / step)
    parts = {
        "residual": rows.residual,
        "weight": rows.weight,
        "field": rows.samples["field"].values,
        "seconds": np.zeros(len(rows.weight)),
    } | {f"direction:{name}": one for name, one in rows.directions.items()}
    parts |= {f"{_COLUMN}{name}": one for name, one in rows.averaged.items()}
    columns, channels = [], set(features.channels)
    for name, width in zip(features.names, features.widths, strict=True):
        values = parts[name] if name in parts else rows.samples.variables[name].values
        flat = np.asarray(values[:count], dtype=np.float64).reshape(-1, step, width)
        good = np.isfinite(flat)
        part = (np.where(good, flat, 0.0) * factor[:, :, None]).sum(axis=1)
        lost = (~good & (weight[:, :, None] > 0)).any(axis=1)
        if name in channels:
            # A row without weight has its channels all the same: slow responses need them.
            lost |= ~good.any(axis=1)
        part[lost] = np.nan
        if name == "field" and rows.residual.shape[1] == 1:
            strength = np.linalg.norm(flat, axis=2)
            part = (
                direction_of(part) * (np.where(good.all(axis=2), strength, 0.0) * factor).sum(axis=1)[:, None]
            )
        columns.append(part)
    stamps = rows.samples["tt2000"].values[:count].reshape(-1, step)
    at = columns[features.names.index("weight")]
    at[:, 0] = total / step
    return stamps[:, 0] + (stamps[:, -1] - stamps[:, 0]) // 2, np.concatenate(columns, axis=1)


def pack_blocks(stamps: Int64, values: Floats, edges: Sequence[int], samples: int) -> np.ndarray:
    """Return (block, sample, feature) float32; places beyond the end are NaN."""
    out = np.full((len(edges) - 1, samples, values.shape[1]), np.nan, dtype=np.float32)
    places = np.searchsorted(stamps, edges)
    for block in range(len(edges) - 1):
        part = slice(int(places[block]), min(int(places[block + 1]), int(places[block]) + samples))
        count = part.stop - part.start
        out[block, :count] = values[part]
        out[block, :count, 0] = (stamps[part] - edges[block]) / SECOND
    return out


@dataclass(frozen=True)
class Series:
    """The whole span, in order of time.

    Attributes
    ----------
    tt2000 : ndarray of int64, shape (sample,)
    values : ndarray of float32, shape (sample, feature)
        As they are stored; who asks for a feature gets it in double precision.
    block : ndarray, shape (sample,)
        Index of the block each sample belongs to.
    missing : dict of str to ndarray of bool, shape (sample,)
        Where a channel was not recorded; those that lack something.
    row_filter : RowFilter, optional
        What the residual went through.
    """

    tt2000: Int64
    values: npt.NDArray[np.float32]
    block: np.ndarray
    features: Features
    missing: Mapping[str, np.ndarray] = field(default_factory=dict)
    row_filter: RowFilter | None = None

    @classmethod
    def of(
        cls,
        packed: np.ndarray,
        starts: Int64,
        features: Features,
        filled: Mapping[str, float] | None = None,
    ) -> Series:
        """Return the series of packed blocks, in order of their starts.

        Parameters
        ----------
        filled : mapping of str to float, optional
            Recorded channels, and what replaces them in the Gram blocks where they are missing.
        """
        known = np.isfinite(packed[:, :, 0])
        block = np.broadcast_to(np.arange(len(packed))[:, None], known.shape)[known]
        # One feature after the other: who asks for a channel reads one run of memory.
        values = np.empty((len(block), packed.shape[2]), dtype=packed.dtype, order="F")
        for place in range(packed.shape[2]):
            values[:, place] = packed[:, :, place][known]
        missing: dict[str, np.ndarray] = {}
        for name in [one for one in filled or {} if one in features.names]:
            part = values[:, features.place(name)]
            lost = np.asarray(~np.isfinite(part).all(axis=1))
            if lost.any():
                missing[name] = lost
                part[~np.isfinite(part)] = (filled or {})[name]
        seconds = values[:, 0].astype(np.float64)
        return cls(starts[block] + (seconds * SECOND).astype(np.int64), values, block, features, missing)

    @property
    def turn_rows(self) -> int:
        """Rows of a synthetic turn; 1 where nothing is folded."""
        return self.row_filter.sectors if isinstance(self.row_filter, Folding) else 1

    def without(self, rows: np.ndarray) -> Series:
        """Return the series with some rows (sample,) of bool that have no weight."""
        values = self.values.copy(order="K")
        values[rows, self.features.place("weight")] = 0.0
        return replace(self, values=values)

    def part(self, rows: slice) -> Series:
        """Return some consecutive rows."""
        return replace(
            self,
            tt2000=self.tt2000[rows],
            values=self.values[rows],
            block=self.block[rows],
            missing={name: lost[rows] for name, lost in self.missing.items()},
        )

    def __getitem__(self, name: str) -> Floats:
        """Return a feature; (sample,) or (sample, component)."""
        return self._stored(name).astype(np.float64)

    def at(self, rows: Int64, name: str) -> Floats:
        """Return a feature at some rows, by their places."""
        return self._stored(name)[rows].astype(np.float64)

    def _stored(self, name: str) -> npt.NDArray[np.float32]:
        place = self.features.place(name)
        part = self.values[:, place]
        return part[:, 0] if place.stop - place.start == 1 else part

    @property
    def channels(self) -> list[str]:
        """Names of channels and geometry."""
        return self.features.channels

    @cached_property
    def step_s(self) -> float:
        """Usual spacing, seconds."""
        return float(np.median(np.diff(self.tt2000))) / SECOND if self.tt2000.size > 1 else 1.0

    def direction(self, sensor: str | None = None) -> Floats:
        """Return the direction of each row at a sensor; (sample, row, axis)."""
        name = sensor or self.features.sensors[0]
        return self[f"direction:{name}"].reshape(len(self.values), self.features.rows, 3)

    def _measured(self, name: str) -> Floats:
        """Return a reading or the field, NaN where nothing was measured."""
        part = self[name]
        there = self["weight"] > 0
        return np.where(there if part.ndim == 1 else there[:, None], part, np.nan)

    def rows(self, matrices: dict[str, Floats], more: dict[str, xr.Variable]) -> DesignRows:
        """Return the series as rows, so that columns can be made from it."""
        # Effects only look variables up: no Dataset is made of them for every column that is tried.
        samples = cast("xr.Dataset", PlainSamples({**self._variables, **more}))
        return DesignRows(
            samples,
            self._residual,
            self._directions,
            matrices,
            self["weight"],
            self.row_filter,
            _Averaged(self),
        )

    @cached_property
    def _residual(self) -> Floats:
        return self.of_row("residual")

    def of_row(self, name: str) -> Floats:
        """Return a feature with a value a row; (sample, row)."""
        return self[name].reshape(len(self.values), -1)

    @cached_property
    def _directions(self) -> dict[str, Floats]:
        return {name: self.direction(name) for name in self.features.sensors}

    @cached_property
    def _variables(self) -> dict[str, xr.Variable]:
        """Channels, geometry and readings, as effects take them: who uses one makes it double."""
        data = {"tt2000": xr.Variable("time", self.tt2000)}
        for name in (*self.channels, *_ROLES, "field"):
            if name in self.features.names:
                # A missing reading is stored as 0: a rate of change across it would be enormous.
                part = self._stored(name) if name in self.channels else self._measured(name)
                unit = self.features.units[self.features.names.index(name)]
                data.setdefault(name, xr.Variable(("time", "axis")[: part.ndim], part, {"units": unit}))
        data["field_direction"] = xr.Variable(("time", "axis"), direction_of(self._measured("field")))
        return data


class _Averaged(Mapping[str, Floats]):
    """The columns that a series holds; each is made double when it is asked for: all are megabytes."""

    def __init__(self, series: Series) -> None:
        self._series, self._names = series, series.features.columns

    def __getitem__(self, name: str) -> Floats:
        if name not in self._names:
            raise KeyError(name)
        return self._series.of_row(f"{_COLUMN}{name}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)
