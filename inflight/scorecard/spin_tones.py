"""Figures of the eight parameters from the spin (Plaschke et al. 2019).

Their fields are pieces of an orbit like THEMIS-C's in July 2007 (`piece`): solar wind, magnetosheath, and the
way past perigee. Fluctuations have a power of -5/3 and by region the strength at the spin that the paper's
uncertainties imply: some pT in the wind and in the magnetosphere, tenths of a nT in the sheath (Plaschke et
al. 2019, Figs. 2 and 3). They show estimators at work in such fields; THEMIS-C's own readings they are not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from inflight.arrays import Floats
from inflight.scorecard.figure import RECOVERED, Estimate, PublishedFigure, ToleranceInterval
from inflight.scorecard.scene import SimulatedDays
from inflight.spin import (
    SPIN_RELATED,
    CalibrationParameters,
    SpinEstimates,
    cut_into_blocks,
    estimate_jointly,
    estimate_pairs,
    measure_tones,
    respin,
)
from inflight.time import SECOND, Int64

SECTION = "spin"
#: What the paper prints for THEMIS-C, in the order of `SPIN_RELATED`, and its errors; put in here.
THEMIS_C = (0.99998, 5e-4, 3e-4, -3e-5, -7e-5, -1.7e-4, -0.007, 0.036)
ERRORS = (4e-5, 4e-4, 7e-4, 6e-5, 6e-5, 4e-5, 0.023, 0.025)
#: Uncertainties of spin axis, elevations (rad) and offsets (nT) held, as in the paper.
_HELD = {"spin axis": 6e-5, "elevations": 7e-4, "offsets": 0.025}
#: Which of them is whose.
_KIND = {"spin_axis": "spin axis", "elevation": "elevations", "offset": "offsets"}
#: The best of the estimates of a region whose uncertainty is taken.
_BEST = 0.1
#: Near perigee is below this distance, Earth radii.
_NEAR = 3.0
#: White noise and steady field, nT; hours of it.
_WHITE, _STEADY, _LONG = 0.1, (200.0, 0.0, 300.0), 12.0
#: Axial field of the correlation of offset and elevation: mean and half its range, nT.
_AXIAL, _RANGE = 1000.0, 500.0
#: Spin-plane field beside it, nT: strong, so that the spin axis is known and the two are alone.
_PLANE = 1e4

#: Spin period and cadence, s; hours of each piece.
SPIN, CADENCE, HOURS = 3.0, 0.25, 3.0
#: Mean field, nT, and root of the power density at 1 Hz, nT/sqrt(Hz), of wind and sheath.
WIND, SHEATH = ((3.5, -3.0, 1.0), 0.02), ((17.5, -15.0, 17.0), 0.8)
_QUIET = 0.012
#: Part of the fluctuations that changes the size.
_COMPRESSED = 0.4
#: Dipole at the equator, Earth's radius (km), the dipole's tilt from the spin axis (rad).
_DIPOLE, _RADIUS, _TILT = 30_000.0, 6371.2, 0.5
#: Earth radii, and the Earth's gravitational parameter, km^3/s^2.
_PERIGEE, _APOGEE = 1.4, 14.4
_MU = 398_600.4
#: Below this frequency, Hz, the spectrum is flat.
_SLOWEST = 2e-4


@dataclass(frozen=True)
class Piece:
    """Samples of one region.

    Attributes
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000.
    phase : ndarray, shape (time,)
        Spin phase, rad.
    field : ndarray, shape (time, 3)
        nT, spinning axes.
    distance : ndarray, shape (time,)
        Earth radii; NaN where it does not matter.
    """

    stamps: Int64
    phase: Floats
    field: Floats
    distance: Floats


def piece(region: str, seed: int) -> Piece:
    """Return three hours of ``wind``, ``sheath`` or ``perigee``."""
    seconds: Floats = (np.arange(round(HOURS * 3600.0 / CADENCE), dtype=np.float64) + 0.5) * CADENCE
    distance: Floats = np.full(seconds.size, np.nan)
    if region == "perigee":
        mean, distance = _past_perigee(seconds - 1800.0 * HOURS)
        density = _QUIET
    else:
        level, density = WIND if region == "wind" else SHEATH
        mean = np.tile(level, (seconds.size, 1))
    phase: Floats = 2.0 * np.pi * seconds / SPIN
    field = _fluctuating(mean, density, np.random.default_rng([seed, len(region)]))
    return Piece((seconds * SECOND).astype(np.int64), phase, respin(field, phase), distance)


def _fluctuating(mean: Floats, density: float, generator: np.random.Generator) -> Floats:
    """Return the mean field (time, 3) with turbulence that turns it and changes its size."""
    size = 1 << (len(mean) - 1).bit_length()
    frequency = np.maximum(np.fft.rfftfreq(size, CADENCE), _SLOWEST)
    amplitude = density * np.sqrt(frequency ** (-5.0 / 3.0) * size / CADENCE / 4.0)
    parts = generator.normal(size=(4, frequency.size)) + 1j * generator.normal(size=(4, frequency.size))
    waves = np.fft.irfft(amplitude * parts, size, axis=1).T[: len(mean)]
    bent = mean + waves[:, :3]
    strength = np.linalg.norm(mean, axis=1) + _COMPRESSED * waves[:, 3]
    return np.asarray(bent * (strength / np.linalg.norm(bent, axis=1))[:, None])


def _past_perigee(seconds: Floats) -> tuple[Floats, Floats]:
    """Return a dipole's field (time, 3), nT, and the distance, seconds from perigee."""
    axis = 0.5 * (_PERIGEE + _APOGEE)
    eccentricity = (_APOGEE - _PERIGEE) / (_APOGEE + _PERIGEE)
    mean = seconds * np.sqrt(_MU / (axis * _RADIUS) ** 3)
    anomaly = np.cbrt(6.0 * mean)
    for _ in range(20):
        fall = anomaly - eccentricity * np.sin(anomaly) - mean
        anomaly = anomaly - fall / (1.0 - eccentricity * np.cos(anomaly))
    across = axis * np.sqrt(1.0 - eccentricity**2) * np.sin(anomaly)
    place = np.column_stack(
        [-axis * (np.cos(anomaly) - eccentricity), across * np.cos(0.3), across * np.sin(0.3)]
    )
    distance = np.linalg.norm(place, axis=1)
    up, moment = place / distance[:, None], np.array([np.sin(_TILT), 0.0, np.cos(_TILT)])
    field = -_DIPOLE / distance[:, None] ** 3 * (3.0 * (up @ moment)[:, None] * up - moment)
    return field, distance


def _put_in() -> CalibrationParameters:
    return CalibrationParameters().changed(dict(zip(SPIN_RELATED, THEMIS_C, strict=True)))


def estimates_of(scene: SimulatedDays, region: str) -> tuple[SpinEstimates, Floats]:
    """Return the estimates of a region's sub-intervals and their distances (sub,), Earth radii."""
    found = piece(region, 1)
    readings = _put_in().disturb(found.field)
    layout = cut_into_blocks(readings, found.phase, found.stamps)
    tones = measure_tones(readings, found.phase, found.stamps, layout, _put_in())
    middle = np.searchsorted(found.stamps, tones.start // 2 + tones.end // 2)
    return estimate_pairs(tones, _HELD), found.distance[middle]


def best_uncertainty(scene: SimulatedDays, region: str, *names: str) -> tuple[float, ...]:
    """Return the tenth best uncertainty of parameters in a region; at perigee near it."""
    estimates, distance = scene.cached(estimates_of, region)
    use = estimates.usable & (~(distance > _NEAR))
    columns = [SPIN_RELATED.index(name) for name in names]
    return tuple(np.quantile(estimates.uncertainty[use][:, columns], _BEST, axis=0))


def below(scene: SimulatedDays, limit: float, name: str, *regions: str) -> float:
    """Return the part of estimates of regions whose uncertainty is below a limit."""
    column = SPIN_RELATED.index(name)
    each = [scene.cached(estimates_of, region)[0].uncertainty[:, column] for region in regions]
    return float(np.mean(np.concatenate(each) < limit))


def themis_c(scene: SimulatedDays) -> Estimate:
    """Return the eight parameters from wind and perigee together, the paper's values put in."""
    wind, near = piece("wind", 2), piece("perigee", 2)
    turns = np.ceil((wind.phase[-1] - near.phase[0]) / (2.0 * np.pi))
    phase = np.concatenate([wind.phase, near.phase + 2.0 * np.pi * turns])
    later = wind.stamps[-1] - near.stamps[0] + round(CADENCE * SECOND)
    stamps = np.concatenate([wind.stamps, near.stamps + later])
    readings = _put_in().disturb(np.concatenate([wind.field, near.field]))
    layout = cut_into_blocks(readings, phase, stamps)
    found = estimate_jointly(readings, phase, stamps, layout, CalibrationParameters())
    return Estimate.of(found.value, found.sigma)


def _steady(hours: float) -> tuple[Floats, Floats]:
    seconds: Floats = np.arange(round(hours * 3600.0 / CADENCE), dtype=np.float64) * CADENCE
    return seconds, 2.0 * np.pi * seconds / SPIN


def over_white_noise(scene: SimulatedDays) -> float:
    """Return the published uncertainty over the scatter in white noise: gain ratio, azimuth, spin axis."""
    seconds, phase = _steady(_LONG)
    across, _, along = _STEADY
    field = np.column_stack([across * np.cos(phase), -across * np.sin(phase), np.full(phase.size, along)])
    readings = field + _WHITE * np.random.default_rng(5).normal(size=field.shape)
    stamps = (seconds * SECOND).astype(np.int64)
    layout = cut_into_blocks(readings, phase, stamps)
    estimates = estimate_pairs(measure_tones(readings, phase, stamps, layout, CalibrationParameters()), _HELD)
    columns = [SPIN_RELATED.index(name) for name in ("gain_ratio", "azimuth", "spin_axis[x]", "spin_axis[y]")]
    size = np.sqrt(np.mean(estimates.uncertainty[:, columns] ** 2, axis=0))
    return float(np.mean(size / estimates.value[:, columns].std(axis=0)))


def offset_and_elevation(scene: SimulatedDays) -> float:
    """Return the correlation of the errors of offset and elevation from an axial field of 500 to 1500 nT."""
    seconds, phase = _steady(HOURS)
    axial = _AXIAL + _RANGE * (2.0 * seconds / seconds[-1] - 1.0)
    field = np.column_stack([_PLANE * np.cos(phase), -_PLANE * np.sin(phase), axial])
    readings = field + _WHITE * np.random.default_rng(6).normal(size=field.shape)
    stamps = (seconds * SECOND).astype(np.int64)
    layout = cut_into_blocks(readings, phase, stamps)
    found = estimate_jointly(readings, phase, stamps, layout, CalibrationParameters())
    return found.correlation("offset[1]", "elevation[1]")


derived = partial(PublishedFigure, section=SECTION, basis="derived")
recovered = partial(PublishedFigure, section=SECTION, basis="recovered_from_injection", why=RECOVERED)
needs_data = partial(PublishedFigure, section=SECTION, basis="needs_mission_data")

_SOURCE = "Plaschke et al. 2019"
_SHOWN = "Fluctuations of the size the paper's regions have were put in: this shows the estimator at work."


def _order(
    name: str, what: str, unit: str, where: str, limit: float, region: str, *names: str
) -> PublishedFigure:
    return recovered(
        id=f"themis-c.{name}",
        what=what,
        unit=unit,
        source=f"{_SOURCE}, {where}",
        published=limit,
        tolerance=ToleranceInterval(0.0, limit),
        obtain=lambda scene: best_uncertainty(scene, region, *names),
        # What is known beforehand; nothing of gain ratio and azimuth.
        nominal=tuple(_HELD.get(_KIND.get(name.partition("[")[0], ""), float("inf")) for name in names),
        why=_SHOWN,
    )


def _none(name: str, what: str, where: str, limit: float, parameter: str, *regions: str) -> PublishedFigure:
    return recovered(
        id=f"themis-c.{name}",
        what=what,
        unit="1",
        source=f"{_SOURCE}, {where}",
        published=0.0,
        tolerance=0.0,
        obtain=lambda scene: below(scene, limit, parameter, *regions),
        why=_SHOWN,
    )


FIGURES = (
    derived(
        id="uncertainty.white-noise",
        what="published uncertainty over the scatter of the estimates in white noise",
        unit="1",
        source="the larger of two amplitudes: root 3 of one component's sigma",
        published=1.7,
        tolerance=0.1,
        why="The larger of two squared Rayleigh amplitudes has 1.5 times the mean of one: 3 variances.",
        obtain=over_white_noise,
        printed=False,
    ),
    derived(
        id="offset-elevation.correlation",
        what="correlation of the errors of offset and elevation, axial field 500 to 1500 nT",
        unit="1",
        source="one tone, O + Ba (sP - dth): mean of Ba over its root mean square",
        published=0.97,
        tolerance=0.02,
        why="Only the change of the axial field tells the two apart.",
        obtain=offset_and_elevation,
        printed=False,
    ),
    _order(
        "offset-wind",
        "uncertainty of the spin-plane offsets in the solar wind",
        "nT",
        "section 6",
        0.010,
        "wind",
        "offset[1]",
        "offset[2]",
    ),
    _none(
        "offset-sheath",
        "part of the offsets below 10 pT in the magnetosheath",
        "section 6",
        0.010,
        "offset[1]",
        "sheath",
    ),
    _order(
        "gains-perigee",
        "uncertainty of gain ratio, azimuth and spin axis near perigee",
        "1",
        "section 6",
        1e-5,
        "perigee",
        "gain_ratio",
        "azimuth",
        "spin_axis[x]",
        "spin_axis[y]",
    ),
    _none(
        "gains-elsewhere",
        "part of the gain ratios below 1e-4 in wind and sheath",
        "section 6",
        1e-4,
        "gain_ratio",
        "wind",
        "sheath",
    ),
    _order(
        "elevation-perigee",
        "uncertainty of the elevations near perigee",
        "rad",
        "section 6",
        1e-4,
        "perigee",
        "elevation[1]",
        "elevation[2]",
    ),
    _none(
        "elevation-elsewhere",
        "part of the elevations below 1e-4 in wind and sheath",
        "section 6",
        1e-4,
        "elevation[1]",
        "wind",
        "sheath",
    ),
    recovered(
        id="themis-c.recovered",
        what="gain ratio, elevations, azimuth, spin axis, spin-plane offsets from wind and perigee",
        unit="1, rad, nT",
        source=f"{_SOURCE}, section 6",
        published=THEMIS_C,
        tolerance=ERRORS,
        obtain=lambda scene: scene.cached(themis_c),
        nominal=tuple(CalibrationParameters().spin_related().tolist()),
    ),
    needs_data(
        id="themis-c.parameters",
        what="gain ratio, elevations, azimuth, spin axis, spin-plane offsets of THEMIS-C",
        unit="1, rad, nT",
        source=f"{_SOURCE}, section 6",
        published=THEMIS_C,
        tolerance=ERRORS,
        why="They are of two days of the spacecraft's readings; tried in the injection themis-c.recovered.",
    ),
)
