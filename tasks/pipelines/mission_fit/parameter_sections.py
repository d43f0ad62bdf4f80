"""Sections of the whole-mission report on daily parameters, and on what the model does not hold.

Daily parameters: periods, means, steps, clock, temperature. What the model does not hold: the coil's lag, day
and night, cross-talk. Each function takes `MissionFitResults` and returns a `Part`. A *deviation* is a
parameter of one day less the continuous one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.diagnosis import CrossTalk
from inflight.effects import AXES
from inflight.errors import InflightError, SettingsError
from inflight.figures import (
    clock_figure,
    cross_talk_figure,
    day_night_figure,
    event_steps_figure,
    html_table,
    hysteresis_figure,
    ignored_effects_figure,
    parameter_spectrum_figure,
    rivals_figure,
    running_means_figure,
    scale_curves_figure,
    short_parameter,
    temperature_figure,
    unique_labels,
    with_and_without_figure,
)
from inflight.mission_fit import (
    MIN_CYCLES,
    CoilFit,
    CrossTalkTable,
    DayNightField,
    RunningMean,
    TemperatureChoice,
    find_week_pattern,
    hysteresis_loop,
    measure_event_steps,
    running_mean,
)
from inflight.tasks.pipelines.base import Part
from inflight.tasks.pipelines.mission_fit.fit import MissionFitResults
from inflight.tasks.pipelines.mission_fit.sections import MISSION_REPORT_SETTINGS, NINE_SHOWN
from inflight.tasks.pipelines.mission_fit.tables import (
    TABLE_SETTINGS,
    faults_of,
    middles,
    of_days_alone,
    spectra_of,
    stated_periods,
    time_shifts,
)
from inflight.time import DAY, mjd2000, to_tt2000
from inflight.units import with_error


class Deviation(NamedTuple):
    """A daily parameter less the continuous one, as it is shown.

    Attributes
    ----------
    name, short : str
        Of the parameter, as the table has it and as figures show it.
    value, sigma : ndarray, shape (interval,)
        In `unit`; NaN on days without.
    unit : str
    """

    name: str
    short: str
    value: Floats
    sigma: Floats
    unit: str


def display_units(daily: xr.Dataset) -> dict[str, tuple[float, str]]:
    """Return factor and unit each daily parameter is shown with."""
    out = {}
    for name, units in zip(daily["parameter"].values.tolist(), daily["units"].values.tolist(), strict=True):
        own = [(factor, unit) for group, _, factor, unit in NINE_SHOWN if f".{group}[" in name]
        out[name] = own[0] if own else ((1e3, "ms") if units == "s" else (1.0, ""))
    return out


def deviations(daily: xr.Dataset) -> list[Deviation]:
    """Return the deviation of every daily parameter."""
    out, daily = [], of_days_alone(daily)
    for name, (factor, unit) in display_units(daily).items():
        one = daily.sel(parameter=name)
        value = factor * (one["value"].values - one["continuous"].values)
        out.append(Deviation(name, short_parameter(name), value, factor * one["sigma"].values, unit))
    return out


def behaviour(found: MissionFitResults) -> Part:
    """What still varies from day to day: size, periods, running means, steps."""
    part = Part("behaviour", "Behaviour of daily parameters")
    with part.optional("Parameters of each day"):
        daily = found.table("daily-after")
        part.add_text(
            "Each day's own parameters less the continuous ones, everything else at the fit of all days. "
            "What is left here repeats, steps or wanders beyond what a trend can say."
        )
        series, mjd = deviations(daily), middles(daily)
        _add_scatter(part, series)
        _add_periods(part, found, daily)
        _add_means(part, series, mjd)
        _add_event_steps(part, found, daily, series)
        _add_weekdays(part, series, mjd)
    return part


def _add_scatter(part: Part, series: Sequence[Deviation]) -> None:
    """Add how far parameters scatter from day to day, against their sigma."""
    rows, cells = [], []
    for one in series:
        known = np.isfinite(one.value)
        if not known.any():
            continue
        size, usual = float(one.value[known].std()), float(np.median(one.sigma[known]))
        ratio = float(np.sqrt(np.mean((one.value[known] / one.sigma[known]) ** 2)))
        rows.append(
            {"parameter": one.name, "unit": one.unit, "scatter": size, "sigma": usual, "over_sigma": ratio}
        )
        cells.append((one.short, f"{size:.3g}", f"{usual:.3g}", one.unit, f"{ratio:.2f}"))
    part.fields["scatter"] = rows
    part.text.append(html_table(("parameter", "scatter of days", "sigma of a day", "unit", "ratio"), cells))


def _add_periods(part: Part, found: MissionFitResults, daily: xr.Dataset) -> None:
    """Add the amplitudes of the named periods, and a spectrum of each parameter."""
    shortest = TABLE_SETTINGS.shortest_period_d
    short = [name for name, length in found.mission.periods.items() if length < shortest * DAY]
    if short:
        text = f"Shorter than {shortest:g} days and not in daily values: {', '.join(short)}."
        part.add_text(text, quiet=True)
    spectra, why = spectra_of(daily, stated_periods(found.mission), display_units(daily))
    for reason in dict.fromkeys(why.values()):
        names = ", ".join(short_parameter(name) for name, one in why.items() if one == reason)
        part.add_absent("Periods", f"{names}: {reason}" if spectra else reason)
    part.fields["periods"] = {name: one.summary() for name, one in spectra.items()}
    unresolved: dict[str, str] = {}
    cells = []
    for name, spectrum in spectra.items():
        label = short_parameter(name)
        for period in spectrum.named:
            if period.resolved:
                size = with_error(period.amplitude, period.sigma)
                cells.append((label, period.name, size, spectrum.unit, f"{period.false_alarm:.2g}"))
            else:
                unresolved.setdefault(period.name, period.why)
        part.plots.append(parameter_spectrum_figure(spectrum, f"Periods in {label}"))
    for name, reason in unresolved.items():
        part.add_absent(f"Period {name}", f"not resolved, {reason}")
    if cells:
        part.text.append(html_table(("parameter", "period", "amplitude", "unit", "chance"), cells))


def _add_means(part: Part, series: Sequence[Deviation], mjd: Floats) -> None:
    """Add running means of all parameters; a window that does not fit is listed once."""
    why: dict[str, str] = {}
    for one in series:
        means: list[RunningMean] = []
        for window in MISSION_REPORT_SETTINGS.mean_windows_d:
            try:
                means.append(running_mean(mjd, one.value, window, unit=one.unit))
            except InflightError as error:
                why.setdefault(f"Running mean of {window:g} d", error.message)
        if means:
            part.plots.append(running_means_figure(mjd, one.value, means, f"Running means of {one.short}"))
            known = [(mean, np.isfinite(mean.value)) for mean in means]
            part.fields.setdefault("running_means", {})[one.name] = [
                {
                    "window_days": mean.window,
                    "days": int(use.sum()),
                    "lowest": float(mean.value[use].min()),
                    "highest": float(mean.value[use].max()),
                    "sigma": float(np.median(mean.sigma[use])),
                    "unit": mean.unit,
                }
                for mean, use in known
            ]
    for what, reason in why.items():
        part.add_absent(what, reason)


def _add_event_steps(
    part: Part, found: MissionFitResults, daily: xr.Dataset, series: Sequence[Deviation]
) -> None:
    """Add the steps on the mission's event days."""
    first, last = int(daily["start"].values[0]), int(daily["end"].values[-1])
    stated = [
        (one, int(to_tt2000(np.datetime64(str(one.at).removesuffix("Z"), "ns"))))
        for one in found.mission.events
    ]
    inside = [(one, at) for one, at in stated if first <= at < last]
    if not inside:
        part.add_absent(
            "Steps on event days",
            f"the mission's file names {len(stated) or 'no'} events{', none in the span' * bool(stated)}",
        )
        return
    mjd, at = middles(daily), mjd2000(np.array([at for _, at in inside], dtype=np.int64))
    why: dict[str, None] = {}
    fields = part.fields["steps"] = {}
    for one in series:
        try:
            steps = measure_event_steps(mjd, one.value, one.sigma, at, unit=one.unit)
        except InflightError as error:
            why.setdefault(error.message)
            continue
        numbers = zip(inside, steps.size, steps.sigma, steps.found, strict=True)
        fields[one.name] = [
            {
                "event": event.name,
                "step": float(size),
                "sigma": float(sigma),
                "found": bool(beyond),
                "unit": one.unit,
            }
            for (event, _), size, sigma, beyond in numbers
        ]
        part.plots.append(event_steps_figure(steps, f"Steps of {one.short} on event days"))
    for reason in why:
        part.add_absent("Steps on event days", reason)


def _add_weekdays(part: Part, series: Sequence[Deviation], mjd: Floats) -> None:
    """Add whether parameters step on one day of the week."""
    why: dict[str, None] = {}
    fields: dict[str, str] = {}
    for one in series:
        try:
            fields[one.name] = find_week_pattern(mjd, one.value, unit=one.unit).summary()
        except InflightError as error:
            why.setdefault(error.message)
    part.fields["weekdays"] = fields
    if fields:
        rows = [(short_parameter(name), text) for name, text in fields.items()]
        part.text.append(html_table(("parameter", "days of the week"), rows))
    for reason in why:
        part.add_absent("Steps on a day of the week", reason)


def clock(found: MissionFitResults) -> Part:
    """Spans of days on which a clock was wrong."""
    part = Part("clock_faults", "Clock")
    with part.optional("Time shift of each day"):
        daily = found.table("daily-after")
        with part.optional("Clock faults"):
            faults, shift = faults_of(daily)
            _, sigma = time_shifts(daily)
            sentences = faults.summary()
            usual = 1e3 * float(np.median(shift[np.isfinite(shift)]))
            part.fields = {
                "faults": [vars(one) for one in faults.faults],
                "told": sentences,
                "usual_ms": usual,
            }
            part.add_text(
                f"The time shift is usually {usual:.3f} ms. "
                + ("; ".join(sentences) if sentences else "No span of days stands out.")
            )
            part.plots.append(clock_figure(faults, shift, sigma))
    return part


def temperature(found: MissionFitResults) -> Part:
    """Daily parameters against the day's temperature: what they follow still, and the loop."""
    part = Part("temperature", "Against temperature")
    with part.optional("Parameters against temperature"):
        daily, temperatures = found.table("daily-after"), found.table("daily-temperature")
        first = temperatures.isel(channel=0)
        channel = str(first["channel"].item())
        means = dict(zip(first["start"].values.tolist(), first["value"].values.tolist(), strict=True))
        degrees = np.array([means.get(start, np.nan) for start in daily["start"].values.tolist()])
        part.fields = {"channel": channel, "correlation": {}, "loops": {}}
        part.add_text(
            f"Daily means of {channel.replace('_', ' ')}; parameters are each day's own less the continuous "
            "ones."
        )
        why: dict[str, None] = {}
        for name, short, value, sigma, unit in deviations(daily):
            both = np.isfinite(value) & np.isfinite(degrees)
            if both.sum() < 3:
                why.setdefault(f"{int(both.sum())} days have parameter and temperature")
                continue
            part.fields["correlation"][name] = float(np.corrcoef(degrees[both], value[both])[0, 1])
            try:
                loop = hysteresis_loop(middles(daily), degrees, value, unit)
            except InflightError as error:
                why.setdefault(error.message)
                title = f"{short} against temperature"
                part.plots.append(temperature_figure(degrees[both], value[both], sigma[both], title, unit))
                continue
            part.fields["loops"][name] = {
                "area": loop.area,
                "sigma": loop.sigma,
                "open": loop.is_open,
                "unit": f"{unit} K",
            }
            part.plots.append(hysteresis_figure(loop, short))
        for reason in why:
            part.add_absent("Loop against temperature", reason)
    return part


# --- what the model does not hold -----------------------------------------------------------------------

#: Factor and unit of an angle that is shown.
_ANGLE = (3600.0, "arcsec")


def coil_temperature(found: MissionFitResults) -> Part:
    """What the scale factors follow: coefficients of the coil's temperature, its lag, and rivals."""
    part = Part("coil_temperature", "Temperature of the coil")
    with part.optional("Lag of the coil's temperature"):
        table = found.table("coil-temperature")
        fit = CoilFit.of_table(table)
        part.fields = _coefficient_fields(table) | {"told": fit.summary(), "channel": fit.channel}
        part.add_text(
            f"Fitted with everything else: {fit.summary()}, to first order about the lag it was aligned with."
        )
        part.text.append(_coefficient_table(part.fields["items"]))
        low, high = fit.reference - 10.0, fit.reference + 10.0
        daily = found.tables.get("daily-temperature")
        if daily is not None and fit.channel in daily["channel"].values:
            own = daily.sel(channel=fit.channel)
            low = float((own["value"] - 2.0 * own["spread"]).min())
            high = float((own["value"] + 2.0 * own["spread"]).max())
        part.plots.append(scale_curves_figure(fit, np.linspace(low, high, 61)))
    with part.optional("Rival temperatures"):
        choice = TemperatureChoice.of_table(found.table("temperature-rivals"))
        part.fields["rivals"] = [vars(one) | {"tied": one.ties} for one in choice.rivals]
        part.fields["choice"] = choice.summary()
        part.add_text(
            f"Each with linear and quadratic coefficients and a lag of its own: {choice.summary()}."
        )
        part.plots.append(rivals_figure(choice))
    return part


def _coefficient_fields(table: xr.Dataset) -> dict[str, list[dict[str, Any]]]:
    """Return the coefficients of a table as plain rows."""
    names = [str(name) for name in table["parameter"].values]
    columns = [table[name].values.tolist() for name in ("value", "sigma", "units", "determined", "retained")]
    keys = ("name", "value", "sigma", "unit", "determined", "retained")
    return {"items": [dict(zip(keys, row, strict=True)) for row in zip(names, *columns, strict=True)]}


def _coefficient_table(items: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows of `_coefficient_fields` as HTML."""
    rows = [
        (
            short_parameter(one["name"]),
            with_error(one["value"], one["sigma"]),
            one["unit"],
            "yes" if one["determined"] else "no",
            f"{one['retained']:.2g}",
        )
        for one in items
    ]
    return html_table(("", "value ± sigma", "unit", "determined", "left beside all others"), rows)


def day_night(found: MissionFitResults) -> Part:
    """The field of day and night beside the model, and what daily angles do without and with it."""
    part = Part("day_night", "Day and night")
    for name, what in (("day-night", "Switched field"), ("day-night-series", "Series along the orbit")):
        with part.optional(what):
            table = found.table(name)
            before, after = table.attrs["before_nT"], table.attrs["after_nT"]
            fields = _coefficient_fields(table)
            part.fields[name] = fields | {"before_nT": before, "after_nT": after}
            part.add_text(
                f"{what}, vector less scalar sensor, beside everything the model has: residual of all days "
                f"{before:.5g} nT without and {after:.5g} nT with it."
            )
            part.text.append(_coefficient_table(fields["items"]))
            if name == "day-night-series":
                part.plots.append(day_night_figure(DayNightField.of_table(table)))
    with part.optional("Wander of the angles"):
        both = (of_days_alone(found.table(name)) for name in ("daily-after", "day-night-daily"))
        _add_angles(part, found, *both)
    return part


def _add_angles(part: Part, found: MissionFitResults, ignored: xr.Dataset, added: xr.Dataset) -> None:
    """Add the angles of days with the field ignored and in the model, and the amplitudes of named periods."""
    angles = [name for name in map(str, added["parameter"].values) if ".misalignment[" in name]
    known = stated_periods(found.mission)
    # Spectra take a second each: none where no period can be resolved.
    resolves = np.ptp(middles(added)) >= MIN_CYCLES * min(known.values())
    units = dict.fromkeys(angles, _ANGLE)
    spectra = [
        spectra_of(one.sel(parameter=angles), known, units)[0] if resolves else {} for one in (ignored, added)
    ]
    fields: dict[str, Any] = {}
    cells = []
    for name in angles:
        pair = []
        for table in (ignored, added):
            one = table.sel(parameter=[name])
            pair.append(
                one.assign(
                    value=_ANGLE[0] * (one["value"] - one["continuous"]),
                    sigma=_ANGLE[0] * one["sigma"],
                    units=("parameter", [_ANGLE[1]]),
                )
            )
        scatter = [float(np.nanstd(one["value"].values)) for one in pair]
        fields[name] = {"scatter": scatter, "unit": _ANGLE[1], "periods": {}}
        if all(name in one for one in spectra):
            for both in zip(*(one[name].named for one in spectra), strict=True):
                if both[0].resolved:
                    fields[name]["periods"][both[0].name] = [[one.amplitude, one.sigma] for one in both]
                    sizes = (with_error(one.amplitude, one.sigma) for one in both)
                    cells.append((short_parameter(name), both[0].name, *sizes))
        title = f"{short_parameter(name)} of each day less the continuous one"
        part.plots.append(with_and_without_figure(pair[0], pair[1], name, title))
    part.fields["wander"] = fields
    if cells:
        part.text.append(html_table(("angle", "period", "ignored, arcsec", "in the model, arcsec"), cells))
    else:
        part.add_absent("Periods of the angles", "the span resolves none of the named periods")


def cross_talk(found: MissionFitResults, cause: str = "") -> Part:
    """What an ignored cause does to the nine, and parameters of the whole model to each other."""
    part = Part("cross_talk", "Cross-talk")
    with part.optional("Shift of the nine"):
        _add_nine_shifts(part, found.table("cross-talk"))
    with part.optional("Shift of all parameters"):
        _add_joint_shifts(part, found.table("cross-talk-all"))
    if cause and "cross-talk-all" in found.tables:
        part.fields["asked"] = cross_talk_of(
            found.tables["cross-talk-all"], found.tables.get("cross-talk"), cause
        )
    return part


def _add_nine_shifts(part: Part, table: xr.Dataset) -> None:
    """Add what each ignored cause does to the nine parameters fitted alone."""
    listed = ("ignored", "parameter", "value", "sigma", "units", "size", "size_units")
    part.fields["nine"] = {
        name: table[name].values.tolist() for name in (*listed, "before", "after", "retained")
    }
    part.add_text(
        "What a cause of the stated size, that is in the readings and not in the model, does to the nine "
        "parameters when they alone are fitted. Drawn are causes of three components at most."
    )
    causes = [str(name) for name in table["ignored"].values]
    components = Counter(name.partition("[")[0] for name in causes)
    drawn = [name for name in causes if components[name.partition("[")[0]] <= len(AXES)]
    part.plots.append(ignored_effects_figure(CrossTalkTable.of_table(table, drawn)))
    whole = CrossTalkTable.of_table(table)
    columns = zip(whole.parameters, whole.units, strict=True)
    head = (
        "ignored",
        *(f"{short_parameter(name)} ({unit})" for name, unit in columns),
        "before, nT",
        "left, nT",
    )
    rows = [
        (short_parameter(one.label), *(f"{x:+.2g}" for x in shift), f"{before:.2g}", f"{after:.2g}")
        for one, shift, before, after in zip(
            whole.ignored, whole.shift, whole.before, whole.after, strict=True
        )
    ]
    part.text.append(html_table(head, rows, kind="wide", folded="all causes"))


def _add_joint_shifts(part: Part, table: xr.Dataset) -> None:
    """Add the pairs of parameters of different effects whose errors are most correlated."""
    names = [str(name) for name in table["parameter"].values]
    correlation = table["correlation"].values
    pairs = [
        (abs(correlation[i, j]), i, j)
        for i in range(len(names))
        for j in range(i)
        if names[i].partition(".")[0] != names[j].partition(".")[0]
    ]
    part.add_text(
        "With everything fitted together, parameters of different effects whose errors go together most: "
        "what the first does to the second when it is left out, everything else answering."
    )
    rows = []
    for _, i, j in sorted(pairs, reverse=True)[: MISSION_REPORT_SETTINGS.listed_pairs]:
        shift = with_error(float(table["value"].values[i, j]), float(table["sigma"].values[i, j]))
        size = f"{table['size'].values[i]:.3g} {table['size_units'].values[i]}"
        unit = str(table["units"].values[j])
        rows.append((names[i], size, names[j], shift, unit, f"{correlation[i, j]:+.3f}"))
    keys = ("ignored", "size", "parameter", "shift", "unit", "correlation")
    part.fields["pairs"] = [dict(zip(keys, row, strict=True)) for row in rows]
    part.text.append(html_table(("ignored", "size", "does to", "by", "unit", "correlation"), rows))
    groups = ["calibration"] * 9 + ["model"] * (len(names) - 9)
    part.plots.append(cross_talk_figure(CrossTalk(tuple(unique_labels(names)), tuple(groups), correlation)))


def cross_talk_of(joint: xr.Dataset, nine: xr.Dataset | None, name: str) -> dict[str, Any]:
    """Return what one cause does: to all others fitted together, and to the nine fitted alone.

    Raises
    ------
    SettingsError
        When there is no such cause.
    """
    tables = {"together": joint} | ({} if nine is None else {"alone": nine})
    with_cause = {key: table for key, table in tables.items() if name in table["ignored"].values}
    if not with_cause:
        known = sorted({str(one) for table in tables.values() for one in table["ignored"].values})
        raise SettingsError(
            f"--cross-talk: there is no parameter {name!r}", remedy=f"choose one of {', '.join(known)}"
        )
    out: dict[str, Any] = {"ignored": name}
    for key, table in with_cause.items():
        row = table.sel(ignored=name)
        out["size"], out["size_unit"] = float(row["size"]), str(row["size_units"].item())
        columns = (row[one].values.tolist() for one in ("parameter", "value", "sigma", "units"))
        out[key] = [
            {"parameter": str(parameter), "shift": shift, "sigma": sigma, "unit": str(unit)}
            for parameter, shift, sigma, unit in zip(*columns, strict=True)
            if np.isfinite(shift)
        ]
    return out
