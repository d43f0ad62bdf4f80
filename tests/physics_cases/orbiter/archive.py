"""A simulated mission into a workspace: mission YAML, model of what is known, archive or files."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import xarray as xr

from inflight.catalog import Catalog, DayData, Workspace, write_segment
from inflight.flags import Flag
from inflight.mission import Mission
from inflight.time import SECOND, day_bounds, to_utc

from .house import Channel

#: Rows of an instrument: stamps (time,) TT2000 and the channels' values at them.
Table = tuple[np.ndarray, dict[str, np.ndarray]]


def instrument_entry(
    role: str, channels: Iterable[Channel], name: str, extra: dict[str, Any]
) -> dict[str, Any]:
    """Return an instrument of the mission YAML."""
    channels = list(channels)
    files = {"pattern": f"{name}/{name}_{{day:%Y%m%d}}.parquet", "reader": "parquet", "time": "time"}
    told = {channel.name: _channel_entry(channel) for channel in channels}
    return {"role": role, "cadence": f"{channels[0].cadence:g} s", "files": files, "channels": told} | extra


def _channel_entry(channel: Channel) -> dict[str, Any]:
    axes = "xyzw"[: channel.values.shape[1]] if channel.values.ndim > 1 else ""
    entry: dict[str, Any] = {"unit": channel.unit, "resolution": channel.resolution}
    entry |= {"variables": [f"{channel.name}_{a}" for a in axes]} if axes else {"variable": channel.name}
    entry |= {"axes": list(axes)} if axes else {}
    entry |= {"kind": channel.kind} if channel.kind != "other" else {}
    return entry | ({"frame": "itrf"} if channel.kind in ("attitude", "position") else {})


def make_workspace(root: Path, mission: dict[str, Any], model: dict[str, Any]) -> Workspace:
    """Make a workspace of a mission and its pre-flight model, given as trees; JSON is YAML."""
    source = root.parent / f"{root.name}-delivered"
    (source / "models").mkdir(parents=True, exist_ok=True)
    (source / mission["preflight"]).write_text(json.dumps(model, indent=1), encoding="utf-8")
    yaml = source / "mission.yaml"
    yaml.write_text(json.dumps(mission, indent=1), encoding="utf-8")
    return Workspace.create(root, yaml)


def write_archive(workspace: Workspace, tables: dict[str, Table], days: list[np.datetime64]) -> Catalog:
    """Write every instrument's days straight into the archive, as ingest would have."""
    mission, catalog = workspace.mission(), Catalog(workspace.root)
    with catalog.run("ingest", {"mission": mission.mission}) as run:
        for name, table in tables.items():
            made = list(_days(mission, name, table, days))
            run.attach(write_segment(workspace.root, run.id, f"l1/{name}", made))
        run.publish()
    return catalog


def write_files(workspace: Workspace, tables: dict[str, Table], days: list[np.datetime64]) -> None:
    """Deliver every instrument's days as Parquet files, for `inflight ingest` to take in."""
    for name, (stamps, columns) in tables.items():
        folder = workspace.data / name
        folder.mkdir(parents=True, exist_ok=True)
        utc = to_utc(stamps)
        for day in days:
            rows = _rows(stamps, day)
            arrays = {"time": pa.array(utc[rows])}
            for key, values in columns.items():
                parts = {key: values}
                if values.ndim > 1:
                    parts = {f"{key}_{'xyzw'[axis]}": series for axis, series in enumerate(values.T)}
                arrays |= {part: pa.array(series[rows]) for part, series in parts.items()}
            pq.write_table(pa.table(arrays), folder / f"{name}_{str(day).replace('-', '')}.parquet")


def _rows(stamps: np.ndarray, day: np.datetime64) -> slice:
    first, last = np.searchsorted(stamps, day_bounds(day))
    return slice(int(first), int(last))


def _days(mission: Mission, name: str, table: Table, days: list[np.datetime64]) -> Iterable[DayData]:
    stamps, columns = table
    instrument = mission.instruments[name]
    missing = {"vector": Flag.VECTOR_MISSING, "scalar": Flag.SCALAR_MISSING}.get(instrument.role, Flag.GOOD)
    for day in days:
        rows = _rows(stamps, day)
        if rows.stop == rows.start:
            continue
        out: dict[str, Any] = {"tt2000": ("time", stamps[rows])}
        lost = np.zeros(rows.stop - rows.start, dtype=bool)
        for key, channel in instrument.channels.items():
            values = columns[key][rows]
            dims = ("time", "axis" if len(channel.axis_names) == 3 else f"{key}_axis")[: values.ndim]
            attrs = {"units": channel.unit, "kind": channel.kind, "cadence_ns": instrument.cadence}
            attrs |= {"lag_ns": channel.lag, "frame": channel.frame or "", "resolution": channel.resolution}
            out[key] = (dims, values, attrs)
            lost |= ~np.isfinite(values if values.ndim == 1 else values.sum(axis=1))
        out["flag"] = ("time", np.where(lost, np.uint32(missing), np.uint32(0)))
        expected = 86_400 * SECOND / instrument.cadence
        report = {"coverage": min(1.0, float((~lost).sum() / expected))}
        yield DayData(day, xr.Dataset(out), key=f"{name}-{day}", report=report)


def sampled(channel: Channel, seconds: np.ndarray, start: int) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps and values of a channel at its own cadence, in whole steps of its resolution."""
    at = np.arange(0.0, seconds[-1] + 1e-6, channel.cadence)
    take: Callable[[np.ndarray], np.ndarray] = lambda v: v if at.size == v.size else np.interp(at, seconds, v)  # noqa: E731
    values = channel.values
    values = take(values) if values.ndim == 1 else np.stack([take(v) for v in values.T], axis=1)
    stamps = start + np.round(at * 1e9).astype(np.int64)
    return stamps, np.round(values / channel.resolution) * channel.resolution
