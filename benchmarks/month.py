"""A month through the front door and every verb of the command line, against floors of the same run."""

from __future__ import annotations

import hashlib
import tempfile
from dataclasses import replace
from pathlib import Path

import cdflib
import numpy as np
import zarr

from benchmarks.measured import Row, command, timed
from benchmarks.nine import naive_day
from inflight.catalog import Catalog, Workspace
from inflight.simulate import SimulationSettings
from inflight.tasks.analysis import DiagnoseSettings
from inflight.tasks.analysis import diagnosis as diagnosis_steps
from inflight.tasks.archive import simulate
from inflight.threads import one_thread


def month(days: int = 30, repeats: int = 3) -> list[Row]:
    """Return the rows of a month at 1 Hz, 25 channels in 6 CDF files a day, with an effect hidden in it."""
    with tempfile.TemporaryDirectory() as scratch:
        workspace = Workspace.create(Path(scratch) / "w", "champ")
        empty = Workspace.create(Path(scratch) / "empty", "champ").root
        root = workspace.root
        simulate(SimulationSettings(start="2005-01-01", days=days, hide=["day_night"]), workspace.data)
        rows = [
            command("inflight --help", ["--help"], root, repeats, fails=False),
            command("a wrong folder", ["-w", "nowhere", "compare"], root, repeats, fails=True),
            command("an empty archive: diagnose", ["diagnose"], empty, repeats, fails=True),
            command(f"ingest, {days} days", ["ingest"], root),
            command("ingest, nothing new", ["ingest"], root, repeats),
            command(f"reprocess, {days} days", ["reprocess"], root),
            command("reprocess, nothing to do", ["reprocess"], root, repeats),
            command("catalog list", ["catalog", "list"], root, repeats),
            command("compare", ["compare"], root, repeats),
            command("diagnose, first time", ["diagnose"], root),
            command("diagnose again", ["diagnose"], root, repeats),
        ]
        with one_thread():
            more = _floors(Catalog(root), workspace, Path(scratch))
    aims = [
        "0.3 s",
        "1 s",
        "1 s",
        "2 floors + 2 s",
        "3 s",
        "2 floors + 2 s",
        "1.5 s",
        "1 s",
        "5 s",
        "",
        "3 s",
    ]
    return [replace(row, aim=aim, **found) for row, aim, found in zip(rows, aims, more, strict=True)]


def _floors(cat: Catalog, workspace: Workspace, scratch: Path) -> list[dict[str, object]]:
    """Return floor and naive way of each row of `month`, in its order."""
    files = sorted(path for path in workspace.data.rglob("*.cdf"))
    mission = workspace.mission()
    archive = [day for name in mission.instruments for day in cat.days(f"l1/{name}", states=("published",))]
    products = cat.days("l2/field", states=("published",))
    blocks = cat.days("equations/main/library", states=("published",))
    read_archive = timed(lambda: [cat.read(day, with_time=False) for day in archive])[0]
    read_products = timed(lambda: [cat.read(day, with_time=False) for day in products])[0]
    read_blocks = timed(lambda: [cat.read(day, with_time=False) for day in blocks])[0]
    write_products = timed(
        lambda: [_write(scratch / "l2" / str(day.day), cat.read(day, with_time=False)) for day in products]
    )[0]
    deliver = timed(lambda: [_copy_cdf(path, scratch / "cdf" / path.stem) for path in files])[0]
    hashed = timed(lambda: [hashlib.sha256(path.read_bytes()).digest() for path in files])[0]
    plan = diagnosis_steps.plan_pass(cat, mission, DiagnoseSettings()).plan
    width = len(plan.library.columns) + 1
    matrix = np.random.default_rng(0).normal(size=(86_400 * 10**9 // plan.cadence_ns, width))
    blas = 2 * len(products) * min(timed(lambda: matrix.T @ matrix, 5))
    fit = naive_day(cat, products[0].day)
    refit = _refit(width) * len(products) * sum(not one.placebo for one in plan.library.candidates)
    return [
        {},
        {},
        {},
        {"floor_s": deliver, "floor": "ingest: cdflib reads the files, zarr writes the same arrays"},
        {"floor_s": hashed, "floor": "ingest, nothing new: sha256 of the files"},
        {
            "floor_s": read_archive + write_products - read_products,
            "floor": "reprocess: the archive decoded, the products' arrays written by zarr",
            "naive_s": fit * len(products),
            "naive": "reprocess: scipy's least_squares with a numerical Jacobian, a day at a time",
        },
        {},
        {},
        {"floor_s": read_products, "floor": "compare: the products decoded"},
        {
            "floor_s": read_archive + blas,
            "floor": "diagnose, first time: the archive decoded, X'X of all columns in two forms",
            "naive_s": refit,
            "naive": "diagnose: the model fitted anew to every sample with each candidate (lstsq), once",
        },
        {
            "floor_s": read_blocks,
            "floor": "diagnose again: the statistics decoded",
            "naive_s": refit,
        },
    ]


def _copy_cdf(path: Path, target: Path) -> None:
    source = cdflib.CDF(path)
    names = source.cdf_info().zVariables
    group = zarr.open_group(target, mode="w")
    for name in names:
        values = np.asarray(source.varget(name))
        if values.dtype.kind in "iuf":
            group.create_array(name, data=values)


def _write(target: Path, dataset: object) -> None:
    group = zarr.open_group(target, mode="w")
    for name, variable in dataset.data_vars.items():  # type: ignore[attr-defined]
        group.create_array(str(name), data=np.asarray(variable.values))


def _refit(width: int) -> float:
    """Return the seconds of fitting nine parameters and three more to a day's samples."""
    del width
    generator = np.random.default_rng(0)
    columns, residual = generator.normal(size=(86_400, 12)), generator.normal(size=86_400)
    return min(timed(lambda: np.linalg.lstsq(columns, residual, rcond=None), 3))
