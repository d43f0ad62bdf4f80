"""Small datasets and pieces of work shared by the catalog's tests."""

from __future__ import annotations

import multiprocessing
import os
import resource
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import xarray as xr
from probe_mission import PROBE_YAML
from sqlalchemy import update

from inflight.catalog import Catalog, DayData, FileRecord, Run, write_segment
from inflight.catalog.schema import RunRow
from inflight.errors import StorageError
from inflight.mission import Mission
from inflight.time import SECOND, day_bounds


def delivered(run: Run, sha256: str, *days: np.datetime64, **report: object) -> FileRecord:
    """A delivered file of instrument ``fgm``."""
    return FileRecord(
        instrument="fgm",
        path="a.cdf",
        sha256=sha256,
        size=10,
        mtime_ns=123,
        days=tuple(map(str, days)),
        report=report,
        run=run.id,
    )


def samples(
    day: str | np.datetime64, *, step_s: float = 600, seed: int = 0, jitter: bool = False
) -> xr.Dataset:
    """A day of a vector instrument: a packed vector, a float, a flag and a matrix without rows."""
    start, end = day_bounds(np.datetime64(day, "D"))
    times = np.arange(start, end, int(step_s * SECOND), dtype=np.int64)
    rng = np.random.default_rng([seed, abs(int(np.datetime64(day, "D").astype(int)))])
    if jitter:
        times = times + rng.integers(0, int(step_s * SECOND) // 2, times.size)
        times = times[times < end]
    field = np.round(rng.normal(0, 30000, (times.size, 3)), 2)
    field[::17, 1] = np.nan
    return xr.Dataset(
        {
            "tt2000": ("time", times),
            "field": (("time", "axis"), field, {"units": "nT", "resolution": 0.01, "frame": "sensor"}),
            "temperature": ("time", rng.normal(20, 1, times.size), {"units": "degC"}),
            "flag": ("time", rng.integers(0, 5, times.size).astype("uint32"), {"flag_masks": [1, 2, 4]}),
            "rotation": (("axis", "other"), np.eye(3)),
        },
        coords={"axis": ["x", "y", "z"]},
        attrs={"mission": "test"},
    )


def days_from(first: str, count: int) -> list[np.datetime64]:
    return [np.datetime64(first, "D") + offset for offset in range(count)]


def publish(
    catalog: Catalog,
    name: str,
    days: Sequence[np.datetime64],
    *,
    seed: int = 0,
    key: str = "",
    context: str | None = None,
) -> str:
    """Publish days as one segment; return the run's id. The key of each day ends with the day."""
    with catalog.run("test", {}, context) as run:
        data = [
            DayData(day, samples(day, seed=seed), f"{key}-{day}" if key else "", ("file:abc",))
            for day in days
        ]
        run.attach(write_segment(catalog.workspace, run.id, name, data))
        run.publish()
    return run.id


def table(value: float = 1.0) -> xr.Dataset:
    """A calibration table of two intervals and two parameters."""
    return xr.Dataset(
        {
            "value": (("interval", "parameter"), np.full((2, 2), value), {"units": "nT"}),
            "determined": (("interval", "parameter"), np.ones((2, 2), bool)),
            "source": (("interval",), np.array(["fit", "prior"])),
        },
        coords={"parameter": ["offset[x]", "offset[y]"]},
    )


def publish_seed(catalog: Catalog, seed: int) -> None:
    """Publish one generation of four days in two segments, with a table certified in the same transaction.

    Every value says of which generation it is. Days that a dead run left verified are adopted.
    """
    with catalog.run("generation", {"seed": seed}) as run:
        for half in (GENERATION_DAYS[:2], GENERATION_DAYS[2:]):
            new = [day for day in half if run.adopt("l2/field", day, f"{seed}-{day}") is None]
            data = [DayData(day, generation(day, seed), f"{seed}-{day}", ("file:abc",)) for day in new]
            if data:
                run.attach(write_segment(catalog.workspace, run.id, "l2/field", data))
        made = run.stage_table("offsets", table(float(seed)), start=0, end=100)
        run.publish(certify=[(made, 0, 100, None)], supersede=True)


GENERATION_DAYS = days_from("2005-01-01", 4)


def generation(day: np.datetime64, seed: int) -> xr.Dataset:
    dataset = samples(day, step_s=3600)
    return dataset.assign(seed=("time", np.full(dataset.sizes["time"], seed)))


def generation_seen(catalog: Catalog) -> int:
    """Return the one generation that every day, every value and the table show; fail when they differ."""
    days = catalog.days("l2/field")
    assert len(days) == len(GENERATION_DAYS)
    assert {day.state for day in days} == {"published"}
    runs = {day.run for day in days}
    assert len(runs) == 1, f"days of different runs are visible together: {runs}"
    seeds = set(np.unique(catalog.open("l2/field", variables=["seed"])["seed"].values))
    assert len(seeds) == 1, f"values of generations {seeds} are visible together"
    return int(seeds.pop())


#: What publishing imports at its first use: for a process that is killed a second later, most of its life.
_NEEDED = ("alembic.command", "dask.array", "pint", "psycopg", "zarr.api.asynchronous", "zarr.storage")


def spawn(target: Callable[..., None], *arguments: object, kill_at: str = "") -> BaseProcess:
    """Start a process of its own, quickly: its imports are made once, by a server that forks."""
    here, *others = str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])
    if not others or here not in others[0].split(os.pathsep):
        os.environ["PYTHONPATH"] = os.pathsep.join([here, *others])
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["catalog_cases", *_NEEDED])
    process = context.Process(target=_begin, args=(kill_at, target, arguments))
    process.start()
    return process


def _begin(kill_at: str, target: Callable[..., None], arguments: tuple[object, ...]) -> None:
    os.environ["INFLIGHT_KILL_AT"] = kill_at
    target(*arguments)


def publish_generations(workspace: Path, first: int, stop: int, ready: Connection | None = None) -> None:
    """Publish one generation after the other."""
    catalog = Catalog(workspace)
    if ready is not None:
        ready.send("ready")
    for seed in range(first, stop):
        publish_seed(catalog, seed)


def publish_until_told(workspace: Path, pipe: Connection) -> None:
    """Publish one generation after the other until something is sent; then tell the last one."""
    catalog, seed = Catalog(workspace), 0
    while not pipe.poll():
        seed += 1
        publish_seed(catalog, seed)
    pipe.send(seed)


def save_a_model(workspace: Path, text: str) -> None:
    Catalog(workspace).save_model("m", text)


def hold_a_run(workspace: Path, pipe: Connection) -> None:
    """Begin a run, tell so, and end it when told."""
    with Catalog(workspace).run("slow") as run:
        pipe.send(run.id)
        pipe.recv()


def write_under_a_size_limit(workspace: Path, pipe: Connection) -> None:
    """Write a segment where the kernel refuses files of more than 4000 bytes; tell the error."""
    catalog = Catalog(workspace)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
    day = GENERATION_DAYS[0]
    try:
        write_segment(catalog.workspace, "run", "l2/field", [DayData(day, samples(day))])
    except StorageError as error:
        pipe.send((error.cause, error.remedy))
    else:
        pipe.send(("", "written"))


def publish_one_day(workspace: Path, first_seed: int, times: int) -> None:
    """Publish the same day again and again."""
    catalog = Catalog(workspace)
    for seed in range(times):
        publish(catalog, "l2/field", GENERATION_DAYS[:1], seed=1000 * first_seed + seed)


def publish_own_dataset(workspace: Path, name: str, days: int) -> None:
    """Publish a span of days of one dataset, a run for each two of them."""
    catalog = Catalog(workspace)
    span = days_from("2005-01-01", days)
    for first in range(0, days, 2):
        publish(catalog, name, span[first : first + 2])


def state_url(workspace: Path, url: str) -> None:
    """Say in a workspace where its catalog is."""
    workspace.mkdir(parents=True, exist_ok=True)
    (workspace / "catalog.yaml").write_text(f"url: {url}\n")


def end_leases(catalog: Catalog) -> None:
    """Let the time pass after which runs without a sign of life are taken for dead."""
    catalog._database.write(lambda session: session.execute(update(RunRow).values(lease=0.0 * RunRow.lease)))


def freeze(workspace: Path, version: str) -> None:
    Catalog(workspace).release(version)


def freeze_as_cdf(workspace: Path, version: str) -> None:
    Catalog(workspace).release(version, formats=("cdf",), mission=release_mission())


def freeze_under_a_size_limit(workspace: Path, formats: Sequence[str], pipe: Connection) -> None:
    """Release in each format where the kernel refuses files of more than 60 kB; tell the errors.

    The database's own files are smaller while it is only read.
    """
    catalog = Catalog(workspace)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
    for form in formats:
        try:
            catalog.release("1.0", formats=(form,), mission=release_mission())
        except StorageError as error:
            pipe.send(error.message)
        else:
            pipe.send("written")


def release_mission() -> Mission:
    """A mission with all that the files of a release state."""
    return Mission.parse(PROBE_YAML)
