"""What a simulation is asked for: span, seed, effects, noise and defects of the deliveries."""

from __future__ import annotations

import datetime as dt
from typing import Annotated, Literal

from pydantic import Field

from inflight.simulate.mission import MissionSettings
from inflight.simulate.parameters import Parameters

#: Effects present unless removed with `without`: name -> what it is.
STANDARD_EFFECTS: dict[str, str] = {
    "ageing": "scale factors of the fluxgate drift with the logarithm of time",
    "misalignment": "angles between the fluxgate axes",
    "offset": "constant readings of the fluxgate in zero field",
    "nonlinearity": "quadratic and cubic terms of the fluxgate",
    "temperature": "scale factors follow the temperature of the feedback coil",
    "temperature_lag": "the recorded temperature leads the coil that acts",
    "torquer": "field of the magneto-torquers at both sensors",
    "solar_array": "field of the currents of three solar panels",
    "battery": "field of the battery current",
    "star_camera": "field of the star camera's supply on the boom",
    "heater": "field of the recorded heater current",
    "remanent": "magnetic moment of the body, which the mean torquer current compensates",
    "time_shift": "the scalar sensor is sampled earlier than its stamps say",
    "oscillator": "reference oscillator of the scalar sensor is off its nominal frequency",
    "heading": "constant field of the scalar sensor itself",
    "induced": "soft magnetic material and cross-talk at the scalar sensor, proportional to the field",
    "scalar_filter": "bandwidth of the scalar sensor",
    "external_field": "ionospheric and crustal field, common to both sensors",
}
#: Effects absent unless asked for with `include` or `hide`.
EXTRA_EFFECTS: dict[str, str] = {
    "scalar_bias": "constant error of the scalar reading",
    "day_night": "field at the vector sensor that is there in sunlight only",
    "unrecorded_heater": "field at the vector sensor that no channel knows, switched with a fixed period",
    "hysteresis": "offset of the vector sensor that follows the coil temperature with play",
    "adc_temperature": "scale factors follow the temperature of the converter",
    "eddy": "field at the vector sensor proportional to the rate of change of the field",
    "offset_steps": "offset of the vector sensor jumps at every Wednesday's reset",
    "offset_drift": "offset of the vector sensor wanders over weeks",
    "clock_fault": "four days on which the scalar stamps are another 12 ms late",
}
Defect = Literal[
    "gaps", "duplicates", "missing_days", "fill_values", "clock_step", "unsorted", "flags", "spikes"
]


def effect_names() -> tuple[str, ...]:
    """Return the name of every effect the simulator knows."""
    return tuple(SimulationSettings.describe_effects())


class SimulationSettings(MissionSettings):
    """A simulated CHAMP; the pre-flight model written with the deliveries names no effect of `hide`."""

    standard_effects = STANDARD_EFFECTS
    extra_effects = EXTRA_EFFECTS

    start: dt.date = dt.date(2005, 1, 1)
    days: Annotated[int, Field(ge=1)] = 30
    #: Seconds between samples of the magnetometers and torquer currents.
    cadence: Literal[1, 2, 5, 10] = 1
    #: Standard deviation of the fluxgate's white noise, nT an axis.
    vector_noise: Annotated[float, Field(ge=0)] = 0.08
    #: Standard deviation of the scalar sensor's white noise, nT.
    scalar_noise: Annotated[float, Field(ge=0)] = 0.04
    #: Smallest step of both magnetometers, nT; 0 for none.
    resolution: Annotated[float, Field(ge=0)] = 0.01
    #: Root mean square of the common external field, nT a component.
    external_field: Annotated[float, Field(ge=0)] = 5.0
    defects: tuple[Defect, ...] = ("gaps",)
    #: Deliver a second fluxgate, `fgm2`.
    second_fluxgate: bool = False

    @property
    def parameters(self) -> Parameters:
        """The numbers behind the effects."""
        return Parameters().changed(self.overrides)
