"""Sections of the whole-mission report on parameters, and on what the model does not hold.

Daily parameters: periods, means, steps, clock, temperature. What the model does not hold: the coil's lag, day
and night, cross-talk. Each function takes `ChainResults` and returns a `ChannelFactor`.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

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
from inflight.tasks.pipelines.base import Part, with_error
from inflight.tasks.pipelines.mission.fit import MissionFitResults
from inflight.tasks.pipelines.mission.sections import SHOWN
from inflight.tasks.pipelines.mission.tables import SHORTEST, faults_of, middles, spectra_of, stated_periods
from inflight.time import DAY, mjd2000, to_tt2000

#: Windows of running means, days (Yin 2010, ch. 4).
WINDOWS = (60.0, 260.0)


def display_units(daily: xr.Dataset) -> dict[str, tuple[float, str]]:
    """Return factor and unit each daily parameter is shown with."""
    out = {}
    for name in map(str, daily["parameter"].values):
        own = [(factor, unit) for part, _, factor, unit in SHOWN if f".{part}[" in name]
        seconds = str(daily["units"].sel(parameter=name).item()) == "s"
        out[name] = own[0] if own else ((1e3, "ms") if seconds else (1.0, ""))
    return out


def deviation_of(daily: xr.Dataset, name: str, factor: float) -> tuple[Floats, Floats]:
    """Return a daily parameter less the continuous one, and its sigma; (interval,), times a factor."""
    one = daily.sel(parameter=name)
    return factor * (one["value"].values - one["continuous"].values), factor * one["sigma"].values


def behaviour(found: MissionFitResults) -> Part:
    """What still wanders from day to day: size, periods, running means, steps."""
    part = Part("behaviour", "Behaviour of daily parameters")
    daily = found.tables.get("daily-after")
    if daily is None:
        part.add_absent("Parameters of each day", found.why("daily-after"))
        return part
    part.add_text(
        "Each day's own parameters less the continuous ones, everything else at the fit of all days. What "
        "is left here repeats, steps or wanders beyond what a trend can say."
    )
    _scatter(part, daily)
    _periods(part, found, daily)
    _means(part, daily)
    _steps(part, found, daily)
    _weekdays(part, daily)
    return part


def _scatter(part: Part, daily: xr.Dataset) -> None:
    rows, cells = [], []
    for name, (factor, unit) in display_units(daily).items():
        left, sigma = deviation_of(daily, name, factor)
        known = np.isfinite(left)
        if not known.any():
            continue
        size, usual = float(left[known].std()), float(np.median(sigma[known]))
        pull = float(np.sqrt(np.mean((left[known] / sigma[known]) ** 2)))
        rows.append({"parameter": name, "unit": unit, "scatter": size, "sigma": usual, "over_sigma": pull})
        cells.append((short_parameter(name), f"{size:.3g}", f"{usual:.3g}", unit, f"{pull:.2f}"))
    part.fields["scatter"] = rows
    part.text.append(html_table(("parameter", "scatter of days", "sigma of a day", "unit", "ratio"), cells))


def _periods(part: Part, found: MissionFitResults, daily: xr.Dataset) -> None:
    known, shown = stated_periods(found.mission), display_units(daily)
    short = [name for name, length in found.mission.periods.items() if length < SHORTEST * DAY]
    if short:
        part.add_text(
            f"Shorter than {SHORTEST:g} days and not in daily values: {', '.join(short)}.", quiet=True
        )
    spectra, why = spectra_of(daily, known, shown)
    for reason in dict.fromkeys(why.values()):
        names = [short_parameter(name) for name, one in why.items() if one == reason]
        part.add_absent("Periods", f"{', '.join(names)}: {reason}" if spectra else reason)
    part.fields["periods"] = {name: one.told() for name, one in spectra.items()}
    unresolved: dict[str, str] = {}
    cells = []
    for name, one in spectra.items():
        for period in one.named:
            if period.resolved:
                told = with_error(period.amplitude, period.sigma)
                cells.append(
                    (short_parameter(name), period.name, told, one.unit, f"{period.false_alarm:.2g}")
                )
            else:
                unresolved.setdefault(period.name, period.why)
        part.plots.append(parameter_spectrum_figure(one, f"Periods in {short_parameter(name)}"))
    for name, reason in unresolved.items():
        part.add_absent(f"Period {name}", f"not resolved, {reason}")
    if cells:
        part.text.append(html_table(("parameter", "period", "amplitude", "unit", "chance"), cells))


def _means(part: Part, daily: xr.Dataset) -> None:
    """Draw running means of all parameters; a window that does not fit is told once."""
    mjd = middles(daily)
    why: dict[str, str] = {}
    for name, (factor, unit) in display_units(daily).items():
        left, _ = deviation_of(daily, name, factor)
        means = []
        for window in WINDOWS:
            try:
                means.append(running_mean(mjd, left, window, unit=unit))
            except InflightError as error:
                why.setdefault(f"Running mean of {window:g} d", error.message)
        if means:
            title = f"Running means of {short_parameter(name)}"
            part.plots.append(running_means_figure(mjd, left, means, title))
            part.fields.setdefault("running_means", {})[name] = [_reach(one) for one in means]
    for what, reason in why.items():
        part.add_absent(what, reason)


def _reach(mean: RunningMean) -> dict[str, Any]:
    known = np.isfinite(mean.value)
    return {
        "window_days": mean.window,
        "days": int(known.sum()),
        "lowest": float(mean.value[known].min()),
        "highest": float(mean.value[known].max()),
        "sigma": float(np.median(mean.sigma[known])),
        "unit": mean.unit,
    }


def _steps(part: Part, found: MissionFitResults, daily: xr.Dataset) -> None:
    """Tell the steps on the mission's event days."""
    first, last = (int(daily[name].values[index]) for name, index in (("start", 0), ("end", -1)))
    events = [one for one in found.mission.events if first <= int(to_tt2000(_instant(one.at))) < last]
    if not events:
        stated = len(found.mission.events)
        part.add_absent(
            "Steps on event days",
            f"the mission's file names {stated or 'no'} events{', none in the span' * bool(stated)}",
        )
        return
    at = mjd2000(np.array([int(to_tt2000(_instant(one.at))) for one in events], dtype=np.int64))
    mjd = middles(daily)
    why: dict[str, str] = {}
    told: dict[str, Any] = {}
    for name, (factor, unit) in display_units(daily).items():
        left, sigma = deviation_of(daily, name, factor)
        try:
            steps = measure_event_steps(mjd, left, sigma, at, unit=unit)
        except InflightError as error:
            why.setdefault(error.message, name)
            continue
        told[name] = [
            {"event": one.name, "step": float(size), "sigma": float(own), "found": bool(beyond), "unit": unit}
            for one, size, own, beyond in zip(events, steps.size, steps.sigma, steps.found, strict=True)
        ]
        part.plots.append(event_steps_figure(steps, f"Steps of {short_parameter(name)} on event days"))
    part.fields["steps"] = told
    for reason in why:
        part.add_absent("Steps on event days", reason)


def _instant(text: Any) -> np.datetime64:
    return np.datetime64(str(text).removesuffix("Z"), "ns")


def _weekdays(part: Part, daily: xr.Dataset) -> None:
    """Tell whether parameters step on one day of the week."""
    mjd = middles(daily)
    why: dict[str, str] = {}
    told: dict[str, str] = {}
    for name, (factor, unit) in display_units(daily).items():
        try:
            told[name] = find_week_pattern(mjd, deviation_of(daily, name, factor)[0], unit=unit).told()
        except InflightError as error:
            why.setdefault(error.message, name)
    part.fields["weekdays"] = told
    if told:
        part.text.append(
            html_table(("parameter", "days of the week"), [(short_parameter(k), v) for k, v in told.items()])
        )
    for reason in why:
        part.add_absent("Steps on a day of the week", reason)


def clock(found: MissionFitResults) -> Part:
    """Spans of days on which a clock was wrong."""
    part = Part("clock_faults", "Clock")
    daily = found.tables.get("daily-after")
    if daily is None:
        part.add_absent("Time shift of each day", found.why("daily-after"))
        return part

    def make() -> None:
        faults, shift = faults_of(daily)
        told = faults.told()
        known = np.isfinite(shift)
        usual = 1e3 * float(np.median(shift[known]))
        part.fields = {"faults": [vars(one) for one in faults.faults], "told": told, "usual_ms": usual}
        part.add_text(
            f"The time shift is usually {usual:.3f} ms. "
            + ("; ".join(told) if told else "No span of days stands out.")
        )
        part.plots.append(clock_figure(faults, shift, _sigma_of_shift(daily)))

    part.add_if_possible("Clock faults", make)
    return part


def _sigma_of_shift(daily: xr.Dataset) -> Floats:
    name = next(str(one) for one in daily["parameter"].values if ".seconds" in str(one))
    return np.asarray(daily["sigma"].sel(parameter=name).values)


def temperature(found: MissionFitResults) -> Part:
    """Daily parameters against the day's temperature: what they follow still, and the loop."""
    part = Part("temperature", "Against temperature")
    daily, warm = found.tables.get("daily-after"), found.tables.get("daily-temperature")
    if daily is None or warm is None:
        part.add_absent(
            "Parameters against temperature",
            found.why("daily-after" if daily is None else "daily-temperature"),
        )
        return part
    channel = str(warm["channel"].values[0])
    degrees = _on_days(warm, daily["start"].values)
    part.fields = {"channel": channel, "correlation": {}, "loops": {}}
    part.add_text(
        f"Daily means of {channel.replace('_', ' ')}; parameters are each day's own less the continuous ones."
    )
    why: dict[str, str] = {}
    for name, (factor, unit) in display_units(daily).items():
        left, sigma = deviation_of(daily, name, factor)
        both = np.isfinite(left) & np.isfinite(degrees)
        if both.sum() < 3:
            why.setdefault(f"{int(both.sum())} days have parameter and temperature", name)
            continue
        short = short_parameter(name)
        part.fields["correlation"][name] = float(np.corrcoef(degrees[both], left[both])[0, 1])
        try:
            loop = hysteresis_loop(middles(daily), degrees, left, unit)
        except InflightError as error:
            why.setdefault(error.message, name)
            part.plots.append(
                temperature_figure(
                    degrees[both], left[both], sigma[both], f"{short} against temperature", unit
                )
            )
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


def _on_days(warm: xr.Dataset, start: np.ndarray) -> Floats:
    """Return the first channel's daily means at days' starts; NaN where there is none."""
    known = dict(zip(warm["start"].values.tolist(), warm["value"].values[:, 0].tolist(), strict=True))
    return np.array([known.get(one, np.nan) for one in start.tolist()])


#: Pairs that are listed.
_PAIRS = 12

#: Factor and unit of an angle that is shown.
_ANGLE = (3600.0, "arcsec")


def coil_temperature(found: MissionFitResults) -> Part:
    """What the scale factors follow: coefficients of the coil's temperature, its lag, and rivals."""
    part = Part("coil_temperature", "Temperature of the coil")
    table = found.tables.get("coil-temperature")
    if table is None:
        part.add_absent("Lag of the coil's temperature", found.why("coil-temperature"))
    else:
        fit = CoilFit.of_table(table)
        part.fields = _values(table) | {"told": fit.told(), "channel": fit.channel}
        part.add_text(
            f"Fitted with everything else: {fit.told()}, to first order about the lag it was aligned with."
        )
        part.text.append(_value_table(table))
        part.plots.append(scale_curves_figure(fit, _range(found, fit)))
    rivals = found.tables.get("temperature-rivals")
    if rivals is None:
        part.add_absent("Rival temperatures", found.why("temperature-rivals"))
        return part
    choice = TemperatureChoice.of_table(rivals)
    part.fields["rivals"] = [vars(one) | {"tied": one.ties} for one in choice.rivals]
    part.fields["choice"] = choice.told()
    part.add_text(f"Each with linear and quadratic coefficients and a lag of its own: {choice.told()}.")
    part.plots.append(rivals_figure(choice))
    return part


def _range(found: MissionFitResults, fit: CoilFit) -> np.ndarray:
    """Return temperatures over the range that days had, degC; ten about the reference when not known."""
    warm = found.tables.get("daily-temperature")
    if warm is None or fit.channel not in warm["channel"].values:
        return np.linspace(fit.reference - 10.0, fit.reference + 10.0, 61)
    one = warm.sel(channel=fit.channel)
    low, high = (one["value"] + sign * 2.0 * one["spread"] for sign in (-1.0, 1.0))
    return np.linspace(float(low.min()), float(high.max()), 61)


def _values(table: xr.Dataset) -> dict[str, Any]:
    names = [str(name) for name in table["parameter"].values]
    columns = [table[name].values.tolist() for name in ("value", "sigma", "units", "determined", "retained")]
    keys = ("name", "value", "sigma", "unit", "determined", "retained")
    return {"items": [dict(zip(keys, row, strict=True)) for row in zip(names, *columns, strict=True)]}


def _value_table(table: xr.Dataset) -> str:
    rows = [
        (
            short_parameter(one["name"]),
            with_error(one["value"], one["sigma"]),
            one["unit"],
            "yes" if one["determined"] else "no",
            f"{one['retained']:.2g}",
        )
        for one in _values(table)["items"]
    ]
    return html_table(("", "value ± sigma", "unit", "determined", "left beside all others"), rows)


def day_night(found: MissionFitResults) -> Part:
    """The field of day and night beside the model, and what the angles of days do without and with it."""
    part = Part("day_night", "Day and night")
    for name, what in (("day-night", "Switched field"), ("day-night-series", "Series along the orbit")):
        table = found.tables.get(name)
        if table is None:
            part.add_absent(what, found.why(name))
            continue
        part.fields[name] = _values(table) | {key: table.attrs[key] for key in ("before_nT", "after_nT")}
        part.add_text(
            f"{what}, vector less scalar sensor, beside everything the model has: residual of all days "
            f"{table.attrs['before_nT']:.5g} nT without and {table.attrs['after_nT']:.5g} nT with it."
        )
        part.text.append(_value_table(table))
        if name == "day-night-series":
            part.plots.append(day_night_figure(DayNightField.of_table(table)))
    ignored, added = found.tables.get("daily-after"), found.tables.get("day-night-daily")
    if ignored is None or added is None:
        part.add_absent(
            "Wander of the angles", found.why("daily-after" if ignored is None else "day-night-daily")
        )
        return part
    _wander(part, found, ignored, added)
    return part


def _wander(part: Part, found: MissionFitResults, ignored: xr.Dataset, added: xr.Dataset) -> None:
    """Draw the angles of days without the field and with it; tell the amplitudes of the named periods."""
    angles = [name for name in map(str, added["parameter"].values) if ".misalignment[" in name]
    known = stated_periods(found.mission)
    days = np.ptp(middles(added))
    # Spectra take a second each: none where no period can be told.
    resolves = days >= MIN_CYCLES * min(known.values())
    shown = dict.fromkeys(angles, _ANGLE)
    spectra = [
        spectra_of(one.sel(parameter=angles), known, shown)[0] if resolves else {} for one in (ignored, added)
    ]
    told: dict[str, Any] = {}
    cells = []
    for name in angles:
        pair = [_less_continuous(one, name) for one in (ignored, added)]
        size = [float(np.nanstd(one["value"].values)) for one in pair]
        told[name] = {"scatter": size, "unit": _ANGLE[1], "periods": {}}
        rows = zip(*(one[name].named for one in spectra if name in one), strict=True)
        for without, *others in rows:
            if without.resolved and others:
                both = (without, others[0])
                told[name]["periods"][without.name] = [[one.amplitude, one.sigma] for one in both]
                cells.append(
                    (short_parameter(name), without.name, *(with_error(o.amplitude, o.sigma) for o in both))
                )
        title = f"{short_parameter(name)} of each day less the continuous one"
        part.plots.append(with_and_without_figure(pair[0], pair[1], name, title))
    part.fields["wander"] = told
    if cells:
        part.text.append(html_table(("angle", "period", "ignored, arcsec", "in the model, arcsec"), cells))
    else:
        part.add_absent("Periods of the angles", "the span resolves none of the named periods")


def _less_continuous(daily: xr.Dataset, name: str) -> xr.Dataset:
    one = daily.sel(parameter=[name])
    return one.assign(
        value=_ANGLE[0] * (one["value"] - one["continuous"]),
        sigma=_ANGLE[0] * one["sigma"],
        units=("parameter", [_ANGLE[1]]),
    )


def cross_talk(found: MissionFitResults, cause: str = "") -> Part:
    """What an ignored cause does to the nine, and parameters of the whole model to each other."""
    part = Part("cross_talk", "Cross-talk")
    nine, every = found.tables.get("cross-talk"), found.tables.get("cross-talk-all")
    if nine is None:
        part.add_absent("Shift of the nine", found.why("cross-talk"))
    else:
        _of_nine(part, nine)
    if every is None:
        part.add_absent("Shift of all parameters", found.why("cross-talk-all"))
        return part
    _of_all(part, every)
    if cause:
        part.fields["asked"] = cross_talk_of(every, nine, cause)
    return part


def _of_nine(part: Part, table: xr.Dataset) -> None:
    part.fields["nine"] = _matrix(table) | {
        name: table[name].values.tolist() for name in ("before", "after", "retained")
    }
    part.add_text(
        "What a cause of the stated size, that is in the readings and not in the model, does to the nine "
        "parameters when they alone are fitted. Drawn are causes of three components at most."
    )
    every = [str(name) for name in table["ignored"].values]
    kinds = Counter(name.partition("[")[0] for name in every)
    names = [name for name in every if kinds[name.partition("[")[0]] <= len(AXES)]
    part.plots.append(ignored_effects_figure(CrossTalkTable.of_table(table, names)))
    whole = CrossTalkTable.of_table(table)
    head = (
        "ignored",
        *(f"{short_parameter(n)} ({u})" for n, u in zip(whole.parameters, whole.units, strict=True)),
    )
    head += ("before, nT", "left, nT")
    rows = [
        (short_parameter(one.label), *(f"{x:+.2g}" for x in shift), f"{before:.2g}", f"{after:.2g}")
        for one, shift, before, after in zip(
            whole.ignored, whole.shift, whole.before, whole.after, strict=True
        )
    ]
    part.text.append(html_table(head, rows, kind="wide", folded="all causes"))


def _matrix(table: xr.Dataset) -> dict[str, Any]:
    listed = ("ignored", "parameter", "value", "sigma", "units", "size", "size_units")
    return {name: table[name].values.tolist() for name in listed}


def _of_all(part: Part, table: xr.Dataset) -> None:
    names = [str(name) for name in table["parameter"].values]
    related = table["correlation"].values
    pairs = [
        (abs(related[i, j]), i, j)
        for i in range(len(names))
        for j in range(i)
        if names[i].partition(".")[0] != names[j].partition(".")[0]
    ]
    part.add_text(
        "With everything fitted together, parameters of different effects whose errors go together most: "
        "what the first does to the second when it is left out, everything else answering."
    )
    rows = []
    for _, i, j in sorted(pairs, reverse=True)[:_PAIRS]:
        told = with_error(float(table["value"].values[i, j]), float(table["sigma"].values[i, j]))
        size = f"{table['size'].values[i]:.3g} {table['size_units'].values[i]}"
        rows.append((names[i], size, names[j], told, str(table["units"].values[j]), f"{related[i, j]:+.3f}"))
    part.fields["pairs"] = [
        dict(zip(("ignored", "size", "parameter", "shift", "unit", "correlation"), row, strict=True))
        for row in rows
    ]
    part.text.append(html_table(("ignored", "size", "does to", "by", "unit", "correlation"), rows))
    groups = ["calibration"] * 9 + ["model"] * (len(names) - 9)
    part.plots.append(cross_talk_figure(CrossTalk(tuple(unique_labels(names)), tuple(groups), related)))


def cross_talk_of(every: xr.Dataset, nine: xr.Dataset | None, name: str) -> dict[str, Any]:
    """Return what one cause does: to all others fitted together, and to the nine fitted alone.

    Raises
    ------
    SettingsError
        When there is no such cause.
    """
    tables = {"together": every, "alone": nine}
    held = {key: one for key, one in tables.items() if one is not None and name in one["ignored"].values}
    if not held:
        known = sorted({str(n) for one in tables.values() if one is not None for n in one["ignored"].values})
        raise SettingsError(
            f"--cross-talk: there is no parameter {name!r}", remedy=f"choose one of {', '.join(known)}"
        )
    out: dict[str, Any] = {"ignored": name}
    for key, table in held.items():
        row = table.sel(ignored=name)
        out["size"], out["size_unit"] = float(row["size"]), str(row["size_units"].item())
        out[key] = [
            {"parameter": str(n), "shift": float(v), "sigma": float(s), "unit": str(u)}
            for n, v, s, u in zip(
                *(row[one].values for one in ("parameter", "value", "sigma", "units")), strict=True
            )
            if np.isfinite(v)
        ]
    return out
