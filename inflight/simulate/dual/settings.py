"""Settings of a simulation of two sensors on one boom: span, effects, defects, numbers of the spacecraft.

Effects and numbers have the names that `inflight simulate` and a mission's overrides use.
"""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from inflight.simulate.dual.switching import UNITS
from inflight.simulate.mission import MissionParameters, MissionSettings

#: Effects present unless removed with `without`: name -> what it is. With `hide` the current of a unit is not
#: delivered.
STANDARD: dict[str, str] = {unit.name: f"field of the {unit.name.replace('_', ' ')}" for unit in UNITS} | {
    "offset": "constant readings in zero field",
    "offset_drift": "offsets of both sensors wander by days",
    "thermal_drift": "the inboard offset follows the temperature of the body",
}
#: Effects absent unless requested with `include` or `hide`.
EXTRA: dict[str, str] = {
    "six_states": "one of six free pairs of vectors at a time (Venus Express, Table 1) in place of the units",
    "new_unit": "a unit that nobody switched before `new_unit_day`, without housekeeping",
    "simultaneous": "every second switching of the camera is one of the spectrometer, too",
    "ageing": "moments of all units grow by `ageing` a day",
    "valve": "a valve is driven for two seconds now and then",
    "array_current": "field of the continuous current of the solar array",
    "monitor": "the ambient field is known for the first `monitor_days`, as from a spacecraft nearby",
    "misalignment": "the inboard sensor is turned by an angle that nobody states",
}
DualDefect = Literal["gaps", "spikes"]


@dataclass(frozen=True)
class DualParameters(MissionParameters):
    """Numbers behind the spacecraft; fields in nT, times in seconds, places in m, spacecraft axes.

    Attributes
    ----------
    inboard, outboard : tuple of float
        Where the sensors are; z is along the boom.
    turned : float
        The inboard sensor's axes are the spacecraft's turned by this angle about z, deg.
    rise : float
        How long a switching takes.
    commissioning : int
        Days that begin with every unit switched by itself.
    """

    cadence: float = 1.0
    inboard: tuple[float, float, float] = (0.0, 0.0, 0.10)
    outboard: tuple[float, float, float] = (0.0, 0.0, 1.05)
    turned: float = 90.0
    noise_inboard: float = 0.03
    noise_outboard: float = 0.02
    resolution: float = 0.008
    field: float = 9.0
    turning: float = 0.45
    compression: float = 0.06
    rise: float = 0.6
    commissioning: int = 1
    offset_inboard: tuple[float, float, float] = (1.4, -0.9, 2.1)
    offset_outboard: tuple[float, float, float] = (-0.3, 0.5, 0.2)
    offset_drift: float = 0.05
    thermal_drift: tuple[float, float, float] = (0.02, -0.015, 0.025)
    new_unit_day: int = 2
    monitor_days: int = 1
    noise_monitor: float = 0.05
    ageing: float = 0.02
    valve_moment: tuple[float, float, float] = (0.02, 0.01, 0.03)
    valve_switches: float = 30.0
    array_moment: tuple[float, float, float] = (0.01, -0.006, 0.008)
    misalignment: float = 0.2


class DualSettings(MissionSettings):
    """A simulated mission with two sensors; `hide` names units whose housekeeping is not delivered."""

    standard_effects = STANDARD
    extra_effects = EXTRA

    start: dt.date = dt.date(2006, 5, 14)
    days: Annotated[int, Field(ge=1)] = 4
    defects: tuple[DualDefect, ...] = ()

    @property
    def parameters(self) -> DualParameters:
        """The numbers behind the effects."""
        return DualParameters().changed(self.overrides)
