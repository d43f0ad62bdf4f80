"""What the verbs are held against: the floor of the machine, and the naive way.

All are measured on some days of the workspace that a verb worked on, on one core, and scaled by days. A floor
reads, decodes, multiplies or writes the same arrays and does nothing else. The naive way is what one writes
first: `xarray.open_zarr`, every channel interpolated onto the times of the vector, scipy's `least_squares`
with a numerical Jacobian, ``to_zarr``; the model fitted anew to every sample with each candidate by `lstsq`.
It corrects nothing but the nine parameters, and so does less than the verb.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cdflib
import numcodecs
import numpy as np
import xarray as xr
import zarr
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.measured import timed
from inflight.arrays import Floats
from inflight.calibration import reference_of
from inflight.catalog import Catalog, Day, Workspace
from inflight.design import Library, Term, design_matrix
from inflight.mission import Mission
from inflight.tasks.analysis import DiagnoseSettings
from inflight.tasks.analysis.diagnosis import PlannedPass, plan_pass
from inflight.tasks.analysis.gram_pass import PassPlan, day_rows
from inflight.tasks.archive import ChannelReader, DerivedChannels, evenly_spread
from inflight.threads import one_thread
from inflight.time import DAY, day_bounds

#: Days that are measured, and candidates that are fitted, of all; chosen so that a minute is enough.
DAYS, CANDIDATES = 3, 4


@dataclass(frozen=True, kw_only=True)
class Rivals:
    """Seconds of a record of some days; see the module.

    Attributes
    ----------
    decode, products, write : float
        Floor: level 1 decoded, level 2 decoded, level 2 compressed and written as it is stored.
    blas : float
        Floor: X'X of all columns in two forms.
    solve : float
        Floor: each day's nine parameters and the model's columns solved from matrices that are there.
    align, reprocess, compare : float
        Naive: channels on the vector's times; that, a fit a day, and a product; products less the scalar.
    refit : float
        Naive: the model and one candidate fitted to every sample.
    candidates : int
        That a diagnosis tries.
    """

    decode: float
    products: float
    write: float
    blas: float
    solve: float
    align: float
    reprocess: float
    compare: float
    refit: float
    candidates: int

    def of_reprocess(self) -> dict[str, Any]:
        """Return what a row of `reprocess` is held against."""
        return {
            "floor_s": self.decode + self.write,
            "floor": "reprocess: level 1 decoded, level 2 compressed and written; some days, one core",
            "naive_s": self.reprocess,
            "naive": "reprocess: xarray opens, interpolates and writes, scipy fits each day; some days",
        }

    def of_diagnose(self) -> dict[str, Any]:
        """Return what a row of a first `diagnose` is held against."""
        return {
            "floor_s": self.decode + self.blas,
            "floor": "diagnose: level 1 decoded, X'X of all columns in two forms; some days, one core",
            "naive_s": self.align + self.candidates * self.refit,
            "naive": "diagnose: xarray opens and interpolates, each candidate fitted anew with the model "
            f"(lstsq, every sample, a day at a time); {CANDIDATES} candidates of some days, once",
        }

    def of_compare(self) -> dict[str, Any]:
        """Return what a row of `compare` is held against."""
        return {
            "floor_s": self.products,
            "floor": "compare: the products decoded; some days, one core",
            "naive_s": self.compare,
            "naive": "compare: xarray opens product and scalar, interpolates and subtracts; some days",
        }

    def of_change(self) -> dict[str, Any]:
        """Return what a change of the model is held against whose statistics are in memory."""
        return {
            "floor_s": self.solve,
            "floor": "change of the model: nine parameters of each day and the model's columns solved",
            "naive_s": self.align + self.refit,
            "naive": "change of the model: xarray opens and interpolates, the model fitted anew to every "
            "sample (lstsq); some days",
        }

    def of_update(self, floor_of_file: float, naive_of_file: float, days: int) -> dict[str, Any]:
        """Return what `update` by a day's files is held against."""
        return {
            "floor_s": floor_of_file + (self.decode + self.blas + self.write) / days,
            "floor": "update: floors of ingest, reprocess and diagnose of one day",
            "naive_s": naive_of_file + self.reprocess / days + self.candidates * self.refit,
            "naive": "update: the day taken in, fitted and written by xarray and scipy, each candidate "
            "fitted anew to all days",
        }


def measure_rivals(cat: Catalog, some: int = DAYS) -> Rivals:
    """Return floors and naive ways of a workspace whose days were reprocessed."""
    mission = Workspace.open(cat.workspace).mission()
    made = plan_pass(cat, mission, DiagnoseSettings())
    dates = evenly_spread([day.day for day in cat.days("l2/field", states=("published",))], some)
    named = {
        name: [day for day in cat.days(name, states=("published",)) if day.day in dates]
        for name in (*(f"l1/{one}" for one in mission.instruments), "l2/field")
    }
    products = named["l2/field"]
    level1 = [day for name, days in named.items() if name != "l2/field" for day in days]
    scale = len(made.plan.days) / len(dates)
    with one_thread(), tempfile.TemporaryDirectory() as scratch:
        naive = [_naive_day(cat, mission, made.plan, named, at, Path(scratch)) for at in range(len(dates))]
        refit = [_refit_day(cat, mission, made, day) for day in dates]
        found = Rivals(
            decode=decoded(cat, level1),
            products=decoded(cat, products),
            write=sum(_written(cat, day, Path(scratch)) for day in products),
            blas=_blas(made.plan, len(dates)),
            solve=_solve(made.plan, len(dates)),
            align=sum(one["align"] for one in naive),
            reprocess=sum(one["reprocess"] for one in naive),
            compare=sum(one["compare"] for one in naive),
            refit=sum(refit),
            candidates=sum(not one.placebo for one in made.plan.library.candidates),
        )
    values = {name: scale * value for name, value in vars(found).items() if name != "candidates"}
    return replace(found, **values)


def start_up() -> dict[str, Any]:
    """Return what a verb that has little to do is held against."""
    return start_up_floor() | {
        "naive_s": _python("import numpy, scipy.optimize, xarray, zarr, dask.distributed, prefect"),
        "naive": "little to do: a script starts that imports xarray, zarr, scipy, dask and prefect",
    }


def start_up_floor() -> dict[str, Any]:
    """Return the floor of a verb that has little to do."""
    return {"floor_s": _python("pass"), "floor": "little to do: the interpreter starts"}


def _python(code: str) -> float:
    return float(np.median(timed(lambda: subprocess.run([sys.executable, "-c", code], check=True), 3)))


def decoded(cat: Catalog, days: Sequence[Day]) -> float:
    """Return the seconds of reading and decoding some days."""
    return min(timed(lambda: [cat.read(day, with_time=False) for day in days], 3))


def _written(cat: Catalog, day: Day, scratch: Path) -> float:
    """Return the seconds of compressing and writing a day's arrays as they are stored, without zarr."""
    group = zarr.open_group(cat.workspace / str(day.segment), mode="r")
    files = []
    for name in cat.variables_of(day):
        array = group[name]
        assert isinstance(array, zarr.Array)
        if array.shape[0] <= day.rows[1] - day.rows[0]:
            continue
        delta = numcodecs.Delta(dtype=array.dtype) if array.filters else None
        (stored,) = array.compressors
        blosc = numcodecs.Blosc(stored.cname.value, stored.clevel)
        values = np.asarray(array[slice(*day.rows)]).reshape(day.rows[1] - day.rows[0], -1)
        columns = [np.ascontiguousarray(column) for column in values.T]
        together = [columns] if array.shards else [[column] for column in columns]
        files += [(delta, blosc, chunks) for chunks in together]

    def write() -> None:
        for at, (delta, blosc, chunks) in enumerate(files):
            plain = (delta.encode(one) if delta is not None else one for one in chunks)
            (scratch / f"file-{at}").write_bytes(b"".join(blosc.encode(one) for one in plain))

    return min(timed(write, 3))


def _blas(plan: PassPlan, days: int) -> float:
    rows, width = DAY // plan.cadence_ns, len(plan.library.columns) + 1
    matrix = np.random.default_rng(0).normal(size=(rows, width)).astype(np.float32)
    return 2 * days * min(timed(lambda: matrix.T @ matrix, 3))


def _solve(plan: PassPlan, days: int) -> float:
    base, rest = 9, 4 + sum(len(term.columns) for term in plan.library.refined)
    rows = np.random.default_rng(0).normal(size=(days, 100, base + rest))
    gram = rows.swapaxes(1, 2) @ rows
    own, cross, inner = gram[:, :base, :base], gram[:, :base, base:], gram[:, base:, base:]

    def solve() -> Floats:
        left = (inner - cross.swapaxes(1, 2) @ np.linalg.solve(own, cross)).sum(axis=0)
        return np.linalg.solve(left[:-1, :-1], left[:-1, -1])

    return min(timed(solve, 3))


# The naive way.


def naive_fit(reading: Floats, additive: Floats, scalar: Floats, start: Floats) -> Floats:
    """Fit with scipy's default least squares, numerical Jacobian and no scaling but the units'."""

    def residual(p: Floats) -> Floats:
        return np.linalg.norm((reading - p[6:]) @ _matrix(p).T - additive, axis=1) - scalar

    return np.asarray(least_squares(residual, start, x_scale=[1e-5] * 3 + [1e-3] * 3 + [1.0] * 3).x)


def _matrix(p: Floats) -> Floats:
    cos = np.cos(np.deg2rad(p[3:6]))
    return np.array([[p[0], cos[0], cos[1]], [0.0, p[1], cos[2]], [0.0, 0.0, p[2]]])


def naive_ingest(path: Path, target: Path) -> None:
    """Turn a file into a store: cdflib reads it, xarray writes it."""
    source = cdflib.CDF(path)
    held = {name: np.asarray(source.varget(name)) for name in source.cdf_info().zVariables}
    arrays = {name: values for name, values in held.items() if values.dtype.kind in "iuf" and values.ndim}
    dims = {name: ("record", *(f"{name}_{at}" for at in range(1, one.ndim))) for name, one in arrays.items()}
    rows = max(len(values) for values in arrays.values())
    dataset = xr.Dataset(
        {name: (dims[name], values) for name, values in arrays.items() if len(values) == rows}
    )
    dataset.to_zarr(target, mode="w", consolidated=False)


def copy_file(path: Path, target: Path) -> None:
    """Do the same with the libraries alone: cdflib reads, zarr writes the same arrays."""
    source = cdflib.CDF(path)
    group = zarr.open_group(target, mode="w")
    for name in source.cdf_info().zVariables:
        values = np.asarray(source.varget(name))
        if values.dtype.kind in "iuf":
            group.create_array(name, data=values)


def _opened(root: Path, day: Day) -> xr.Dataset:
    """Open a day as xarray reads a store, with its times."""
    found = xr.open_zarr(root / str(day.segment)).isel(time=slice(*day.rows)).load()
    return found.assign_coords(time=found["tt2000"].values.astype("datetime64[ns]")).drop_vars(["tt2000"])


def _naive_day(
    cat: Catalog, mission: Mission, plan: PassPlan, named: dict[str, list[Day]], at: int, scratch: Path
) -> dict[str, float]:
    """Return the seconds of aligning, of reprocessing and of comparing one day."""
    root, product = cat.workspace, named["l2/field"][at]
    day = product.day
    roles = mission.comparisons[plan.model.comparison].instruments()
    records = {
        name.removeprefix("l1/"): one
        for name, days in named.items()
        if name != "l2/field"
        for one in days
        if one.day == day
    }
    start = reference_of(plan.model, sum(day_bounds(day)) // 2).value
    held: dict[str, xr.Dataset] = {}

    def align() -> None:
        base = _opened(root, records[roles["vector"]])
        held["vector"] = base
        for name, record in records.items():
            if name != roles["vector"]:
                held[name] = _opened(root, record).interp(time=base["time"])

    def calibrate() -> None:
        reading, scalar = held["vector"]["field"].values, held[roles["scalar"]]["field"].values
        good = np.isfinite(reading).all(axis=1) & np.isfinite(scalar)
        p = naive_fit(reading[good], np.zeros((1, 3)), scalar[good], start)
        field = (reading - p[6:]) @ _matrix(p).T
        out = xr.Dataset(coords={"time": held["vector"]["time"]})
        out["field"] = (("time", "axis"), field)
        out["residual"] = ("time", np.linalg.norm(field, axis=1) - scalar)
        attitude = next((one["attitude"] for one in held.values() if "attitude" in one), None)
        if attitude is not None:
            turned = np.nan_to_num(attitude.values) + np.array([0.0, 0.0, 0.0, 1e-12])
            out["field_earth"] = (("time", "axis"), Rotation.from_quat(turned).apply(np.nan_to_num(field)))
        for name, one in held.items():
            for channel, values in one.data_vars.items():
                dims = ("time", *(f"{name}_{dim}" for dim in values.dims[1:]))
                out[f"{name}_{channel}"] = (dims, values.values)
        out.to_zarr(scratch / "product", mode="w", consolidated=False)

    def compare() -> None:
        made, scalar = _opened(root, product), _opened(root, records[roles["scalar"]])
        strength = np.sqrt((made["field_spacecraft"] ** 2).sum("axis"))
        float((strength - scalar["field"].interp(time=made["time"])).std())

    aligned = timed(align)[0]
    return {"align": aligned, "reprocess": aligned + timed(calibrate)[0], "compare": timed(compare)[0]}


def _refit_day(cat: Catalog, mission: Mission, made: PlannedPass, day: np.datetime64) -> float:
    """Return the seconds of fitting the model with one candidate more to a day's samples, of real columns."""
    own = made.plan.library
    real = [one for one in own.candidates if not one.placebo and one.terms[0] in own.terms]
    candidates = real[:: max(1, len(real) // CANDIDATES)][:CANDIDATES]
    model = [*own.base, *own.refined]
    more = {key: own.terms[key] for one in candidates for key in one.terms[:1]}
    columns, residual = native_columns(cat, mission, made, Library(own.base, own.refined, more), day)
    width = sum(len(term.columns) for term in model)
    spent, at = [], width
    for term in more.values():
        both = np.column_stack([columns[:, :width], columns[:, at : at + len(term.columns)]])
        at += len(term.columns)
        spent.append(lstsq_s(both, residual))
    return float(np.median(spent))


def lstsq_s(columns: Floats, residual: Floats, repeats: int = 1) -> float:
    """Return the seconds of fitting columns to a residual."""
    return min(timed(lambda: np.linalg.lstsq(columns, residual, rcond=None), repeats))


def native_columns(
    cat: Catalog, mission: Mission, made: PlannedPass, library: Library, day: np.datetime64
) -> tuple[Floats, Floats]:
    """Return the columns of a library and the residual at every good sample of a day; (sample, column)."""
    native = max(need.cadence_ns for need in made.plan.needs if need.channel == "field")
    plan = replace(made.plan, cadence_ns=native, library=library, estimates=True)
    rows, _ = day_rows(cat, mission, plan, made.index, derived_of(cat, mission, made, plan), day)
    terms: Sequence[Term] = library.all_terms
    columns = design_matrix(terms, rows)[rows.weight > 0]
    return columns.reshape(-1, columns.shape[2]), rows.residual[rows.weight > 0].ravel()


def derived_of(
    cat: Catalog, mission: Mission, made: PlannedPass, plan: PassPlan, *, by_levels: bool = False
) -> DerivedChannels:
    """Return what makes the channels of a plan's columns."""
    reader = ChannelReader(
        cat, mission, plan.channel_needs, made.index, plan.cadence_ns, plan.span, by_levels=by_levels
    )
    return DerivedChannels(reader, plan.days, plan.channel_summaries, plan.library.placebos, plan.origin.days)


def files_of(folder: Path, work: Callable[[Path, Path], None], scratch: Path, some: int = 0) -> float:
    """Return the seconds of some work on the CDF files of a folder, or on those of the last days of them."""
    files = sorted(folder.rglob("*.cdf"), key=lambda path: (path.stem.split("_")[-2], path.name))
    files = [path for path in files if "truth" not in path.parts][-some:]
    return timed(lambda: [work(path, scratch / path.stem) for path in files])[0]
