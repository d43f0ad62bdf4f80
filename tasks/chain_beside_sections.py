"""Sections of a chain's report on what the model does not hold: the coil's lag, day and night, cross-talk."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import xarray as xr

from inflight.diagnosis.tradeoffs import CrossTalk
from inflight.effects.base import AXES
from inflight.errors import SettingsError
from inflight.estimators.coil_temperature import CoilFit
from inflight.estimators.crosstalk import CrossTalkTable
from inflight.estimators.day_night import DayNightField
from inflight.estimators.periods import LEAST_TURNS
from inflight.estimators.temperature_rivals import TemperatureChoice
from inflight.figures.coil_temperature import rivals_figure, scale_curves_figure
from inflight.figures.crosstalk import cross_talk_figure, ignored_figure
from inflight.figures.day_night import day_night_figure, wandering_figure
from inflight.figures.naming import distinct, short_parameter
from inflight.figures.page import html_table
from inflight.tasks.chain_daily import middles, spectra_of, stated_periods
from inflight.tasks.chain_results import ChainResults
from inflight.tasks.chain_sections import Part, with_error

#: Pairs that are listed.
_PAIRS = 12
#: Factor and unit of an angle that is shown.
_ANGLE = (3600.0, "arcsec")


def coil_temperature(found: ChainResults) -> Part:
    """What the scale factors follow: coefficients of the coil's temperature, its lag, and rivals."""
    part = Part("coil_temperature", "Temperature of the coil")
    table = found.tables.get("coil-temperature")
    if table is None:
        part.lack("Lag of the coil's temperature", found.why("coil-temperature"))
    else:
        fit = CoilFit.of_table(table)
        part.fields = _values(table) | {"told": fit.told(), "channel": fit.channel}
        part.say(
            f"Fitted with everything else: {fit.told()}, to first order about the lag it was aligned with."
        )
        part.text.append(_value_table(table))
        part.plots.append(scale_curves_figure(fit, _range(found, fit)))
    rivals = found.tables.get("temperature-rivals")
    if rivals is None:
        part.lack("Rival temperatures", found.why("temperature-rivals"))
        return part
    choice = TemperatureChoice.of_table(rivals)
    part.fields["rivals"] = [vars(one) | {"tied": one.ties} for one in choice.rivals]
    part.fields["choice"] = choice.told()
    part.say(f"Each with linear and quadratic coefficients and a lag of its own: {choice.told()}.")
    part.plots.append(rivals_figure(choice))
    return part


def _range(found: ChainResults, fit: CoilFit) -> np.ndarray:
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


def day_night(found: ChainResults) -> Part:
    """The field of day and night beside the model, and what the angles of days do without and with it."""
    part = Part("day_night", "Day and night")
    for name, what in (("day-night", "Switched field"), ("day-night-series", "Series along the orbit")):
        table = found.tables.get(name)
        if table is None:
            part.lack(what, found.why(name))
            continue
        part.fields[name] = _values(table) | {key: table.attrs[key] for key in ("before_nT", "after_nT")}
        part.say(
            f"{what}, vector less scalar sensor, beside everything the model has: residual of all days "
            f"{table.attrs['before_nT']:.5g} nT without and {table.attrs['after_nT']:.5g} nT with it."
        )
        part.text.append(_value_table(table))
        if name == "day-night-series":
            part.plots.append(day_night_figure(DayNightField.of_table(table)))
    ignored, added = found.tables.get("daily-after"), found.tables.get("day-night-daily")
    if ignored is None or added is None:
        part.lack("Wander of the angles", found.why("daily-after" if ignored is None else "day-night-daily"))
        return part
    _wander(part, found, ignored, added)
    return part


def _wander(part: Part, found: ChainResults, ignored: xr.Dataset, added: xr.Dataset) -> None:
    """Draw the angles of days without the field and with it; tell the amplitudes of the named periods."""
    angles = [name for name in map(str, added["parameter"].values) if ".misalignment[" in name]
    known = stated_periods(found.mission)
    days = np.ptp(middles(added))
    # Spectra take a second each: none where no period can be told.
    resolves = days >= LEAST_TURNS * min(known.values())
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
        part.plots.append(wandering_figure(pair[0], pair[1], name, title))
    part.fields["wander"] = told
    if cells:
        part.text.append(html_table(("angle", "period", "ignored, arcsec", "in the model, arcsec"), cells))
    else:
        part.lack("Periods of the angles", "the span resolves none of the named periods")


def _less_continuous(daily: xr.Dataset, name: str) -> xr.Dataset:
    one = daily.sel(parameter=[name])
    return one.assign(
        value=_ANGLE[0] * (one["value"] - one["continuous"]),
        sigma=_ANGLE[0] * one["sigma"],
        units=("parameter", [_ANGLE[1]]),
    )


def cross_talk(found: ChainResults, asked: str = "") -> Part:
    """What an ignored cause does to the nine, and parameters of the whole model to each other."""
    part = Part("cross_talk", "Cross-talk")
    nine, every = found.tables.get("cross-talk"), found.tables.get("cross-talk-all")
    if nine is None:
        part.lack("Shift of the nine", found.why("cross-talk"))
    else:
        _of_nine(part, nine)
    if every is None:
        part.lack("Shift of all parameters", found.why("cross-talk-all"))
        return part
    _of_all(part, every)
    if asked:
        part.fields["asked"] = asked_for(every, nine, asked)
    return part


def _of_nine(part: Part, table: xr.Dataset) -> None:
    part.fields["nine"] = _matrix(table) | {
        name: table[name].values.tolist() for name in ("before", "after", "retained")
    }
    part.say(
        "What a cause of the stated size, that is in the readings and not in the model, does to the nine "
        "parameters when they alone are fitted. Drawn are causes of three components at most."
    )
    every = [str(name) for name in table["ignored"].values]
    kinds = Counter(name.partition("[")[0] for name in every)
    names = [name for name in every if kinds[name.partition("[")[0]] <= len(AXES)]
    part.plots.append(ignored_figure(CrossTalkTable.of_table(table, names)))
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
    part.text.append(
        f'<div class="wide"><details><summary>all causes</summary>{html_table(head, rows)}</details></div>'
    )


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
    part.say(
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
    part.plots.append(cross_talk_figure(CrossTalk(tuple(distinct(names)), tuple(groups), related)))


def asked_for(every: xr.Dataset, nine: xr.Dataset | None, name: str) -> dict[str, Any]:
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
