"""The numbers of the simulated spacecraft, each with its source.

"Yin" is Yin (2010), the thesis on CHAMP's magnetometers; what it does not print is chosen here and
says so. Axes are the spacecraft's: x along flight, z down, y = z x x.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from inflight.simulate.mission import MissionParameters

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]


@dataclass(frozen=True)
class Parameters(MissionParameters):
    """Truth of a simulated mission; every name can be overridden in `SimulationSettings.overrides`."""

    #: Orbit, Yin 1.3: km above 6371.2 km at MJD 196 and its decay in km a day; degrees.
    altitude: float = 454.0
    altitude_decay: float = 0.031
    inclination: float = 87.3
    #: Yin 1.3 and 3.4.1: 24 h of local time in 260.5 d, falling; 03:20 on 2007-04-30 (MJD 2676).
    local_time_period: float = 260.5
    local_time: float = 3.0 + 20.0 / 60.0
    local_time_mjd: float = 2676.0
    #: Root mean square of roll, pitch, yaw, degrees (chosen).
    attitude_rms: Vector = (0.10, 0.12, 0.15)
    #: Field of sources far away that stays, nT along Earth-fixed axes, which a model of the main field lacks.
    steady_field: Vector = (0.0, 0.0, 0.0)
    #: Noise of the delivered attitude, arcsec an axis; 4 arcsec is three sigma (Yin 1.2.3).
    attitude_noise: float = 1.3

    #: Sensors on the boom, m from the assumed dipole (Yin 3.4.1).
    vector_position: Vector = (4.75, 0.0, 0.0)
    scalar_position: Vector = (6.5, 0.0, 0.0)

    #: Correction side, Yin 3.3: l0 = la + lb ln(MJD - 150), offsets in nT, angles xy, xz, yz in degrees.
    scale_constant: Vector = (1.00025304, 1.00111601, 1.00102659)
    scale_log: Vector = (2.8960e-4, 2.9990e-4, 2.9850e-4)
    scale_epoch: float = 150.0
    #: MJD whose scale factors hold for ever when `ageing` is absent (chosen).
    scale_frozen_mjd: float = 1000.0
    offset: Vector = (26.970, 19.843, 21.625)
    angles: Vector = (90.02613, 90.05986, 90.03873)
    #: Chosen to give at most 100 pT each at 65 000 nT, the printed deviation from linearity.
    quadratic: Vector = (1.5e-11, -1.0e-11, 2.0e-11)
    cubic: Vector = (2.0e-16, 1.5e-16, -2.5e-16)
    #: Yin 2.1; the reference temperature in degC is chosen.
    temperature_linear: Vector = (29.6e-6, 30.37e-6, 30.46e-6)
    temperature_quadratic: float = 4e-8
    temperature_reference: float = 10.0
    #: Seconds by which the recorded temperature leads the coil's effect (Yin 3.3).
    temperature_lag: float = 100.0

    #: Yin 2.5 and 3.3: seconds by which the scalar sample precedes its stamp, and nT.
    time_shift: float = 0.015
    heading: Vector = (-0.178, -0.138, 0.035)
    induced_first: Vector = (1.40e-5, -6.0e-6, -5.0e-6)
    induced_second: Vector = (-8.84e-6, 5.44e-6, 5.90e-6)
    #: Relative offset of the reference oscillator, its wander and response in 1/K (chosen).
    oscillator_offset: float = 1.2e-6
    oscillator_wander: float = 2e-7
    oscillator_temperature: float = 3e-8
    #: Hz, at -3 dB (Yin 1.2.2).
    scalar_bandwidth: float = 0.28
    #: nT, the value of 2004 with the sign of "the reading is too high" (Yin 2.5; 3.3 has none).
    scalar_bias: float = 0.4

    #: nT/A; Yin 2.3 for the vector sensor, 3.4.3 (after the flight correction) for the scalar one.
    torquer_vector: Matrix = ((15.0, -9.6, -13.4), (0.0, -27.1, 0.1), (-1.3, 1.0, -35.95))
    torquer_scalar: Matrix = ((7.785, -2.466, -2.238), (-0.402, -9.248, -0.199), (-0.163, 0.053, -11.368))
    #: Mean torquer current at launch and the change it approaches over `torquer_trend_days`, mA
    #: (size from the remanent field of Yin 2.5; the trend is chosen).
    torquer_mean: Vector = (0.0, -42.0, 14.0)
    torquer_trend: Vector = (0.0, 10.0, 8.0)
    torquer_trend_days: float = 900.0
    #: mA: orbital part, 20 s modulation, white commands (chosen to look like Yin Fig. 3.10).
    torquer_orbital: Vector = (15.0, 8.0, 12.0)
    torquer_modulation: Vector = (18.0, 4.0, 15.0)
    torquer_random: Vector = (10.0, 6.0, 10.0)
    #: Remanent field at the scalar sensor for the mean torquer current, nT/A (Yin 3.4.4), from a
    #: dipole 1.16 times farther than the coils.
    remanent_per_current: float = 7.1
    remanent_position: Vector = (-1.12, 0.0, 0.0)

    #: Field at the vector sensor of each panel's current, nT/A (Yin 3.4.1; the top panel is chosen).
    #: A1 and A2 face -y and +y as seen from the falling local time of the thesis' phases.
    panel_fields: Matrix = ((0.02, 0.01, -0.01), (-0.01, 0.01, 0.02), (0.005, 0.0, 0.01))
    panel_positions: Matrix = ((0.0, -0.45, 0.1), (0.0, 0.45, 0.1), (0.2, 0.0, -0.35))
    #: A at normal incidence; 10.5 A together at noon.
    panel_peaks: Vector = (7.0, 7.0, 0.6)
    #: A that the spacecraft draws, and seconds the array needs to fall back when the battery is full.
    load: float = 2.5
    regulation_time: float = 5.0
    battery_field: Vector = (0.010, -0.010, 0.020)
    battery_position: Vector = (-0.6, 0.2, 0.1)
    #: Difference between the sensors is 1 nT/A (Yin 3.4.2); the axis and position are chosen.
    camera_field: Vector = (0.3, -0.3, 1.0)
    camera_position: Vector = (3.9, 0.0, 0.15)
    camera_current: float = 0.23
    camera_sunlit_current: float = 0.40
    heater_field: Vector = (0.05, 0.0, -0.1)
    heater_position: Vector = (1.0, 0.0, 0.0)
    heater_current: float = 0.35
    heater_period: float = 2820.0
    heater_duty: float = 0.45

    #: The second fluxgate, there when asked for; all of it chosen. Metres; the turn from sensor to
    #: spacecraft axes as a rotation vector, degrees; then as for the first one.
    second_position: Vector = (4.85, 0.0, 0.0)
    second_rotation: Vector = (0.040, -0.025, 0.060)
    second_scale_constant: Vector = (1.00061210, 0.99982450, 1.00140330)
    second_scale_log: Vector = (2.7500e-4, 3.0500e-4, 2.9000e-4)
    second_offset: Vector = (-14.320, 31.870, 8.450)
    second_angles: Vector = (89.95310, 90.04120, 89.97240)
    second_temperature_linear: Vector = (30.1e-6, 29.8e-6, 30.9e-6)

    #: Extra effects, off unless asked for; nT, nT/K, 1/K, nT per nT/s, seconds.
    day_night_field: Vector = (0.0, 0.0, 0.65)
    unrecorded_heater_field: Vector = (0.0, 0.0, 0.35)
    unrecorded_heater_period: float = 2460.0
    unrecorded_heater_duty: float = 0.366
    hysteresis_field: Vector = (0.0, 0.0, 0.06)
    hysteresis_width: float = 2.0
    adc_temperature_linear: Vector = (2e-6, 2e-6, 2e-6)
    eddy_time: Vector = (0.0, 0.005, 0.0)
    offset_step_rms: float = 0.3
    offset_drift_rms: float = 0.2
    #: How much of both an axis has (chosen).
    offset_axes: Vector = (1.0, 1.0, 1.0)
    #: Yin ch. 4: first and last MJD, seconds.
    clock_fault_days: tuple[float, float] = (3164.0, 3168.0)
    clock_fault: float = 0.012

    def check_override(self, name: str, given: Any) -> Any:
        """Return a value with the shape of the number it replaces; raises ValueError when it has another."""
        return _with_shape_of(name, getattr(self, name), given)


def _with_shape_of(name: str, old: Any, new: Any) -> Any:
    if isinstance(old, tuple):
        if not isinstance(new, list | tuple) or len(new) != len(old):
            raise ValueError(f"overrides.{name}: {new!r} found, {len(old)} values expected")
        return tuple(_with_shape_of(name, before, after) for before, after in zip(old, new, strict=True))
    if not isinstance(new, int | float):
        raise ValueError(f"overrides.{name}: {new!r} found, a number expected")
    return float(new)
