"""Tables of the whole-mission fit, from the days' stored statistics: the archive is not read again.

Each function takes statistics of days, or another table, and returns one table; `fit_mission_tables` calls
them in turn. What the model may lack: the coil's lag and its rivals, day and night, cross-talk
(`auxiliary_table_makers`). How daily parameters scatter after the fit of all days: values of each day, faults
of clocks, periods (`daily_after` and what is made from it). The formulas stand in `inflight.mission_fit`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NormalEquations, with_learnt_spans
from inflight.errors import CalibrationError, InflightError, SamplesError
from inflight.mission import Mission
from inflight.mission_fit import (
    KNOWN_PERIODS,
    SERIES,
    SWITCHED,
    ClockFaults,
    JointDayNight,
    MissionFit,
    ParameterSpectrum,
    compare_temperatures_jointly,
    concat_band_equations,
    daily_parameters,
    day_night_columns,
    filled_running_mean,
    find_clock_faults,
    fit_coil_lag,
    fit_day_night_jointly,
    free_terms,
    held_variance,
    joint_cross_talk,
    nine_parameter_cross_talk,
    node_local_time,
    offsets_from_spread,
    parameter_spectrum,
    residual_noise,
    shift_columns,
    temperature_entry,
    with_auxiliary_columns,
)
from inflight.model import Model
from inflight.tasks.archive import channels_by_name
from inflight.tasks.pipelines.mission_fit.day import (
    AuxiliaryChannels,
    StoredDays,
    auxiliary_columns_of,
    means_of_channels,
)
from inflight.time import DAY, SECOND, day_of, mjd2000

#: The tables of `auxiliary_table_makers`.
AUXILIARY_TABLES = (
    "coil-temperature",
    "temperature-rivals",
    "day-night",
    "day-night-series",
    "day-night-daily",
    "cross-talk",
    "cross-talk-all",
)


@dataclass(frozen=True, kw_only=True)
class TableSettings:
    """Numbers of the tables.

    Attributes
    ----------
    least_spread_days : int
        Fewest days whose spread of the residual tells what the noise alone makes of it; assumed.
    shortest_period_d : float
        Shortest period that daily values are examined for, days; assumed.
    same_period : float
        Two stated periods closer than this part of them are one; assumed.
    most_turns : int
        Orbits a day: the slow wave of a temperature repeats so often (an orbit of 93 min, as CHAMP's).
    """

    least_spread_days: int = 5
    shortest_period_d: float = 10.0
    same_period: float = 1e-3
    most_turns: int = 15


TABLE_SETTINGS = TableSettings()


# --- from the parts of days -----------------------------------------------------------------------------


def own_fits(read: Sequence[xr.Dataset], found: MissionFit, model: Model) -> xr.Dataset:
    """Return each day's own nine parameters: what they do from day to day, nothing held at the common fit.

    Everything else is held at the model: its errors, as the model states them, are in those of the nine.

    Parameters
    ----------
    read : sequence of Dataset
        Of days that were fitted: `fit`, `fit_covariance`, `after`, `start`, `end`.
    found : MissionFit
    model : Model
        The one that the days' own fits held the rest at.

    Returns
    -------
    xarray.Dataset
        dims interval, parameter: `value`, `sigma`, `own_sigma` (of the day alone), `covariance` (interval,
        parameter, other), `after` (interval), nT; `units` (parameter); `start`, `end` (interval), TT2000.
    """
    joined = {
        name: np.concatenate([day[name].values for day in read])
        for name in ("fit", "fit_covariance", "after", "start", "end")
    }
    each, names = ("interval", "parameter"), list(found.fit.trends)[:9]
    others = {
        name: sigma
        for term in free_terms(model)
        for name, sigma in zip(term.columns, term.sigma, strict=True)
        if name in found.equations.columns and name not in names and np.isfinite(sigma)
    }
    prior = np.diag(np.square(list(others.values())))
    covariance = joined["fit_covariance"] + held_variance(found.equations, names, list(others), prior)
    table = xr.Dataset(
        {
            "value": (each, joined["fit"]),
            "sigma": (each, np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))),
            "own_sigma": (each, np.sqrt(np.diagonal(joined["fit_covariance"], axis1=1, axis2=2))),
            "covariance": ((*each, "other"), covariance),
            "after": ("interval", joined["after"]),
            "units": ("parameter", np.array([found.fit.units[name] for name in names], dtype="U8")),
            "start": ("interval", joined["start"]),
            "end": ("interval", joined["end"]),
        },
        coords={"parameter": names, "other": names},
    )
    return with_learnt_spans(table, joined["start"], joined["end"])


def torquer_band(days: StoredDays) -> xr.Dataset:
    """Return the equations of the torquers' band of all days, as `inflight.mission_fit.band_equations`.

    Raises
    ------
    SamplesError
        When no day has any.
    """
    parts = days.rows_of("band")
    if not parts:
        raise SamplesError(
            "no day has a stretch of torquer currents at a cadence that holds their band",
            remedy="see the missing days of the torquers' channel",
        )
    return concat_band_equations(parts)


def torquer_mean(read: Sequence[xr.Dataset], window: float) -> xr.Dataset:
    """Return the running mean of the torquer currents, A, as `inflight.mission_fit.FilledRunningMean.table`.

    Parameters
    ----------
    read : sequence of Dataset
        Days with the part ``channel``, `start` and `end`.
    window : float
        Days.

    Raises
    ------
    SamplesError
        When no day has torquer currents.
    """
    means = means_of_channels(read)
    torquers = [means[name] for name in means if name.endswith(("[x]", "[y]", "[z]"))]
    if len(torquers) != 3:
        raise SamplesError("no day has torquer currents", remedy="see the missing days of their channel")
    value = np.stack([one[:, 0] for one in torquers], axis=1)
    count = np.min([one[:, 2] for one in torquers], axis=0)
    known = np.isfinite(count)
    start = np.concatenate([day["start"].values for day in read])
    days = day_of(start).astype("datetime64[D]").astype(np.int64)
    mean = filled_running_mean(days[known], value[known], count[known], window=window)
    return mean.table().assign_attrs(window_days=window)


def daily_temperatures(mission: Mission, model: Model, read: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return daily means of the temperatures, those the model uses first.

    Parameters
    ----------
    read : sequence of Dataset
        Days with the part ``channel``, `start` and `end`.

    Returns
    -------
    xarray.Dataset
        dims interval, channel: `value`, `spread` within the day, `sigma`, degC; `start`, `end`. NaN on days
        without readings.

    Raises
    ------
    SamplesError
        When the mission has no temperature, or none was archived.

    Notes
    -----
    The spread is one slow wave, which repeats with each turn: of a day that is read in part, a mean errs as
    one of some turns out of all (finite population). Readings themselves scatter by no more than the spread.
    """
    used = {name for entry in model.effects for name in entry.effect.channels}
    means = means_of_channels(read)
    stated = AuxiliaryChannels.of(mission, model.comparison).temperatures
    names = sorted(stated, key=lambda name: name not in used)
    known = [name for name in names if name in means and np.isfinite(means[name][:, 0]).any()]
    if not known:
        raise SamplesError(
            f"no day has one of the temperatures {', '.join(names) or '(none are stated)'}",
            remedy="state a channel of kind 'temperature' in the mission's file",
        )
    mean, spread, count = np.stack([means[name] for name in known], axis=1).transpose(2, 0, 1)
    start, end = (np.concatenate([day[name].values for day in read]) for name in ("start", "end"))
    cadence = [mission.instruments[channels_by_name(mission)[name][0]].cadence for name in known]
    missing = np.clip(1.0 - count * cadence / (end - start)[:, None], 0.0, 1.0)
    turns, number = np.clip(count, 1, TABLE_SETTINGS.most_turns), np.maximum(count, 1)
    each, units = ("interval", "channel"), {"units": "degC"}
    return xr.Dataset(
        {
            "value": (each, mean, units),
            "spread": (each, spread, units),
            "sigma": (each, spread * np.sqrt(missing / turns + 1.0 / number), units),
            "start": ("interval", start, {"scale": "TT2000"}),
            "end": ("interval", end, {"scale": "TT2000"}),
        },
        coords={"channel": known},
    )


def node_times(epochs: xr.Dataset) -> Floats | None:
    """Return the local time of the ascending node at each epoch, h; None where the orbit is not known."""
    if not {"local_time", "orbit_phase", "latitude"} <= set(map(str, epochs.data_vars)):
        return None
    return node_local_time(*(epochs[name].values for name in ("local_time", "orbit_phase", "latitude")))


def spread_offsets(reports: Mapping[np.datetime64, Mapping[str, Any]]) -> xr.Dataset:
    """Return the daily offsets along z from the spread of the products' residual (Yin 2010, eq. 3.6).

    Parameters
    ----------
    reports : mapping of datetime64[D] to mapping
        Of products; ``spread`` holds what `inflight.mission_fit.day_statistics` returned.

    Raises
    ------
    CalibrationError
        When too few days have a spread, or their noise cannot be told.
    """
    statistics = spread_statistics(reports)
    return offsets_from_spread(statistics, *residual_noise(statistics)).table()


def slope_offsets(reports: Mapping[np.datetime64, Mapping[str, Any]]) -> xr.Dataset:
    """Return the daily offsets along z by the slope of the residual against Bz/|B|; as `spread_offsets`.

    What spreads the residual and does not follow Bz/|B| is no part of them.
    """
    found = spread_offsets(reports)
    table = found.assign(value=found["slope"], sigma=found["sigma_slope"])
    return table.drop_vars(["slope", "sigma_slope", "wrong_sign", "determined"])


def spread_statistics(reports: Mapping[np.datetime64, Mapping[str, Any]]) -> xr.Dataset:
    """Return what `day_statistics` told of the days that have it, in order; as `spread_offsets`."""
    spreads = [reports[day]["spread"] for day in sorted(reports) if reports[day].get("spread")]
    if len(spreads) < TABLE_SETTINGS.least_spread_days:
        raise CalibrationError(
            f"{len(spreads)} days tell the spread of their residual, "
            f"{TABLE_SETTINGS.least_spread_days} needed",
            remedy="make the products of more days",
        )
    dims = dict.fromkeys(spreads[0], ("interval",)) | {
        "covariance": ("interval", "statistic", "other"),
        "direction_mean": ("interval", "axis"),
        "direction_square": ("interval", "axis"),
    }
    return xr.Dataset({name: (dims[name], np.array([one[name] for one in spreads])) for name in spreads[0]})


# --- what the model may lack ----------------------------------------------------------------------------


def auxiliary_table_makers(
    mission: Mission, model: Model, equations: NormalEquations, days: StoredDays, found: MissionFit
) -> dict[str, Callable[[], xr.Dataset]]:
    """Return what makes each of `AUXILIARY_TABLES`.

    Parameters
    ----------
    model : Model
        The one the days' statistics were made with.
    equations : NormalEquations
        The days'; those that could be fitted.
    days : StoredDays
        The same days.
    found : MissionFit
    """
    units, columns = found.fit.units, cache(lambda: auxiliary_columns_of(days.read_part("beside")))

    def coil_lag() -> xr.Dataset:
        """Return the coil's lag, fitted about the one that its temperature was aligned with, s."""
        entry, aligned = temperature_entry(model), 0.0
        if entry is not None:
            instrument, channel = channels_by_name(mission)[entry.effect.channels[0]]
            aligned = mission.instruments[instrument].channels[channel].lag / SECOND
        return fit_coil_lag(equations, columns(), found, model, aligned).table()

    def temperature_rivals() -> xr.Dataset:
        channels = AuxiliaryChannels.of(mission, model.comparison).temperatures
        if not channels:
            raise CalibrationError(
                "the vector sensor has no temperature", remedy="state a channel of kind 'temperature'"
            )
        return compare_temperatures_jointly(equations, columns(), found, model, channels).table()

    def day_night_series() -> xr.Dataset:
        return fit_day_night_jointly(equations, columns(), found, model, SERIES).field.table()

    @cache
    def switched() -> JointDayNight:
        return fit_day_night_jointly(equations, columns(), found, model, SWITCHED)

    def day_night() -> xr.Dataset:
        return switched().field.table()

    def day_night_daily() -> xr.Dataset:
        return switched().daily()

    def nine_cross_talk() -> xr.Dataset:
        return nine_parameter_cross_talk(_with_day_night(equations, columns()), units, model).table()

    return {
        "coil-temperature": coil_lag,
        "temperature-rivals": temperature_rivals,
        # Before the switched field, whose equations are kept for the daily parameters.
        "day-night-series": day_night_series,
        "day-night": day_night,
        "day-night-daily": day_night_daily,
        "cross-talk": nine_cross_talk,
        "cross-talk-all": lambda: joint_cross_talk(equations, units, model),
    }


def _with_day_night(equations: NormalEquations, columns: Sequence[xr.Dataset | None]) -> NormalEquations:
    """Return the equations with the field of day and night as a cause, where any day knows its orbit."""
    night = day_night_columns(columns)
    try:
        return with_auxiliary_columns(equations, columns, night) if night else equations
    except CalibrationError:
        return equations


# --- daily parameters after the fit ---------------------------------------------------------------------


def daily_after(equations: NormalEquations, found: MissionFit) -> xr.Dataset:
    """Return each day's nine parameters and time shift, everything else at the common fit.

    Parameters
    ----------
    equations : NormalEquations
        Wide ones of the days.
    found : MissionFit
        Fitted to them.
    """
    return daily_parameters(equations, found, shift_columns(found.model))


def of_days_alone(table: xr.Dataset) -> xr.Dataset:
    """Return a table of days with the errors in which days differ, for what happens from day to day."""
    return table.assign(sigma=table["own_sigma"]) if "own_sigma" in table else table


def middles(table: xr.Dataset) -> Floats:
    """Return the middles of a table's intervals as days since 2000-01-01; (interval,)."""
    return mjd2000(table["start"].values // 2 + table["end"].values // 2)


def time_shifts(daily: xr.Dataset) -> tuple[Floats, Floats]:
    """Return the time shift of each day and its sigma; (interval,), s.

    Raises
    ------
    CalibrationError
        When data move no time shift.
    """
    names = [str(name) for name in daily["parameter"].values if ".seconds" in str(name)]
    if not names:
        raise CalibrationError(
            "the model has no time shift that data may move",
            remedy="give the model an effect 'time_shift' with a sigma",
        )
    own = of_days_alone(daily).sel(parameter=names[0])
    return own["value"].values, own["sigma"].values


def faults_of(daily: xr.Dataset) -> tuple[ClockFaults, Floats]:
    """Return the clock faults that daily time shifts show, and these shifts; (interval,), s.

    Raises
    ------
    CalibrationError
        As `time_shifts`, and when too few days have one.
    """
    value, sigma = time_shifts(daily)
    return find_clock_faults(middles(daily), value, sigma), value


def faults_table(daily: xr.Dataset) -> xr.Dataset:
    """Return what each day's clock was off by, and the faults there were; one interval a day.

    Returns
    -------
    xarray.Dataset
        dim interval: `value`, time shift less what is usual around the day, and `sigma`, what days scatter
        by, s; `fault`, the number of the fault a day belongs to, 0 for none; `start`, `end`. The attribute
        ``told`` describes each fault.

    Raises
    ------
    CalibrationError
        As `faults_of`.
    """
    found, shift = faults_of(daily)
    number = np.zeros(shift.size, dtype=np.int64)
    for index, one in enumerate(found.faults, start=1):
        number[(found.mjd >= one.first) & (found.mjd < one.last + 1)] = index
    return xr.Dataset(
        {
            "value": ("interval", shift - found.usual, {"units": "s"}),
            "sigma": ("interval", found.scatter, {"units": "s"}),
            "fault": ("interval", number),
            "start": ("interval", daily["start"].values, {"scale": "TT2000"}),
            "end": ("interval", daily["end"].values, {"scale": "TT2000"}),
        },
        attrs={"told": "; ".join(found.summary()), "limit": found.limit},
    )


def stated_periods(mission: Mission | None) -> dict[str, float]:
    """Return the periods that daily parameters are examined for, days: the orbit's, and the mission's own.

    Those shorter than `TableSettings.shortest_period_d` do not show in daily values.
    """
    out = dict(KNOWN_PERIODS)
    for name, length in (mission.periods if mission is not None else {}).items():
        days = length / DAY
        if days < TABLE_SETTINGS.shortest_period_d:
            continue
        same = next(
            (key for key, other in out.items() if abs(other - days) < TABLE_SETTINGS.same_period * days), None
        )
        if same is None:
            out[f"{name}, {days:g} d"] = days
        else:
            out = {f"{name}, {key}" if key == same else key: value for key, value in out.items()}
    return out


def spectra_of(
    daily: xr.Dataset, known: Mapping[str, float], units: Mapping[str, tuple[float, str]]
) -> tuple[dict[str, ParameterSpectrum], dict[str, str]]:
    """Return the spectrum of each daily parameter less the continuous one, and why some have none.

    Parameters
    ----------
    known : mapping of str to float
        Periods to name, days.
    units : mapping of str to (float, str)
        Factor and unit of parameters; as they are where absent.
    """
    found, why, mjd, daily = {}, {}, middles(daily), of_days_alone(daily)
    for name in map(str, daily["parameter"].values):
        one = daily.sel(parameter=name)
        factor, unit = units.get(name, (1.0, str(one["units"].item())))
        deviation = factor * (one["value"].values - one["continuous"].values)
        try:
            found[name] = parameter_spectrum(
                mjd,
                deviation,
                factor * one["sigma"].values,
                known,
                shortest=TABLE_SETTINGS.shortest_period_d,
                unit=unit,
            )
        except InflightError as error:
            why[name] = error.message
    return found, why


def periods_of(daily: xr.Dataset, known: Mapping[str, float]) -> xr.Dataset:
    """Return the amplitudes of named periods in the daily parameters.

    Returns
    -------
    xarray.Dataset
        dims parameter, period: `value`, `sigma` (in `units`), `false_alarm`, `determined`; `days` (period);
        NaN where the span does not resolve a period, as the attribute ``told`` says for each parameter.

    Raises
    ------
    CalibrationError
        When no parameter has days enough for a spectrum.
    """
    found, why = spectra_of(daily, known, {})
    if not found:
        raise CalibrationError(next(iter(why.values())), remedy="use a longer span")
    each, rows = ("parameter", "period"), [one.named for one in found.values()]
    return xr.Dataset(
        {
            name: (each, np.array([[getattr(peak, field) for peak in row] for row in rows]))
            for name, field in (
                ("value", "amplitude"),
                ("sigma", "sigma"),
                ("false_alarm", "false_alarm"),
                ("determined", "resolved"),
            )
        }
        | {
            "units": ("parameter", np.array([one.unit for one in found.values()], dtype="U16")),
            "days": ("period", np.array(list(known.values())), {"units": "d"}),
        },
        coords={"parameter": list(found), "period": list(known)},
        attrs={"told": json.dumps({name: one.summary() for name, one in found.items()})},
    )
