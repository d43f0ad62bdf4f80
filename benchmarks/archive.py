"""A mission archive written directly: simulated days as segments, without files in between."""

from __future__ import annotations

import datetime as dt
import shutil
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy.interpolate import CubicSpline

from inflight.catalog import Catalog, DayData, Segment, Workspace, write_segment
from inflight.mission import Mission
from inflight.simulate import SimulationSettings, simulate_day
from inflight.time import SECOND, day_range

_BATCH = 15
#: Models that come with the project.
SHIPPED = Path(__file__).parents[1] / "missions" / "models"


def simulated_workspace(
    folder: Path,
    days: int,
    start: str = "2005-01-01",
    *,
    settings: SimulationSettings | None = None,
    model: str = "",
    workers: int = 2,
    vector_hz: int = 0,
) -> Catalog:
    """Return a workspace whose archive holds so many simulated days; an existing one is kept.

    Parameters
    ----------
    settings : SimulationSettings, optional
        Everything but the span.
    model : str
        File of the shipped models that stands for the pre-flight one.
    workers : int
        Processes; 1 stays in this one.
    vector_hz : int
        Readings of the vector magnetometer a second; 0 is the simulation's own cadence.
    """
    if (folder / "mission.yaml").is_file():
        return Catalog(folder)
    settings = (settings or SimulationSettings()).model_copy(
        update={"start": dt.date.fromisoformat(start), "days": days}
    )
    workspace = Workspace.create(folder, "champ")
    _adapt(folder, settings.cadence, model, vector_hz)
    mission, catalog = workspace.mission(), Catalog(folder)
    dates = day_range(start, np.datetime64(start) + np.timedelta64(days, "D"))
    batches = [dates[at : at + _BATCH] for at in range(0, days, _BATCH)]
    with catalog.run("simulate", {"days": days}) as run:
        jobs = [(folder, run.id, mission.text, settings, vector_hz, batch) for batch in batches]
        for segments in _spread(jobs, workers):
            for segment in segments:
                run.attach(segment)
        run.publish()
    return catalog


def _adapt(folder: Path, cadence: int, model: str, vector_hz: int) -> None:
    """Let the mission's file tell the cadence of the simulation and the model to start from."""
    path = folder / "mission.yaml"
    text = path.read_text(encoding="utf-8").replace("cadence: 1 s", f"cadence: {cadence} s")
    if vector_hz:
        head, vector, rest = text.partition("  fgm:")
        text = head + vector + rest.replace(f"cadence: {cadence} s", f"cadence: {1000 / vector_hz:g} ms", 1)
    if model:
        shutil.copy(SHIPPED / model, folder / "models" / model)
        text = text.replace("models/champ-preflight.yaml", f"models/{model}")
    path.write_text(text, encoding="utf-8")


def _spread(jobs: list[tuple[Any, ...]], workers: int) -> Iterator[list[Segment]]:
    if workers < 2:
        yield from map(_write_batch, jobs)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("forkserver")) as pool:
        yield from pool.map(_write_batch, jobs)


def _write_batch(job: tuple[Any, ...]) -> list[Segment]:
    folder, run, text, settings, vector_hz, batch = job
    mission = Mission.parse(text)
    made = [dict(simulate_day(settings, day).instruments) for day in batch]
    if vector_hz:
        made = [{**one, "fgm": _at_rate(one["fgm"], vector_hz)} for one in made]
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


def _at_rate(delivered: xr.Dataset, hertz: int) -> xr.Dataset:
    """Return an instrument's day with so many readings a second, by splines through those simulated."""
    stamps = delivered["Epoch"].values
    step = SECOND // hertz
    faster = np.arange(stamps[0], stamps[-1] + 1, step)
    noise = np.random.default_rng(int(stamps[0] // SECOND)).normal
    out: dict[str, Any] = {"Epoch": ("record", faster)}
    for name, variable in delivered.data_vars.items():
        if name == "Epoch":
            continue
        values = np.asarray(variable.values)
        if values.dtype.kind != "f":
            made = values[np.searchsorted(stamps, faster, side="right") - 1]
        else:
            made = CubicSpline((stamps - stamps[0]) / SECOND, values)((faster - stamps[0]) / SECOND)
            if values.ndim > 1:
                # White noise of 0.1 nT a reading, which the mean of a second's readings hardly shows.
                made = made + noise(0.0, 0.1, made.shape)
        out[str(name)] = (("record", *variable.dims[1:]), made, variable.attrs)
    return xr.Dataset(out)


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
