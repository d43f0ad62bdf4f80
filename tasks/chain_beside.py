"""Tables of what is looked at beside the model: the coil's lag and its rivals, day and night, cross-talk.

All of it is algebra of the days' stored statistics: the archive is not read again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import xarray as xr

from inflight.calibration import NormalEquations
from inflight.chain import Continuous
from inflight.chain.beside import joined_with, temperature_entry
from inflight.chain.crosstalk import of_everything, of_the_nine
from inflight.chain.daylight import Daylight, fit_daylight
from inflight.chain.temperature import fit_coil_lag, rival_temperatures
from inflight.errors import CalibrationError
from inflight.estimators.day_night import SERIES, SWITCHED
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.chain import Witnesses
from inflight.tasks.chain_parts import strips_of
from inflight.tasks.needs import channel_homes
from inflight.time import SECOND

#: The tables of this module.
BESIDE = (
    "coil-temperature",
    "temperature-rivals",
    "day-night",
    "day-night-series",
    "day-night-daily",
    "cross-talk",
    "cross-talk-all",
)


def beside_makers(
    mission: Mission, model: Model, equations: NormalEquations, read: Sequence[xr.Dataset], found: Continuous
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
    strips, units = strips_of(read), found.fit.units

    @cache
    def switched() -> Daylight:
        return fit_daylight(equations, strips, found, model, SWITCHED)

    return {
        "coil-temperature": lambda: fit_coil_lag(
            equations, strips, found, model, _lag(mission, model)
        ).table(),
        "temperature-rivals": lambda: _rivals(mission, model, equations, strips, found),
        # Before the switched field, whose equations are kept for the daily parameters.
        "day-night-series": lambda: _field(fit_daylight(equations, strips, found, model, SERIES)),
        "day-night": lambda: _field(switched()),
        "day-night-daily": lambda: switched().daily(),
        "cross-talk": lambda: of_the_nine(_with_daylight(equations, strips), units, model).table(),
        "cross-talk-all": lambda: of_everything(equations, units, model),
    }


def _field(one: Daylight) -> xr.Dataset:
    return one.field.table()


def _lag(mission: Mission, model: Model) -> float:
    """Return the lag with which the model's temperature was aligned, s."""
    entry = temperature_entry(model)
    if entry is None:
        return 0.0
    instrument, channel = channel_homes(mission)[entry.effect.channels[0]]
    return mission.instruments[instrument].channels[channel].lag / SECOND


def _rivals(
    mission: Mission,
    model: Model,
    equations: NormalEquations,
    strips: Sequence[xr.Dataset | None],
    found: Continuous,
) -> xr.Dataset:
    channels = Witnesses.of(mission, model.comparison).temperatures
    if not channels:
        raise CalibrationError(
            "the vector sensor has no temperature", remedy="state a channel of kind 'temperature'"
        )
    return rival_temperatures(equations, strips, found, model, channels).table()


def _with_daylight(equations: NormalEquations, strips: Sequence[xr.Dataset | None]) -> NormalEquations:
    """Return the equations with the field of day and night as a cause, where any day knows its orbit."""
    names = {str(one) for strip in strips if strip is not None for one in strip["beside"].values}
    beside = sorted(name for name in names if name.startswith(SWITCHED))
    try:
        return joined_with(equations, strips, beside) if beside else equations
    except CalibrationError:
        return equations
