"""From the archive to samples: the channels a model needs, on one time base, for one day."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from inflight.alignment import FIELD_ROLES, align
from inflight.catalog import Catalog
from inflight.comparison import folding_of
from inflight.derived import parse, product
from inflight.errors import SamplesError
from inflight.folding import fold
from inflight.geometry import GEOMETRY, add_geometry
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.archive_index import ArchiveIndex
from inflight.tasks.channel_series import channel_series
from inflight.tasks.flips import flip_flags
from inflight.tasks.needs import (
    SPIN_AXIS,
    SPIN_PHASE,
    Need,
    base_role,
    channel_homes,
    geometry_channels,
    position_channel,
)
from inflight.tasks.spinning import Turned, saturated, spin_phase
from inflight.time import day_bounds
from inflight.units import parse_unit


def load_samples(
    cat: Catalog,
    mission: Mission,
    model: Model,
    day: np.datetime64,
    needs: list[Need],
    index: ArchiveIndex,
    geometry: bool = True,
    folded: bool = True,
) -> xr.Dataset:
    """Read one day from the archive and align it.

    Parameters
    ----------
    needs : list of Need
        As `needs_of` returns them.
    index : ArchiveIndex
        The days around.
    geometry : bool
        False leaves out what `add_geometry` makes unless a need or the model asks for it.
    folded : bool
        False leaves a spin comparison's samples as they were measured.

    Returns
    -------
    xarray.Dataset
        Samples of `inflight.align`, cut to the UTC day; attitude and position under these names,
        derived channels under theirs, and what `inflight.geometry.add_geometry` makes of them. Those of
        a spin comparison have `spin_phase`, and are folded (`inflight.folding.fold`).

    Raises
    ------
    SamplesError
        When a field's day is not in the archive.
    """
    base = next(need for need in needs if need.name == base_role(mission, model.comparison))
    needs = [need for need in needs if need.name != SPIN_AXIS]
    clock = next((need for need in needs if need.name == SPIN_PHASE), None)
    present = _present(cat, [need for need in needs if need is not clock], base, day, index)
    stamps = present[base.name]["tt2000"].values
    start, end = day_bounds(day)
    samples = align(present, stamps[(stamps >= start) & (stamps < end)])
    if clock is not None:
        told = channel_series(cat, clock, day, index, alone=False)
        turned = spin_phase(mission, model.comparison, clock, told, samples["tt2000"].values)
        _add_phase(samples, mission, base, day, turned)
    for need in needs:
        if need.name not in samples:
            samples[need.name] = _absent(mission, need, samples.sizes["time"])
    samples = _oriented(mission, model, _name_geometry(mission, samples))
    wanted = GEOMETRY if geometry else _asked_geometry(model, needs)
    if wanted:
        samples = add_geometry(samples, wanted)
    samples = _with_products(samples, needs)
    folding = folding_of(mission, model.comparison) if folded else None
    return samples if folding is None else fold(samples, folding, (start, end))


def _present(
    cat: Catalog, needs: Sequence[Need], base: Need, day: np.datetime64, index: ArchiveIndex
) -> dict[str, xr.DataArray]:
    """Return the series of what is needed and there; refused where a field is not."""
    channels = {
        need.name: channel_series(cat, need, day, index, index.stands_alone(need, base, day))
        for need in needs
    }
    missing = [need for need in needs if need.name in FIELD_ROLES and channels[need.name] is None]
    if missing:
        raise SamplesError(
            f"no measurements of '{missing[0].instrument}'", day=str(day), remedy="ingest the day's files"
        )
    return {name: series for name, series in channels.items() if series is not None}


def _add_phase(samples: xr.Dataset, mission: Mission, base: Need, day: np.datetime64, turned: Turned) -> None:
    """Put the spin phase beside the samples, and flag what it, saturation and the flipper make unusable."""
    samples[SPIN_PHASE] = turned.phase
    channel = mission.instruments[base.instrument].channels[base.channel]
    flag = samples["flag"] | turned.flag | saturated(samples[base.name].values, channel)
    samples["flag"] = flag | flip_flags(mission, day, samples["tt2000"].values)


def _asked_geometry(model: Model, needs: Sequence[Need]) -> set[str]:
    """Return the factors of a model or a product that only geometry makes."""
    names = {channel for entry in model.effects for channel in entry.effect.channels}
    names |= {name for need in needs for name in need.products}
    return {factor for name in names for factor in name.split("*")} & set(GEOMETRY)


def _oriented(mission: Mission, model: Model, samples: xr.Dataset) -> xr.Dataset:
    """Tell each vector reading how its sensor is mounted."""
    for role, name in mission.comparisons[model.comparison].instruments().items():
        if role in samples and samples[role].ndim == 2:
            samples[role].attrs["orientation"] = tuple(mission.instruments[name].orientation)
    return samples


def _with_products(samples: xr.Dataset, needs: Sequence[Need]) -> xr.Dataset:
    """Add the products of channels; a factor that is missing makes a product of nothing but gaps."""
    for name in sorted({name for need in needs for name in need.products}):
        factors = [samples[part.name] for part in parse(name).parts]
        values = product([np.asarray(factor.values, dtype=np.float64) for factor in factors])
        dims = next((factor.dims for factor in factors if factor.ndim == values.ndim), ("time",))
        unit = parse_unit("1")
        for factor in factors:
            unit = unit * parse_unit(str(factor.attrs.get("units", "1")))
        samples[name] = xr.Variable(dims, values, {"units": str(unit), "kind": "other"})
    return samples


def _absent(mission: Mission, need: Need, count: int) -> xr.DataArray:
    """Return a channel of nothing but gaps, so that the samples say what is missing."""
    channel = mission.instruments[need.instrument].channels[need.channel]
    from_geometry = need.part is not None and need.part.channel in GEOMETRY
    width = 0 if from_geometry else len(channel.axis_names)
    shape = (count, width) if width else (count,)
    dims = ("time", "axis" if width == 3 else f"{need.name}_component")[: len(shape)]
    attrs = {"units": channel.unit, "kind": channel.kind} | (
        {"frame": channel.frame} if channel.frame else {}
    )
    return xr.DataArray(np.full(shape, np.nan), dims=dims, attrs=attrs)


def _name_geometry(mission: Mission, samples: xr.Dataset) -> xr.Dataset:
    """Call the attitude and the position by their kinds, whatever the mission names them."""
    first = {"position": position_channel(mission)}
    for name in geometry_channels(mission):
        instrument, channel = channel_homes(mission)[name]
        kind = mission.instruments[instrument].channels[channel].kind
        if name in samples:
            first[kind] = first.get(kind) or name
    return samples.rename(
        {
            name: kind
            for kind, name in first.items()
            if name in samples and name != kind and kind not in samples
        }
    )
