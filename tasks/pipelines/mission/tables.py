"""Tables beside the whole-mission fit, from the days' stored statistics: the archive is not read again.

What the model may lack: the coil's lag and its rivals, day and night, cross-talk (`beside_makers`). How daily
parameters scatter after the fit of all days: values of each day, faults of clocks, periods (`daily_after`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import cache

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NormalEquations
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
    daily_parameters,
    find_clock_faults,
    fit_coil_lag,
    fit_day_night_jointly,
    joint_cross_talk,
    nine_parameter_cross_talk,
    node_local_time,
    parameter_spectrum,
    shift_columns,
    temperature_entry,
    with_auxiliary_columns,
)
from inflight.model import Model
from inflight.tasks.archive import channels_by_name
from inflight.tasks.pipelines.mission.day import AuxiliaryChannels, auxiliary_columns_of, means_of_channels
from inflight.time import DAY, SECOND, mjd2000

#: The tables of this module.
AUXILIARY_TABLES = (
    "coil-temperature",
    "temperature-rivals",
    "day-night",
    "day-night-series",
    "day-night-daily",
    "cross-talk",
    "cross-talk-all",
)


def auxiliary_table_makers(
    mission: Mission, model: Model, equations: NormalEquations, read: Sequence[xr.Dataset], found: MissionFit
) -> dict[str, Callable[[], xr.Dataset]]:
    """Return what makes each table of this module.

    Parameters
    ----------
    model : Model
        The one the days were looked at with.
    equations : NormalEquations
        The days'; those that could be fitted.
    read : sequence of Dataset
        The same days, with their parts.
    found : Continuous
    """
    strips, units = auxiliary_columns_of(read), found.fit.units

    @cache
    def switched() -> JointDayNight:
        return fit_day_night_jointly(equations, strips, found, model, SWITCHED)

    return {
        "coil-temperature": lambda: fit_coil_lag(
            equations, strips, found, model, _lag(mission, model)
        ).table(),
        "temperature-rivals": lambda: _rivals(mission, model, equations, strips, found),
        # Before the switched field, whose equations are kept for the daily parameters.
        "day-night-series": lambda: _field(fit_day_night_jointly(equations, strips, found, model, SERIES)),
        "day-night": lambda: _field(switched()),
        "day-night-daily": lambda: switched().daily(),
        "cross-talk": lambda: nine_parameter_cross_talk(
            _with_daylight(equations, strips), units, model
        ).table(),
        "cross-talk-all": lambda: joint_cross_talk(equations, units, model),
    }


def _field(one: JointDayNight) -> xr.Dataset:
    return one.field.table()


def _lag(mission: Mission, model: Model) -> float:
    """Return the lag with which the model's temperature was aligned, s."""
    entry = temperature_entry(model)
    if entry is None:
        return 0.0
    instrument, channel = channels_by_name(mission)[entry.effect.channels[0]]
    return mission.instruments[instrument].channels[channel].lag / SECOND


def _rivals(
    mission: Mission,
    model: Model,
    equations: NormalEquations,
    strips: Sequence[xr.Dataset | None],
    found: MissionFit,
) -> xr.Dataset:
    channels = AuxiliaryChannels.of(mission, model.comparison).temperatures
    if not channels:
        raise CalibrationError(
            "the vector sensor has no temperature", remedy="state a channel of kind 'temperature'"
        )
    return compare_temperatures_jointly(equations, strips, found, model, channels).table()


def _with_daylight(equations: NormalEquations, strips: Sequence[xr.Dataset | None]) -> NormalEquations:
    """Return the equations with the field of day and night as a cause, where any day knows its orbit."""
    names = {str(one) for strip in strips if strip is not None for one in strip["beside"].values}
    beside = sorted(name for name in names if name.startswith(SWITCHED))
    try:
        return with_auxiliary_columns(equations, strips, beside) if beside else equations
    except CalibrationError:
        return equations


#: Shortest period that daily values are asked for, days.
SHORTEST = 10.0

#: Two stated periods closer than this part of them are one.
_SAME = 1e-3

#: Orbits of a day: the slow wave of a temperature repeats so often.
_TURNS = 15


def daily_after(equations: NormalEquations, found: MissionFit) -> xr.Dataset:
    """Return each day's nine parameters and time shift, everything else at the continuous fit.

    Parameters
    ----------
    equations : NormalEquations
        Wide ones of the days.
    found : Continuous
        Fitted to them.
    """
    return daily_parameters(equations, found, shift_columns(found.model))


def middles(table: xr.Dataset) -> Floats:
    """Return the middles of a table's intervals as days since 2000-01-01; (interval,)."""
    return mjd2000(table["start"].values // 2 + table["end"].values // 2)


def faults_of(daily: xr.Dataset) -> tuple[ClockFaults, Floats]:
    """Return the clock faults that daily time shifts tell, and these shifts (interval,), s.

    Raises
    ------
    CalibrationError
        When no day tells a time shift, or too few do.
    """
    names = [str(name) for name in daily["parameter"].values if ".seconds" in str(name)]
    if not names:
        raise CalibrationError(
            "the model has no time shift that data may move",
            remedy="give the model an effect 'time_shift' with a sigma",
        )
    value, sigma = (daily[part].sel(parameter=names[0]).values for part in ("value", "sigma"))
    return find_clock_faults(middles(daily), value, sigma), value


def faults_table(daily: xr.Dataset) -> xr.Dataset:
    """Return what each day's clock was off by, and the faults there were; one interval a day.

    Returns
    -------
    xarray.Dataset
        dim interval: `value`, time shift less what is usual around the day, and `sigma`, what days scatter
        by, s; `fault`, the number of the fault a day belongs to, 0 for none; `start`, `end`. The attribute
        ``told`` says each fault.

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
        attrs={"told": "; ".join(found.told()), "limit": found.limit},
    )


def node_times(epochs: xr.Dataset) -> Floats | None:
    """Return the local time of the ascending node at each epoch, h; None where the orbit is not known."""
    if not {"local_time", "orbit_phase", "latitude"} <= set(map(str, epochs.data_vars)):
        return None
    return node_local_time(*(epochs[name].values for name in ("local_time", "orbit_phase", "latitude")))


def daily_temperatures(mission: Mission, model: Model, read: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return daily means of the temperatures, those the model uses first.

    Parameters
    ----------
    read : sequence of Dataset
        The chain's days.

    Returns
    -------
    xarray.Dataset
        dims interval, channel: `value`, `spread` within the day, `sigma` (that of a mean whose spread is one
        slow wave: the spread over the root of the turns, at most the spread), degC; `start`, `end`. NaN on
        days without readings.

    Raises
    ------
    SamplesError
        When the mission has no temperature, or none was archived.
    """
    used = {name for entry in model.effects for name in entry.effect.channels}
    told = means_of_channels(read)
    names = sorted(
        AuxiliaryChannels.of(mission, model.comparison).temperatures, key=lambda name: name not in used
    )
    known = [name for name in names if name in told and np.isfinite(told[name][:, 0]).any()]
    if not known:
        raise SamplesError(
            f"no day has one of the temperatures {', '.join(names) or '(none are stated)'}",
            remedy="state a channel of kind 'temperature' in the mission's file",
        )
    mean, spread, count = np.stack([told[name] for name in known], axis=1).transpose(2, 0, 1)
    sigma = spread / np.sqrt(np.clip(count, 1, _TURNS))
    each, units = ("interval", "channel"), {"units": "degC"}
    return xr.Dataset(
        {
            "value": (each, mean, units),
            "spread": (each, spread, units),
            "sigma": (each, sigma, units),
            "start": ("interval", np.concatenate([day["start"].values for day in read]), {"scale": "TT2000"}),
            "end": ("interval", np.concatenate([day["end"].values for day in read]), {"scale": "TT2000"}),
        },
        coords={"channel": known},
    )


def stated_periods(mission: Mission | None) -> dict[str, float]:
    """Return the periods that daily parameters are asked for, days: the orbit's, and the mission's own.

    Those shorter than ten days do not show in daily values.
    """
    out = dict(KNOWN_PERIODS)
    for name, length in (mission.periods if mission is not None else {}).items():
        days = length / DAY
        if days < SHORTEST:
            continue
        same = next((key for key, other in out.items() if abs(other - days) < _SAME * days), None)
        if same is None:
            out[f"{name}, {days:g} d"] = days
        else:
            out = {f"{name}, {key}" if key == same else key: value for key, value in out.items()}
    return out


def spectra_of(
    daily: xr.Dataset, known: Mapping[str, float], shown: Mapping[str, tuple[float, str]]
) -> tuple[dict[str, ParameterSpectrum], dict[str, str]]:
    """Return the spectrum of each daily parameter less the continuous one, and why some have none.

    Parameters
    ----------
    known : mapping of str to float
        Periods to tell by name, days.
    shown : mapping of str to (float, str)
        Factor and unit of parameters; as they are where absent.
    """
    found, why, mjd = {}, {}, middles(daily)
    for name in map(str, daily["parameter"].values):
        one = daily.sel(parameter=name)
        factor, unit = shown.get(name, (1.0, str(one["units"].item())))
        left = factor * (one["value"].values - one["continuous"].values)
        try:
            found[name] = parameter_spectrum(
                mjd, left, factor * one["sigma"].values, known, shortest=SHORTEST, unit=unit
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
        NaN where the span does not resolve a period, which the attribute ``told`` says of each parameter.

    Raises
    ------
    CalibrationError
        When no parameter has days enough for a spectrum.
    """
    found, why = spectra_of(daily, known, {})
    if not found:
        raise CalibrationError(next(iter(why.values())), remedy="use a longer span")
    each = ("parameter", "period")
    rows = [one.named for one in found.values()]
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
        attrs={"told": json.dumps({name: one.told() for name, one in found.items()})},
    )
