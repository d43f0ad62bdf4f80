"""What a simulation of a spinning spacecraft is asked for: craft, span, effects, defects."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from inflight.simulate.mission import MissionParameters, MissionSettings

#: Effects present unless removed with `without`: name -> what it is.
STANDARD: dict[str, str] = {
    "gain_ratio": "the two spin-plane gains differ",
    "azimuth": "the spin-plane sensors are not at right angles",
    "elevation": "the spin-plane sensors are not at right angles to the third",
    "spin_axis": "the spin axis is not the third sensor's",
    "offset": "constant readings in zero field",
    "thermal_gain": "gains follow the temperature of the sensor",
    "zero_drift": "the offset along the spin axis drifts by days",
}
#: Effects absent unless asked for with `include` or `hide`.
EXTRA: dict[str, str] = {
    "torquer": "field of a coil that is driven at the spin period",
    "eclipse_shift": "spin-plane offsets follow the temperature of the sensor",
    "solar_array": "field of the current of the array, which is modulated by the spin",
    "perigee_turn": "the spin axis moves in the body at every perigee, one way and back",
    "manoeuvre": "the spin axis moves in the body at a known time",
    "flipper": "a flipper turns sensors 1 and 3 into each other's place, beside a field of the spacecraft",
    "nonlinearity": "quadratic and cubic terms of the spin-plane sensors",
}
SpinDefect = Literal["gaps", "missing_pulses", "false_pulses", "spikes", "saturation"]


@dataclass(frozen=True)
class SpinningParameters(MissionParameters):
    """Numbers behind a spinning spacecraft; angles in radians, fields in nT, times in seconds.

    Attributes
    ----------
    spin_period, cadence : float
        Of the spacecraft, and between samples.
    pulse_angle : float
        Angle of the sensor's x axis from the Sun at a sun pulse.
    gain_ratio, spin_plane_gain, axial_gain, elevation, azimuth, spin_axis, rotation, offset
        The twelve of Plaschke et al. (2019), angles as departures from their nominal values.
    attitude : tuple of float, optional
        Direction of the spin axis, gse; fields are simulated in payload axes.
    perigee, apogee : float
        Of the orbit, Earth radii; no orbit where apogee is 0.
    main_field : bool
        The Earth's field is the IGRF's in place of a dipole that stands still in gse.
    flips : tuple of float
        Times of the flipper, days from the first one; sensors lie plain before the first.
    range : float
        Readings beyond saturate, nT.
    """

    spin_period: float = 3.0137
    cadence: float = 0.25
    pulse_angle: float = 0.0
    gain_ratio: float = 1.0012
    spin_plane_gain: float = 1.0
    axial_gain: float = 1.0
    elevation: tuple[float, float] = (0.0012, -0.0019)
    azimuth: float = 0.0016
    spin_axis: tuple[float, float] = (-0.0014, 0.0023)
    rotation: float = 0.0
    offset: tuple[float, float, float] = (3.2, -4.1, 1.7)
    zero_drift: float = 0.01
    thermal_gain: tuple[float, float, float] = (2.5e-5, 2.2e-5, 2.8e-5)
    reference_temperature: float = 0.0
    field: float = 6.0
    turning: float = 0.5
    compression: float = 0.06
    noise: float = 0.01
    resolution: float = 0.003
    attitude: tuple[float, float, float] | None = None
    perigee: float = 0.0
    apogee: float = 0.0
    main_field: bool = False
    range: float = 25000.0
    torquer_field: tuple[float, float, float] = (0.35, -0.2, 0.25)
    torquer_current: float = 0.08
    eclipse_shift: tuple[float, float, float] = (0.006, -0.009, 0.0)
    array_field: tuple[float, float, float] = (0.05, 0.04, -0.07)
    flips: tuple[float, ...] = (2.3,)
    spacecraft_field: tuple[float, float, float] = (2.8, 0.9, -0.6)
    perigee_turn: tuple[float, float] = (0.0002, -0.0003)
    manoeuvre_day: int = 3
    manoeuvre_turn: tuple[float, float] = (0.0008, -0.0005)
    quadratic: tuple[float, float, float] = (2.0e-9, -1.5e-9, 0.0)
    cubic: tuple[float, float, float] = (4.0e-14, 3.0e-14, 0.0)


#: Spacecraft: THEMIS turns in 3 s and passes through dipole, sheath and wind; IMP-8 in 2.6 s and Helios
#: in 1 s, both in the solar wind.
SPACECRAFT_PRESETS: dict[str, SpinningParameters] = {
    "themis": SpinningParameters(perigee=1.5, apogee=19.5, attitude=(0.07, -0.05, 1.0)),
    "imp8": SpinningParameters(
        spin_period=2.5871, cadence=0.32, noise=0.03, resolution=0.05, attitude=(0.0, 0.0, 1.0)
    ),
    "helios": SpinningParameters(spin_period=1.0043, cadence=0.125, field=8.0, noise=0.03, resolution=0.05),
}


class SpinningSettings(MissionSettings):
    """A simulated spinning mission."""

    standard_effects = STANDARD
    extra_effects = EXTRA

    craft: Literal["themis", "imp8", "helios"] = "themis"
    start: dt.date = dt.date(2012, 3, 1)
    days: Annotated[int, Field(ge=1)] = 6
    defects: tuple[SpinDefect, ...] = ()

    @property
    def parameters(self) -> SpinningParameters:
        """The numbers behind the effects."""
        return SPACECRAFT_PRESETS[self.craft].changed(self.overrides)
