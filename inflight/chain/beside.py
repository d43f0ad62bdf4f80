"""Columns of causes that a model does not hold: their Gram strip beside a day's wide equations.

Temperatures with their lag, and the field of day and night, in the rows the wide equations are made of. The
strip is a small part of a day's statistics; what it says is asked of all days together, later.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NormalEquations
from inflight.calibration.equations import RESIDUAL
from inflight.calibration.sensor import vector_sensor_of
from inflight.diagnosis.coarse import bin_means, bridged
from inflight.diagnosis.columns import Rows
from inflight.errors import CalibrationError
from inflight.estimators.coil_temperature import KINDS, coil_columns
from inflight.estimators.day_night import series_columns, switched_columns
from inflight.geometry import add_geometry
from inflight.model import Model, ModelEffect
from inflight.time import SECOND, Int64

#: Degrees Celsius where a rival temperature's change is 0, when the model states none.
REFERENCE = 20.0
#: Order of the day/night series; a day holds fifteen orbits, all of them alike.
ORDER = 4
#: Physical size of one unit of a column, by the kind of what it answers to.
_SCALE = dict(zip(KINDS, (1e-6, 1e-8, 1e-6, 1e-8), strict=True))
_FIELD = 0.1


def temperature_entry(model: Model) -> ModelEffect | None:
    """Return the effect by which data may move how the vector sensor follows a temperature; None without."""
    own = vector_sensor_of(model)
    for entry in model.effects:
        same = entry.effect.name == "temperature" and entry.sensor == own.sensor
        if same and all(entry.parameters[name].free for name in KINDS[:2]):
            return entry
    return None


def reference_of(entry: ModelEffect | None) -> float:
    """Return where the change of a temperature is 0, degC."""
    return REFERENCE if entry is None else float(entry.parameters["reference"].value[0, 0])


@dataclass(frozen=True)
class Beside:
    """What is looked at beside a model, for every day of a mission alike.

    Attributes
    ----------
    temperatures : tuple of str
        Channels, degC. Of the model's own only the answers to its lag are needed.
    orbit : bool
        Whether the mission delivers positions, from which day and night follow.
    """

    temperatures: tuple[str, ...] = ()
    orbit: bool = False

    def columns(self, model: Model, samples: xr.Dataset, edges: Int64, rows: Rows) -> dict[str, Floats]:
        """Return the columns on the bins, physical units, (bin,) each; NaN where they are not known.

        Parameters
        ----------
        samples : xarray.Dataset
            Native ones.
        edges : ndarray of int64, shape (bin + 1,)
            TT2000.
        rows : Rows
            On these bins.
        """
        stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
        field = np.asarray(rows.samples["field"].values)
        centre = edges[:-1] // 2 + edges[1:] // 2
        entry = temperature_entry(model)
        own = "" if entry is None else entry.effect.channels[0]
        found: dict[str, Floats] = {}
        for name in self.temperatures:
            values = _on_bins(samples, name, stamps, edges)
            made = coil_columns(name, field, centre, values, 0.0, reference_of(entry))
            kept = KINDS[2:] if name == own else KINDS
            found |= {key: one for key, one in made.items() if _kind_of(key) in kept}
        if self.orbit and not holds_day_night(model):
            sunlit, phase = _daylight(samples, stamps, edges, centre)
            along = np.asarray(rows.samples["field_direction"].values)
            found |= switched_columns(along, sunlit) | series_columns(along, phase, ORDER)
        return found


def holds_day_night(model: Model) -> bool:
    """Return True when the model itself has a field of day and night."""
    return any(entry.effect.name in ("day_night", "day_night_series") for entry in model.effects)


def scale_of(name: str) -> float:
    """Return the physical size of one unit of a column."""
    return _SCALE.get(_kind_of(name), _FIELD)


def _kind_of(name: str) -> str:
    return name.rpartition(".")[2].partition("[")[0]


def _on_bins(samples: xr.Dataset, name: str, stamps: Int64, edges: Int64) -> Floats:
    """Return means of a channel on the bins, (bin, ...), its short gaps bridged."""
    if name not in samples:
        return np.full(edges.size - 1, np.nan)
    values = np.asarray(samples[name].values, dtype=np.float64)
    known = np.asarray(np.isfinite(values.reshape(len(values), -1)).all(axis=1))
    return bridged(bin_means(values, stamps, edges, known)[0])


def _daylight(samples: xr.Dataset, stamps: Int64, edges: Int64, centre: Int64) -> tuple[Floats, Floats]:
    """Return which part of the Sun shines, and the phase along the orbit from the point nearest it, deg."""
    if "position" not in samples:
        return (np.full(centre.size, np.nan),) * 2
    place = _on_bins(samples, "position", stamps, edges)
    position = xr.Variable(samples["position"].dims, place, samples["position"].attrs)
    told = add_geometry(xr.Dataset({"position": position, "tt2000": ("time", centre)}))
    return np.asarray(told["sunlit"].values), np.asarray(told["sun_phase"].values)


def split(equations: xr.Dataset, model_columns: Sequence[str], known: Mapping[str, bool]) -> xr.Dataset:
    """Return the strip of one block's columns that are none of the model's.

    Parameters
    ----------
    equations : Dataset
        One block of `NormalEquations`, the model's columns before all others.
    model_columns : sequence of str
    known : mapping of str to bool
        Whether a column could be formed; the strip of one that could not is 0.

    Returns
    -------
    xarray.Dataset
        dims beside, column (the model's and the residual), other (= beside): `cross`, `own` nT^2 scaled;
        `scale`, `known` (beside).
    """
    wide = [*model_columns, RESIDUAL]
    names = [name for name in equations["column"].values.tolist() if name not in set(wide)]
    gram = equations["gram"].isel(block=0)
    return xr.Dataset(
        {
            "cross": (("beside", "column"), gram.sel(column=names, other=wide).values, {"units": "nT2"}),
            "own": (("beside", "other"), gram.sel(column=names, other=names).values, {"units": "nT2"}),
            "scale": ("beside", equations["scale"].sel(column=names).values),
            "known": ("beside", np.array([known[name] for name in names], dtype=np.int64)),
        },
        coords={"beside": names, "column": wide, "other": names},
    )


def joined_with(
    equations: NormalEquations, strips: Sequence[xr.Dataset | None], names: Sequence[str]
) -> NormalEquations:
    """Return the equations with some columns of the strips beside the model's, of the days that know them.

    Parameters
    ----------
    equations : NormalEquations
        Of the days.
    strips : sequence of Dataset or None
        As `split` makes them, one a block.
    names : sequence of str
        Columns of the strips.

    Raises
    ------
    CalibrationError
        When no day knows all of the columns.
    """
    wanted = list(names)
    kept = [place for place, strip in enumerate(strips) if strip is not None and _knows(strip, wanted)]
    if not kept:
        raise CalibrationError(
            f"no day knows the columns of {', '.join(sorted({name.partition('.')[0] for name in wanted}))}",
            remedy="see the missing days of the channels, and of the orbit",
        )
    parts = [strip.sel(beside=wanted, other=wanted) for place in kept if (strip := strips[place]) is not None]
    data = equations.dataset.isel(block=kept)
    old, new = data.sizes["column"] - 1, len(wanted)
    gram = np.zeros((len(kept), old + new + 1, old + new + 1))
    places = np.append(np.arange(old), old + new)
    gram[:, places[:, None], places[None, :]] = data["gram"].values
    cross = np.stack([part["cross"].values for part in parts])
    gram[:, old : old + new, places] = cross
    gram[:, places, old : old + new] = cross.swapaxes(1, 2)
    gram[:, old : old + new, old : old + new] = np.stack([part["own"].values for part in parts])
    scale = np.concatenate([data["scale"].values[:-1], parts[0]["scale"].values, [1.0]])
    nought = np.zeros((len(kept), new))
    reference = np.concatenate(
        [data["reference"].values[:, :-1], nought, data["reference"].values[:, -1:]], axis=1
    )
    return of_grams(data, gram, reference, scale, [*equations.columns, *wanted])


def _knows(strip: xr.Dataset, names: Sequence[str]) -> bool:
    have = dict(zip(strip["beside"].values.tolist(), strip["known"].values.tolist(), strict=True))
    return all(bool(have.get(name, 0)) for name in names)


def of_grams(
    data: xr.Dataset, gram: Floats, reference: Floats, scale: Floats, names: Sequence[str]
) -> NormalEquations:
    """Return equations of the same blocks with other columns.

    Parameters
    ----------
    data : Dataset
        Of the equations they come from.
    gram : ndarray, shape (block, column + 1, column + 1)
        Scaled, the residual last.
    reference : ndarray, shape (block, column + 1)
    scale : ndarray, shape (column + 1,)
    names : sequence of str
        Of the columns.
    """
    row, both = ("block", "column", "other"), [*names, RESIDUAL]
    return NormalEquations(
        xr.Dataset(
            {
                "gram": (row, gram, {"units": "nT2"}),
                # Days scatter between themselves: what scatters inside one is not asked.
                "scatter": (row, np.broadcast_to(0.0, gram.shape)),
                "reference": (("block", "column"), reference),
                "start": data["start"],
                "end": data["end"],
                "count": data["count"],
                "scale": ("column", scale),
            },
            coords={"column": both, "other": both},
            attrs=data.attrs,
        )
    )


def lag_of(samples: xr.Dataset, name: str) -> float:
    """Return the lag that a channel was aligned with, s."""
    return float(samples[name].attrs.get("lag_ns", 0)) / SECOND if name in samples else 0.0
