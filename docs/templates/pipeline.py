"""A pipeline to copy: one gain of a vector sensor, from the field strength that a scalar instrument measures.

Copy this file into a folder of its own under ``tasks/pipelines``, change what is yours, and put an instance
into `PIPELINES` in ``tasks/pipelines/registry.py``, before any other that would take the same comparisons.
Then run `check_pipeline` on it, with a small workspace: see ``docs/how-to/own-pipeline.md``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from inflight.catalog import Catalog, Day
from inflight.errors import CalibrationError, CatalogError
from inflight.figures import LazySection, Section, html_table
from inflight.flags import UNUSABLE
from inflight.mission import Mission
from inflight.progress import Progress, silent
from inflight.tasks.archive import load_samples
from inflight.tasks.pipelines import (
    Batch,
    CompareResult,
    EarlierProducts,
    Pipeline,
    ProductBatch,
    Report,
    Reprocessing,
    ReprocessSettings,
    TablesToPublish,
    TextLine,
    Versions,
    newest_table,
    residual_of_days,
    window_edges,
)
from inflight.time import day_bounds


class GainPipeline(Pipeline):
    """One gain a window: the mean of the measured field strength over that of the scalar instrument.

    A day leaves the sums of ratios ``|B| / F``, their squares and their number; the gain of a window is their
    mean. The product is the field divided by it, its residual ``|B| - F``.
    """

    #: The name that users and documents call it by.
    tag = "gain"
    #: Raise one of these when the numbers it makes change: what was published is then made anew.
    versions = Versions(statistics=1, tables=1, products=1)

    def handles(self, mission: Mission, settings: ReprocessSettings) -> bool:
        """Return True for a comparison of a vector sensor with a scalar instrument."""
        return mission.comparisons[settings.comparison].kind == "scalar"

    def extra_channels(self, mission: Mission, comparison: str) -> Sequence[str]:
        """Return none: nothing is read beside the fields and what the model's effects need."""
        return ()

    def make_day(self, batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return count, sum and square sum of ratios along ``block`` (one), and how many samples were used.

        Raises
        ------
        CalibrationError
            When no sample of the day is usable.
        """
        ratio = _ratios(_samples(batch, day))
        ratio = ratio[np.isfinite(ratio)]
        if not ratio.size:
            raise CalibrationError("no sample of the day is usable", remedy="look at the day's deliveries")
        start, end = day_bounds(day)
        sums = {"count": float(ratio.size), "total": ratio.sum(), "square": (ratio**2).sum()}
        made = {
            name: ("block", np.array([value]))
            for name, value in (*sums.items(), ("start", start), ("end", end))
        }
        return xr.Dataset(made), {"used": int(ratio.size)}

    def solve(self, work: Reprocessing, days: Mapping[np.datetime64, Day]) -> TablesToPublish:
        """Make the tables of days, of windows and of the span; products take the one that is asked for."""
        keep, ordered = self.table_stager(work, days), sorted(days)
        read = [work.cat.read(days[day]) for day in ordered]
        after = ordered[-1] + np.timedelta64(1, "D")
        edges = {
            "daily": [*ordered, after],
            "window": window_edges(ordered[0], ordered[-1], work.plan.settings.window_days),
            "span": [ordered[0], after],
        }
        for name, bounds in edges.items():
            keep.table(name, partial(gain_table, read, bounds))
        return keep.solved(work.plan.settings.table, work.plan.model)

    def make_product(self, batch: ProductBatch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the field divided by the gain, its residual before and after, and a report of both."""
        samples = _samples(batch, day)
        middle = sum(day_bounds(day)) // 2
        row = int(np.searchsorted(batch.table["start"].values, middle, side="right")) - 1
        gain = float(batch.table["value"].values[row, 0])
        vector, scalar = (np.asarray(samples[name].values, dtype=np.float64) for name in ("vector", "scalar"))
        before = np.linalg.norm(vector, axis=1) - scalar
        after = np.linalg.norm(vector / gain, axis=1) - scalar
        product = xr.Dataset(
            {
                "field_sensor": (("time", "axis"), vector / gain, {"units": "nT"}),
                "residual": ("time", after, {"units": "nT"}),
                "residual_preflight": ("time", before, {"units": "nT"}),
                "flag": ("time", samples["flag"].values),
            },
            coords={"tt2000": ("time", samples["tt2000"].values)},
            attrs={"mission": batch.mission.mission, "day": str(day)},
        )
        good = (samples["flag"].values & np.uint32(UNUSABLE)) == 0
        report = {
            "coverage": float(good.mean()),
            "samples": int(good.sum()),
            "before_nT": float(np.sqrt(np.nanmean(before[good] ** 2))),
            "after_nT": float(np.sqrt(np.nanmean(after[good] ** 2))),
        }
        return product, report

    def results(self, work: Reprocessing, solved: TablesToPublish | None) -> dict[str, Any]:
        """Return the residual of the planned days, from the reports of their products."""
        return {"residual": residual_of_days(work) if solved else {}}

    def compare(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        days: Sequence[Day],
        span: slice,
        progress: Progress,
        client: Any = None,
        earlier: EarlierProducts | None = None,
    ) -> CompareResult[GainReport]:
        """Return the residual of each day before and after, from the reports of the products."""
        report = GainReport(comparison, [{"day": str(day.day), **day.report} for day in days])
        parts: list[LazySection] = [("Residual", lambda: ([_residual_table(report)], []))]
        return CompareResult(report, f"{mission.mission}: gain", parts)

    def report(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        output: Path | None = None,
        cause: str = "",
        progress: Progress = silent,
    ) -> Report:
        """Refuse: there is nothing of all days together."""
        raise CatalogError("a gain has no report of its own", remedy="'inflight compare' shows the residual")

    def sections(self, cat: Catalog, mission: Mission, comparison: str) -> list[Section]:
        """Return the gains of the newest table."""
        table = newest_table(cat, f"{comparison}-window")
        if table is None:
            return []
        gains = zip(table["value"].values[:, 0], table["sigma"].values[:, 0], strict=True)
        rows = [(f"{value:.6f}", f"{sigma:.1g}") for value, sigma in gains]
        return [("Gain", [html_table(("gain", "sigma"), rows)], [])]


@dataclass
class GainReport:
    """What `compare` found; `path` is the page, when one was written."""

    comparison: str
    by_day: list[dict[str, Any]]
    path: Path | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""
        sizes = {name: _rms([day[name] for day in self.by_day]) for name in ("before_nT", "after_nT")}
        return {
            "command": "compare",
            "comparison": self.comparison,
            "residual": sizes,
            "by_day": self.by_day,
            "fails_where": [],
            "path": str(self.path) if self.path else "",
        }

    def summary(self) -> list[TextLine]:
        """Return what a person reads."""
        size = self.as_json()["residual"]
        return [
            TextLine(f"residual {size['before_nT']:.3f} nT before, {size['after_nT']:.3f} nT after", "bold")
        ]


def gain_table(read: Sequence[xr.Dataset], edges: Sequence[np.datetime64]) -> xr.Dataset:
    """Return the gain of each interval that has a day; dims interval, parameter (one).

    Parameters
    ----------
    read : sequence of Dataset
        Statistics of days, as `GainPipeline.make_day` makes them.
    edges : sequence of datetime64[D]
        Of the intervals.

    Returns
    -------
    Dataset
        `value`, `sigma` (interval, parameter), no unit; `start`, `end` (interval) TT2000.
    """
    rows = []
    for low, high in pairwise(day_bounds(edge)[0] for edge in edges):
        inside = [one for one in read if low <= int(one["start"].values[0]) < high]
        if inside:
            count, total, square = (
                sum(float(one[name].values[0]) for one in inside) for name in ("count", "total", "square")
            )
            mean = total / count
            rows.append((low, high, mean, np.sqrt(max(square / count - mean**2, 0.0) / count)))
    start, end, value, sigma = (np.array(column) for column in zip(*rows, strict=True))
    each = ("interval", "parameter")
    return xr.Dataset(
        {
            "value": (each, value[:, None]),
            "sigma": (each, sigma[:, None]),
            "units": ("parameter", np.array(["1"])),
            "start": ("interval", start),
            "end": ("interval", end),
        },
        coords={"parameter": ["gain"]},
    )


def _samples(batch: Batch, day: np.datetime64) -> xr.Dataset:
    job = batch.job
    return load_samples(
        batch.cat, batch.mission, batch.model, day, list(job.needs), job.index, geometry=False
    )


def _ratios(samples: xr.Dataset) -> np.ndarray:
    """Return the field strengths' ratio at each sample, NaN where one is not usable; (time,)."""
    good = (samples["flag"].values & np.uint32(UNUSABLE)) == 0
    ratio = np.linalg.norm(samples["vector"].values, axis=1) / samples["scalar"].values
    return np.where(good, ratio, np.nan)


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _residual_table(report: GainReport) -> str:
    rows = [(day["day"], f"{day['before_nT']:.3f}", f"{day['after_nT']:.3f}") for day in report.by_day]
    return html_table(("day", "before, nT", "after, nT"), rows)
