"""Sections of the whole-mission report: what was fitted, currents that step, torquers, offsets.

Each function takes `ChainResults` and returns a `ChannelFactor`: fields, paragraphs and figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from bokeh.layouts import column

from inflight.arrays import Floats
from inflight.calibration import PARAMETER_GROUPS, Jumps, table_jumps, trend_jumps, vector_sensor_of
from inflight.dipole import dipole_split
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
    stack_figures,
    torquer_mean_figures,
    unique_labels,
)
from inflight.mission_fit import (
    CURRENT_WINDOW_DAYS,
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
from inflight.model import component_names
from inflight.tasks.pipelines.base import Part, with_error
from inflight.tasks.pipelines.mission.fit import MissionFitResults
from inflight.tasks.pipelines.mission.tables import node_times
from inflight.time import Int64, to_utc

#: How the nine parameters are shown: part, title, factor, unit.
SHOWN = (
    ("scale_factor", "Scale factors", 1e6, "ppm"),
    ("misalignment", "Misalignment angles", 3600.0, "arcsec"),
    ("offset", "Offsets", 1.0, "nT"),
)


def matrix_table(corner: str, rows: Sequence[str], columns: Sequence[str], value: Any, sigma: Any) -> str:
    """Return a table of values with errors, rows by columns."""
    cells = [
        [name, *(with_error(float(one), float(own)) for one, own in zip(*pair, strict=True))]
        for name, pair in zip(rows, zip(value, sigma, strict=True), strict=True)
    ]
    return html_table([corner, *columns], cells)


def residual(found: MissionFitResults) -> Part:
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
    part.add_text(
        f"{rms[0]:.4g} nT before, {rms[1]:.4g} nT with each day's own nine parameters and all else as "
        f"known before; {rms[2]:.4g} nT in the products, with the values of all days together."
        if np.isfinite(rms[2])
        else f"{rms[0]:.4g} nT before, {rms[1]:.4g} nT with each day's own nine parameters."
    )
    if not np.isfinite(after).all():
        count = int(np.isfinite(after).sum())
        part.add_absent(
            "Residual of all products",
            f"{count} of {after.size} days have products of this fit; 'inflight reprocess' makes them",
        )
    shown, name = (after, "all days together") if np.isfinite(rms[2]) else (own, "own nine")
    part.plots.append(daily_figure(to_utc(table["start"].values), before, shown, nan, ("before", name)))
    return part


def _rms(values: Floats, weight: Floats) -> float:
    use = np.isfinite(values) & (weight > 0)
    return float(np.sqrt(np.average(values[use] ** 2, weights=weight[use]))) if use.any() else float("nan")


def coefficients(found: MissionFitResults) -> Part:
    """Every coefficient: value, sigma, unit, whether the data tell it, and how far it went."""
    part = Part("coefficients", "Coefficients")
    rows = coefficient_rows(found)
    part.fields = {"items": rows}
    known = sum(row["determined"] for row in rows)
    far = [row for row in rows if abs(row["shift_sigma"] or 0.0) > 3.0]
    part.add_text(
        f"{len(rows)} coefficients, {known} of them determined by the data. The error is that of days "
        "that differ, correlated in time. Shift: value less what was known before, in sigmas of that; what "
        "the vector sensor and the scalar sensor share shows only as their difference."
    )
    if far:
        told = "; ".join(f"{row['name']} ({row['shift_sigma']:+.1f})" for row in far)
        part.add_text(f"Beyond three sigmas of what was known: {told}.")
    part.text.append(_coefficient_table(rows))
    drawn = [row for row in rows if row["shift_sigma"] is not None]
    shift = np.array([row["shift_sigma"] for row in drawn])
    sigma = np.array([row["sigma"] / row["prior_sigma"] for row in drawn])
    names = unique_labels([short_parameter(row["name"]) for row in drawn])
    part.plots.append(prior_figure(names, shift, sigma, [row["determined"] for row in drawn]))
    return part


def coefficient_rows(found: MissionFitResults) -> list[dict[str, Any]]:
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


def _priors(found: MissionFitResults) -> dict[str, tuple[float, float]]:
    """Return what was known of each coefficient: value and sigma."""
    out = {}
    for term in free_terms(found.model):
        values = np.concatenate([term.entry.parameters[name].value[:, 0] for name in term.parameters])
        for name, value, sigma in zip(term.columns, values, term.sigma, strict=True):
            out[name] = (float(value), float(sigma))
    return out


def _units(found: MissionFitResults) -> dict[str, str]:
    """Return the units the model states, by column."""
    return {
        name: timed.parameter.unit
        for term in free_terms(found.model)
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
    return html_table(head, cells, kind="wide", folded="all values", opened=True)


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
    daily = found.tables.get("daily-after")
    if daily is None:
        part.add_absent("Parameters of each day", found.why("daily-after"))
    names = [str(name) for name in table["parameter"].values]
    for kind_of, title, factor, unit in SHOWN:
        own = [name for name in names if f".{kind_of}[" in name]
        points = (daily if daily is not None else table).sel(parameter=own)
        part.plots.append(continuous_figure(points, table.sel(parameter=own), title, factor, unit))
    choice = found.tables.get("trend-choice")
    if choice is None:
        part.add_absent(
            "Rival trends", found.skipped.get("trend-choice", "the trend was stated, or too few days")
        )
        return part
    comparison = rivals_of(choice)
    part.add_text(comparison.told() + ".")
    part.fields["told"] = comparison.told()
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
    part = Part("jumps", "Jumps between intervals")
    window = found.tables.get("window")
    if window is None:
        part.add_absent("Jumps of a table of windows", found.why("window"))
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
            part.add_absent("Jumps of a table of windows", "the span holds no boundary between two windows")
            return
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

    part.add_if_possible("Jumps of a table of windows", make)
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


_AXES = ("x", "y", "z")

#: Rough directions that are drawn apart.
_DIRECTIONS = ((-1, "drops"), (1, "rises"))


def current_steps(found: MissionFitResults) -> Part:
    """The field of the current that steps, from superposed epochs."""
    part = Part("current_steps", "Currents that step")
    table, epochs = found.tables.get("current-steps"), found.epochs
    if table is None or epochs is None:
        part.add_absent("Field of a current from its steps", found.why("current-steps"))
        return part
    names = [str(name) for name in table["current"].values]
    told = " and ".join(name.replace("_", " ") for name in names)
    value, sigma = table["value"].values, table["sigma"].values
    part.fields = {
        "currents": names,
        "epochs": int(table.attrs["epochs"]),
        "days": int(table.attrs["days"]),
        "value": value,
        "sigma": sigma,
        "determined": table["determined"].values,
        "unit": "nT/A",
        "at": "difference",
        "placebo": float(table.attrs["placebo"]),
    }
    count, days = table.attrs["epochs"], table.attrs["days"]
    part.add_text(
        f"{count} steps of the {told} on {days} days. The residual's own steps tell the field per ampere at "
        "the vector sensor less that at the scalar sensor; what follows the orbit does not enter. Where "
        f"nothing steps the same contrasts scatter by {table.attrs['placebo']:.2f} of their white noise."
    )
    part.text.append(matrix_table("nT/A, difference", names, _AXES, value, sigma))
    _confounding(part, table)
    part.add_if_possible("Split into both sensors' fields", lambda: _split(part, found, table))
    for direction, name in _DIRECTIONS:
        chosen = epochs.isel(epoch=np.flatnonzero(np.sign(epochs["step"].values[:, 0]) == direction))
        if not chosen.sizes["epoch"]:
            part.add_absent(f"Mean curve of {name}", f"no epoch is one of {name}")
            continue
        stacked = partial(_stacked, part, chosen, value[0], told)
        part.add_if_possible(f"Mean curve of {name}", stacked)
    return part


def _confounding(part: Part, table: xr.Dataset) -> None:
    names = [str(name) for name in table["confounder"].values]
    numbers = zip(table["correlation"].values, table["slope"].values, strict=True)
    rows = [(name, float(one), float(slope)) for name, (one, slope) in zip(names, numbers, strict=True)]
    part.fields["confounding"] = [
        {"channel": name, "correlation": one, "slope": slope} for name, one, slope in rows
    ]
    if not rows:
        return
    cells = [(name, f"{one:+.3f}", f"{slope:+.3g}") for name, one, slope in rows]
    part.add_text("Channels that step with it: the coefficient holds their field times the last column.")
    part.text.append(html_table(("channel", "correlation of steps", "its step for 1 A"), cells))


def _split(part: Part, found: MissionFitResults, table: xr.Dataset) -> None:
    """Tell both sensors' shares where they stand on one line through the dipole."""
    entry = found.mission.comparisons[found.comparison]
    instruments = entry.instruments()
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


def _stacked(part: Part, epochs: xr.Dataset, value: np.ndarray, name: str) -> None:
    # Both share their axis of time, so they are one figure of the page.
    part.plots.append(column(*stack_figures(stack_epochs(epochs, value), name)))


def panels(found: MissionFitResults) -> Part:
    """How the solar current's field turns with local time, and which model of panels foretells it."""
    part = Part("panels", "Solar panels")
    epochs = found.epochs
    if epochs is None:
        part.add_absent("Field by local time", found.why("panels"))
        return part
    part.add_if_possible("Choice of the panels' model", lambda: _choice(part, found, epochs))
    part.add_if_possible("Field by local time", lambda: _by_local_time(part, epochs))
    return part


def _choice(part: Part, found: MissionFitResults, epochs: xr.Dataset) -> None:
    table = found.tables.get("panels")
    if table is None:
        raise SamplesError(found.why("panels"))
    names = [str(name) for name in table["model"].values]
    scores = {name: table[name].values for name in ("score", "behind", "behind_sigma", "ties")}
    chosen = str(table.attrs["chosen"])
    value, sigma = table["value"].values, table["sigma"].values
    sentence = str(table.attrs["sentence"]).replace("_", " ")
    part.fields |= {
        "chosen": chosen,
        "sentence": sentence,
        "value": value,
        "sigma": sigma,
        "unit": "nT/A",
        "models": [
            {"model": name, **{key: one[index].item() for key, one in scores.items()}}
            for index, name in enumerate(names)
        ],
    }
    part.add_text(f"{sentence}. Taken: {chosen.replace('_', ' ')}, the simplest that is as good.")
    cells = [
        (
            name.replace("_", " "),
            f"{scores['score'][index]:.4f}",
            "best" if index == 0 else with_error(scores["behind"][index], scores["behind_sigma"][index]),
            "yes" if scores["ties"][index] else "no",
        )
        for index, name in enumerate(names)
    ]
    head = ("model", "held-out square over variance", "behind the best", "as good")
    part.text.append(html_table(head, cells))
    rows = [chosen if len(value) == 1 else f"panel {index + 1}" for index in range(len(value))]
    part.text.append(matrix_table("nT/A, difference", rows, _AXES, value, sigma))


def _by_local_time(part: Part, epochs: xr.Dataset) -> None:
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
    part.fields["by_local_time"] = [
        {"local_time_h": hour, "value": value, "sigma": sigma, "epochs": int(count)}
        for hour, value, sigma, count in zip(
            course.local_time[known],
            course.value[known],
            course.sigma[known],
            course.epochs[known],
            strict=True,
        )
    ]
    part.plots.append(local_time_figure(course, select_panel_model(epochs, local_time).chosen))


def torquers(found: MissionFitResults) -> Part:
    """The band of the torquers' modulation before and after, the matrix, and the running mean of currents."""
    part = Part("torquers", "Magneto-torquers")
    matrix, equations = found.tables.get("torquer-band"), found.band
    if matrix is None or equations is None:
        part.add_absent("Matrix from the band at 20 s", found.why("torquer-band"))
    else:
        _matrix(part, matrix, equations)
    daily, mean = found.tables.get("torquer-band-daily"), found.tables.get("torquer-band-mean")
    if daily is None or mean is None:
        part.add_absent(
            "Matrix of each day", found.why("torquer-band-daily" if daily is None else "torquer-band-mean")
        )
    else:
        part.plots += coefficient_figures(daily, mean)
    running = found.tables.get("torquer-mean")
    if running is None:
        part.add_absent("Running mean of the currents", found.why("torquer-mean"))
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
    part.add_text(
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
    arrays = {name: table[name].values for name in ("value", "sigma", "coverage", "state", "daily")}
    mean = FilledRunningMean(
        day=days, window=float(table.attrs.get("window_days", CURRENT_WINDOW_DAYS)), **arrays
    )
    last = int(np.argmax(mean.coverage))
    part.fields["running_mean"] = {
        "sentence": mean.sentence,
        "coverage": [float(mean.coverage.min()), float(mean.coverage.max())],
        "best_day_A": mean.value[last],
        "best_day_sigma_A": mean.sigma[last],
    }
    part.add_text(
        f"{mean.sentence}; the window is covered by {mean.coverage.min():.0%} to {mean.coverage.max():.0%}."
    )
    part.plots += torquer_mean_figures(mean, remanent_field(mean))


def offsets(found: MissionFitResults) -> Part:
    """Daily offsets along z from the spread of the products' residual."""
    part = Part("offsets_from_spread", "Offsets from the spread of the residual")
    table = found.tables.get("z-offset")
    if table is None:
        part.add_absent("Offsets of each day", found.why("z-offset"))
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
    part.add_text(
        f"On {seen.sum()} of {seen.size} days the spread of the products' residual is above its noise "
        f"(hollow marks: the others); the offsets it tells are {part.fields['rms_nT']:.3g} nT rms, those of "
        f"the slope {part.fields['slope_rms_nT']:.3g} nT. A spread has no sign: it takes the slope's."
    )
    part.plots.append(offsets_figure(told))
    return part
