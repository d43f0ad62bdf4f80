"""Sections of a chain's report on what was fitted: coefficients, trend, jumps, torquers, offsets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from html import escape
from math import floor, log10
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration.sensor import PARTS, vector_sensor_of
from inflight.chain import terms_of
from inflight.errors import InflightError
from inflight.estimators.jumps import Jumps, table_jumps, trend_jumps
from inflight.estimators.secular import RunningMean, remanent_field
from inflight.estimators.trend_choice import Rival, TrendComparison
from inflight.estimators.z_offset import OffsetsFromSpread
from inflight.figures.chain import band_level_figure, continuous_figure, prior_figure
from inflight.figures.naming import distinct, short_parameter
from inflight.figures.page import html_table
from inflight.figures.residual import daily_figure
from inflight.figures.torquers import coefficient_figures, running_mean_figures
from inflight.figures.trends import comparison_figure, jumps_figure
from inflight.figures.z_offset import offsets_figure
from inflight.model.timed import component_names
from inflight.tasks.chain_results import ChainResults
from inflight.time import Int64, to_utc

#: How the nine parameters are shown: part, title, factor, unit.
SHOWN = (
    ("scale_factor", "Scale factors", 1e6, "ppm"),
    ("misalignment", "Misalignment angles", 3600.0, "arcsec"),
    ("offset", "Offsets", 1.0, "nT"),
)


@dataclass
class Part:
    """One section: what it tells as plain fields, as HTML paragraphs and as figures.

    Attributes
    ----------
    key : str
        Its name in the JSON.
    absent : dict of str to str
        What the span cannot tell, and why.
    """

    key: str
    heading: str
    fields: dict[str, Any] = field(default_factory=dict)
    text: list[str] = field(default_factory=list)
    plots: list[Any] = field(default_factory=list)
    absent: dict[str, str] = field(default_factory=dict)

    def say(self, text: str, quiet: bool = False) -> None:
        """Add a paragraph of plain text."""
        opening = '<p class="quiet">' if quiet else "<p>"
        self.text.append(f"{opening}{escape(text)}</p>")

    def lack(self, what: str, why: str) -> None:
        """Say what is not there, with its reason."""
        self.absent[what] = why
        self.text.append(f'<p class="absent"><b>{escape(what)}</b>: not told. {escape(_sentence(why))}</p>')

    def attempt(self, what: str, make: Callable[[], None]) -> None:
        """Do a piece of the section; when the span does not suffice for it, say so."""
        try:
            make()
        except InflightError as error:
            remedy = f"; {error.remedy}" if error.remedy else ""
            self.lack(what, f"{error.message}{remedy}")


def _sentence(text: str) -> str:
    whole = text[:1].upper() + text[1:]
    return whole if whole.endswith(".") else f"{whole}."


def with_error(value: float, sigma: float) -> str:
    """Return a value and its error to the same digit, two of the error's: ``-0.0450 ± 0.0012``."""
    if not np.isfinite(value):
        return ""
    if not 0.0 < sigma < float("inf"):
        return f"{value:.5g}"
    place = floor(log10(sigma)) - 1
    if -7 <= place <= 0:
        return f"{value:.{-place}f} ± {sigma:.{-place}f}"
    digits = max(1, floor(log10(max(abs(value), sigma))) - place)
    return f"{value:.{digits}e} ± {sigma:.1e}"


def matrix_table(corner: str, rows: Sequence[str], columns: Sequence[str], value: Any, sigma: Any) -> str:
    """Return a table of values with errors, rows by columns."""
    cells = [
        [name, *(with_error(float(one), float(own)) for one, own in zip(*pair, strict=True))]
        for name, pair in zip(rows, zip(value, sigma, strict=True), strict=True)
    ]
    return html_table([corner, *columns], cells)


def residual(found: ChainResults) -> Part:
    """How far the residual falls, day by day."""
    part = Part("residual", "Residual")
    table = found.tables["continuous"]
    before = np.array([float(day["before"].values[0]) for day in found.read])
    own = np.array([float(day["after"].values[0]) for day in found.read])
    after = table["after"].values
    weight = np.maximum(table["count"].values, 0.0)
    rms = [_rms(one, weight) for one in (before, own, after)]
    part.fields = dict(zip(("before_nT", "own_fit_nT", "continuous_nT"), rms, strict=True))
    part.say(
        f"{rms[0]:.4g} nT before, {rms[1]:.4g} nT with each day's own nine parameters, "
        f"{rms[2]:.4g} nT with the values of all days together."
    )
    when = to_utc(table["start"].values)
    part.plots.append(daily_figure(when, before, after, float("nan"), ("before", "all days together")))
    return part


def _rms(values: Floats, weight: Floats) -> float:
    return float(np.sqrt(np.average(values**2, weights=weight))) if weight.sum() else float("nan")


def coefficients(found: ChainResults) -> Part:
    """Every coefficient: value, sigma, unit, whether the data tell it, and how far it went."""
    part = Part("coefficients", "Coefficients")
    rows = coefficient_rows(found)
    part.fields = {"items": rows}
    known = sum(row["determined"] for row in rows)
    far = [row for row in rows if abs(row["shift_sigma"] or 0.0) > 3.0]
    part.say(
        f"{len(rows)} coefficients, {known} of them determined by the data. The error is that of days "
        "that differ, correlated in time. Shift: value less what was known before, in sigmas of that; what "
        "the vector sensor and the scalar sensor share shows only as their difference."
    )
    if far:
        told = "; ".join(f"{row['name']} ({row['shift_sigma']:+.1f})" for row in far)
        part.say(f"Beyond three sigmas of what was known: {told}.")
    part.text.append(_coefficient_table(rows))
    drawn = [row for row in rows if row["shift_sigma"] is not None]
    shift = np.array([row["shift_sigma"] for row in drawn])
    sigma = np.array([row["sigma"] / row["prior_sigma"] for row in drawn])
    names = distinct([short_parameter(row["name"]) for row in drawn])
    part.plots.append(prior_figure(names, shift, sigma, [row["determined"] for row in drawn]))
    return part


def coefficient_rows(found: ChainResults) -> list[dict[str, Any]]:
    """Return the coefficients as plain rows; a shift is None where nothing was known beforehand."""
    table, prior = found.tables["trend"], _priors(found)
    rows = []
    for index, name in enumerate(map(str, table["parameter"].values)):
        value, sigma = float(table["value"].values[index]), float(table["sigma"].values[index])
        at, known = prior.get(name, (float("nan"), float("nan")))
        shift = (value - at) / known if known > 0 and np.isfinite(at) else None
        rows.append(
            {
                "name": name,
                "value": value,
                "sigma": sigma,
                "unit": str(table["units"].values[index]),
                "determined": bool(table["determined"].values[index]),
                "time": str(table["time"].values[index]),
                "prior": at,
                "prior_sigma": known,
                "shift_sigma": shift,
            }
        )
    return rows


def _priors(found: ChainResults) -> dict[str, tuple[float, float]]:
    """Return what was known of each coefficient: value and sigma."""
    out = {}
    for term in terms_of(found.model):
        values = np.concatenate([term.entry.parameters[name].value[:, 0] for name in term.parameters])
        for name, value, sigma in zip(term.columns, values, term.sigma, strict=True):
            out[name] = (float(value), float(sigma))
    return out


def _coefficient_table(rows: Sequence[dict[str, Any]]) -> str:
    head = ("coefficient", "value ± sigma", "unit", "determined", "known before", "shift")
    cells = []
    for row in rows:
        shift = "" if row["shift_sigma"] is None else f"{row['shift_sigma']:+.2f}"
        determined = "yes" if row["determined"] else "no"
        before = with_error(row["prior"], row["prior_sigma"])
        cells.append(
            (row["name"], with_error(row["value"], row["sigma"]), row["unit"], determined, before, shift)
        )
    listed = html_table(head, cells)
    return f'<div class="wide"><details open><summary>all values</summary>{listed}</details></div>'


def trend(found: ChainResults) -> Part:
    """The scale factors in time, with the trends that were compared."""
    part = Part("trend", "Continuous parameters")
    table = found.tables["continuous"]
    kind, origin = str(table.attrs.get("trend", "")), found.tables["trend"].attrs.get("origin", "")
    part.fields = {"kind": kind, "origin": origin}
    part.say(
        f"Scale factors follow a {kind} trend in time{f'; {origin}' if origin else ''}; angles and offsets "
        "have one value. Points are each day's own, with everything else at the fit of all days; the line and "
        "its band of one sigma are the fit's."
    )
    daily = found.tables.get("daily-after")
    if daily is None:
        part.lack("Parameters of each day", found.why("daily-after"))
    names = [str(name) for name in table["parameter"].values]
    for kind_of, title, factor, unit in SHOWN:
        own = [name for name in names if f".{kind_of}[" in name]
        points = (daily if daily is not None else table).sel(parameter=own)
        part.plots.append(continuous_figure(points, table.sel(parameter=own), title, factor, unit))
    choice = found.tables.get("trend-choice")
    if choice is None:
        part.lack("Rival trends", found.left_out.get("trend-choice", "the trend was stated, or too few days"))
        return part
    comparison = rivals_of(choice)
    part.say(comparison.told() + ".")
    part.fields["told"] = comparison.told()
    part.fields["rivals"] = [vars(one) for one in comparison.rivals]
    part.plots.append(comparison_figure(comparison))
    return part


def rivals_of(table: xr.Dataset) -> TrendComparison:
    """Return a comparison of trends from its table."""
    rivals = [
        Rival(
            str(table["kind"].values[index]),
            int(table["coefficients"].values[index]),
            *(float(table[name].values[index]) for name in ("value", "behind", "sigma_behind")),
            bool(table["tied"].values[index]),
        )
        for index in range(table.sizes["kind"])
    ]
    unit = str(table["units"].values[0])
    return TrendComparison(tuple(rivals), str(table.attrs["chosen"]), int(table.attrs["folds"]), unit)


def jumps(found: ChainResults) -> Part:
    """Steps of a table of windows at their boundaries against the continuous parameters'."""
    part = Part("jumps", "Jumps between intervals")
    window = found.tables.get("window")
    if window is None:
        part.lack("Jumps of a table of windows", found.why("window"))
        return part

    def make() -> None:
        steps = table_jumps(window)
        inside = (steps.at > found.tables["continuous"]["start"].values[0]) & (
            steps.at < found.tables["continuous"]["end"].values[-1]
        )
        own = Jumps(
            steps.at[inside], steps.mean[inside], steps.rms[inside], steps.sigma[inside], steps.strength
        )
        if not own.at.size:
            part.lack("Jumps of a table of windows", "the span holds no boundary between two windows")
            return
        common = trend_jumps(lambda times: nine_at(found, times), own.at)
        sizes = [float(np.sqrt(np.mean(one.rms**2))) for one in (own, common)]
        part.fields = {
            "boundaries": int(own.at.size),
            "strength_nT": own.strength,
            "window_rms_nT": sizes[0],
            "continuous_rms_nT": sizes[1],
        }
        part.say(
            f"At {own.at.size} boundaries the windows' field of {own.strength:.0f} nT steps by "
            f"{sizes[0]:.3g} nT rms over directions, the continuous one by {sizes[1]:.2g} nT."
        )
        part.plots.append(jumps_figure(own, common))

    part.attempt("Jumps of a table of windows", make)
    return part


def nine_at(found: ChainResults, times: Int64) -> Floats:
    """Return the nine fitted parameters at TT2000 times; (time, 9)."""
    own = vector_sensor_of(found.fitted)
    columns = []
    for name in PARTS:
        value = own.parameters[name]
        size = len(component_names(value.key, value.parameter))
        columns.append(np.broadcast_to(value.at(times), (times.size, size)))
    return np.concatenate(columns, axis=1)


def torquers(found: ChainResults) -> Part:
    """The band of the torquers' modulation before and after, the matrix, and the running mean of currents."""
    part = Part("torquers", "Magneto-torquers")
    matrix, equations = found.tables.get("torquer-band"), found.band
    if matrix is None or equations is None:
        part.lack("Matrix from the band at 20 s", found.why("torquer-band"))
    else:
        _matrix(part, matrix, equations)
    daily, mean = found.tables.get("torquer-band-daily"), found.tables.get("torquer-band-mean")
    if daily is None or mean is None:
        part.lack(
            "Matrix of each day", found.why("torquer-band-daily" if daily is None else "torquer-band-mean")
        )
    else:
        part.plots += coefficient_figures(daily, mean)
    running = found.tables.get("torquer-mean")
    if running is None:
        part.lack("Running mean of the currents", found.why("torquer-mean"))
    else:
        _running(part, running)
    return part


def _matrix(part: Part, matrix: xr.Dataset, equations: xr.Dataset) -> None:
    value, sigma = matrix["value"].values, matrix["sigma"].values
    day, before, after = band_levels(equations, value)
    axes = [str(name) for name in matrix["axis"].values]
    size = [float(np.sqrt(np.mean(one**2))) for one in (before, after)]
    part.fields["matrix"] = {
        "value": value,
        "sigma": sigma,
        "for_scalar": -value,
        "unit": "nT/A",
        "at": "difference",
        "band_before_nT": size[0],
        "band_after_nT": size[1],
    }
    part.say(
        "What the torquers' matrices lack, vector less scalar sensor, nT/A, by the band around the "
        "modulation's 20 s alone. When the vector sensor's matrix is right, its negative is added to the "
        f"scalar sensor's. The band holds {size[0]:.3g} nT before and {size[1]:.3g} nT with it."
    )
    columns = [f"coil {one}" for one in matrix["coil"].values]
    part.text.append(matrix_table("field along", axes, columns, value, sigma))
    part.plots.append(band_level_figure(day, before, after))


def band_levels(equations: xr.Dataset, value: Floats) -> tuple[Int64, Floats, Floats]:
    """Return days' starts and the residual's level in the band before and after a matrix; nT a sample.

    Parameters
    ----------
    equations : xarray.Dataset
        Of `band_equations`.
    value : ndarray, shape (3, 3)
        nT/A, axis by coil.
    """
    gram, rows = equations["gram"].values, equations["rows"].values
    step = np.append(-value.reshape(-1), 1.0)
    after = np.einsum("i,tij,j->t", step, gram, step)
    day, which = np.unique(equations["day"].values, return_inverse=True)
    count = np.maximum(np.bincount(which, weights=rows), 1.0)
    sums = [np.bincount(which, weights=one) for one in (gram[:, -1, -1], after)]
    first = np.array([equations["start"].values[which == index].min() for index in range(day.size)])
    before, left = (np.sqrt(np.maximum(one, 0.0) / count) for one in sums)
    return first, before, left


def _running(part: Part, table: xr.Dataset) -> None:
    days = to_utc(table["start"].values).astype("datetime64[D]").astype(np.int64)
    arrays = [table[name].values for name in ("value", "sigma", "coverage", "state", "daily")]
    mean = RunningMean(days, *arrays, float(table.attrs.get("window_days", 260.0)))
    last = int(np.argmax(mean.coverage))
    part.fields["running_mean"] = {
        "sentence": mean.sentence,
        "coverage": [float(mean.coverage.min()), float(mean.coverage.max())],
        "best_day_A": mean.value[last],
        "best_day_sigma_A": mean.sigma[last],
    }
    part.say(
        f"{mean.sentence}; the window is covered by {mean.coverage.min():.0%} to {mean.coverage.max():.0%}."
    )
    part.plots += running_mean_figures(mean, remanent_field(mean))


def offsets(found: ChainResults) -> Part:
    """Daily offsets along z from the spread of the products' residual."""
    part = Part("offsets_from_spread", "Offsets from the spread of the residual")
    table = found.tables.get("z-offset")
    if table is None:
        part.lack("Offsets of each day", found.why("z-offset"))
        return part
    name = str(table["parameter"].values[0])
    columns = {
        key: table[key].values[:, 0] for key in ("value", "sigma", "wrong_sign", "slope", "sigma_slope")
    }
    seen, nan = table["determined"].values[:, 0].astype(bool), np.full(table.sizes["interval"], np.nan)
    told = OffsetsFromSpread(
        nan,
        nan,
        **columns,
        seen=seen,
        start=table["start"].values,
        end=table["end"].values,
        axis=name.rsplit("[", maxsplit=1)[-1].rstrip("]"),
    )
    part.fields = {
        "days": int(seen.size),
        "seen": int(seen.sum()),
        "rms_nT": float(np.sqrt(np.mean(told.value**2))),
        "slope_rms_nT": float(np.sqrt(np.mean(told.slope**2))),
    }
    part.say(
        f"On {seen.sum()} of {seen.size} days the spread of the products' residual is above its noise "
        f"(hollow marks: the others); the offsets it tells are {part.fields['rms_nT']:.3g} nT rms, those of "
        f"the slope {part.fields['slope_rms_nT']:.3g} nT. A spread has no sign: it takes the slope's."
    )
    part.plots.append(offsets_figure(told))
    return part
