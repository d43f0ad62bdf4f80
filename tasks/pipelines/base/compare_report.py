"""The report of a comparison: numbers for programs and people, and figures that are drawn when shown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy as np

from inflight.catalog import Catalog, Day
from inflight.figures import LazySection, Section, bullet_list, html_table
from inflight.plumbing import Finding
from inflight.progress import Progress, silent, tell_each
from inflight.residual import Line, NoiseFloor, ParameterScatter, ResidualStatistics, above_floor, is_at_floor
from inflight.tasks.pipelines.base.parts import TextLine, plumbing_lines

if TYPE_CHECKING:
    import xarray as xr

#: Structures below this part of the noise are not told, but listed on the page; assumed.
MATTERS = 0.1

_NO_FLOOR = "unknown: every stretch of the residual has missing samples"


class Structure(Protocol):
    """One structure of a residual: of `inflight.residual.dependence` or `inflight.spin.residual`."""

    @property
    def coordinate(self) -> str:
        """The coordinate that the residual follows."""

    @property
    def amplitude(self) -> float:
        """Rms of the structure, nT."""

    @property
    def sigma(self) -> float:
        """Its standard deviation between blocks, nT."""

    @property
    def sentence(self) -> str:
        """The structure in one sentence."""


class Report(Protocol):
    """Report of a comparison or of tables; `path` is its page, when one was written."""

    path: Path | None

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""

    def summary(self) -> list[TextLine]:
        """Return what the command line prints for a person, the page excepted."""


Report_co = TypeVar("Report_co", bound=Report, covariant=True)


@dataclass(frozen=True)
class EarlierResidual:
    """The residual of the same days as another version of the model left it.

    Attributes
    ----------
    version : int
    message : str
        What made the present version of it.
    rms, above_floor : float
        Without outliers, and of that what is more than the present noise floor, nT.
    by_day : list of dict
        ``day`` and ``after_nT``, as those of `CompareReport`.
    """

    version: int
    message: str
    rms: float
    above_floor: float
    by_day: list[dict[str, Any]]


@dataclass
class CompareReport:
    """What `compare` found.

    Attributes
    ----------
    context : str
        Id in the catalog of mission, model and version of the newest product.
    before, after : ResidualStatistics
        Of the residual, with the pre-flight model and after calibration.
    clear : float
        Rms of the residual after calibration without outliers, nT.
    version : int
        Of the model.
    earlier : EarlierResidual, optional
        What another version of the model left.
    history : sequence of dict
        Versions of the model and what each did to the residual, as `inflight.tasks.ModelHistory.items`.
    floor : NoiseFloor
        Of the residual after calibration.
    by_day : list of dict
        Sizes of each day.
    fails_where : sequence of Structure
        Structures of the residual, strongest first.
    directions : list of str
        Combinations of parameters that the span determines.
    determined : list of str
        Parameters that it determines by themselves.
    block : str
        Length of the blocks between which uncertainties are measured.
    lines : list of Line
        Of the spectrum.
    daily_scatter : list of ParameterScatter
        Of parameters from day to day.
    path : Path, optional
        Of the page, when one was written.
    skipped, outliers : int
        Samples without a usable measurement, and outliers.
    plumbing : sequence of Finding
        Faults of units, clocks, axes and channels of the span.
    """

    comparison: str
    context: str
    before: ResidualStatistics
    after: ResidualStatistics
    floor: NoiseFloor
    by_day: list[dict[str, Any]]
    fails_where: Sequence[Structure]
    directions: list[str]
    determined: list[str]
    block: str
    lines: list[Line]
    daily_scatter: list[ParameterScatter]
    path: Path | None = None
    skipped: int = 0
    outliers: int = 0
    plumbing: Sequence[Finding] = ()
    clear: float = float("nan")
    version: int = 0
    earlier: EarlierResidual | None = None
    history: Sequence[dict[str, Any]] = ()

    @property
    def above_floor(self) -> float:
        """Rms of what is in the residual beside its noise, outliers aside, nT."""
        return above_floor(self.clear if isfinite(self.clear) else self.after.rms, self.floor.level_nT)

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""
        return {
            "command": "compare",
            "run": "",
            "context": self.context,
            "comparison": self.comparison,
            "plumbing": [dict(one.as_json()) for one in self.plumbing],
            "residual": {
                "before_nT": self.before.rms,
                "after_nT": self.after.rms,
                "before_less_mean_nT": self.before.std,
                "after_less_mean_nT": self.after.std,
                "without_outliers_nT": self.clear,
                "above_floor_nT": self.above_floor,
                "noise_floor_nT": self.floor.level_nT,
                "noise_floor_interval_nT": [self.floor.low_nT, self.floor.high_nT],
                "before": self.before.as_json(),
                "after": self.after.as_json(),
                "samples_left_out": self.skipped,
                "outliers": self.outliers,
            },
            "model_version": self.version,
            "against": None if self.earlier is None else vars(self.earlier),
            "by_day": self.by_day,
            "at_noise_floor": self.is_at_floor,
            "fails_where": [
                {
                    "coordinate": one.coordinate,
                    "amplitude_nT": one.amplitude,
                    "sigma_nT": one.sigma,
                    "sentence": one.sentence,
                }
                for one in self.fails_where
            ],
            "block": self.block,
            "parameters": {
                "determined": self.determined,
                "combinations": self.directions,
                "wander": [one.as_json() for one in self.daily_scatter],
            },
            "spectrum_lines": [line.as_json() for line in self.lines],
            "path": str(self.path) if self.path else "",
        }

    def summary(self) -> list[TextLine]:
        """Return what a person reads: residual before and after, what the data determine, where it fails."""
        out = plumbing_lines(self.plumbing)
        out += [TextLine(text, "bold") for text in self._sizes()]
        determined = ", ".join(name.rpartition(".")[2] for name in self.determined) or "nothing"
        out.append(TextLine(f"  determined by these data: {determined}"))
        told = [one for one in self.fails_where if self.matters(one)]
        if self.is_at_floor:
            out.append(
                TextLine(
                    "  The residual is at its noise floor: nothing that it follows reaches a tenth of it."
                )
            )
        elif not told:
            out.append(
                TextLine(
                    "  No single coordinate of these explains it: something fast, something that no channel "
                    "records, or several causes at once."
                )
            )
        return out + [TextLine(f"  {one.sentence}") for one in told]

    def matters(self, structure: Structure) -> bool:
        """Return True for a structure of at least a tenth of the noise: half a percent of the rms."""
        floor = self.floor.level_nT
        return not isfinite(floor) or structure.amplitude >= MATTERS * floor

    @property
    def is_at_floor(self) -> bool:
        """True when the rms is that of the noise floor and no structure beside it matters."""
        size = self.clear if isfinite(self.clear) else self.after.rms
        return is_at_floor(size, self.floor.level_nT) and not any(map(self.matters, self.fails_where))

    def _sizes(self) -> Iterator[str]:
        """Yield the size of the residual with each model, and how much of it is more than noise."""
        without = f"; its {self.outliers} outliers left out, with them {self.after.rms:.4g} nT"
        sizes = [("pre-flight model", self.before.rms, "")]
        if self.earlier is not None:
            sizes.append((f"model version {self.earlier.version}", self.earlier.rms, ""))
        made = f"  ({self.earlier.message})" if self.earlier is not None and self.earlier.message else ""
        now = f"model version {self.version}" if self.version else "calibrated"
        clear = self.clear if isfinite(self.clear) else self.after.rms
        sizes.append((now, clear, made + (without if self.outliers else "")))
        for place, (name, size, more) in enumerate(sizes):
            yield f"{'residual' if not place else '':<9} {name:<18} {size:9.4f} nT rms{more}"
        level = self.floor.level_nT
        if not isfinite(level):
            yield f"noise floor                  {_NO_FLOOR}"
            return
        # Estimated at other frequencies or times than the residual: it may lie above what is left.
        limit = "  (the residual is below it: an upper limit here)" if clear < self.floor.low_nT else ""
        yield f"noise floor                  {level:9.4f} nT{limit}"
        left = f"{self.above_floor:.3g} nT"
        if self.earlier is not None:
            left = f"{self.earlier.above_floor:.3g} -> {left}"
        yield f"left above the noise floor   {left}"


@dataclass(frozen=True)
class CompareResult(Generic[Report_co]):
    """A report with everything that is shown of it.

    Attributes
    ----------
    report : CompareReport or DualCompareReport
    title : str
        Of the page.
    parts : sequence of LazySection
        Sections by heading, made when called: the explorer makes the one in view, the page all of them.
    data : object, optional
        What the figures of a residual at every sample are drawn from.
    """

    report: Report_co
    title: str
    parts: Sequence[LazySection]
    data: Any = None

    def sections(self, progress: Progress = silent) -> Iterator[Section]:
        """Make everything that is shown, section by section."""
        for heading, make in tell_each(progress, "sections", self.parts):
            yield heading, *make()


def tables_in_use(cat: Catalog, comparison: str, day: Day) -> tuple[xr.Dataset, xr.Dataset]:
    """Return the table of daily fits that holds on a day, and the one that products use.

    A workspace that was only ever fitted to all days at once has those of that fit.
    """
    at, made = str(day.day), {record.name for record in cat.tables()}
    alone = [f"{comparison}-{kind}" for kind in ("daily-after", "continuous")]
    if f"{comparison}-window" in made or not made.issuperset(alone):
        return cat.table(f"{comparison}-daily", at), cat.table(f"{comparison}-window", at)
    daily, used = (cat.table(name, at) for name in alone)
    # What was known beforehand stands in the table of the fit.
    shared = [name for name in used["parameter"].values if name in daily["parameter"].values]
    known = used.sel(parameter=shared)
    return daily.sel(parameter=shared).assign({name: known[name] for name in ("prior", "prior_sigma")}), used


def day_summary(
    day: Day, before: ResidualStatistics, after: ResidualStatistics, **more: float
) -> dict[str, Any]:
    """Return the size of a day's residual before and after calibration, as plain fields; nT."""
    return {
        "day": str(day.day),
        "version": day.version,
        "before_nT": before.rms,
        "after_nT": after.rms,
        "before_less_mean_nT": before.std,
        "after_less_mean_nT": after.std,
        **more,
        "samples": after.count,
    }


def daily_residual_figure(report: CompareReport) -> Any:
    """Draw the rms of each day before and after calibration, and the noise floor."""
    from inflight.figures import daily_figure

    day = np.array([entry["day"] for entry in report.by_day], dtype="datetime64[ns]")
    before, after = (np.array([entry[name] for entry in report.by_day]) for name in ("before_nT", "after_nT"))
    labels = ("pre-flight model", f"model version {report.version}" if report.version else "calibrated")
    earlier = None
    if report.earlier is not None:
        known = {entry["day"]: entry["after_nT"] for entry in report.earlier.by_day}
        own = np.array([known.get(entry["day"], np.nan) for entry in report.by_day])
        earlier = own, f"model version {report.earlier.version}"
    return daily_figure(day, before, after, report.floor.level_nT, labels, earlier)


def fall_figure_of(report: CompareReport) -> Any:
    """Draw how the residual of each day fell with the last change of the model; None without one before."""
    from inflight.figures import fall_figure

    if report.earlier is None:
        return None
    known = {entry["day"]: entry["after_nT"] for entry in report.earlier.by_day}
    days = [entry["day"] for entry in report.by_day]
    before = np.array([known.get(day, np.nan) for day in days])
    after = np.array([entry["after_nT"] for entry in report.by_day])
    labels = f"model version {report.earlier.version}", f"model version {report.version}"
    return fall_figure(np.array(days, dtype="datetime64[ns]"), before, after, report.floor.level_nT, labels)


def sizes_html(report: CompareReport) -> str:
    """Return the residual with each model, and how much of it is more than noise, as HTML."""
    level = report.floor.level_nT
    clear = report.clear if isfinite(report.clear) else report.after.rms
    rows = [("pre-flight model", report.before.rms, above_floor(report.before.rms, level))]
    if report.earlier is not None:
        one = report.earlier
        rows.append((f"model version {one.version}", one.rms, one.above_floor))
    made = f" ({report.earlier.message})" if report.earlier and report.earlier.message else ""
    name = f"model version {report.version}{made}" if report.version else "calibrated"
    rows.append((name, clear, report.above_floor))
    cells = [(name, f"{size:.4f}", f"{above:.3g}" if isfinite(above) else "") for name, size, above in rows]
    cells.append(("noise floor", f"{level:.4f}" if isfinite(level) else "unknown", ""))
    return html_table(("nT, outliers left out", "rms", "left above the noise floor"), cells)


def history_section(report: CompareReport) -> tuple[list[str], list[Any]]:
    """Return what each version of the model took off, on days not used in the fit; empty without changes."""
    from inflight.figures import error_figure

    changed = [one for one in report.history if one["change"]]
    if not changed:
        return [], []
    rows = [
        (
            f"{one['version']}",
            one["message"],
            *(
                f"{pair[0]:.4g} to {pair[1]:.4g}" if pair and None not in pair else ""
                for pair in (one["change"].get("held_out_nT"), one["change"].get("above_floor_nT"))
            ),
        )
        for one in changed
    ]
    head = ("version", "what was done", "rms on days not used in the fit, nT", "above the noise, nT")
    note = "Everything else was fitted anew before and after; the products above are as they were made."
    drawn = [
        {
            "command": "",
            "effect": one["message"],
            "model": {"version": one["version"]},
            "error": one["change"],
        }
        for one in changed
    ]
    return [html_table(head, rows), note], [error_figure(drawn)]


def structures_html(report: CompareReport) -> list[str]:
    """Return the structures of a residual as HTML; those that do not matter by their names alone."""
    if not report.fails_where:
        return [f"No structure stands out by five sigma between blocks of one {report.block}."]
    told = [one for one in report.fails_where if report.matters(one)]
    small = [one for one in report.fails_where if not report.matters(one)]
    out = []
    if report.is_at_floor:
        out.append("The residual is at its noise floor: nothing that it follows reaches a tenth of it.")
    if told:
        out.append(bullet_list([one.sentence for one in told], ordered=True))
        out.append("Each structure is measured after the stronger ones were taken off.")
    if small:
        listed = ", ".join(f"{one.coordinate} {1000.0 * one.amplitude:.2g} pT" for one in small)
        out.append(f"Below a tenth of the noise, with no cause to look for: {listed}.")
    return out


def scatter_html(report: CompareReport) -> str:
    """Return the daily scatter of parameters as HTML."""
    rows = [
        (
            one.name.split(".", 1)[-1],
            one.unit,
            f"{one.std:.3g}",
            f"{one.sigma:.3g}",
            f"{one.ratio:.2f}",
            f"{one.days}",
        )
        for one in report.daily_scatter
        if np.isfinite(one.ratio)
    ]
    if not rows:
        return "Fewer than three days determine any parameter by themselves: no scatter from day to day."
    head = ("parameter", "unit", "daily scatter", "stated sigma", "ratio", "days")
    return html_table(head, rows) + (
        "A ratio well above 1 says that something missing from the model drives the parameter."
    )
