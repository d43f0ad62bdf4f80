"""What a simulation of two sensors on one boom is asked for: span, effects, defects, numbers."""

from __future__ import annotations

import datetime as dt
from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from inflight.errors import SettingsError
from inflight.simulate.dual.switching import UNITS

#: Effects present unless removed with `without`: name -> what it is. `hide` keeps a unit's current back.
STANDARD: dict[str, str] = {unit.name: f"field of the {unit.name.replace('_', ' ')}" for unit in UNITS} | {
    "offset": "constant readings in zero field",
    "offset_drift": "offsets of both sensors wander by days",
    "thermal_drift": "the inboard offset follows the temperature of the body",
}
#: Effects absent unless asked for with `include` or `hide`.
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
class DualParameters:
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

    def changed(self, overrides: dict[str, Any]) -> DualParameters:
        """Return the same with some numbers replaced.

        Raises
        ------
        SettingsError
            When there is no such number.
        """
        known = {one.name for one in fields(self)}
        if unknown := sorted(set(overrides) - known):
            raise SettingsError(
                f"no parameter {', '.join(unknown)}", remedy=f"there are {', '.join(sorted(known))}"
            )
        given: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in overrides.items()
        }
        return replace(self, **given)

    def as_dict(self) -> dict[str, Any]:
        """Return the numbers by name."""
        return asdict(self)


class DualSettings(BaseModel):
    """A simulated mission with two sensors; the same settings always give the same measurements.

    `hide` names units whose housekeeping is not delivered; `without` and `include` as in
    `inflight.simulate.SimulationSettings`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    start: dt.date = dt.date(2006, 5, 14)
    days: Annotated[int, Field(ge=1)] = 4
    seed: Annotated[int, Field(ge=0)] = 1
    hide: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    include: tuple[str, ...] = ()
    defects: tuple[DualDefect, ...] = ()
    overrides: dict[str, Any] = {}

    @model_validator(mode="after")
    def _known(self) -> Self:
        known = {*STANDARD, *EXTRA}
        for key in ("hide", "without", "include"):
            if unknown := sorted(set(getattr(self, key)) - known):
                raise ValueError(f"{key}: no effect {unknown}; there are {', '.join(sorted(known))}")
        if both := sorted(set(self.without) & {*self.hide, *self.include}):
            raise ValueError(f"{both} cannot be both in the data and without")
        DualParameters().changed(self.overrides)
        return self

    @property
    def effects(self) -> frozenset[str]:
        """Names of the effects present in the data."""
        return frozenset({*STANDARD, *self.include, *self.hide} - set(self.without))

    @property
    def parameters(self) -> DualParameters:
        """The numbers behind the effects."""
        return DualParameters().changed(self.overrides)

    @property
    def day_list(self) -> list[np.datetime64]:
        """The UTC days asked for, datetime64[D]."""
        first = np.datetime64(self.start, "D")
        return [first + offset for offset in range(self.days)]


def describe_dual_effects() -> dict[str, str]:
    """Return effect name -> one line of description."""
    return STANDARD | EXTRA
