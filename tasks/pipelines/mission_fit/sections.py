"""Sections of the whole-mission report: what was fitted, currents that step, torquers, offsets.

Each function takes `MissionFitResults` and returns a `Part`: fields, paragraphs and figures. A piece whose
table is absent, or that the span does not suffice for, is listed with the reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from bokeh.layouts import column

from inflight.arrays import Floats
from inflight.calibration import PARAMETER_GROUPS, table_boundary_steps, trend_jumps, vector_sensor_of
from inflight.dipole import dipole_split
from inflight.effects import RemanentMoment
from inflight.errors import SamplesError, SettingsError
from inflight.figures import (
    band_level_figure,
    boundary_steps_figure,
    coefficient_figures,
    comparison_figure,
    continuous_figure,
    daily_figure,
    html_table,
    local_time_figure,
    offsets_figure,
    prior_figure,
    short_parameter,
    spread_law_figure,
    stack_figures,
    torquer_lines_figure,
    torquer_mean_figures,
    unique_labels,
)
from inflight.mission_fit import (
    CURRENT_WINDOW_DAYS,
    ETA,
    FilledRunningMean,
    OffsetsFromSpread,
    RivalTrend,
    TrendComparison,
    fit_by_local_time,
    free_terms,
    remanent_field,
    select_panel_model,
    stack_epochs,
)
from inflight.model import Model, component_names
from inflight.tasks.pipelines.base import Part, with_unit
from inflight.tasks.pipelines.mission_fit.fit import MissionFitResults
from inflight.tasks.pipelines.mission_fit.tables import node_times, of_days_alone, torquer_band
from inflight.tasks.pipelines.scalar import z_offsets_of
from inflight.time import Int64, to_utc
from inflight.units import with_error


@dataclass(frozen=True, kw_only=True)
class MissionReportSettings:
    """What the report of a whole-mission fit lists.

    Attributes
    ----------
    far_sigma : float
        Coefficients farther from what was known before, in its sigmas, are named; convention.
    listed_shifts : int
        Shifts by one ignored cause that the command line lists, at most; assumed.
    listed_pairs : int
        Pairs of correlated parameters that the page lists, at most; assumed.
    mean_windows_d : tuple of float
        Windows of running means, days (Yin 2010, ch. 4).
    """

    far_sigma: float = 3.0
    listed_shifts: int = 15
    listed_pairs: int = 12
    mean_windows_d: tuple[float, ...] = (60.0, 260.0)


MISSION_REPORT_SETTINGS = MissionReportSettings()

#: How the nine parameters are shown: part, title, factor, unit.
NINE_SHOWN = (
    ("scale_factor", "Scale factors", 1e6, "ppm"),
    ("misalignment", "Misalignment angles", 3600.0, "arcsec"),
    ("offset", "Offsets", 1.0, "nT"),
)

_AXES = ("x", "y", "z")


def matrix_table(corner: str, rows: Sequence[str], columns: Sequence[str], value: Any, sigma: Any) -> str:
    """Return a table of values with errors, rows by columns."""
    cells = [
        [name, *(with_error(float(v), float(s)) for v, s in zip(*pair, strict=True))]
        for name, pair in zip(rows, zip(value, sigma, strict=True), strict=True)
    ]
    return html_table([corner, *columns], cells)


def residual(found: MissionFitResults) -> Part:
    """How far the residual falls, day by day."""
    part = Part("residual", "Residual")
    table = found.tables["continuous"]
    days = found.stored.read("before", "after")
    before, own = (np.array([float(day[name].values[0]) for day in days]) for name in ("before", "after"))
    after = np.array([float(found.reports.get(day.day, {}).get("after_nT", np.nan)) for day in found.days])
    weight = np.maximum(table["count"].values, 0.0)

    def rms(values: Floats) -> float:
        use = np.isfinite(values) & (weight > 0)
        return float(np.sqrt(np.average(values[use] ** 2, weights=weight[use]))) if use.any() else np.nan

    size = part.fields = {"before_nT": rms(before), "own_fit_nT": rms(own), "products_nT": rms(after)}
    has_products = np.isfinite(size["products_nT"])
    text = (
        f"{size['before_nT']:.4g} nT before, {size['own_fit_nT']:.4g} nT with each day's own nine parameters"
    )
    if has_products:
        text += (
            f" and all else as known before; {size['products_nT']:.4g} nT in the products, with the values "
        )
        text += "of all days together"
    part.add_text(f"{text}.")
    if not np.isfinite(after).all():
        count = int(np.isfinite(after).sum())
        part.add_absent(
            "Residual of all products",
            f"{count} of {after.size} days have products of this fit; 'inflight reprocess' makes them",
        )
    drawn, name = (after, "all days together") if has_products else (own, "own nine")
    part.plots.append(daily_figure(to_utc(table["start"].values), before, drawn, np.nan, ("before", name)))
    return part


def coefficients(found: MissionFitResults) -> Part:
    """Every coefficient: value, sigma, unit, whether the data determine it, and how far it went."""
    part = Part("coefficients", "Coefficients")
    rows = coefficient_rows(found)
    part.fields = {"items": rows}
    known = sum(row["determined"] for row in rows)
    part.add_text(
        f"{len(rows)} coefficients, {known} of them determined by the data. The error is that of days "
        "that differ, correlated in time. Shift: value less what was known before, in sigmas of that; what "
        "the vector sensor and the scalar sensor share shows only as their difference."
    )
    if far := [row for row in rows if abs(row["shift_sigma"] or 0.0) > MISSION_REPORT_SETTINGS.far_sigma]:
        listed = "; ".join(f"{row['name']} ({row['shift_sigma']:+.1f})" for row in far)
        part.add_text(f"Beyond three sigmas of what was known: {listed}.")
    cells = [
        (
            row["name"],
            with_error(row["value"], row["sigma"]),
            row["unit"],
            "yes" if row["determined"] else "no",
            with_error(row["prior"], row["prior_sigma"]),
            "" if row["shift_sigma"] is None else f"{row['shift_sigma']:+.2f}",
        )
        for row in rows
    ]
    head = ("coefficient", "value ± sigma", "unit", "determined", "known before", "shift")
    part.text.append(html_table(head, cells, kind="wide", folded="all values", opened=True))
    drawn = [row for row in rows if row["shift_sigma"] is not None]
    shift = np.array([row["shift_sigma"] for row in drawn])
    sigma = np.array([row["sigma"] / row["prior_sigma"] for row in drawn])
    names = unique_labels([short_parameter(row["name"]) for row in drawn])
    part.plots.append(prior_figure(names, shift, sigma, [row["determined"] for row in drawn]))
    return part


def coefficient_rows(found: MissionFitResults) -> list[dict[str, Any]]:
    """Return the coefficients as plain rows; a shift is None where nothing was known beforehand."""
    prior: dict[str, tuple[float, float]] = {}
    units: dict[str, str] = {}
    for term in free_terms(found.model):
        values = np.concatenate([term.entry.parameters[name].value[:, 0] for name in term.parameters])
        known = zip(values.tolist(), map(float, term.sigma), strict=True)
        prior |= dict(zip(term.columns, known, strict=True))
        for timed in term.entry.parameters.values():
            units |= dict.fromkeys(timed.columns, timed.parameter.unit)
    rows, table = [], found.tables["trend"]
    for name in map(str, table["parameter"].values):
        one = table.sel(parameter=name)
        value, (before, sigma) = float(one["value"]), prior.get(name, (np.nan, np.nan))
        rows.append(
            {
                "name": name,
                "value": value,
                "sigma": float(one["sigma"]),
                "unit": units.get(name.split("*")[0], str(one["units"].item())),
                "determined": bool(one["determined"]),
                "time": str(one["time"].item()),
                "prior": before,
                "prior_sigma": sigma,
                "shift_sigma": (value - before) / sigma if sigma > 0 and np.isfinite(before) else None,
            }
        )
    return rows


def trend(found: MissionFitResults) -> Part:
    """The scale factors in time, with the trends that were compared."""
    part = Part("trend", "Continuous parameters")
    table = found.tables["continuous"]
    kind, origin = str(table.attrs.get("trend", "")), found.tables["trend"].attrs.get("origin", "")
    part.fields = {"kind": kind, "origin": origin}
    part.add_text(
        f"Scale factors follow a {kind} trend in time{f'; {origin}' if origin else ''}; angles and offsets "
        "have one value. Points are each day's own, with everything else at the fit of all days; the line is "
        "the fit's. Its sigma is mostly common to all days: a field that both sensors may share, say."
    )
    daily = table
    with part.optional("Parameters of each day"):
        daily = of_days_alone(found.table("daily-after"))
    names = [str(name) for name in table["parameter"].values]
    for group, title, factor, unit in NINE_SHOWN:
        own = [name for name in names if f".{group}[" in name]
        points, line = daily.sel(parameter=own), table.sel(parameter=own)
        part.plots.append(continuous_figure(points, line, title, factor, unit))
    choice = found.tables.get("trend-choice")
    if choice is None:
        reason = found.skipped.get("trend-choice", "the trend was stated, or too few days")
        part.add_absent("Rival trends", reason)
        return part
    comparison = rivals_of(choice)
    part.add_text(comparison.summary() + ".")
    part.fields["told"] = comparison.summary()
    part.fields["rivals"] = [vars(one) for one in comparison.rivals]
    part.plots.append(comparison_figure(comparison))
    return part


def rivals_of(table: xr.Dataset) -> TrendComparison:
    """Return a comparison of trends from its table."""
    rivals = [
        RivalTrend(
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


def jumps(found: MissionFitResults) -> Part:
    """Steps of a table of windows at their boundaries against the continuous parameters'."""
    part, what = Part("jumps", "Jumps between intervals"), "Jumps of a table of windows"
    with part.optional(what):
        steps, continuous = table_boundary_steps(found.table("window")), found.tables["continuous"]
        inside = (steps.at > continuous["start"].values[0]) & (steps.at < continuous["end"].values[-1])
        own = replace(
            steps,
            at=steps.at[inside],
            mean=steps.mean[inside],
            rms=steps.rms[inside],
            sigma=steps.sigma[inside],
        )
        if not own.at.size:
            part.add_absent(what, "the span holds no boundary between two windows")
            return part
        common = trend_jumps(lambda times: nine_at(found, times), own.at)
        sizes = [float(np.sqrt(np.mean(one.rms**2))) for one in (own, common)]
        part.fields = {
            "boundaries": int(own.at.size),
            "strength_nT": own.strength,
            "window_rms_nT": sizes[0],
            "continuous_rms_nT": sizes[1],
        }
        part.add_text(
            f"At {own.at.size} boundaries the windows' field of {own.strength:.0f} nT steps by "
            f"{sizes[0]:.3g} nT rms over directions, the continuous one by {sizes[1]:.2g} nT."
        )
        part.plots.append(boundary_steps_figure(own, common))
    return part


def nine_at(found: MissionFitResults, times: Int64) -> Floats:
    """Return the nine fitted parameters at TT2000 times; (time, 9)."""
    own = vector_sensor_of(found.fitted)
    columns = []
    for name in PARAMETER_GROUPS:
        value = own.parameters[name]
        size = len(component_names(value.key, value.parameter))
        columns.append(np.broadcast_to(value.at(times), (times.size, size)))
    return np.concatenate(columns, axis=1)


def current_steps(found: MissionFitResults) -> Part:
    """The field of the current that steps, from superposed epochs."""
    part = Part("current_steps", "Currents that step")
    table, epochs = found.tables.get("current-steps"), found.epochs
    if table is None or epochs is None:
        part.add_absent("Field of a current from its steps", found.why_absent("current-steps"))
        return part
    names = [str(name) for name in table["current"].values]
    title = " and ".join(name.replace("_", " ") for name in names)
    value, sigma = table["value"].values, table["sigma"].values
    count, days, placebo = (table.attrs[name] for name in ("epochs", "days", "placebo"))
    part.fields = {
        "currents": names,
        "epochs": int(count),
        "days": int(days),
        "value": value,
        "sigma": sigma,
        "determined": table["determined"].values,
        "unit": "nT/A",
        "at": "difference",
        "placebo": float(placebo),
    }
    part.add_text(
        f"{count} steps of the {title} on {days} days. The residual's own steps tell the field per ampere at "
        "the vector sensor less that at the scalar sensor; what follows the orbit does not enter. Where "
        f"nothing steps the same contrasts scatter by {placebo:.2f} of their white noise."
    )
    part.text.append(matrix_table("nT/A, difference", names, _AXES, value, sigma))
    if "day_night" in table:
        _add_light(part, table)
    confounders = zip(
        *(table[name].values.tolist() for name in ("confounder", "correlation", "slope")), strict=True
    )
    rows = part.fields["confounding"] = [
        {"channel": str(name), "correlation": correlation, "slope": slope}
        for name, correlation, slope in confounders
    ]
    if rows:
        cells = [(one["channel"], f"{one['correlation']:+.3f}", f"{one['slope']:+.3g}") for one in rows]
        part.add_text("Channels that step with it: the coefficient holds their field times the last column.")
        part.text.append(html_table(("channel", "correlation of steps", "its step for 1 A"), cells))
    with part.optional("Split into both sensors' fields"):
        _add_dipole_split(part, found, table)
    for direction, name in ((-1, "drops"), (1, "rises")):
        chosen = epochs.isel(epoch=np.flatnonzero(np.sign(epochs["step"].values[:, 0]) == direction))
        if not chosen.sizes["epoch"]:
            part.add_absent(f"Mean curve of {name}", f"no epoch is one of {name}")
            continue
        with part.optional(f"Mean curve of {name}"):
            # Both share their axis of time, so they are one figure of the page.
            part.plots.append(column(*stack_figures(stack_epochs(chosen, value[0]), title)))
    return part


def _add_light(part: Part, table: xr.Dataset) -> None:
    """Add the field of day and night that was fitted beside the current."""
    value, sigma = table["day_night"].values, table["day_night_sigma"].values
    determined = table["day_night_determined"].values
    part.fields["day_night"] = {"value": value, "sigma": sigma, "determined": determined, "unit": "nT"}
    part.add_text(
        "A field of day and night is fitted beside: the current does not take what steps with the light. "
        + "; ".join(
            f"{axis} {number:.3g} +- {error:.2g} nT" if known else f"{axis} not determined"
            for axis, number, error, known in zip(_AXES, value, sigma, determined, strict=True)
        )
        + "."
    )


def _add_dipole_split(part: Part, found: MissionFitResults, table: xr.Dataset) -> None:
    """Add both sensors' shares where they stand on one line through the dipole."""
    instruments = found.mission.comparisons[found.comparison].instruments()
    places = [found.mission.instruments[instruments[role]].position for role in ("vector", "scalar")]
    if any(place is None for place in places):
        raise SettingsError("the mission does not say where both sensors stand", remedy="state 'position'")
    if table.sizes["current"] != 1:
        raise SettingsError("several currents were fitted together", remedy="fit one")
    made = dipole_split(
        table["value"].values[0],
        np.array(places[0], dtype=np.float64),
        np.array(places[1], dtype=np.float64),
        covariance=table["covariance"].values[0, :, 0, :],
    )
    part.fields["dipole"] = {
        "vector": made.vector,
        "sigma_vector": made.sigma_vector,
        "scalar": made.scalar,
        "sigma_scalar": made.sigma_scalar,
        "factors": list(made.factor),
    }
    part.add_text(
        f"If it is one dipole at the origin of the positions, the vector sensor has {made.factor[0]:.4f} of "
        f"the difference, the scalar sensor {made.factor[1]:.4f}."
    )
    rows = (made.vector, made.scalar), (made.sigma_vector, made.sigma_scalar)
    part.text.append(matrix_table("nT/A, dipole", ("vector sensor", "scalar sensor"), _AXES, *rows))


def panels(found: MissionFitResults) -> Part:
    """How the solar current's field turns with local time, and which model of panels predicts it."""
    part = Part("panels", "Solar panels")
    epochs = found.epochs
    if epochs is None:
        part.add_absent("Field by local time", found.why_absent("panels"))
        return part
    with part.optional("Choice of the panels' model"):
        _add_panel_models(part, found.table("panels"))
    with part.optional("Field by local time"):
        _add_local_time(part, epochs)
    return part


def _add_panel_models(part: Part, table: xr.Dataset) -> None:
    """Add the models of panels by their held-out scores, and the coefficients of the chosen one."""
    keys = ("score", "behind", "behind_sigma", "ties")
    rows = zip(*(table[key].values.tolist() for key in keys), strict=True)
    models = [
        {"model": str(name), **dict(zip(keys, row, strict=True))}
        for name, row in zip(table["model"].values, rows, strict=True)
    ]
    chosen, sentence = str(table.attrs["chosen"]), str(table.attrs["sentence"]).replace("_", " ")
    value, sigma = table["value"].values, table["sigma"].values
    part.fields |= {
        "chosen": chosen,
        "sentence": sentence,
        "value": value,
        "sigma": sigma,
        "unit": "nT/A",
        "models": models,
    }
    part.add_text(f"{sentence}. Taken: {chosen.replace('_', ' ')}, the simplest that is as good.")
    cells = [
        (
            one["model"].replace("_", " "),
            f"{one['score']:.4f}",
            "best" if index == 0 else with_error(one["behind"], one["behind_sigma"]),
            "yes" if one["ties"] else "no",
        )
        for index, one in enumerate(models)
    ]
    head = ("model", "held-out square over variance", "behind the best", "as good")
    part.text.append(html_table(head, cells))
    names = [chosen if len(value) == 1 else f"panel {index + 1}" for index in range(len(value))]
    part.text.append(matrix_table("nT/A, difference", names, _AXES, value, sigma))


def _add_local_time(part: Part, epochs: xr.Dataset) -> None:
    """Add the field per ampere in bins of local time, where the steps fill two at least."""
    local_time = node_times(epochs)
    if local_time is None:
        raise SamplesError(
            "epochs do not know the orbit's local time", remedy="give the mission the orbit's positions"
        )
    course = fit_by_local_time(epochs, local_time)
    known = np.isfinite(course.value).all(axis=1)
    if known.sum() < 2:
        hours = np.nanmin(local_time), np.nanmax(local_time)
        raise SamplesError(
            f"the steps lie at {hours[0]:.1f} to {hours[1]:.1f} h of local time, in {int(known.sum())} of "
            f"{known.size} bins with days enough",
            remedy="a turn of local time takes 260.5 days",
        )
    columns = (course.local_time, course.value, course.sigma, course.epochs)
    part.fields["by_local_time"] = [
        {"local_time_h": hour, "value": value, "sigma": sigma, "epochs": int(count)}
        for hour, value, sigma, count in zip(*(one[known] for one in columns), strict=True)
    ]
    part.plots.append(local_time_figure(course, select_panel_model(epochs, local_time).chosen))


def torquers(found: MissionFitResults) -> Part:
    """The band of the torquers' modulation before and after, the matrix, and the running mean of currents."""
    part = Part("torquers", "Magneto-torquers")
    with part.optional("Line of each instrument at 20 s"):
        lines = found.table("torquer-lines")
        part.fields["lines"] = {
            str(sensor): {"rms_nT": float(one), "sigma_nT": float(error)}
            for sensor, one, error in zip(
                lines["sensor"].values, lines["value"].values, lines["sigma"].values, strict=True
            )
        }
        sizes = ", ".join(
            f"{sensor} {with_unit(one['rms_nT'], one['sigma_nT'], 'nT')} rms"
            for sensor, one in part.fields["lines"].items()
        )
        part.fields["lines"]["told"] = f"line at 0.05 Hz: {sizes}; {lines.attrs['told']}"
        part.add_text(
            "By the first differences of each instrument alone (Yin 2010, Fig. 3.12), what its spectrum "
            f"holds in the torquers' band above that beside it: {sizes}. Thus {lines.attrs['told']}."
        )
        part.plots.append(torquer_lines_figure(lines))
    with part.optional("Matrix from the band at 20 s"):
        _add_torquer_matrix(part, found.table("torquer-band"), torquer_band(found.stored))
    with part.optional("Matrix of each day"):
        daily = found.table("torquer-band-daily")
        part.plots += coefficient_figures(daily, found.table("torquer-band-mean"))
    with part.optional("Running mean of the currents"):
        running = found.table("torquer-mean")
        currents = FilledRunningMean(
            day=to_utc(running["start"].values).astype("datetime64[D]").astype(np.int64),
            window=float(running.attrs.get("window_days", CURRENT_WINDOW_DAYS)),
            **{name: running[name].values for name in ("value", "sigma", "coverage", "state", "daily")},
        )
        low, high, best = currents.coverage.min(), currents.coverage.max(), int(np.argmax(currents.coverage))
        part.fields["running_mean"] = {
            "sentence": currents.sentence,
            "coverage": [float(low), float(high)],
            "best_day_A": currents.value[best],
            "best_day_sigma_A": currents.sigma[best],
        }
        part.add_text(f"{currents.sentence}; the window is covered by {low:.0%} to {high:.0%}.")
        eta, eta_sigma, told = eta_at_scalar(found.fitted)
        part.fields["eta"] = {"value": eta, "sigma": eta_sigma, "unit": "nT/A", "told": told}
        part.add_text(f"The body's field at the scalar sensor is drawn with eta = {told}.")
        part.plots += torquer_mean_figures(currents, remanent_field(currents, eta=eta, eta_sigma=eta_sigma))
    return part


def eta_at_scalar(model: Model) -> tuple[float, float, str]:
    """Return eta at the scalar sensor, nT/A, its sigma, and in words where it is from.

    Of a body whose place is stated, the model's eta is that at the vector sensor.
    """
    ground = f"{ETA:g} nT/A, of CHAMP's test on ground"
    for entry in model.effects:
        if not isinstance(entry.effect, RemanentMoment):
            continue
        timed, transfers = entry.parameters["eta"], list(entry.transfers().values())
        value, sigma = float(timed.value[0, 0]), float(timed.sigma_at(0)[0])
        if not transfers and not entry.sensor.is_scalar:
            told = with_unit(value, sigma, "nT/A")
            return ETA, 0.0, f"{ground}; fitted is {told}, vector less scalar sensor: its place is not stated"
        share = 1.0 if entry.sensor.is_scalar else float(transfers[0][1, 1])
        told = with_unit(share * value, share * sigma, "nT/A")
        return share * value, share * sigma, f"{told} at the scalar sensor, fitted"
    return ETA, 0.0, f"{ground}; 'inflight add remanent_moment' fits it"


def _add_torquer_matrix(part: Part, matrix: xr.Dataset, equations: xr.Dataset) -> None:
    """Add the matrix of nT/A that the band tells, and the level of the band before and after it."""
    value, sigma = matrix["value"].values, matrix["sigma"].values
    day, before, after = band_levels(equations, value)
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
    part.add_text(
        "What the torquers' matrices lack, vector less scalar sensor, nT/A, by the band around the "
        "modulation's 20 s alone. When the vector sensor's matrix is right, its negative is added to the "
        f"scalar sensor's. The band holds {size[0]:.3g} nT before and {size[1]:.3g} nT with it."
    )
    axes, coils = ([str(name) for name in matrix[dim].values] for dim in ("axis", "coil"))
    columns = [f"coil {name}" for name in coils]
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
    squares = gram[:, -1, -1], np.einsum("i,tij,j->t", step, gram, step)
    day, which = np.unique(equations["day"].values, return_inverse=True)
    count = np.maximum(np.bincount(which, weights=rows), 1.0)
    before, after = (np.sqrt(np.maximum(np.bincount(which, weights=one), 0.0) / count) for one in squares)
    first = np.array([equations["start"].values[which == index].min() for index in range(day.size)])
    return first, before, after


def offsets(found: MissionFitResults) -> Part:
    """Daily offsets along z from the spread of the products' residual."""
    part = Part("offsets_from_spread", "Offsets from the spread of the residual")
    with part.optional("Law of the spread"):
        law = found.table("z-offset-law")
        (factor, noise), (factor_sigma, noise_sigma) = law["value"].values, law["sigma"].values
        geometry = float(law.attrs["geometry"])
        part.fields["law"] = {
            "factor": factor,
            "factor_sigma": factor_sigma,
            "geometry": geometry,
            "noise_nT2": noise,
            "noise_sigma_nT2": noise_sigma,
            "days": int(law.attrs["days"]),
        }
        part.add_text(
            f"Over {law.attrs['days']} days std^2(dB) = ({with_error(factor, factor_sigma)}) Z0^2 + "
            f"({with_error(noise, noise_sigma)}) nT^2 (Yin 2010, eq. 3.6), Z0 a day's own offset along z "
            f"less the common one; the orbit's own factor is {geometry:.4f}."
        )
        part.plots.append(spread_law_figure(law))
    with part.optional("Offsets of each day"):
        own = found.table("z-offset").isel(parameter=0)
        seen, unknown = own["determined"].values.astype(bool), np.full(own.sizes["interval"], np.nan)
        daily = OffsetsFromSpread(
            unknown,
            unknown,
            **{name: own[name].values for name in ("value", "sigma", "wrong_sign", "slope", "sigma_slope")},
            seen=seen,
            start=own["start"].values,
            end=own["end"].values,
            axis=str(own["parameter"].item()).rsplit("[", maxsplit=1)[-1].rstrip("]"),
        )
        size, slope, error = (
            float(np.sqrt(np.mean(one**2))) for one in (daily.value, daily.slope, daily.sigma)
        )
        part.fields |= {
            "days": int(seen.size),
            "seen": int(seen.sum()),
            "rms_nT": size,
            "slope_rms_nT": slope,
            "sigma_rms_nT": error,
            "applied": bool(z_offsets_of(found.fitted)),
        }
        part.add_text(
            f"On {seen.sum()} of {seen.size} days the spread of the products' residual, with no such offset "
            "taken off, is above its noise "
            f"(hollow marks: the others); the offsets it tells are {size:.3g} nT rms, with errors of "
            f"{error:.3g} nT, those of "
            f"the slope {slope:.3g} nT. A spread has no sign: it takes the slope's."
        )
        part.plots.append(offsets_figure(daily))
    return part
