"""What is shown of a comparison with a scalar instrument: its numbers and figures, section by section.

In go the report and the aggregates of `compare_samples`, out come sections that are made when shown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.figures import (
    LazySection,
    SectionBody,
    axis_figure,
    bullet_list,
    dependence_figure,
    draw_floor,
    excess_scatter_figure,
    histogram_figure,
    html_table,
    parameter_figures,
    series_figure,
    spectrum_figure,
)
from inflight.mission import Mission
from inflight.residual import (
    SERIES,
    Dependence,
    Line,
    RankedDependence,
    SpectrumSum,
    drawn_periods,
    format_period,
)
from inflight.tasks.pipelines.base import (
    MATTERS,
    CompareReport,
    daily_residual_figure,
    fall_figure_of,
    history_section,
    scatter_html,
    sizes_html,
    structures_html,
)
from inflight.time import to_utc
from inflight.units import with_error

#: Points of the figure of the residual in time, at most: what a browser can draw.
_POINTS = 20_000

#: Lines of the spectrum in the page's table.
_LISTED = 24


@dataclass(frozen=True)
class Spectra:
    """Spectra of days (after, before) and of weeks, the lines in them, and the periods that are known (s)."""

    fast: SpectrumSum | None
    before: SpectrumSum | None
    slow: SpectrumSum | None
    lines: list[Line]
    known: dict[str, float]


@dataclass(frozen=True)
class FigureData:
    """Aggregates that the figures are drawn from.

    Attributes
    ----------
    counts : dict of str to ndarray
        Histograms ``before`` and ``after`` over ``edges``, nT.
    rows : dict of str to ndarray
        Means of short spans, as `rows_of_day`.
    spectra : Spectra
    found : list of Dependence
    tables : tuple of Dataset
        Of the daily fits, and the one products use.
    earlier : dict of str to Dependence
        By coordinate, what the residual followed with another version of the model.
    earlier_spectrum : SpectrumSum, optional
        Of that residual.
    """

    counts: dict[str, Floats]
    rows: dict[str, Floats]
    spectra: Spectra
    found: list[Dependence]
    tables: tuple[xr.Dataset, xr.Dataset]
    earlier: Mapping[str, Dependence] = field(default_factory=dict)
    earlier_spectrum: SpectrumSum | None = None


def compare_parts(report: CompareReport, data: FigureData) -> list[LazySection]:
    """Return everything that is shown of a comparison, as the page and the explorer have it."""
    responses = [one.response for one in report.fails_where if isinstance(one, RankedDependence)]
    along_axes = [response for response in responses if response is not None]
    return [
        ("Residual", lambda: _residual(report, data)),
        ("Where it fails", lambda: (structures_html(report), list(map(axis_figure, along_axes)))),
        ("What the residual follows", lambda: _dependences(report, data)),
        ("Spectrum", lambda: (_lines(report), _spectrum_figures(report, data))),
        ("What each change took off", lambda: history_section(report)),
        ("Parameters", lambda: _parameters(report, data)),
    ]


def page_title(report: CompareReport, mission: Mission) -> str:
    """Return what the page is headed with."""
    first, last = report.by_day[0]["day"], report.by_day[-1]["day"]
    return f"{mission.mission}: model against measurement, {first} to {last}"


def _residual(report: CompareReport, data: FigureData) -> SectionBody:
    """Return sizes before and after, by day, as a histogram and in time."""
    head = ("nT", "rms", "mean", "std", "robust sigma", "least", "largest", "samples")
    cells = [
        (name, *(f"{v:.4f}" for v in (s.rms, s.mean, s.std, s.robust, s.least, s.largest)), f"{s.count}")
        for name, s in (("pre-flight model", report.before), ("calibrated", report.after))
    ]
    note = (
        f"Noise floor {report.floor.level_nT:.4f} nT, 95 % interval {report.floor.low_nT:.4f} to "
        f"{report.floor.high_nT:.4f} (white level of the calibrated residual between a tenth of the Nyquist "
        f"frequency and the Nyquist frequency, what falls with the frequency taken off). "
        f"{report.skipped} samples without a measurement are "
        f"left out; {report.outliers} outliers count in this table, but not in the spectra and dependences."
    )
    counts = data.counts
    fall = fall_figure_of(report)
    plots = [
        *([] if fall is None else [fall]),
        daily_residual_figure(report),
        histogram_figure(counts["edges"], counts["before"], counts["after"]),
        series_figure(*thin_series(data.rows)),
    ]
    return [sizes_html(report), html_table(head, cells), note], plots


def thin_series(rows: dict[str, Floats]) -> tuple[Any, Floats, Floats, Floats]:
    """Return UTC, mean, lowest and highest of groups of rows: at most as many as a browser can draw."""
    shown = np.flatnonzero(np.isfinite(rows["after"]))
    if not shown.size:
        return to_utc(np.empty(0, dtype=np.int64)), np.empty(0), np.empty(0), np.empty(0)
    first = np.arange(0, shown.size, -(-shown.size // _POINTS))
    count = np.diff(np.append(first, shown.size))
    return (
        to_utc(rows["tt2000"][shown][first].astype(np.int64)),
        np.add.reduceat(rows["after"][shown], first) / count,
        np.minimum.reduceat(rows["low"][shown], first),
        np.maximum.reduceat(rows["high"][shown], first),
    )


def _dependences(report: CompareReport, data: FigureData) -> SectionBody:
    """Return the mean residual against every coordinate, clear dependences first."""
    text = (
        f"Mean residual in bins of each coordinate, clear ones first; bands and bars are one sigma between "
        f"blocks of one {report.block}. Where a channel's rising and falling branches differ by five sigma, "
        "both are drawn."
    )
    level = MATTERS * report.floor.level_nT
    if np.isfinite(level):
        text += f" The grey band is a tenth of the noise floor, {1000.0 * level:.2g} pT either way."
    order = sorted(data.found, key=lambda one: (not one.is_clear, -one.amplitude))
    name = f"model version {report.earlier.version}" if report.earlier else ""
    return [text], [dependence_figure(one, data.earlier.get(one.coordinate), name, level) for one in order]


def _parameters(report: CompareReport, data: FigureData) -> SectionBody:
    """Return what the span's data determine, and how the daily parameters scatter."""
    names = ", ".join(name.split(".", 1)[-1] for name in report.determined) or "none"
    text = [f"Parameters that the span's data determine by themselves: {names}."]
    if len(report.determined) < len(report.directions) or not report.determined:
        before = (
            f"The data determine {len(report.directions)} combinations, in units of each prior's sigma, "
            "best known first; everything else stays at its prior:"
        )
        text.append(bullet_list(report.directions, before=before, ordered=True))
    plots = [*parameter_figures(*data.tables), excess_scatter_figure(report.daily_scatter)]
    return [*text, scatter_html(report)], plots


def _spectrum_figures(report: CompareReport, data: FigureData) -> list[Any]:
    """Return the spectra of days along each series, then those of weeks.

    Beside them stands that of the model before, where there is one, else that of the pre-flight model.
    """
    spectra = data.spectra
    periods, plots = drawn_periods(spectra.known), []
    fast, before, slow = spectra.fast, spectra.before, spectra.slow
    labels = ("pre-flight model", "calibrated")
    if report.earlier is not None and data.earlier_spectrum is not None:
        before = data.earlier_spectrum
        labels = (f"model version {report.earlier.version}", f"model version {report.version}")
    if fast is not None:
        if before is not None and before.frequency.size != fast.frequency.size:
            before = None
        for index, series in enumerate(SERIES):
            own = None if before is None else before.density[index]
            plot = spectrum_figure(
                fast.frequency, own, fast.density[index], periods, spectra.lines, series, labels
            )
            if series == "residual":
                draw_floor(plot, fast.frequency, report.floor.level_nT)
            plots.append(plot)
    if slow is not None:
        plots.append(spectrum_figure(slow.frequency, None, slow.density[0], periods, spectra.lines))
    return plots


def _lines(report: CompareReport) -> list[str]:
    """Return the lines of the spectrum as a table: unknown periods first."""
    if not report.lines:
        return ["No line stands above the spectrum around it."]
    head = (
        "period",
        "what it is",
        "times background",
        "residual, nT",
        "along x, nT",
        "along y, nT",
        "along z, nT",
    )
    rows = [
        (
            format_period(line.period_s),
            line.label or line.follows or "unknown",
            f"{line.ratio:.0f}",
            *(
                with_error(a, s) if np.isfinite(a) else ""
                for a, s in zip(line.amplitude, line.sigma, strict=True)
            ),
        )
        for line in report.lines[:_LISTED]
    ]
    more = len(report.lines) - len(rows)
    note = (f"{more} weaker ones are in the JSON. " if more > 0 else "") + (
        "A field along one axis shows at its own period in the residual times that axis's direction; in the "
        "residual itself it shows at sidebands. Amplitudes along an axis are those of a field that acts "
        "there alone."
    )
    return [html_table(head, rows), note]
