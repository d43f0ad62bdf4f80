"""What a simulation is asked for: span, seed, effects, noise and defects of the deliveries."""

from __future__ import annotations

import datetime as dt
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

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
    """Return the name of every effect the simulator knows; `describe_effects` says what each is."""
    return (*STANDARD_EFFECTS, *EXTRA_EFFECTS)


def describe_effects() -> dict[str, str]:
    """Return effect name -> one line of description."""
    return STANDARD_EFFECTS | EXTRA_EFFECTS


class SimulationSettings(BaseModel):
    """A simulated mission; the same settings always give the same files.

    An effect named in `hide` is in the data, but only the truth tells of it: the pre-flight model
    written beside the deliveries does not. One named in `without` is not in the data at all, and
    one of `include` is added to the standard ones.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    start: dt.date = dt.date(2005, 1, 1)
    #: Number of UTC days.
    days: Annotated[int, Field(ge=1)] = 30
    seed: Annotated[int, Field(ge=0)] = 1
    hide: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    include: tuple[str, ...] = ()
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
    #: Values of `Parameters` that differ from CHAMP's, by name.
    overrides: dict[str, Any] = {}

    @model_validator(mode="after")
    def _known_names(self) -> Self:
        for key in ("hide", "without", "include"):
            unknown = sorted(set(getattr(self, key)) - set(effect_names()))
            if unknown:
                raise ValueError(f"{key}: no effect {unknown}; there are {', '.join(effect_names())}")
        both = sorted(set(self.without) & {*self.hide, *self.include})
        if both:
            raise ValueError(f"{both} cannot be both in the data and without")
        Parameters.with_overrides(self.overrides)
        return self

    @property
    def effects(self) -> frozenset[str]:
        """Names of the effects present in the data."""
        return frozenset({*STANDARD_EFFECTS, *self.include, *self.hide} - set(self.without))

    @property
    def parameters(self) -> Parameters:
        """The numbers behind the effects."""
        return Parameters.with_overrides(self.overrides)

    @property
    def day_list(self) -> list[np.datetime64]:
        """The UTC days asked for, datetime64[D]."""
        first = np.datetime64(self.start, "D")
        return [first + offset for offset in range(self.days)]
