"""Sections of a chain's report on what was fitted: residual, coefficients, trend, jumps."""

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
from inflight.estimators.trend_choice import Rival, TrendComparison
from inflight.figures.chain import continuous_figure, prior_figure
from inflight.figures.naming import distinct, short_parameter
from inflight.figures.page import html_table
from inflight.figures.residual import daily_figure
from inflight.figures.trends import comparison_figure, jumps_figure
from inflight.model.timed import component_names
from inflight.tasks.chain_results import ChainResults
from inflight.time import Int64, to_utc

#: Numbers smaller than this are written with an exponent.
_PLAIN = 1e-4
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
    if -10 <= place <= 0 and max(abs(value), sigma) >= _PLAIN:
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
    nan = float("nan")
    after = np.array([float(found.reports.get(day.day, {}).get("after_nT", nan)) for day in found.days])
    weight = np.maximum(table["count"].values, 0.0)
    rms = [_rms(one, weight) for one in (before, own, after)]
    part.fields = dict(zip(("before_nT", "own_fit_nT", "products_nT"), rms, strict=True))
    part.say(
        f"{rms[0]:.4g} nT before, {rms[1]:.4g} nT with each day's own nine parameters and all else as "
        f"known before; {rms[2]:.4g} nT in the products, with the values of all days together."
        if np.isfinite(rms[2])
        else f"{rms[0]:.4g} nT before, {rms[1]:.4g} nT with each day's own nine parameters."
    )
    if not np.isfinite(after).all():
        count = int(np.isfinite(after).sum())
        part.lack(
            "Residual of all products",
            f"{count} of {after.size} days have products of this fit; 'inflight reprocess' makes them",
        )
    shown, name = (after, "all days together") if np.isfinite(rms[2]) else (own, "own nine")
    part.plots.append(daily_figure(to_utc(table["start"].values), before, shown, nan, ("before", name)))
    return part


def _rms(values: Floats, weight: Floats) -> float:
    use = np.isfinite(values) & (weight > 0)
    return float(np.sqrt(np.average(values[use] ** 2, weights=weight[use]))) if use.any() else float("nan")


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
    table, prior, units = found.tables["trend"], _priors(found), _units(found)
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
                "unit": units.get(name.split("*")[0], str(table["units"].values[index])),
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


def _units(found: ChainResults) -> dict[str, str]:
    """Return the units the model states, by column."""
    return {
        name: timed.parameter.unit
        for term in terms_of(found.model)
        for timed in term.entry.parameters.values()
        for name in timed.columns
    }


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
        "have one value. Points are each day's own, with everything else at the fit of all days; the line is "
        "the fit's. Its sigma is mostly common to all days: a field that both sensors may share, say."
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
            kind=str(one["kind"].item()),
            coefficients=int(one["coefficients"]),
            rms=float(one["value"]),
            behind=float(one["behind"]),
            sigma_behind=float(one["sigma_behind"]),
            tied=bool(one["tied"]),
        )
        for one in (table.isel(kind=index) for index in range(table.sizes["kind"]))
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
