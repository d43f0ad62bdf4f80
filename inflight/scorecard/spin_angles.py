"""Figures of Slope/Intercept and Beta/Phi (Farrell et al. 1995): signs, removal, angles."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from inflight.arrays import Floats
from inflight.scorecard.figure import RECOVERED, Estimate, PublishedFigure, ToleranceInterval
from inflight.scorecard.scene import SimulatedDays
from inflight.spin import SensorAngles, azimuth_between, calibrate_farrell, fit_spins, respin
from inflight.time import SECOND

SECTION = "spin"
#: Readings of a spin, and spins of a record.
_READINGS, _SPINS = 12, 240
#: Spin-plane and axial field in which ways of removal are compared, nT.
_PLANE, _AXIAL = 1e4, 2e3
#: Noise of a reading whose angles are recovered, nT.
_NOISE = 0.05
#: Angles in the ranges of IMP-8's, degrees: elevations and azimuths of both, tilt and where to.
_DEGREES = (0.3, -0.4, 0.25, -0.32, 0.5, 130.0)
#: As given back by the estimator: both elevations, the tilt's components, the difference of azimuths.
_TILT = (np.deg2rad(0.5) * np.cos(np.deg2rad(129.75)), np.deg2rad(0.5) * np.sin(np.deg2rad(129.75)))
ANGLES = (np.deg2rad(0.3), np.deg2rad(-0.4), *_TILT, np.deg2rad(-0.32 - 0.25))


def _sensors() -> SensorAngles:
    first, second, third, fourth, tilt, towards = np.deg2rad(_DEGREES)
    return SensorAngles(np.array([first, second]), np.array([third, fourth]), float(tilt), float(towards))


def _phase() -> Floats:
    return (np.arange(_READINGS * _SPINS) + 0.5) * 2.0 * np.pi / _READINGS


def _turned() -> tuple[Floats, Floats]:
    """Return the phase and a steady field in spinning axes; (time,), (time, 3)."""
    phase = _phase()
    return phase, respin(np.tile([0.6 * _PLANE, 0.8 * _PLANE, _AXIAL], (phase.size, 1)), phase)


def _left(restored: Floats) -> Floats:
    """Return the largest difference to the field in the spin plane, nT; (2,)."""
    return np.asarray(np.abs(restored - _turned()[1]).max(axis=0)[:2])


def left_by_inverse(scene: SimulatedDays) -> float:
    """Return what the exact inverse leaves, nT."""
    return float(_left(_sensors().remove(_sensors().disturb(_turned()[1]))).max())


def left_by_steps(scene: SimulatedDays) -> float:
    """Return what first-order steps with the right signs leave, nT."""
    readings = _sensors().disturb(_turned()[1])
    return float(_left(_sensors().remove_first_order(readings, azimuth=True)).max())


def left_as_printed(scene: SimulatedDays) -> tuple[float, ...]:
    """Return what first-order steps with the signs of (13) and (32) leave in sensors 1 and 2, nT."""
    sensors = _sensors()
    restored = sensors.remove_first_order(sensors.disturb(_turned()[1]))
    restored[:, 0] += sensors.azimuth[0] * restored[:, 1]
    restored[:, 1] -= sensors.azimuth[1] * restored[:, 0]
    return tuple(_left(restored))


def signs_of_azimuths(scene: SimulatedDays) -> tuple[float, ...]:
    """Return the signs of dph2 Bsp cos wt in reading 2, of dph B2 and dph B1 to be added to 1 and 2."""
    small = 1e-6
    turned = SensorAngles(azimuth=np.array([small, small]))
    phase, field = _turned()
    change = turned.disturb(field) - field
    # In payload axes along the field: psi = 0.
    psi = np.arctan2(0.8, 0.6)
    second = float(change[:, 1] @ np.cos(phase - psi) / (0.5 * phase.size)) / (small * _PLANE)
    added = [
        -float(change[:, one] @ field[:, other]) / float(field[:, other] @ field[:, other]) / small
        for one, other in ((0, 1), (1, 0))
    ]
    return tuple(float(np.round(one, 3)) for one in (second, *added))


def signs_of_phases(scene: SimulatedDays) -> tuple[float, ...]:
    """Return (24) and (31) as printed over the differences of azimuth that there are."""
    sensors = replace(_sensors(), azimuth=np.array([0.02, -0.03]))
    phase, field = _turned()
    stamps = (np.arange(phase.size) * (SECOND // 4)).astype(np.int64)
    fits = fit_spins(stamps, sensors.disturb(field), phase)
    tone = np.arctan2(fits.value[..., 1], fits.value[..., 2])
    third = _wrapped(tone[:, 2] - tone[:, 0]).mean() / (sensors.tilt_azimuth - sensors.azimuth[0])
    second = _wrapped(tone[:, 1] - tone[:, 0]).mean() / (0.5 * np.pi - 0.05)
    right = azimuth_between(fits, 0, 2).mean() / (sensors.tilt_azimuth - sensors.azimuth[0])
    return tuple(float(np.round(one, 2)) for one in (third, second, right))


def _wrapped(angle: Floats) -> Floats:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def angles_of_fits(scene: SimulatedDays) -> Estimate:
    """Return elevations, tilt and difference of azimuths from spin fits to a field that steps, rad."""
    rng = np.random.default_rng(1)
    phase = _phase()
    steps = rng.normal(size=(_SPINS // 20, 3)) @ np.diag([0.2, 0.2, 0.5]) + [0.6, 0.8, 0.2]
    field = respin(1e3 * np.repeat(steps, 20 * _READINGS, axis=0), phase)
    stamps = (np.arange(phase.size) * (SECOND // 4)).astype(np.int64)
    readings = _sensors().disturb(field) + _NOISE * rng.normal(size=field.shape)
    fits = fit_spins(stamps, readings, phase)
    found = calibrate_farrell(fits, spin_axis_zero=(0.0, 0.0))
    return Estimate.of(found.value[:5], found.sigma[:5])


_SOURCE = "Farrell et al. 1995"
derived = partial(PublishedFigure, section=SECTION, basis="derived")
recovered = partial(PublishedFigure, section=SECTION, basis="recovered_from_injection", why=RECOVERED)

FIGURES = (
    derived(
        id="signs.azimuth",
        what="signs of dph2 Bsp cos wt in reading 2, and of dph B2, dph B1 added to B1, B2",
        unit="1",
        source=f"{_SOURCE}, eqs. 13, 32, 33",
        published=(1.0, 1.0, 1.0),
        tolerance=0.01,
        why=(
            "An axis turned from X to Y sees less of X: (13) and (32) have the wrong sign, (33) the right "
            "one."
        ),
        obtain=signs_of_azimuths,
    ),
    derived(
        id="signs.phase",
        what="phases of eqs. 24 and 31 over the angles there are, and by arg(Z3/Z1)",
        unit="1",
        source=f"{_SOURCE}, eqs. 24 and 31",
        published=(1.0, 1.0, 1.0),
        tolerance=0.01,
        why="With B = C0 + C1 sin + C2 cos the printed differences are the angles reversed.",
        obtain=signs_of_phases,
    ),
    derived(
        id="removal.inverse",
        what="left in a spin plane of 10^4 nT by the exact inverse",
        unit="nT",
        source=f"{_SOURCE}, eqs. 10 to 20, made exact",
        published=0.0,
        tolerance=1e-9,
        why="What sensors see is linear in the field: its inverse leaves nothing.",
        obtain=left_by_inverse,
        printed=False,
    ),
    derived(
        id="removal.first-order",
        what="left in a spin plane of 10^4 nT by first-order steps, angles of 0.25 to 0.5 deg",
        unit="nT",
        source=f"{_SOURCE}, eqs. 26 to 33 with their signs corrected",
        published=1.7,
        tolerance=ToleranceInterval(0.1, 1.7),
        why="Second-order terms are left: half the angle squared times the field, up to 1.7 nT at a degree.",
        obtain=left_by_steps,
        printed=False,
    ),
    derived(
        id="removal.printed-signs",
        what="left in a spin plane of 10^4 nT by the steps with the printed signs, sensors 1 and 2",
        unit="nT",
        source=f"{_SOURCE}, eqs. 13 and 32",
        published=(83.0, 116.0),
        tolerance=ToleranceInterval(83.0, 116.0),
        why="A wrong sign doubles the error instead of removing it: 2 dph Bsp.",
        obtain=left_as_printed,
        printed=False,
    ),
    recovered(
        id="spin-angles.recovered",
        what="elevations, tilt along and across sensor 1, difference of azimuths",
        unit="rad",
        source="angles put in, of IMP-8's size",
        published=ANGLES,
        tolerance=1e-5,
        obtain=angles_of_fits,
        nominal=(0.0,) * 5,
        printed=False,
    ),
)
