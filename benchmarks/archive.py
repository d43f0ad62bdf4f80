"""A mission archive written directly: simulated days as segments, without files in between."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from inflight.catalog import Catalog, DayData, Segment, write_segment
from inflight.catalog.workspace import Workspace
from inflight.mission import Mission
from inflight.simulate import SimulationSettings, simulate_day
from inflight.time import day_range

_BATCH = 15


def simulated_workspace(folder: Path, days: int, start: str = "2005-01-01") -> Catalog:
    """Return a workspace whose archive holds so many simulated days; an existing one is kept."""
    if (folder / "mission.yaml").is_file():
        return Catalog(folder)
    workspace = Workspace.create(folder, "champ")
    mission, catalog = workspace.mission(), Catalog(folder)
    settings = SimulationSettings(start=start, days=days)
    wanted = day_range(start, np.datetime64(start) + np.timedelta64(days, "D"))
    batches = [wanted[at : at + _BATCH] for at in range(0, days, _BATCH)]
    with catalog.run("simulate", {"days": days}) as run:
        jobs = [(folder, run.id, mission.text, settings, batch) for batch in batches]
        with ProcessPoolExecutor(2, mp_context=get_context("forkserver")) as pool:
            for segments in pool.map(_write_batch, jobs):
                for segment in segments:
                    run.attach(segment)
        run.publish()
    return catalog


def _write_batch(job: tuple[Any, ...]) -> list[Segment]:
    folder, run, text, settings, batch = job
    mission = Mission.parse(text)
    made = [simulate_day(settings, day).instruments for day in batch]
    return [
        write_segment(
            folder,
            run,
            f"l1/{name}",
            [
                DayData(day, _level1(mission, name, one[_delivered(mission, name)]), key=f"{name}-{day}")
                for day, one in zip(batch, made, strict=True)
            ],
        )
        for name in mission.instruments
    ]


def _delivered(mission: Mission, name: str) -> str:
    """Return the simulator's name of an instrument: the folder its files are delivered in."""
    pattern = (mission.files(name).pattern or [""])[0]
    return pattern.split("/", maxsplit=1)[0]


def _level1(mission: Mission, name: str, delivered: xr.Dataset) -> xr.Dataset:
    """Name variables as the mission does and give them its attributes, as ingest would."""
    instrument = mission.instruments[name]
    out: dict[str, Any] = {"tt2000": ("time", delivered["Epoch"].values)}
    for channel_name, channel in instrument.channels.items():
        values = delivered[channel.sources[0]].values.astype(np.float64)
        if values.ndim == 1 or not channel.axis_names:
            values = values.reshape(values.shape[0])
        values[np.isin(values, channel.fill or [])] = np.nan
        dims = ("time", "axis" if len(channel.axis_names) == 3 else f"{channel_name}_axis")[: values.ndim]
        attrs = {"units": channel.unit, "kind": channel.kind, "cadence_ns": instrument.cadence}
        attrs |= {"lag_ns": channel.lag, "frame": channel.frame or ""}
        attrs |= {"resolution": channel.resolution} if channel.resolution else {}
        out[channel_name] = (dims, values, attrs)
    out["flag"] = ("time", np.zeros(delivered.sizes["record"], dtype=np.uint32))
    return xr.Dataset(out)
