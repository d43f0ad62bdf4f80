"""Figures of the spacecraft's own fields (Yin 2010, section 3.4) and of the orbit they follow."""

from __future__ import annotations

from functools import partial

import numpy as np

from inflight.dipole import dipole_split
from inflight.scorecard.figure import PublishedFigure
from inflight.scorecard.scene import SimulatedDays

SECTION = "spacecraft-fields"
#: Sensors on the boom, m from the assumed dipole (Yin 2010, section 3.4.1).
VECTOR, SCALAR = (4.75, 0.0, 0.0), (6.5, 0.0, 0.0)
#: Torquer matrix of the scalar sensor, its change and the new one, nT/A (Yin 2010, section 3.4.3).
_MATRIX = np.array([[7.40, -2.60, -2.40], [0.00, -10.70, 0.00], [-0.40, 0.30, -11.60]])
CHANGE = np.array([[0.385, 0.134, 0.162], [-0.402, 1.452, -0.199], [0.237, -0.247, 0.232]])
#: Printed errors of the change, row by row.
CHANGE_ERROR = (0.154, 0.341, 0.035, 0.100, 1.192, 0.140, 0.016, 0.242, 0.139)
_NEW = np.array([[7.785, -2.466, -2.238], [-0.402, -9.248, -0.199], [-0.163, 0.053, -11.368]])
#: Its y and z, and the remanent moment's field for the current that compensates it, nT/A (section 3.4.4).
_TORQUER, _ETA = np.diag(_MATRIX)[1:], 7.1
#: Fields of both side panels at the vector sensor, nT/A (Fig. 3.6, read off); of the camera in dB, nT/mA.
PANELS, CAMERA = (0.02, 0.01, -0.01, -0.01, 0.01, 0.02), 0.001
#: The cycle of local time, and its printed quarter, d (Yin 2010, section 3.4.1).
_CYCLE = 260.5
#: Orbit (Yin 2010, section 1.3): inclination in deg, altitudes over the mission in km.
_INCLINATION, _ALTITUDES = 87.3, (340.0, 450.0)
#: GRS80 equator in km, J2, km^3/s^2, deg a day of the mean Sun.
_EQUATOR, _J2, _GM, _SUN = 6378.137, 1.08263e-3, 398600.4418, 0.98564736
#: Two days and their local times (Yin 2010, section 4.3): day numbers, h.
_LOCAL_TIMES = ((2852, 10.0 + 54.0 / 60.0), (2979, 23.0 + 10.0 / 60.0))


def split_of_boom(scene: SimulatedDays) -> tuple[float, ...]:
    """Return what both sensors see of a difference of 1 between them: a dipole on the boom axis."""
    return dipole_split((1.0, 1.0, 1.0), VECTOR, SCALAR).factor


def remanent_ratios(scene: SimulatedDays) -> tuple[float, float]:
    """Return g on y and z: the remanent moment's field over that of the torquers, equal moments."""
    y, z = -_ETA / _TORQUER
    return float(y), float(z)


def remanent_distance(scene: SimulatedDays) -> float:
    """Return how many times farther than the coils the remanent moment lies, from g = k^-3."""
    return float(np.mean(remanent_ratios(scene)) ** (-1.0 / 3.0))


def local_time_cycle(scene: SimulatedDays) -> float:
    """Return the days in which the local time of a circular orbit turns by 24 h, at the mean altitude.

    The Earth's oblateness turns the node by ``-1.5 n J2 (R/r)^2 cos i``, the Sun moves on.
    """
    radius = 6371.2 + float(np.mean(_ALTITUDES))
    motion = np.degrees(np.sqrt(_GM / radius**3)) * 86400.0
    node = -1.5 * motion * _J2 * (_EQUATOR / radius) ** 2 * np.cos(np.radians(_INCLINATION))
    return float(360.0 / abs(node - _SUN))


def cycle_of_two_days(scene: SimulatedDays) -> float:
    """Return the same from the local times that are printed for two days."""
    (early, first), (late, second) = _LOCAL_TIMES
    return (late - early) * 24.0 / ((first - second) % 24.0)


derived = partial(PublishedFigure, section=SECTION, basis="derived")
needs_data = partial(PublishedFigure, section=SECTION, basis="needs_mission_data")

FIGURES = (
    derived(
        id="dipole.split",
        what="field at the vector, at the scalar sensor over their difference, dipole on the boom axis",
        unit="1",
        source="Yin 2010, section 3.4.1",
        published=(1.64, 0.64),
        tolerance=0.005,
        why="From the sensors' distances of 4.75 and 6.5 m alone; the next digits are 1.64001 and 0.64001.",
        obtain=split_of_boom,
    ),
    derived(
        id="local-time.cycle",
        what="days in which local time turns by 24 h, from the printed orbit",
        unit="d",
        source="Yin 2010, section 1.3",
        published=_CYCLE,
        # 0.05 deg of inclination are 1.4 d, 340 to 450 km are 1.9 d.
        tolerance=3.3,
        why=(
            "Oblateness turns the node: as far as inclination and altitude are printed, 260.5 d is within "
            "reach."
        ),
        obtain=local_time_cycle,
    ),
    derived(
        id="local-time.two-days",
        what="the same cycle from the local times printed for days 2852 and 2979",
        unit="d",
        source="Yin 2010, sections 1.3 and 4.3",
        published=_CYCLE,
        # The hour of the day is not printed: a day at either end.
        tolerance=2.1,
        why="10:54 and 23:10 are 127 days apart.",
        obtain=cycle_of_two_days,
    ),
    derived(
        id="local-time.quarter",
        what="length of one phase of the two-panel model, a quarter of the cycle",
        unit="d",
        source="Yin 2010, section 3.4.1",
        published=65.0,
        tolerance=0.5,
        why="65.125 d; the printed phases of 65 d leave half a day of each cycle without a panel.",
        obtain=lambda scene: _CYCLE / 4.0,
    ),
    derived(
        id="remanent.ratio",
        what="field of the remanent moment over that of the torquers, y and z, at the scalar sensor",
        unit="1",
        source=(
            "follows from eta and the torquer matrix, Yin 2010, sections 3.4.4 and 2.3; the thesis prints "
            "none"
        ),
        published=(0.66, 0.61),
        tolerance=0.005,
        why="Moments cancel on average, so B = -g alpha I; its sign is that of +eta on y and z.",
        obtain=remanent_ratios,
        printed=False,
    ),
    derived(
        id="remanent.distance",
        what="distance of the remanent moment from the scalar sensor over that of the coils",
        unit="1",
        source="follows from the ratios by the cube of the distance; the thesis prints none",
        published=1.16,
        tolerance=0.02,
        why="Both axes agree on one place within 0.02, which no fit has asked of them.",
        obtain=remanent_distance,
        printed=False,
    ),
    derived(
        id="remanent.eta",
        what="eta: remanent field at the scalar sensor per mean torquer current, both axes from one distance",
        unit="nT/mA",
        source="Yin 2010, section 3.4.4",
        published=0.0071,
        tolerance=0.00005,
        why=(
            "One distance serves both axes of the torquer matrix; it is eta's own, that the axes agree is "
            "not."
        ),
        obtain=lambda scene: float(-_TORQUER.mean() * remanent_distance(scene) ** -3.0 / 1e3),
    ),
    needs_data(
        id="panels.fields",
        what="fields of the two side panels at the vector sensor, x, y, z each",
        unit="nT/A",
        source="Yin 2010, Fig. 3.6, read off",
        published=PANELS,
        tolerance=0.005,
        why="Properties of CHAMP's wiring; tried: put in, see panels.recovered.",
    ),
    needs_data(
        id="camera.field",
        what="change of dB per current of the star camera",
        unit="nT/mA",
        source="Yin 2010, section 3.4.2",
        published=CAMERA,
        tolerance=0.0005,
        why="CHAMP's wiring, printed without an axis; tried: put in, see camera.recovered.",
    ),
    derived(
        id="torquer.new",
        what="new torquer matrix of the scalar sensor, row by row, from the old one and the change",
        unit="nT/A",
        source="Yin 2010, section 3.4.3",
        published=tuple(_NEW.ravel().tolist()),
        # A sum of decimals: rounding only.
        tolerance=1e-9,
        why="The printed sums are right.",
        obtain=lambda scene: tuple((_MATRIX + CHANGE).ravel()),
    ),
    needs_data(
        id="torquer.change",
        what="change of the torquer matrix of the scalar sensor, row by row",
        unit="nT/A",
        source="Yin 2010, section 3.4.3",
        published=tuple(CHANGE.ravel().tolist()),
        tolerance=CHANGE_ERROR,
        why="Medians of daily fits to CHAMP; tried: put in, see torquer.recovered.",
    ),
)
