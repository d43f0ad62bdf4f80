"""The statistics of one day for the whole-mission fit: all that later steps need of its samples.

In go the samples of a day and its own fit of nine parameters (`inflight.tasks.pipelines.scalar.fit_day`), out
comes one Dataset with the normal equations of everything the model lets data move
(`inflight.mission_fit.daily_equations`), and beside them up to five *parts*:

``spectrum``
    spectrum of each instrument about that band (`inflight.mission_fit.instrument_spectra`)
``band``
    normal equations of the torquers' band (`inflight.mission_fit.torquers`), one row a segment
``epoch``
    epochs at which a current steps (`inflight.mission_fit.superposed_epochs`), one row an epoch
``channel``
    mean, spread and number of readings of each auxiliary channel
``beside``
    auxiliary columns of the normal equations, which the model does not have

A part is a table of rows. Its numbers are stored in two arrays a day, one of floats and one of integers; an
attribute says which columns are which variable. A store has a file for each array of each day, and fifty
small files would take longer to write and read than their contents to compute. Days of one store need arrays
of one size: a part with more rows on one day than on another is padded; ``<part>.kept`` counts its own rows.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NormalEquations
from inflight.catalog import Catalog, Day
from inflight.effects import position_channel
from inflight.errors import SamplesError
from inflight.frames import add_geometry, direction_of, geometry_at
from inflight.lsq import RESIDUAL, to_amperes
from inflight.mission import Mission
from inflight.mission_fit import (
    LIGHT,
    AuxiliaryColumns,
    DayDrift,
    band_equations,
    empty_equations,
    extract_epochs,
    instrument_spectra,
    wide_and_auxiliary_equations,
    with_nine_parameters,
)
from inflight.model import ResidualRows, rows_of
from inflight.progress import Progress, silent, tell_each
from inflight.residual import find_steps
from inflight.tasks.archive import channels_by_name, own_readings
from inflight.tasks.batches import give_back_memory
from inflight.tasks.pipelines.base import Batch
from inflight.tasks.pipelines.scalar import fit_day
from inflight.time import Int64, day_bounds, usual_step

#: Dimension of each part's rows, and the most rows that are kept (0: all).
PART_ROWS = {
    "spectrum": ("row", 0),
    "band": ("segment", 30),
    "epoch": ("epoch", 48),
    "channel": ("channel", 0),
    "beside": ("beside", 0),
}

#: What `equations_of_days` takes of each day.
EQUATION_VARIABLES = ("gram", "drift", "reference", "start", "end", "count", "scale", "column", "other")

#: Array of a part by the kind of its numbers.
_ARRAYS = {"f": "number", "i": "stamp"}

#: Kinds of channels whose currents may step, the solar array's first.
CURRENT_KINDS = ("solar_current", "battery_current", "camera_current", "heater", "current")


# --- parts of a stored day ------------------------------------------------------------------------------


def pack_parts(day: xr.Dataset, parts: Mapping[str, xr.Dataset | None]) -> xr.Dataset:
    """Return a day with its parts: variables ``part.number``, ``part.stamp`` (block, row, column).

    A part that is None or has no row adds nothing. Rows beyond the most kept are thinned evenly over the day.
    """
    made: dict[str, xr.Variable] = {}
    for name, part in parts.items():
        dim, most = PART_ROWS[name]
        if part is None or not part.sizes[dim]:
            continue
        chosen = np.arange(part.sizes[dim])
        if 0 < most < chosen.size:
            chosen = np.unique(np.linspace(0, chosen.size - 1, most).astype(np.int64))
        kept = {str(key): variable for key, variable in part.isel({dim: chosen}).variables.items()}
        columns = {
            key: variable
            for key, variable in kept.items()
            if variable.dims[:1] == (dim,) and variable.dtype.kind not in "UO"
        }
        made[f"{name}.kept"] = xr.Variable("block", np.array([chosen.size], dtype=np.int64))
        for kind, array in _ARRAYS.items():
            values = [v.values.reshape(chosen.size, -1) for v in columns.values() if v.dtype.kind == kind]
            if values:
                filled = np.concatenate(values, axis=1)
                padded = np.zeros((max(most, chosen.size), filled.shape[1]), filled.dtype)
                padded[: chosen.size] = filled
                dims = ("block", f"{name}.row", f"{name}.{array}_column")
                made[f"{name}.{array}"] = xr.Variable(dims, padded[None])
        # Variables without rows, then texts: the order in which they come back.
        others = [key for key in kept if key not in columns]
        fixed = sorted(others, key=lambda key: kept[key].dims[:1] == (dim,))
        layout = {
            "columns": {key: [v.dtype.kind, v.dims, v.shape[1:], v.attrs] for key, v in columns.items()},
            "fixed": {key: [kept[key].dims, kept[key].values.tolist(), kept[key].attrs] for key in fixed},
            "coordinates": [str(key) for key in part.coords],
            "attributes": part.attrs,
        }
        day.attrs[f"{name}.layout"] = json.dumps(layout, default=lambda value: np.asarray(value).tolist())
    return day.assign(made)


def unpack_part(days: Sequence[xr.Dataset], name: str) -> list[xr.Dataset]:
    """Return the rows of a part as its estimator made them: one Dataset for all days of the same layout.

    Where a part's rows are the same things on every day, as channels are, ask for one day at a time.
    """
    by_layout: dict[str, list[xr.Dataset]] = {}
    for day in days:
        layout = day.attrs.get(f"{name}.layout")
        if layout is not None and f"{name}.kept" in day.variables and int(day[f"{name}.kept"].values[0]):
            by_layout.setdefault(layout, []).append(day)
    return [_unpack_layout(json.loads(layout), same, name) for layout, same in by_layout.items()]


def _unpack_layout(layout: dict[str, Any], days: Sequence[xr.Dataset], name: str) -> xr.Dataset:
    """Return the rows of days of one layout, joined."""
    kept = [int(day[f"{name}.kept"].values[0]) for day in days]
    joined = {
        kind: np.concatenate(
            [day[f"{name}.{array}"].values[0, :rows] for day, rows in zip(days, kept, strict=True)]
        )
        for kind, array in _ARRAYS.items()
        if f"{name}.{array}" in days[0].variables
    }
    variables, used = {}, dict.fromkeys(joined, 0)
    for key, (kind, dims, shape, attrs) in layout["columns"].items():
        first, used[kind] = used[kind], used[kind] + int(np.prod(shape, dtype=np.int64))
        values = joined[kind][:, first : used[kind]]
        variables[key] = xr.Variable(dims, values.reshape(-1, *shape), attrs)
    for key, (dims, values, attrs) in layout["fixed"].items():
        variables[key] = xr.Variable(dims, np.array(values), attrs)
    coordinates = {key: variables.pop(key) for key in layout["coordinates"]}
    return xr.Dataset(variables, coordinates, layout["attributes"])


def unify_variables(days: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """Return days with the same variables, as one store needs them; of a part a day lacks no row counts."""
    union: dict[str, xr.Variable] = {}
    for day in days:
        union |= {str(key): day[key].variable for key in day.variables if str(key) not in union}
    blank = {key: xr.zeros_like(one) if "block" in one.dims else one for key, one in union.items()}
    return [day.assign({key: one for key, one in blank.items() if key not in day.variables}) for day in days]


class StoredDays:
    """Statistics of days in the catalog, read part by part: a mission's take half a gigabyte together.

    Parameters
    ----------
    cat : Catalog
    days : sequence of Day
        In order of time.
    """

    def __init__(self, cat: Catalog, days: Sequence[Day]) -> None:
        self.cat, self.days = cat, list(days)
        self._last: tuple[str, list[xr.Dataset]] = ("", [])

    def of(self, places: Iterable[int]) -> StoredDays:
        """Return some of the days."""
        return StoredDays(self.cat, [self.days[place] for place in places])

    def read(self, *names: str, progress: Progress = silent) -> list[xr.Dataset]:
        """Return each day with those of the named variables that it has; tells "statistics"."""
        out = []
        for day in tell_each(progress, "statistics", self.days):
            there = self.cat.variables_of(day)
            out.append(self.cat.read(day, [name for name in names if name in there]))
        return out

    def read_part(self, name: str, *others: str) -> list[xr.Dataset]:
        """Return each day with the arrays of a part, as `unpack_part` takes them, and other variables."""
        return self.read(f"{name}.kept", *(f"{name}.{array}" for array in _ARRAYS.values()), *others)

    def rows_of(self, name: str) -> list[xr.Dataset]:
        """Return the rows of a part, as `unpack_part`; kept until those of another part are asked for."""
        if self._last[0] != name:
            self._last = ("", [])
            give_back_memory()
            self._last = (name, unpack_part(self.read_part(name), name))
        return self._last[1]


def auxiliary_columns_of(days: Sequence[xr.Dataset]) -> list[xr.Dataset | None]:
    """Return the auxiliary columns of each day's equations; None on days without."""
    return [next(iter(unpack_part([day], "beside")), None) for day in days]


def means_of_channels(days: Sequence[xr.Dataset]) -> dict[str, Floats]:
    """Return mean, spread and number of readings of each channel; (day, 3) each, NaN where a day lacks it."""
    out: dict[str, Floats] = {}
    for place, day in enumerate(days):
        if "channel.layout" in day.attrs and "channel.number" in day.variables:
            names = json.loads(day.attrs["channel.layout"])["fixed"]["channel"][1]
            for name, row in zip(names, day["channel.number"].values[0], strict=True):
                out.setdefault(name, np.full((len(days), 3), np.nan))[place] = row
    return out


def equations_of_days(days: Sequence[xr.Dataset]) -> tuple[NormalEquations, DayDrift]:
    """Return the wide equations of days, which stand in order of time, and what drifts within them."""
    names = [name for name in EQUATION_VARIABLES if "block" in days[0][name].dims]
    joined = {name: np.concatenate([day[name].values for day in days]) for name in names}
    drift, first = DayDrift(joined.pop("drift")), days[0]
    dims = {"gram": ("block", "column", "other"), "reference": ("block", "column")}
    variables = {
        name: (dims.get(name, ("block",)), values, first[name].attrs) for name, values in joined.items()
    }
    # The scatter within days is not used where all days are fitted: between them there is more of it.
    nothing = np.broadcast_to(0.0, joined["gram"].shape)
    equations = xr.Dataset(
        {**variables, "scatter": (dims["gram"], nothing), "scale": first["scale"]},
        coords={"column": first["column"].values, "other": first["other"].values},
        attrs=first.attrs,
    )
    assert str(equations["column"].values[-1]) == RESIDUAL
    return NormalEquations(equations), drift


# --- making a day ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class AuxiliaryChannels:
    """Channels that are examined although the model may not have them.

    Attributes
    ----------
    currents : tuple of str
        Scalar currents, the one of the solar array first where there is one.
    torquer : str
        Three torquer currents; empty when the mission has none.
    temperatures : tuple of str
        Of the comparison's vector sensor.
    orbit : bool
        Whether there are positions.
    """

    currents: tuple[str, ...]
    torquer: str
    temperatures: tuple[str, ...] = ()
    orbit: bool = False

    @classmethod
    def of(cls, mission: Mission, comparison: str) -> AuxiliaryChannels:
        """Return those of a mission's comparison, by the kinds of its channels."""
        homes = channels_by_name(mission)
        channels = {name: mission.instruments[home].channels[own] for name, (home, own) in homes.items()}
        scalars = {name: one.kind for name, one in channels.items() if not one.axis_names}
        vector = mission.comparisons[comparison].instruments().get("vector", "")
        torquers = [name for name, one in channels.items() if one.kind == "torquer_current"]
        return cls(
            currents=tuple(name for kind in CURRENT_KINDS for name in scalars if scalars[name] == kind),
            torquer=torquers[0] if torquers else "",
            temperatures=tuple(
                name for name, kind in scalars.items() if kind == "temperature" and homes[name][0] == vector
            ),
            orbit=bool(position_channel(mission)),
        )

    @property
    def all_currents(self) -> tuple[str, ...]:
        """Scalar currents and the torquers'."""
        return (*self.currents, *((self.torquer,) if self.torquer else ()))

    @property
    def names(self) -> tuple[str, ...]:
        """All of them."""
        return (*self.all_currents, *self.temperatures)


def mission_statistics(batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return the statistics of one day, and a report of its own fit.

    Returns
    -------
    xarray.Dataset
        The wide equations with their parts; `fit`, `fit_covariance`, `before`, `after` and `used` of the
        day's own fit of nine parameters.
    dict
        As `inflight.tasks.pipelines.scalar.day.FittedDay.report`.

    Raises
    ------
    CalibrationError
        As `inflight.tasks.pipelines.scalar.day.calibrate_day`.
    """
    model, fitted = batch.model, fit_day(batch, day)
    fit, samples, span = fitted.fit, fitted.samples, day_bounds(day)
    channels = AuxiliaryChannels.of(batch.mission, model.comparison)
    own_fit = {
        "fit": (("block", "nine"), fit.value[None]),
        "fit_covariance": (("block", "nine", "other_nine"), fit.covariance[None]),
        "before": ("block", np.array([fit.before])),
        "after": ("block", np.array([fit.after])),
        "used": ("block", np.array([fit.used], dtype=np.int64)),
    }
    means = _channel_means(batch, day, samples, channels)
    if not fit.used:
        # Fields without the channels the model needs: no equations, and a product all the same.
        empty = empty_equations(model, span, fitted.attributes).assign(own_fit)
        return pack_parts(empty, {"channel": means}), fitted.report
    own = with_nine_parameters(model, fit.value)
    rows = rows_of(own, samples)
    auxiliary = AuxiliaryColumns(channels.temperatures, channels.orbit)
    wide, columns = wide_and_auxiliary_equations(
        own, samples, rows, span, fitted.attributes, auxiliary=auxiliary
    )
    residual = np.where(rows.good, rows.residual[:, 0], np.nan)
    parts = {
        "spectrum": _spectra(samples, residual, rows, channels.torquer),
        "band": _torquer_band(samples, residual, rows, channels.torquer),
        "epoch": _current_steps(samples, residual, rows, channels.currents),
        "channel": means,
        "beside": columns,
    }
    return pack_parts(wide.assign(own_fit), parts), fitted.report


def _spectra(samples: xr.Dataset, residual: Floats, rows: ResidualRows, torquer: str) -> xr.Dataset | None:
    """Return the spectra of both instruments; None without torquers or a stretch long enough."""
    if not torquer or torquer not in samples:
        return None
    stamps, strength = (
        np.asarray(samples["tt2000"].values, dtype=np.int64),
        np.linalg.norm(rows.field, axis=1),
    )
    try:
        return instrument_spectra(stamps, strength + 0.0 * residual, strength - residual)
    except SamplesError:
        return None


def _torquer_band(
    samples: xr.Dataset, residual: Floats, rows: ResidualRows, torquer: str
) -> xr.Dataset | None:
    """Return the equations of the torquers' band; None without torquers or a stretch long enough."""
    if not torquer or torquer not in samples:
        return None
    current, _ = to_amperes(samples[torquer])
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    try:
        return band_equations(stamps, residual, direction_of(rows.field), current)
    except SamplesError:
        return None


def _current_steps(
    samples: xr.Dataset, residual: Floats, rows: ResidualRows, currents: Sequence[str]
) -> xr.Dataset | None:
    """Return the epochs at which the first current steps; None when it never does."""
    present = [name for name in currents if name in samples]
    if not present:
        return None
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    channel = samples[present[0]]
    own = _own_readings(stamps, channel)
    try:
        values = np.asarray(channel.values, dtype=np.float64)[own]
        steps = find_steps(stamps[own], values, unit=str(channel.attrs["units"]))
        known = {name: samples[name].variable for name in ("tt2000", "weight", *present) if name in samples}
        known["field"] = xr.Variable(("time", "axis"), rows.field, {"units": "nT"})
        light = add_geometry(samples, [LIGHT]).get(LIGHT)
        # Days without a position have the same columns as the others.
        known[LIGHT] = xr.Variable("time", np.full(stamps.size, np.nan)) if light is None else light.variable
        at_steps = _geometry_at_steps(samples, np.searchsorted(stamps, steps.time))
        known |= {name: one for name, one in at_steps.items() if name not in known}
        others = (*present[1:], LIGHT)
        found = extract_epochs(xr.Dataset(known), residual, steps, channel=present[0], others=others)
    except SamplesError:
        return None
    return found if found.sizes["epoch"] else None


def _geometry_at_steps(samples: xr.Dataset, rows: Int64) -> dict[str, xr.Variable]:
    """Return the geometry of the orbit at some samples, NaN at all others; (time, ...)."""
    rows = np.unique(np.minimum(rows, samples.sizes["time"] - 1))
    out = {}
    for name, found in (geometry_at(samples, rows) if rows.size else {}).items():
        values = np.full((samples.sizes["time"], *found.shape[1:]), np.nan)
        values[rows] = found.values
        out[name] = xr.Variable(found.dims, values, found.attrs)
    return out


def _own_readings(stamps: Int64, channel: xr.DataArray) -> npt.NDArray[np.bool_]:
    """Return which samples are a channel's own readings, where it is slower than the samples; (time,).

    What alignment put between two readings knows nothing of steps, and has none of their noise.
    """
    cadence = int(channel.attrs.get("cadence_ns", 0))
    usual = usual_step(stamps, cadence)
    if cadence <= usual:
        return np.ones(stamps.size, dtype=bool)
    number = (stamps - stamps[0] + usual // 2) // cadence
    return np.asarray(np.concatenate([[True], np.diff(number) > 0]))


def _channel_means(
    batch: Batch, day: np.datetime64, samples: xr.Dataset, channels: AuxiliaryChannels
) -> xr.Dataset:
    """Return mean, spread and number of known values of the auxiliary channels over the day; (channel,).

    Currents are those of the samples, component by component, A. Temperatures are the day's own readings, at
    their own cadence.
    """
    series: dict[str, Floats] = {}
    for name in (one for one in channels.all_currents if one in samples):
        values, _ = to_amperes(samples[name])
        for index, column in enumerate(values.reshape(len(values), -1).T):
            series[name if values.ndim == 1 else f"{name}[{'xyz'[index] if index < 3 else index}]"] = column
    for need in batch.job.needs:
        if need.name in channels.temperatures and need.part is None:
            found = own_readings(batch.cat, batch.job.index, need, day)
            series[need.name] = np.zeros(0) if found is None else np.asarray(found, dtype=np.float64)
    known = [values[np.isfinite(values)] for values in series.values()]
    moments = {"mean": [one.mean() if one.size else np.nan for one in known]}
    moments["spread"] = [one.std() if one.size else np.nan for one in known]
    moments["count"] = [float(one.size) for one in known]
    return xr.Dataset(
        {name: ("channel", np.array(values, dtype=np.float64)) for name, values in moments.items()},
        coords={"channel": list(series)},
    )
