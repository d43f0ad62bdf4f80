"""Sections of a chain's report on daily parameters: periods, means, steps, clock, temperature."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import InflightError
from inflight.estimators.behaviour import RunningMean, running_mean
from inflight.estimators.days import mjd_of
from inflight.estimators.event_steps import event_steps, week_pattern
from inflight.estimators.hysteresis import hysteresis_loop
from inflight.figures.behaviour import (
    clock_figure,
    loop_figure,
    parameter_spectrum_figure,
    running_means_figure,
    steps_figure,
)
from inflight.figures.chain import temperature_figure
from inflight.figures.naming import short_parameter
from inflight.figures.page import html_table
from inflight.tasks.chain_daily import SHORTEST, faults_of, middles, spectra_of, stated_periods
from inflight.tasks.chain_results import ChainResults
from inflight.tasks.chain_sections import SHOWN, Part, with_error
from inflight.time import DAY, to_tt2000

#: Windows of running means, days (Yin 2010, ch. 4).
WINDOWS = (60.0, 260.0)


def shown_as(daily: xr.Dataset) -> dict[str, tuple[float, str]]:
    """Return factor and unit each daily parameter is shown with."""
    out = {}
    for name in map(str, daily["parameter"].values):
        own = [(factor, unit) for part, _, factor, unit in SHOWN if f".{part}[" in name]
        seconds = str(daily["units"].sel(parameter=name).item()) == "s"
        out[name] = own[0] if own else ((1e3, "ms") if seconds else (1.0, ""))
    return out


def left_of(daily: xr.Dataset, name: str, factor: float) -> tuple[Floats, Floats]:
    """Return a daily parameter less the continuous one, and its sigma; (interval,), times a factor."""
    one = daily.sel(parameter=name)
    return factor * (one["value"].values - one["continuous"].values), factor * one["sigma"].values


def behaviour(found: ChainResults) -> Part:
    """What still wanders from day to day: size, periods, running means, steps."""
    part = Part("behaviour", "Behaviour of daily parameters")
    daily = found.tables.get("daily-after")
    if daily is None:
        part.lack("Parameters of each day", found.why("daily-after"))
        return part
    part.say(
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
    for name, (factor, unit) in shown_as(daily).items():
        left, sigma = left_of(daily, name, factor)
        known = np.isfinite(left)
        if not known.any():
            continue
        size, usual = float(left[known].std()), float(np.median(sigma[known]))
        pull = float(np.sqrt(np.mean((left[known] / sigma[known]) ** 2)))
        rows.append({"parameter": name, "unit": unit, "scatter": size, "sigma": usual, "over_sigma": pull})
        cells.append((short_parameter(name), f"{size:.3g}", f"{usual:.3g}", unit, f"{pull:.2f}"))
    part.fields["scatter"] = rows
    part.text.append(html_table(("parameter", "scatter of days", "sigma of a day", "unit", "ratio"), cells))


def _periods(part: Part, found: ChainResults, daily: xr.Dataset) -> None:
    known, shown = stated_periods(found.mission), shown_as(daily)
    short = [name for name, length in found.mission.periods.items() if length < SHORTEST * DAY]
    if short:
        part.say(f"Shorter than {SHORTEST:g} days and not in daily values: {', '.join(short)}.", quiet=True)
    spectra, why = spectra_of(daily, known, shown)
    for reason in dict.fromkeys(why.values()):
        names = [short_parameter(name) for name, one in why.items() if one == reason]
        part.lack("Periods", f"{', '.join(names)}: {reason}" if spectra else reason)
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
        part.lack(f"Period {name}", f"not resolved, {reason}")
    if cells:
        part.text.append(html_table(("parameter", "period", "amplitude", "unit", "chance"), cells))


def _means(part: Part, daily: xr.Dataset) -> None:
    """Draw running means of all parameters; a window that does not fit is told once."""
    mjd = middles(daily)
    why: dict[str, str] = {}
    for name, (factor, unit) in shown_as(daily).items():
        left, _ = left_of(daily, name, factor)
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
        part.lack(what, reason)


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


def _steps(part: Part, found: ChainResults, daily: xr.Dataset) -> None:
    """Tell the steps on the mission's event days."""
    first, last = (int(daily[name].values[index]) for name, index in (("start", 0), ("end", -1)))
    events = [one for one in found.mission.events if first <= int(to_tt2000(_instant(one.at))) < last]
    if not events:
        stated = len(found.mission.events)
        part.lack(
            "Steps on event days",
            f"the mission's file names {stated or 'no'} events{', none in the span' * bool(stated)}",
        )
        return
    at = mjd_of(np.array([int(to_tt2000(_instant(one.at))) for one in events], dtype=np.int64))
    mjd = middles(daily)
    why: dict[str, str] = {}
    told: dict[str, Any] = {}
    for name, (factor, unit) in shown_as(daily).items():
        left, sigma = left_of(daily, name, factor)
        try:
            steps = event_steps(mjd, left, sigma, at, unit=unit)
        except InflightError as error:
            why.setdefault(error.message, name)
            continue
        told[name] = [
            {"event": one.name, "step": float(size), "sigma": float(own), "found": bool(beyond), "unit": unit}
            for one, size, own, beyond in zip(events, steps.size, steps.sigma, steps.found, strict=True)
        ]
        part.plots.append(steps_figure(steps, f"Steps of {short_parameter(name)} on event days"))
    part.fields["steps"] = told
    for reason in why:
        part.lack("Steps on event days", reason)


def _instant(text: Any) -> np.datetime64:
    return np.datetime64(str(text).removesuffix("Z"), "ns")


def _weekdays(part: Part, daily: xr.Dataset) -> None:
    """Tell whether parameters step on one day of the week."""
    mjd = middles(daily)
    why: dict[str, str] = {}
    told: dict[str, str] = {}
    for name, (factor, unit) in shown_as(daily).items():
        try:
            told[name] = week_pattern(mjd, left_of(daily, name, factor)[0], unit=unit).told()
        except InflightError as error:
            why.setdefault(error.message, name)
    part.fields["weekdays"] = told
    if told:
        part.text.append(
            html_table(("parameter", "days of the week"), [(short_parameter(k), v) for k, v in told.items()])
        )
    for reason in why:
        part.lack("Steps on a day of the week", reason)


def clock(found: ChainResults) -> Part:
    """Spans of days on which a clock was wrong."""
    part = Part("clock_faults", "Clock")
    daily = found.tables.get("daily-after")
    if daily is None:
        part.lack("Time shift of each day", found.why("daily-after"))
        return part

    def make() -> None:
        faults, shift = faults_of(daily)
        told = faults.told()
        known = np.isfinite(shift)
        usual = 1e3 * float(np.median(shift[known]))
        part.fields = {"faults": [vars(one) for one in faults.faults], "told": told, "usual_ms": usual}
        part.say(
            f"The time shift is usually {usual:.3f} ms. "
            + ("; ".join(told) if told else "No span of days stands out.")
        )
        part.plots.append(clock_figure(faults, shift, _sigma_of_shift(daily)))

    part.attempt("Clock faults", make)
    return part


def _sigma_of_shift(daily: xr.Dataset) -> Floats:
    name = next(str(one) for one in daily["parameter"].values if ".seconds" in str(one))
    return np.asarray(daily["sigma"].sel(parameter=name).values)


def temperature(found: ChainResults) -> Part:
    """Daily parameters against the day's temperature: what they follow still, and the loop."""
    part = Part("temperature", "Against temperature")
    daily, warm = found.tables.get("daily-after"), found.tables.get("daily-temperature")
    if daily is None or warm is None:
        part.lack(
            "Parameters against temperature",
            found.why("daily-after" if daily is None else "daily-temperature"),
        )
        return part
    channel = str(warm["channel"].values[0])
    degrees = _on_days(warm, daily["start"].values)
    part.fields = {"channel": channel, "correlation": {}, "loops": {}}
    part.say(
        f"Daily means of {channel.replace('_', ' ')}; parameters are each day's own less the continuous ones."
    )
    why: dict[str, str] = {}
    for name, (factor, unit) in shown_as(daily).items():
        left, sigma = left_of(daily, name, factor)
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
        part.plots.append(loop_figure(loop, short))
    for reason in why:
        part.lack("Loop against temperature", reason)
    return part


def _on_days(warm: xr.Dataset, start: np.ndarray) -> Floats:
    """Return the first channel's daily means at days' starts; NaN where there is none."""
    known = dict(zip(warm["start"].values.tolist(), warm["value"].values[:, 0].tolist(), strict=True))
    return np.array([known.get(one, np.nan) for one in start.tolist()])
