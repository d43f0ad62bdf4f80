"""What observatory records tell of clocks that are wrong for a while, of steps, and of jumps between windows.

``python -m benchmarks.observatory_steps`` prints it for ``conrad`` and ``wik-cobenzl``. A block's residual
is fitted with a constant and dF/dt: the constant is the baseline, the rate's coefficient the clock. Both are
given to the estimators of daily parameters; in a record of four days an hour stands for a day.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.coil_temperature import ROOT, real_data
from inflight.arrays import Floats
from inflight.calibration import table_boundary_steps
from inflight.catalog import Catalog, Workspace
from inflight.design import bin_means
from inflight.effects import time_derivative
from inflight.errors import InflightError
from inflight.frames import direction_of
from inflight.lsq import grams_by_cluster, solve_clusters
from inflight.mission_fit import CoilBlock, find_clock_faults, measure_event_steps
from inflight.model import rows_of
from inflight.tasks import preflight_model
from inflight.tasks.archive import ArchiveIndex, ingest, load_samples, needs_of
from inflight.tasks.pipelines import ReprocessSettings, reprocess
from inflight.time import SECOND, Int64, mjd2000, to_tt2000

#: Readings faster than this are averaged, s.
_MEAN_S = 10.0
#: Parts of a block whose scatter gives its errors.
_PARTS = 8


@dataclass(frozen=True)
class Record:
    """A shipped mission's record: comparison, folder, hours of a block, events by name, days of a window."""

    name: str
    comparison: str
    folder: str
    hours: int
    events: dict[str, str]
    window_days: int


#: What is known to have happened to the instruments of Vienna-Cobenzl: the logger's clock read zero for a
#: minute, and the stamps of the LEMI jump by 21 s, which the mission corrects; and a storm.
_SEPTEMBER = {
    "the logger's reset": "2011-09-02T11:01:00",
    "the LEMI's stamps": "2011-09-16T17:09:30",
    "the storm": "2011-09-26T12:35:00",
}
SETS = (
    Record(
        "conrad",
        "main",
        "conrad-wic-storm-may2024",
        1,
        {
            "sudden commencement": "2024-05-10T17:05:00",
            "begin of the low hours": "2024-05-12T02:00:00",
            "end of the low hours": "2024-05-12T16:00:00",
        },
        1,
    ),
    Record("wik-cobenzl", "main", "wik-cobenzl-2011", 24, _SEPTEMBER, 5),
    Record("wik-cobenzl", "variometer", "wik-cobenzl-2011", 24, _SEPTEMBER, 5),
)


def blocks_of(days: list[CoilBlock], hours: int) -> tuple[Floats, Floats, Floats]:
    """Return middles (block,) in blocks of `hours`, values and sigmas (block, 2): baseline nT and clock s."""
    found = []
    for day in days:
        stamps, strength, residual = means(day)
        rate = time_derivative(strength, stamps)
        edges = stamps[0] + np.arange(0, 25, hours) * 3600 * SECOND
        for low, high in pairwise(np.searchsorted(stamps, edges)):
            use = np.flatnonzero(np.isfinite(residual[low:high]) & np.isfinite(rate[low:high])) + low
            if use.size < 20 * _PARTS:
                continue
            part = np.minimum(np.arange(use.size) * _PARTS // use.size, _PARTS - 1)
            columns = np.column_stack([np.ones(use.size), rate[use]])
            fit = solve_clusters(*grams_by_cluster(columns, residual[use], np.ones(use.size), part))
            middle = mjd2000(np.array([stamps[low] // 2 + stamps[high - 1] // 2]))[0] * 24 / hours
            # A reading that is early by s leaves s dF/dt: the sign of the effect `time_shift`.
            found.append((middle, *fit.value, *fit.sigma))
    table = np.array(found)
    return table[:, 0], table[:, 1:3], table[:, 3:5]


def means(day: CoilBlock) -> tuple[Int64, Floats, Floats]:
    """Return middles, strength and residual of means over ten seconds, nT; slower records as they are.

    The rate of readings a second apart is noise on a quiet day, which makes what is found too small.
    """
    strength = np.linalg.norm(day.field, axis=1)
    step = int(np.median(np.diff(day.stamps)))
    if step >= _MEAN_S * SECOND:
        return day.stamps, strength, day.residual
    width = round(_MEAN_S * SECOND)
    edges = np.arange(day.stamps[0], day.stamps[-1] + width, width, dtype=np.int64)
    both = np.stack([strength, day.residual], axis=1)
    good = np.asarray(np.isfinite(both).all(axis=1))
    averaged, _ = bin_means(both, day.stamps, edges, good)
    return edges[:-1] + width // 2, averaged[:, 0], averaged[:, 1]


def load(record: Record) -> list[CoilBlock]:
    """Return the days of a record, corrected as its mission's own model says."""
    with tempfile.TemporaryDirectory() as scratch:
        workspace = Workspace.create(Path(scratch) / "w", ROOT / "missions" / f"{record.name}.yaml")
        cat, mission = Catalog(workspace.root), workspace.mission()
        ingest(cat, mission, real_data() / record.folder)
        model = preflight_model(cat, mission, record.comparison)
        needs = needs_of(mission, model)
        index = ArchiveIndex.of(cat, needs)
        days = []
        for day in index.complete_days(needs):
            samples = load_samples(cat, mission, model, day, needs, index)
            rows = rows_of(model, samples)
            residual = np.where(rows.good, rows.residual[:, 0], np.nan)
            stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
            days.append(CoilBlock(stamps, rows.field, residual, {}))
        return days


def tell(record: Record) -> None:
    """Print what a record says of its clock and of steps."""
    days = load(record)
    at, value, sigma = blocks_of(days, record.hours)
    print(f"{record.name} {record.comparison}: {at.size} blocks of {record.hours} h")
    for index, (what, unit) in enumerate((("baseline", "nT"), ("clock", "s"))):
        own = value[:, index]
        spread = float(np.std(np.diff(own)) / np.sqrt(2.0))
        print(
            f"  {what}: median {np.median(own):.4f} {unit}, scatter {own.std():.4f}, of neighbours "
            f"{spread:.4f}, stated {np.median(sigma[:, index]):.4f}"
        )
    try:
        faults = find_clock_faults(at, value[:, 1], sigma[:, 1])
        for one in faults.faults:
            begin, end = (_hour(number * record.hours) for number in (one.first, one.last + 1))
            print(f"  clock off by {one.shift:+.3f} +- {one.sigma:.3f} s, {begin} to {end}, z {one.z:.1f}")
        if not faults.faults:
            print(f"  no clock fault beyond z {faults.limit:.1f}")
    except InflightError as error:
        print(f"  clock faults: {error.message}")
    _steps(record, at, value, sigma)


def _hour(number: int) -> np.datetime64:
    return np.datetime64("2000-01-01T00", "h") + number


def _steps(record: Record, at: Floats, value: Floats, sigma: Floats) -> None:
    """Print the steps at the stated moments, and the largest ones anywhere."""
    moments = np.array([np.datetime64(one, "ns") for one in record.events.values()])
    events = mjd2000(to_tt2000(moments)) * 24 / record.hours
    for index, (what, unit) in enumerate((("baseline", "nT"), ("clock", "s"))):
        try:
            steps = measure_event_steps(at, value[:, index], sigma[:, index], events, unit=unit)
        except InflightError as error:
            print(f"  steps of the {what}: {error.message}")
            continue
        for name, size, own, found in zip(record.events, steps.size, steps.sigma, steps.found, strict=True):
            if not np.isfinite(size):
                print(f"  {what} at '{name}': too near an end of the record")
                continue
            verdict = "a step" if found else "no step"
            print(f"  {what} at '{name}': {size:+.4f} +- {own:.4f} {unit}, {verdict}")


def jumps(record: Record) -> None:
    """Print how a table of windows jumps at its boundaries, in the field's own direction."""
    with tempfile.TemporaryDirectory() as scratch:
        workspace = Workspace.create(Path(scratch) / "w", ROOT / "missions" / f"{record.name}.yaml")
        cat, mission = Catalog(workspace.root), workspace.mission()
        ingest(cat, mission, real_data() / record.folder)
        settings = ReprocessSettings(comparison=record.comparison, window_days=record.window_days)
        try:
            report = reprocess(cat, mission, settings=settings)
        except InflightError as error:
            print(f"  windows: {error.message}")
            return
        residual = report.extra["residual"]
        table = cat.table_by_id(cat.tables(f"{record.comparison}-window")[-1].id)
        product = cat.open("l2/field" if record.comparison == "main" else f"l2/field-{record.comparison}")
        mean = np.nanmedian(product["field_sensor"].values, axis=0)
        strength = float(np.linalg.norm(mean))
        try:
            found = table_boundary_steps(table, strength, direction_of(mean[None]))
        except InflightError as error:
            print(f"  windows: {error.message}")
            return
        steps = ", ".join(f"{a:+.3f} +- {b:.3f}" for a, b in zip(found.mean, found.sigma, strict=True))
        print(
            f"  windows of {record.window_days} d: residual {residual['before_nT']:.3f} -> "
            f"{residual['after_nT']:.4f} nT; jumps {steps} nT"
        )


def main() -> None:
    """Print what each record tells."""
    for record in SETS:
        tell(record)
        jumps(record)


if __name__ == "__main__":
    main()
