"""Pipeline: two calibrated sensors.

How a boom bends between two spinning magnetometers, from their products (Farrell et al. 1995, VI).

Two vector sensors against each other over a mission: tables of how they stand, and no product.

What is compared are the fields that both sensors' own comparisons with a scalar sensor made: a comparison of
kind ``dual`` calibrates nothing, so that no field comes of it. Each day leaves a few Gram matrices, and the
tables are algebra of these.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog, Day, Run, idempotency_key
from inflight.errors import CatalogError, InflightError, MissionError
from inflight.flags import UNUSABLE, Flag
from inflight.mission import Mission
from inflight.mission_fit import CLUSTER_S, corner_moments, corners_of, relation_grams, relation_of
from inflight.spin import fit_spins, measure_boom_bending
from inflight.tasks.archive import ArchiveIndex
from inflight.tasks.models import current_model
from inflight.tasks.pipelines.job import Job, Outcome, make_days
from inflight.tasks.pipelines.planning import ReprocessSettings, equations_of, product_of
from inflight.tasks.pipelines.publication import take_outcome
from inflight.tasks.report import RunReport
from inflight.time import DAY, SECOND, DayLike, Int64, day_bounds, is_within

#: What is read of a product.
READ = ["field_sensor", "spin_phase", "flag"]

#: The table, by name without the comparison.
BENDING_TABLES = ("bending",)

#: What is said where a product would be.
NO_PRODUCT_OF_BOOM = (
    "two sensors on a boom calibrate nothing between them: a table of the bend is made, products come from "
    "each one's own spin comparison"
)


def bending_day(products: Sequence[xr.Dataset], day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return by how much the outboard sensor is turned about the spin axis from the inboard one.

    Both are fitted turn by turn against the phase of the inboard one's product, at the samples they share.

    Parameters
    ----------
    products : sequence of Dataset
        Of the inboard sensor and of the outboard one.

    Returns
    -------
    xarray.Dataset
        `bend`, `sigma` (block) rad, positive from x to y; `fits` (block); `start`, `end` TT2000.

    Raises
    ------
    CalibrationError
        When fewer than ten turns have both.
    """
    bad = np.uint32(UNUSABLE | Flag.NO_PHASE | Flag.PHASE_JUMP)
    used = [one.isel(time=(one["flag"].values & bad) == 0) for one in products]
    inboard, outboard = xr.align(*used, join="inner")
    stamps = np.asarray(inboard["tt2000"].values, dtype=np.int64)
    phase = unwrapped(np.asarray(inboard["spin_phase"].values, dtype=np.float64), stamps)
    inner, outer = (
        fit_spins(stamps, np.asarray(one["field_sensor"].values, dtype=np.float64), phase)
        for one in (inboard, outboard)
    )
    found = measure_boom_bending(outer, inner)
    start, end = day_bounds(day)
    dataset = xr.Dataset(
        {
            "bend": ("block", found.value, {"units": "rad"}),
            "sigma": ("block", found.sigma, {"units": "rad"}),
            "fits": ("block", found.fits),
            "start": ("block", np.array([start], dtype=np.int64), {"scale": "TT2000"}),
            "end": ("block", np.array([end], dtype=np.int64), {"scale": "TT2000"}),
        }
    )
    return dataset, {"samples": int(stamps.size), "bend_rad": float(found.value[0])}


def unwrapped(phase: Floats, stamps: Int64) -> Floats:
    """Return a phase between 0 and two pi as one that runs on, counted across gaps at its usual rate; rad."""
    if phase.size < 2:
        return phase
    seconds = np.diff(stamps) / 1e9
    turned = np.diff(np.unwrap(phase))
    expected = float(np.median(turned / seconds)) * seconds
    step = expected + np.mod(turned - expected + np.pi, 2.0 * np.pi) - np.pi
    return np.asarray(phase[0] + np.concatenate([[0.0], np.cumsum(step)]))


def bending_makers(read: Sequence[xr.Dataset]) -> dict[str, Callable[[], xr.Dataset]]:
    """Return what makes the tables of days, by their names without the comparison."""
    return {"bending": lambda: bending_table(read)}


def bending_table(read: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return the bend over days; dims interval, parameter (one): `value`, `sigma` rad, `fits`, and the span.

    The azimuths as mounted are those of the two pre-flight models: the bend is what is beyond them.
    """
    each = ("interval", "parameter")
    both = {name: np.concatenate([day[name].values for day in read]) for name in ("bend", "sigma", "fits")}
    return xr.Dataset(
        {
            "value": (each, both["bend"][:, None]),
            "sigma": (each, both["sigma"][:, None]),
            "fits": ("interval", both["fits"]),
            "units": ("parameter", np.array(["rad"], dtype="U8")),
            "start": ("interval", np.concatenate([day["start"].values for day in read])),
            "end": ("interval", np.concatenate([day["end"].values for day in read])),
        },
        coords={"parameter": ["bend"]},
    )


#: Clusters of a day at most: two orbits each, and one cut at either end.
MOST_CLUSTERS = int(DAY / SECOND / CLUSTER_S) + 2

#: Bumped by hand when the numbers of the days or tables change.
DUAL_VERSION = 1

#: What is said where a product would be.
NO_PRODUCT = (
    "two vector sensors against each other calibrate nothing: tables of how they stand to each other are "
    "made, products come from each one's comparison with a scalar sensor"
)

#: What is read of a product.
_READ = ["field_spacecraft", "residual", "flag"]

#: The tables, by name without the comparison.
TABLES = ("relation", "relation-daily", "corners")


@dataclass(frozen=True)
class Pair:
    """The comparisons that calibrate both sensors, the inboard one's first: scalar ones, or of the spin."""

    first: str
    second: str
    kind: str = "scalar"

    @classmethod
    def of(cls, mission: Mission, comparison: str) -> Pair:
        """Return those of a mission's dual comparison.

        Raises
        ------
        MissionError
            When one of the sensors is calibrated by no scalar comparison, nor both by their spin.
        """
        own = mission.comparisons[comparison].instruments()
        names: dict[tuple[str, str], str] = {}
        for name, entry in mission.comparisons.items():
            if entry.kind in ("scalar", "spin"):
                names.setdefault((entry.kind, entry.instruments()["vector"]), name)
        roles = ("inboard", "outboard")
        for kind in ("scalar", "spin"):
            if all((kind, own[role]) in names for role in roles):
                return cls(names[kind, own["inboard"]], names[kind, own["outboard"]], kind)
        role = next(role for role in roles if ("scalar", own[role]) not in names)
        raise MissionError(
            f"no scalar comparison calibrates '{own[role]}', the {role} sensor of '{comparison}'",
            remedy="state one in the mission's file, or see 'inflight diagnose' for the difference",
        )

    @property
    def tables(self) -> tuple[str, ...]:
        """Names of the tables, without the comparison."""
        return TABLES if self.kind == "scalar" else BENDING_TABLES

    @property
    def note(self) -> str:
        """What is said where a product would be."""
        return NO_PRODUCT if self.kind == "scalar" else NO_PRODUCT_OF_BOOM


def reprocess_dual(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None,
    end: DayLike | None,
    settings: ReprocessSettings,
    mapper: Callable[..., Any],
) -> RunReport:
    """Make the tables of a dual comparison; parameters and result as `reprocess`.

    Raises
    ------
    MissionError
        When one of the sensors has no scalar comparison.
    CatalogError
        When no day has the products of both.
    """
    pair, dataset = Pair.of(mission, settings.comparison), equations_of(settings.comparison)
    used = current_model(cat, mission, settings.comparison)
    context = cat.save_context(mission.text, used.model.name, used.version, {})
    sources = [_published(cat, name, start, end) for name in (pair.first, pair.second)]
    days = sorted(set(sources[0]) & set(sources[1]))
    if not days:
        raise CatalogError(
            f"no day has products of both '{pair.first}' and '{pair.second}'",
            remedy=f"run 'inflight reprocess' and 'inflight reprocess --comparison {pair.second}' first",
        )
    keys = {
        day: idempotency_key(dataset, day, DUAL_VERSION, context, [one[day].key for one in sources])
        for day in days
    }
    known = {day.day: day for day in cat.days(dataset, states=("published",)) if keys.get(day.day) == day.key}
    todo = [day for day in days if day not in known]
    failed: dict[np.datetime64, dict[str, str]] = {}
    with cat.run("reprocess", settings.model_dump(), context=context) as run:
        fresh: dict[np.datetime64, Day] = {}
        batches = [todo[at : at + settings.batch_days] for at in range(0, len(todo), settings.batch_days)]
        arguments = [(cat, sources, _job(run, dataset, batch, keys, sources), pair.kind) for batch in batches]
        for outcome in mapper("calibrate", dual_batch, arguments):
            fresh |= {day.day: day for day in take_outcome(run, dataset, outcome, failed)}
        made = known | fresh
        ordered = [made[day] for day in sorted(made)]
        left_out = _keep_tables(cat, run, settings.comparison, ordered, pair.kind)
        run.publish(certify=left_out.pop("certify"), supersede=True)
    counts = {
        "planned": len(days),
        "done": len(fresh),
        "unchanged": len(known),
        "failed": len(failed),
    }
    outputs = [f"tables/{settings.comparison}-{name}" for name in pair.tables if name not in left_out]
    extra = {"note": pair.note, "left_out": left_out, "residual": {}}
    return RunReport(
        "reprocess", run.id, context, counts, [failed[day] for day in sorted(failed)], outputs, extra
    )


def _published(
    cat: Catalog, comparison: str, start: DayLike | None, end: DayLike | None
) -> dict[np.datetime64, Day]:
    found = {day.day: day for day in cat.days(product_of(comparison), states=("published",))}
    return {day: one for day, one in found.items() if is_within(day, start, end)}


def _job(
    run: Run,
    dataset: str,
    batch: Sequence[np.datetime64],
    keys: Mapping[np.datetime64, str],
    sources: Sequence[Mapping[np.datetime64, Day]],
) -> Job:
    parents = {day: tuple(one[day].id for one in sources) for day in batch}
    return Job(
        tuple(batch), {day: keys[day] for day in batch}, parents, ArchiveIndex({}), (), run.id, dataset
    )


def dual_batch(
    cat: Catalog, sources: Sequence[Mapping[np.datetime64, Day]], job: Job, kind: str = "scalar"
) -> Outcome:
    """Make what each day of a batch says, and write it as one segment.

    Parameters
    ----------
    sources : sequence of mapping
        Products of the first sensor and of the second, by day.
    kind : str
        Of the comparisons that made them.
    """
    make, read = (dual_day, _READ) if kind == "scalar" else (bending_day, READ)
    return make_days(cat, job, lambda day: make([cat.read(one[day], read) for one in sources], day))


def dual_day(products: Sequence[xr.Dataset], day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return what a day's two products say of each other, and a report.

    Returns
    -------
    xarray.Dataset
        `gram` (block, cluster, column, other) and `rows` (block, cluster) of `relation_grams`, `moments`
        (block, cluster, moment) of `corner_moments`, empty clusters last; `closure` (block) nT.

    Raises
    ------
    CalibrationError
        When a day has too few samples of both.
    """
    used = [one.isel(time=(one["flag"].values & np.uint32(UNUSABLE)) == 0) for one in products]
    first, second = xr.align(*used, join="inner")
    fields = [np.asarray(one["field_spacecraft"].values, dtype=np.float64) for one in (first, second)]
    main, other = (np.asarray(one["residual"].values, dtype=np.float64) for one in (first, second))
    stamps = np.asarray(first["tt2000"].values, dtype=np.int64)
    gram, rows = relation_grams(fields[0], fields[1], stamps)
    along = np.linalg.norm(fields[0], axis=1) - np.linalg.norm(fields[1], axis=1)
    closure = float(np.sqrt(np.nanmean((main - other - along) ** 2)))
    moments = corner_moments(main, other, stamps)
    begin, end = day_bounds(day)
    found = xr.Dataset(
        {
            "gram": (("block", "cluster", "column", "other"), _filled(gram)[None], {"units": "nT2"}),
            "rows": (("block", "cluster"), _filled(rows)[None]),
            "moments": (("block", "cluster", "moment"), _filled(moments)[None]),
            "closure": ("block", np.array([closure]), {"units": "nT"}),
            "start": ("block", np.array([begin], dtype=np.int64), {"scale": "TT2000"}),
            "end": ("block", np.array([end], dtype=np.int64), {"scale": "TT2000"}),
        }
    )
    return found, {"samples": int(stamps.size), "rms_nT": relation_of(gram, rows).rms}


def _filled(values: Floats) -> Floats:
    """Return clusters (cluster, ...) with empty ones behind them: a store's days are of one size."""
    return np.concatenate([values, np.zeros((MOST_CLUSTERS - len(values), *values.shape[1:]))])


def _keep_tables(cat: Catalog, run: Run, comparison: str, days: Sequence[Day], kind: str) -> dict[str, Any]:
    """Stage the tables of all days; return why some are not there, and under ``certify`` what to certify."""
    read = [cat.read(day) for day in days]
    makers = _relation_makers(read) if kind == "scalar" else bending_makers(read)
    out: dict[str, Any] = {"certify": []}
    for name, make in makers.items():
        key = hashlib.sha256("".join([name, *(day.key for day in days)]).encode()).hexdigest()
        called = f"{comparison}-{name}"
        if any(one.key == key and one.certified and not one.damaged for one in cat.tables(called)):
            continue
        try:
            table = make()
        except InflightError as error:
            out[name] = error.message
            continue
        span = day_bounds(days[0].day)[0], day_bounds(days[-1].day)[1]
        staged = run.stage_table(called, table, start=span[0], end=span[1], parents=days, key=key)
        out["certify"].append((staged, *span, None))
    return out


def _relation_makers(read: Sequence[xr.Dataset]) -> dict[str, Callable[[], xr.Dataset]]:
    return {
        "relation": lambda: relation_of(*_grams(read)).table(),
        "relation-daily": lambda: daily_relations(read),
        "corners": lambda: _corners(read),
    }


def _grams(read: Sequence[xr.Dataset]) -> tuple[Floats, Floats]:
    gram, rows = (np.concatenate([day[name].values[0] for day in read]) for name in ("gram", "rows"))
    return gram[rows > 0], rows[rows > 0]


def daily_relations(read: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return the relation of each day by itself; dims interval, parameter: `value`, `sigma`, `units`."""
    tables = [relation_of(*_grams([day])).table() for day in read]
    each = ("interval", "parameter")
    return xr.Dataset(
        {
            "value": (each, np.stack([one["value"].values for one in tables])),
            "sigma": (each, np.stack([one["sigma"].values for one in tables])),
            "rms": ("interval", np.array([one.attrs["rms_nT"] for one in tables]), {"units": "nT"}),
            "units": tables[0]["units"],
            "start": ("interval", np.concatenate([day["start"].values for day in read])),
            "end": ("interval", np.concatenate([day["end"].values for day in read])),
        },
        coords={"parameter": tables[0]["parameter"].values},
    )


def _corners(read: Sequence[xr.Dataset]) -> xr.Dataset:
    closure = float(np.sqrt(np.mean(np.concatenate([day["closure"].values for day in read]) ** 2)))
    moments = np.concatenate([day["moments"].values[0] for day in read])
    return corners_of(moments[moments[:, 0] > 0], closure=closure).table()
