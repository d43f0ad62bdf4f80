"""Figures of the eight parameters from the spin (Plaschke et al. 2019)."""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.scorecard.figure import Figure, Within, recovered
from inflight.scorecard.scene import Scene
from inflight.scorecard.themis_orbit import CADENCE, HOURS, SPIN, piece
from inflight.spin import (
    SPIN_RELATED,
    CalibrationParameters,
    SpinEstimates,
    cut_into_blocks,
    estimate_jointly,
    estimate_pairs,
    measure_tones,
)
from inflight.time import SECOND

SECTION = "spin"
#: What the paper prints for THEMIS-C, in the order of `SPIN_RELATED`, and its errors; put in here.
THEMIS_C = (0.99998, 5e-4, 3e-4, -3e-5, -7e-5, -1.7e-4, -0.007, 0.036)
ERRORS = (4e-5, 4e-4, 7e-4, 6e-5, 6e-5, 4e-5, 0.023, 0.025)
#: Uncertainties of spin axis, elevations (rad) and offsets (nT) held, as in the paper.
_HELD = {"spin axis": 6e-5, "elevations": 7e-4, "offsets": 0.025}
#: The best of the estimates of a region that are looked at.
_BEST = 0.1
#: Near perigee is below this distance, Earth radii.
_NEAR = 3.0
#: White noise and steady field, nT; hours of it.
_WHITE, _STEADY, _LONG = 0.1, (200.0, 0.0, 300.0), 12.0
#: Axial field of the correlation of offset and elevation: mean and half its range, nT.
_AXIAL, _RANGE = 1000.0, 500.0
#: Spin-plane field beside it, nT: strong, so that the spin axis is known and the two are alone.
_PLANE = 1e4


def _put_in() -> CalibrationParameters:
    return CalibrationParameters().changed(dict(zip(SPIN_RELATED, THEMIS_C, strict=True)))


def estimates_of(scene: Scene, region: str) -> tuple[SpinEstimates, Floats]:
    """Return the estimates of a region's sub-intervals and their distances (sub,), Earth radii."""
    found = piece(region, 1)
    readings = _put_in().disturb(found.field)
    layout = cut_into_blocks(readings, found.phase, found.stamps)
    tones = measure_tones(readings, found.phase, found.stamps, layout, _put_in())
    middle = np.searchsorted(found.stamps, tones.start // 2 + tones.end // 2)
    return estimate_pairs(tones, _HELD), found.distance[middle]


def best_uncertainty(scene: Scene, region: str, *names: str) -> tuple[float, ...]:
    """Return the tenth best uncertainty of parameters in a region; at perigee near it."""
    estimates, distance = scene.once(estimates_of, region)
    use = estimates.usable & (~(distance > _NEAR))
    columns = [SPIN_RELATED.index(name) for name in names]
    return tuple(np.quantile(estimates.uncertainty[use][:, columns], _BEST, axis=0))


def below(scene: Scene, limit: float, name: str, *regions: str) -> float:
    """Return the part of estimates of regions whose uncertainty is below a limit."""
    column = SPIN_RELATED.index(name)
    each = [scene.once(estimates_of, region)[0].uncertainty[:, column] for region in regions]
    return float(np.mean(np.concatenate(each) < limit))


def themis_c(scene: Scene) -> tuple[float, ...]:
    """Return the eight parameters from wind and perigee together, the paper's values put in."""
    wind, near = piece("wind", 2), piece("perigee", 2)
    turns = np.ceil((wind.phase[-1] - near.phase[0]) / (2.0 * np.pi))
    phase = np.concatenate([wind.phase, near.phase + 2.0 * np.pi * turns])
    later = wind.stamps[-1] - near.stamps[0] + round(CADENCE * SECOND)
    stamps = np.concatenate([wind.stamps, near.stamps + later])
    readings = _put_in().disturb(np.concatenate([wind.field, near.field]))
    layout = cut_into_blocks(readings, phase, stamps)
    return tuple(estimate_jointly(readings, phase, stamps, layout, CalibrationParameters()).value)


def _steady(hours: float) -> tuple[Floats, Floats]:
    seconds: Floats = np.arange(round(hours * 3600.0 / CADENCE), dtype=np.float64) * CADENCE
    return seconds, 2.0 * np.pi * seconds / SPIN


def over_white_noise(scene: Scene) -> float:
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


def offset_and_elevation(scene: Scene) -> float:
    """Return the correlation of the errors of offset and elevation from an axial field of 500 to 1500 nT."""
    seconds, phase = _steady(HOURS)
    axial = _AXIAL + _RANGE * (2.0 * seconds / seconds[-1] - 1.0)
    field = np.column_stack([_PLANE * np.cos(phase), -_PLANE * np.sin(phase), axial])
    readings = field + _WHITE * np.random.default_rng(6).normal(size=field.shape)
    stamps = (seconds * SECOND).astype(np.int64)
    layout = cut_into_blocks(readings, phase, stamps)
    found = estimate_jointly(readings, phase, stamps, layout, CalibrationParameters())
    return found.correlation("offset[1]", "elevation[1]")


_SOURCE = "Plaschke et al. 2019"
_SHOWN = "Fluctuations of the size the paper's regions have were put in: this shows the estimator at work."


def _order(name: str, what: str, unit: str, where: str, limit: float, region: str, *names: str) -> Figure:
    return recovered(
        f"themis-c.{name}",
        SECTION,
        what,
        unit,
        f"{_SOURCE}, {where}",
        limit,
        Within(0.0, limit),
        lambda scene: best_uncertainty(scene, region, *names),
        why=_SHOWN,
    )


def _none(name: str, what: str, where: str, limit: float, parameter: str, *regions: str) -> Figure:
    return recovered(
        f"themis-c.{name}",
        SECTION,
        what,
        "1",
        f"{_SOURCE}, {where}",
        0.0,
        0.0,
        lambda scene: below(scene, limit, parameter, *regions),
        why=_SHOWN,
    )


FIGURES = (
    Figure(
        "uncertainty.white-noise",
        SECTION,
        "published uncertainty over the scatter of the estimates in white noise",
        "1",
        "the larger of two amplitudes: root 3 of one component's sigma",
        1.7,
        0.1,
        "derived",
        "The larger of two squared Rayleigh amplitudes has 1.5 times the mean of one: 3 variances.",
        over_white_noise,
        False,
    ),
    Figure(
        "offset-elevation.correlation",
        SECTION,
        "correlation of the errors of offset and elevation, axial field 500 to 1500 nT",
        "1",
        "one tone, O + Ba (sP - dth): mean of Ba over its root mean square",
        0.97,
        0.02,
        "derived",
        "Only the change of the axial field tells the two apart.",
        offset_and_elevation,
        False,
    ),
    _order(
        "offset-wind", "uncertainty of the spin-plane offsets in the solar wind", "nT",
        "section 6", 0.010, "wind", "offset[1]", "offset[2]",
    ),
    _none(
        "offset-sheath", "part of the offsets below 10 pT in the magnetosheath", "section 6",
        0.010, "offset[1]", "sheath",
    ),
    _order(
        "gains-perigee", "uncertainty of gain ratio, azimuth and spin axis near perigee", "1",
        "section 6", 1e-5, "perigee", "gain_ratio", "azimuth", "spin_axis[x]", "spin_axis[y]",
    ),
    _none(
        "gains-elsewhere", "part of the gain ratios below 1e-4 in wind and sheath", "section 6",
        1e-4, "gain_ratio", "wind", "sheath",
    ),
    _order(
        "elevation-perigee", "uncertainty of the elevations near perigee", "rad",
        "section 6", 1e-4, "perigee", "elevation[1]", "elevation[2]",
    ),
    _none(
        "elevation-elsewhere", "part of the elevations below 1e-4 in wind and sheath", "section 6",
        1e-4, "elevation[1]", "wind", "sheath",
    ),
    recovered(
        "themis-c.recovered",
        SECTION,
        "gain ratio, elevations, azimuth, spin axis, spin-plane offsets from wind and perigee",
        "1, rad, nT",
        f"{_SOURCE}, section 6",
        THEMIS_C,
        ERRORS,
        lambda scene: scene.once(themis_c),
    ),
    Figure(
        "themis-c.parameters",
        SECTION,
        "gain ratio, elevations, azimuth, spin axis, spin-plane offsets of THEMIS-C",
        "1, rad, nT",
        f"{_SOURCE}, section 6",
        THEMIS_C,
        ERRORS,
        "needs_mission_data",
        "They are of two days of the spacecraft's readings; tried in the injection themis-c.recovered.",
    ),
)  # fmt: skip
