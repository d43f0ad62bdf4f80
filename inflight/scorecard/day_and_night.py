"""Figures of day and night: how long they last and what a field that follows them does (Yin 2010, 4.3)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from inflight.arrays import Floats
from inflight.calibration import (
    NINE_PARAMETER_NAMES,
    NormalEquations,
    block_equations,
    concat_equations,
    nine_columns,
)
from inflight.frames import sun_direction
from inflight.mission_fit import (
    SWITCHED,
    block_parameters,
    fit_day_night,
    orbit_period,
    orbit_plane_sun,
    sunlit_duty,
    switched_columns,
)
from inflight.scorecard.figure import RECOVERED, Estimate, PublishedFigure
from inflight.scorecard.residual import DAY_NIGHT, SECTION, XZ, ignored_causes
from inflight.scorecard.scene import DAYS, MIDNIGHT, NOON, SimulatedDays

_INCLINATION = 87.3
#: Seeds over which an injection is repeated, and its noise, nT.
_SEEDS, _NOISE = 5, 0.1
#: Days at local times 09, 03, 15 and 21 of the ascending node, at which daytime is said to be an hour.
_OBLIQUE = (1833, 1898, 2028, 1963)
#: Days over three cycles of local time, 780 days, for the variation of the angles, and the cycle's length.
_CYCLES, LOCAL_TIME_DAYS = tuple(range(2300, 3082, 12)), 260.5
#: Wide enough to leave each day's nine parameters to the data.
_LOOSE = np.array([0.01] * 3 + [1.0] * 3 + [100.0] * 3)


def noon_and_midnight(scene: SimulatedDays, cause: str, parameter: str) -> tuple[float, ...]:
    """Return the shift of a parameter by an ignored cause on the thesis' days near noon and midnight."""
    return tuple(scene.cached(ignored_causes, mjd).of(cause, parameter) for mjd in (NOON, MIDNIGHT))


def duty(scene: SimulatedDays, *days: int) -> Floats:
    """Return the sunlit part of the orbit, by the angle of Sun and orbit plane; (day,)."""
    declination = _declination(np.array(days) - 0.5)
    orbits = [scene.day(mjd) for mjd in days]
    beta = orbit_plane_sun(np.array([day.local_time for day in orbits]), declination, _INCLINATION)
    return np.array([float(sunlit_duty(day.altitude, one)) for day, one in zip(orbits, beta, strict=True)])


def daytime(scene: SimulatedDays, *days: int) -> tuple[float, ...]:
    """Return the minutes of sunlight in an orbit, counted over each day's samples."""
    orbits = [scene.day(mjd) for mjd in days]
    return tuple(day.sunlit_part * orbit_period(day.altitude) / 60.0 for day in orbits)


def least_duty_at_dawn(scene: SimulatedDays) -> float:
    """Return the smallest sunlit part of an orbit at local times 06 and 18 over a year."""
    declination = _declination(np.arange(366.0))
    hours = [orbit_plane_sun(np.array(hour), declination, _INCLINATION) for hour in (6.0, 18.0)]
    return float(min(sunlit_duty(scene.day(NOON).altitude, beta).min() for beta in hours))


def recovered_field(scene: SimulatedDays) -> Estimate:
    """Return the mean over seeds of a day/night field on z that was put into days with noise, nT."""
    found = []
    for seed in range(_SEEDS):
        equations = _injected(scene, DAYS, seed, robust=True)
        fit = fit_day_night(equations)
        index = fit.columns.index(f"{SWITCHED}[z]")
        found.append(Estimate.of(fit.value[index], fit.sigma[index]))
    return Estimate.mean(found)


def _injected(scene: SimulatedDays, days: Sequence[int], seed: int, *, robust: bool) -> NormalEquations:
    """Return the normal equations of days with noise and a day/night field on z."""
    generator, blocks = np.random.default_rng(seed), []
    for mjd in days:
        day = scene.day(mjd)
        columns = nine_columns(day.field) | switched_columns(day.direction, day.sunlit)
        residual = generator.normal(0.0, _NOISE, day.strength.size) - columns[f"{SWITCHED}[z]"] * DAY_NIGHT
        blocks.append(block_equations(columns, residual, day.span, robust=robust))
    return concat_equations(blocks)


def angle_variation(scene: SimulatedDays) -> tuple[float, float]:
    """Return the amplitude of 260.5 days in the daily angle xz, arcsec: a field by day ignored, and known.

    The field is put into days over three cycles of local time and, for the second number, fitted to the same
    days beside the nine parameters of each.
    """
    equations = _injected(scene, _CYCLES, 0, robust=False)
    found = fit_day_night(equations)
    turn = 2.0 * np.pi * np.array(_CYCLES) / LOCAL_TIME_DAYS
    waves = np.column_stack([np.cos(turn), np.sin(turn), np.ones(turn.size)])
    amplitudes = []
    for known in (None, found.values):
        daily = (
            block_parameters(equations, _LOOSE, known)["value"].sel(parameter=NINE_PARAMETER_NAMES[4]).values
        )
        amplitudes.append(float(np.hypot(*np.linalg.lstsq(waves, daily)[0][:2])))
    return amplitudes[0], amplitudes[1]


def _declination(days: Floats) -> Floats:
    """Declination of the Sun, deg, on days since J2000."""
    return np.asarray(np.degrees(np.arcsin(sun_direction(days)[:, 2])))


derived = partial(PublishedFigure, section=SECTION, basis="derived")
recovered = partial(PublishedFigure, section=SECTION, basis="recovered_from_injection", why=RECOVERED)
needs_data = partial(PublishedFigure, section=SECTION, basis="needs_mission_data")

FIGURES = (
    derived(
        id="day-night.duty",
        what="sunlit part of the orbit near local noon and midnight, days 2852 and 2979",
        unit="1",
        source="Yin 2010, section 4.3: the shortest daytime",
        published=(0.4, 0.4),
        tolerance=0.05,
        why="Geometry gives 0.60 to 0.62 at least; 0.39 is the part of the night.",
        obtain=lambda scene: tuple(duty(scene, NOON, MIDNIGHT)),
    ),
    derived(
        id="day-night.night",
        what="part of the orbit in the shadow on the same days",
        unit="1",
        source="geometry; what the 0.4 of Yin 2010, section 4.3, is when day and night are exchanged",
        published=(0.39, 0.39),
        tolerance=0.015,
        why="The longest night, not the shortest day.",
        obtain=lambda scene: tuple(1.0 - duty(scene, NOON, MIDNIGHT)),
        printed=False,
    ),
    derived(
        id="day-night.daytime",
        what="daytime of an orbit near local noon and midnight, days 2852 and 2979",
        unit="min",
        source="Yin 2010, section 4.1: about 45 min",
        published=(45.0, 45.0),
        tolerance=5.0,
        why="55 to 58 min by geometry; no orbit has less day than night.",
        obtain=lambda scene: daytime(scene, NOON, MIDNIGHT),
    ),
    derived(
        id="day-night.daytime-oblique",
        what="daytime of an orbit at local times 09, 03, 15, 21",
        unit="min",
        source="Yin 2010, section 4.1: about 60 min",
        published=(60.0, 60.0, 60.0, 60.0),
        tolerance=5.0,
        why="Between orbital noon and full sun.",
        obtain=lambda scene: daytime(scene, *_OBLIQUE),
    ),
    derived(
        id="day-night.full-sun",
        what="least sunlit part of the orbit at local times 06 and 18 over a year",
        unit="1",
        source="Yin 2010, sections 4.1 and 4.3: 1, sunlight all the time",
        published=1.0,
        tolerance=0.05,
        why=(
            "True near the equinoxes; it needs the Sun 71 degrees off the orbit plane, at solstice it is "
            "lower."
        ),
        obtain=least_duty_at_dawn,
    ),
    needs_data(
        id="day-night.amplitude",
        what="difference of the slopes of dB on Bz/F by day and by night",
        unit="nT",
        source="Yin 2010, Fig. 4.21: 0.18 and -0.47",
        published=DAY_NIGHT,
        tolerance=0.005,
        why="CHAMP's own field, read off its dB; tried: put in, see day-night.slopes.",
    ),
    recovered(
        id="day-night.recovered",
        what="the same field put into seven days with 0.1 nT of noise, and fitted beside the nine parameters",
        unit="nT",
        source="Yin 2010, Fig. 4.21: 0.18 and -0.47",
        published=DAY_NIGHT,
        # Three times the scatter over seeds.
        tolerance=0.012,
        obtain=recovered_field,
        nominal=0.0,
    ),
    derived(
        id="day-night.xz",
        what="shift of the angle xz on days 2852 and 2979 by the day/night field of 0.65 nT on z",
        unit="arcsec",
        source="Yin 2010, section 4.3: angles of 0.000534 and -0.000649 deg",
        published=(1.9, -2.3),
        tolerance=0.05,
        why="Both signs and the order are right; a square wave of 0.65 nT does more, one of 0.4 nT would do.",
        obtain=lambda scene: noon_and_midnight(scene, "day_night_z", XZ),
    ),
    derived(
        id="day-night.xz-square-wave",
        what="the same, as geometry makes one expect it",
        unit="arcsec",
        source="theory of section 4.3 in the IGRF; the thesis prints the angles of CHAMP",
        published=(3.4, -3.4),
        tolerance=0.2,
        why="A field by day along z is e_z times a wave like e_x, the signal of xz.",
        obtain=lambda scene: noon_and_midnight(scene, "day_night_z", XZ),
        printed=False,
    ),
    recovered(
        id="day-night.wander",
        what="amplitude of 260.5 days in the daily angle xz, the same field ignored, and in the model",
        unit="arcsec",
        source="theory of section 4.3 in the IGRF; the thesis names the field as the reason of the wander",
        published=(3.4, 0.0),
        tolerance=(0.3, 0.1),
        why="65 days of 780: the wander is there while the field is ignored and gone with it in the model.",
        obtain=angle_variation,
        nominal=(0.0, 0.0),
        printed=False,
    ),
    derived(
        id="day-night.scale-x",
        what="shift of the scale factor x on the same days by the same field on x",
        unit="ppm",
        source="theory of section 4.3 in the IGRF; the thesis prints none",
        published=(-12.0, 12.0),
        tolerance=1.0,
        why="A field by day along x is e_x times a wave like e_x, the signal of the scale factor.",
        obtain=lambda scene: noon_and_midnight(scene, "day_night_x", "scale_factor[x]"),
        printed=False,
    ),
)
