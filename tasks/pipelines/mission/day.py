"""A day of the whole-mission fit: its own fit, its wide equations, and what only its samples can witness.

One pass over a day's samples makes all that later steps are computed from: normal equations of everything the
model lets data move, the equations of the torquers' band, epochs of currents that step, and means of
channels.

These parts stand side by side in one Dataset (`pack_parts`, `part_of`). A part is a table of rows: segments,
epochs, channels. Its numbers stand in two arrays a day, one of floats and one of whole numbers, and an
attribute says which columns are which variable: a store has a file for each array of each day, and fifty
small ones would take longer to write and to read than all they hold to compute. Days of one store need arrays
of one size: a part that has more rows on one day than on another is filled up, and says how many it has.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import BlockFit, NormalEquations
from inflight.errors import SamplesError
from inflight.frames import direction_of, geometry_at
from inflight.lsq import RESIDUAL, to_amperes
from inflight.mission import Mission
from inflight.mission_fit import (
    AuxiliaryColumns,
    DayDrift,
    band_equations,
    empty_equations,
    extract_epochs,
    wide_and_auxiliary_equations,
    with_nine_parameters,
)
from inflight.model import ResidualRows, rows_of
from inflight.residual import find_steps
from inflight.tasks.archive import channels_by_name, own_readings, position_channel
from inflight.tasks.pipelines.base import Batch
from inflight.tasks.pipelines.scalar import fit_day
from inflight.time import Int64, day_bounds, usual_step

#: The rows of each part, and the most of them that are kept.
ROWS = {"band": ("segment", 30), "epoch": ("epoch", 48), "channel": ("channel", 0), "beside": ("beside", 0)}

#: Array of a part by the kind of its numbers.
_ARRAYS = {"f": "number", "i": "stamp"}


def pack_parts(day: xr.Dataset, parts: Mapping[str, xr.Dataset | None]) -> xr.Dataset:
    """Return a day with its parts: variables ``part.number``, ``part.stamp`` (block, row, column).

    A part that is None or has no row leaves nothing behind. Rows beyond the most kept are spread evenly over
    the day.
    """
    made: dict[str, xr.Variable] = {}
    for name, part in parts.items():
        dim, most = ROWS[name]
        if part is None or not part.sizes[dim]:
            continue
        chosen = _chosen(part.sizes[dim], most)
        kept = part.isel({dim: chosen})
        made[f"{name}.kept"] = xr.Variable("block", np.array([len(chosen)], dtype=np.int64))
        columns = {str(key): one for key, one in kept.variables.items() if one.dims[:1] == (dim,)}
        fixed = {str(key): one for key, one in kept.variables.items() if str(key) not in columns}
        text = {key: columns.pop(key) for key in list(columns) if columns[key].dtype.kind in "UO"}
        for kind, array in _ARRAYS.items():
            values = [
                one.values.reshape(len(chosen), -1) for one in columns.values() if one.dtype.kind == kind
            ]
            if values:
                whole = np.zeros(
                    (max(most, len(chosen)), sum(one.shape[1] for one in values)), values[0].dtype
                )
                whole[: len(chosen)] = np.concatenate(values, axis=1)
                made[f"{name}.{array}"] = xr.Variable(
                    ("block", f"{name}.row", f"{name}.{array}_column"), whole[None]
                )
        told = {
            "columns": {
                key: [one.dtype.kind, one.dims, one.shape[1:], one.attrs] for key, one in columns.items()
            },
            "fixed": {key: [one.dims, one.values.tolist(), one.attrs] for key, one in (fixed | text).items()},
            "coordinates": [str(key) for key in part.coords],
            "attributes": part.attrs,
        }
        day.attrs[f"{name}.layout"] = json.dumps(told, default=_plain)
    return day.assign(made)


def unify_variables(days: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """Return days with the same variables, as one store needs them: what a day lacks it has no rows of."""
    whole: dict[str, xr.Variable] = {}
    for day in days:
        whole |= {str(key): day[key].variable for key in day.variables if str(key) not in whole}
    blank = {key: xr.zeros_like(one) if "block" in one.dims else one for key, one in whole.items()}
    return [day.assign({key: one for key, one in blank.items() if key not in day.variables}) for day in days]


def unpack_part(days: Sequence[xr.Dataset], name: str) -> list[xr.Dataset]:
    """Return the rows of a part as its estimator made them: one Dataset for all days that are laid out alike.

    Where a part's rows are the same things on every day, as channels are, ask for one day at a time.
    """
    found: dict[str, list[xr.Dataset]] = {}
    for day in days:
        layout = day.attrs.get(f"{name}.layout")
        if layout is not None and f"{name}.kept" in day.variables and int(day[f"{name}.kept"].values[0]):
            found.setdefault(layout, []).append(day)
    return [_unpacked(json.loads(layout), some, name) for layout, some in found.items()]


def auxiliary_columns_of(days: Sequence[xr.Dataset]) -> list[xr.Dataset | None]:
    """Return of each day what was looked at beside the model; None where nothing was."""
    return [next(iter(unpack_part([day], "beside")), None) for day in days]


def means_of_channels(days: Sequence[xr.Dataset]) -> dict[str, Floats]:
    """Return mean, spread and number of readings of each channel; (day, 3) each, NaN where a day lacks it."""
    out: dict[str, Floats] = {}
    names: dict[str, list[str]] = {}
    for place, day in enumerate(days):
        layout = day.attrs.get("channel.layout")
        if layout is None or "channel.number" not in day.variables:
            continue
        if layout not in names:
            names[layout] = json.loads(layout)["fixed"]["channel"][1]
        for name, row in zip(names[layout], day["channel.number"].values[0], strict=True):
            out.setdefault(name, np.full((len(days), 3), np.nan))[place] = row
    return out


def equations_of_days(days: Sequence[xr.Dataset]) -> tuple[NormalEquations, DayDrift]:
    """Return the wide equations of days, which stand in order of time, and what drifts within them."""
    every = {
        name: np.concatenate([day[name].values for day in days])
        for name in ("gram", "drift", "reference", "start", "end", "count")
    }
    drift = DayDrift(every.pop("drift"))
    dims = {"gram": ("block", "column", "other"), "reference": ("block", "column")}
    first = days[0]
    variables = {
        name: (dims.get(name, ("block",)), values, first[name].attrs) for name, values in every.items()
    }
    # The scatter within days is not used where all days are fitted: between them there is more of it.
    nothing = np.broadcast_to(0.0, every["gram"].shape)
    joined = xr.Dataset(
        {**variables, "scatter": (dims["gram"], nothing), "scale": first["scale"]},
        coords={"column": first["column"].values, "other": first["other"].values},
        attrs=first.attrs,
    )
    assert str(joined["column"].values[-1]) == RESIDUAL
    return NormalEquations(joined), drift


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else np.asarray(value).tolist()


def _chosen(rows: int, most: int) -> np.ndarray:
    if not most or rows <= most:
        return np.arange(rows)
    return np.unique(np.linspace(0, rows - 1, most).astype(np.int64))


def _unpacked(layout: dict[str, Any], days: Sequence[xr.Dataset], name: str) -> xr.Dataset:
    """Return the rows of days of one layout."""
    kept = [int(day[f"{name}.kept"].values[0]) for day in days]
    whole = {
        kind: np.concatenate(
            [day[f"{name}.{array}"].values[0, :rows] for day, rows in zip(days, kept, strict=True)]
        )
        for kind, array in _ARRAYS.items()
        if f"{name}.{array}" in days[0].variables
    }
    own, used = {}, dict.fromkeys(whole, 0)
    for key, (kind, dims, shape, attrs) in layout["columns"].items():
        width = int(np.prod(shape, dtype=np.int64))
        part = whole[kind][:, used[kind] : used[kind] + width]
        used[kind] += width
        own[key] = xr.Variable(dims, part.reshape(-1, *shape), attrs)
    own |= {
        key: xr.Variable(dims, np.array(values), attrs)
        for key, (dims, values, attrs) in layout["fixed"].items()
    }
    coordinates = {key: own.pop(key) for key in layout["coordinates"]}
    return xr.Dataset(own, coordinates, layout["attributes"])


#: Kinds of channels whose currents may step.
CURRENTS = ("solar_current", "battery_current", "camera_current", "heater", "current")


@dataclass(frozen=True)
class AuxiliaryChannels:
    """Channels the chain looks at beside the model's own.

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
        kinds = {
            name: mission.instruments[instrument].channels[channel]
            for name, (instrument, channel) in homes.items()
        }
        currents = [
            name
            for kind in CURRENTS
            for name, one in kinds.items()
            if one.kind == kind and not one.axis_names
        ]
        torquers = [name for name, one in kinds.items() if one.kind == "torquer_current"]
        own = mission.comparisons[comparison].instruments().get("vector", "")
        warm = [
            name
            for name, one in kinds.items()
            if one.kind == "temperature" and homes[name][0] == own and not one.axis_names
        ]
        orbit = bool(position_channel(mission))
        return cls(tuple(currents), torquers[0] if torquers else "", tuple(warm), orbit)

    @property
    def names(self) -> tuple[str, ...]:
        """All of them."""
        return (*self.driven, *self.temperatures)

    @property
    def driven(self) -> tuple[str, ...]:
        """All currents."""
        return (*self.currents, *((self.torquer,) if self.torquer else ()))

    @property
    def beside(self) -> AuxiliaryColumns:
        """What is looked at beside the model."""
        return AuxiliaryColumns(self.temperatures, self.orbit)


def mission_statistics(batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return all that one day says, and a report of its own fit.

    Raises
    ------
    CalibrationError
        As `inflight.tasks.pipelines.scalar.calibrate.calibrate_day`.
    """
    model, fitted = batch.model, fit_day(batch, day)
    witnesses = AuxiliaryChannels.of(batch.mission, model.comparison)
    span = day_bounds(day)
    attributes = {
        "comparison": model.comparison,
        "model": model.sha,
        "cadence_ns": fitted.step,
        "filter": "raw",
    }
    means = _means(
        _currents(fitted.samples, witnesses.driven) | _temperatures(batch, day, witnesses.temperatures)
    )
    if not fitted.fit.used:
        # Fields without the channels the model needs: the day tells nothing, and gets a product all the same.
        empty = empty_equations(model, span, attributes).assign(_own_fit(fitted.fit))
        return pack_parts(empty, {"channel": means}), fitted.report
    own = with_nine_parameters(model, fitted.fit.value)
    rows = rows_of(own, fitted.samples)
    wide, strip = wide_and_auxiliary_equations(
        own, fitted.samples, rows, span, attributes, auxiliary=witnesses.beside
    )
    residual = np.where(rows.good, rows.residual[:, 0], np.nan)
    parts = {
        "band": _band(fitted.samples, residual, rows, witnesses),
        "epoch": _epochs(fitted.samples, residual, rows, witnesses),
        "channel": means,
        "beside": strip,
    }
    return pack_parts(wide.assign(_own_fit(fitted.fit)), parts), fitted.report


def _own_fit(fit: BlockFit) -> dict[str, Any]:
    """Return the day's own nine parameters with their covariance, and what they leave."""
    return {
        "fit": (("block", "nine"), fit.value[None]),
        "fit_covariance": (("block", "nine", "other_nine"), fit.covariance[None]),
        "before": ("block", np.array([fit.before])),
        "after": ("block", np.array([fit.after])),
        "used": ("block", np.array([fit.used], dtype=np.int64)),
    }


def _band(
    samples: xr.Dataset, residual: Floats, rows: ResidualRows, witnesses: AuxiliaryChannels
) -> xr.Dataset | None:
    """Return the equations of the torquers' band; None without torquers or a stretch long enough."""
    if not witnesses.torquer or witnesses.torquer not in samples:
        return None
    current, _ = to_amperes(samples[witnesses.torquer])
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    try:
        return band_equations(stamps, residual, direction_of(rows.field), current)
    except SamplesError:
        return None


def _epochs(
    samples: xr.Dataset, residual: Floats, rows: ResidualRows, witnesses: AuxiliaryChannels
) -> xr.Dataset | None:
    """Return the epochs at which the first current steps; None when it never does."""
    there = [name for name in witnesses.currents if name in samples]
    if not there:
        return None
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    channel = samples[there[0]]
    own = _own_readings(stamps, channel)
    try:
        values = np.asarray(channel.values, dtype=np.float64)[own]
        steps = find_steps(stamps[own], values, unit=str(channel.attrs["units"]))
        known = {name: samples[name].variable for name in ("tt2000", "weight", *there) if name in samples}
        known["field"] = xr.Variable(("time", "axis"), rows.field, {"units": "nT"})
        known |= _where(samples, np.searchsorted(stamps, steps.time))
        found = extract_epochs(xr.Dataset(known), residual, steps, channel=there[0], others=there[1:])
    except SamplesError:
        return None
    return found if found.sizes["epoch"] else None


def _where(samples: xr.Dataset, rows: Int64) -> dict[str, xr.Variable]:
    """Return places of the orbit at some samples, NaN at all others."""
    count = samples.sizes["time"]
    rows = np.unique(np.minimum(rows, count - 1))
    out = {}
    for name, told in (geometry_at(samples, rows) if rows.size else {}).items():
        whole = np.full((count, *told.shape[1:]), np.nan)
        whole[rows] = told.values
        out[name] = xr.Variable(told.dims, whole, told.attrs)
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


def _currents(samples: xr.Dataset, names: Sequence[str]) -> dict[str, Floats]:
    """Return currents at the samples, component by component; A."""
    out = {}
    for name in (one for one in names if one in samples):
        values, _ = to_amperes(samples[name])
        for index, column in enumerate(values.reshape(len(values), -1).T):
            out[name if values.ndim == 1 else f"{name}[{'xyz'[index] if index < 3 else index}]"] = column
    return out


def _temperatures(batch: Batch, day: np.datetime64, names: Sequence[str]) -> dict[str, Floats]:
    """Return a day's own readings of temperatures, each at its own cadence; empty ones of what is missing."""
    out = {}
    for need in batch.job.needs:
        if need.name in names and need.part is None:
            found = own_readings(batch.cat, batch.job.index, need, day)
            out[need.name] = np.zeros(0) if found is None else np.asarray(found, dtype=np.float64)
    return out


def _means(series: Mapping[str, Floats]) -> xr.Dataset:
    """Return mean, spread and number of known values of channels over the day."""
    rows = []
    for values in series.values():
        known = values[np.isfinite(values)]
        told = (known.mean(), known.std()) if known.size else (np.nan, np.nan)
        rows.append((*told, float(known.size)))
    table = np.array(rows, dtype=np.float64).reshape(-1, 3)
    return xr.Dataset(
        {name: ("channel", table[:, place]) for place, name in enumerate(("mean", "spread", "count"))},
        coords={"channel": list(series)},
    )
