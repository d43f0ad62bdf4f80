"""Figures of day and night: how long they last and what a field that follows them does (Yin 2010, 4.3)."""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.calibration import NINE, block_equations, concat_equations, nine_columns
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
from inflight.scorecard.figure import Figure
from inflight.scorecard.residual import DAY_NIGHT, SECTION, XZ, ignored_causes
from inflight.scorecard.scene import DAYS, MIDNIGHT, NOON, Scene

_INCLINATION = 87.3
#: Seeds over which an injection is repeated, and its noise, nT.
_SEEDS, _NOISE = 5, 0.1
#: Days at local times 09, 03, 15 and 21 of the ascending node, at which daytime is said to be an hour.
_OBLIQUE = (1833, 1898, 2028, 1963)
#: Days over three cycles of local time, 780 days, for the wander of the angles, and the cycle's length.
_CYCLES, LOCAL_TIME_DAYS = tuple(range(2300, 3082, 12)), 260.5
#: Wide enough to leave each day's nine parameters to the data.
_LOOSE = np.array([0.01] * 3 + [1.0] * 3 + [100.0] * 3)


def noon_and_midnight(scene: Scene, cause: str, parameter: str) -> tuple[float, ...]:
    """Return the shift of a parameter by an ignored cause on the thesis' days near noon and midnight."""
    return tuple(scene.once(ignored_causes, mjd).of(cause, parameter) for mjd in (NOON, MIDNIGHT))


def duty(scene: Scene, *days: int) -> Floats:
    """Return the sunlit part of the orbit, by the angle of Sun and orbit plane; (day,)."""
    declination = _declination(np.array(days) - 0.5)
    told = [scene.day(mjd) for mjd in days]
    beta = orbit_plane_sun(np.array([day.local_time for day in told]), declination, _INCLINATION)
    return np.array([float(sunlit_duty(day.altitude, one)) for day, one in zip(told, beta, strict=True)])


def daytime(scene: Scene, *days: int) -> tuple[float, ...]:
    """Return the minutes of sunlight in an orbit, counted over each day's samples."""
    told = [scene.day(mjd) for mjd in days]
    return tuple(day.sunlit_part * orbit_period(day.altitude) / 60.0 for day in told)


def least_duty_at_dawn(scene: Scene) -> float:
    """Return the smallest sunlit part of an orbit at local times 06 and 18 over a year."""
    declination = _declination(np.arange(366.0))
    hours = [orbit_plane_sun(np.array(hour), declination, _INCLINATION) for hour in (6.0, 18.0)]
    return float(min(sunlit_duty(scene.day(NOON).altitude, beta).min() for beta in hours))


def recovered_field(scene: Scene) -> tuple[float, float]:
    """Return mean and scatter over seeds of a day/night field on z that was put into days with noise, nT."""
    found = [_recovered(scene, seed) for seed in range(_SEEDS)]
    return float(np.mean(found)), float(np.std(found, ddof=1))


def wander(scene: Scene) -> tuple[float, float]:
    """Return the amplitude of 260.5 days in the daily angle xz, arcsec: a field by day ignored, and known.

    The field is put into days over three cycles of local time and, for the second number, fitted to the same
    days beside the nine parameters of each.
    """
    generator, blocks = np.random.default_rng(0), []
    for mjd in _CYCLES:
        day = scene.day(mjd)
        columns = nine_columns(day.field) | switched_columns(day.direction, day.sunlit)
        residual = generator.normal(0.0, _NOISE, day.strength.size) - columns[f"{SWITCHED}[z]"] * DAY_NIGHT
        blocks.append(block_equations(columns, residual, day.span, robust=False))
    whole = concat_equations(blocks)
    found = fit_day_night(whole)
    name = NINE[4]
    ignored, known = (
        _amplitude(block_parameters(whole, _LOOSE, given)["value"].sel(parameter=name).values)
        for given in (None, found.values)
    )
    return ignored, known


def _amplitude(daily: Floats) -> float:
    """Return the amplitude of the period of local time in values of the days of `_CYCLES`."""
    turn = 2.0 * np.pi * np.array(_CYCLES) / LOCAL_TIME_DAYS
    waves = np.column_stack([np.cos(turn), np.sin(turn), np.ones(turn.size)])
    return float(np.hypot(*np.linalg.lstsq(waves, daily)[0][:2]))


def _recovered(scene: Scene, seed: int) -> float:
    generator, blocks = np.random.default_rng(seed), []
    for mjd in DAYS:
        day = scene.day(mjd)
        columns = nine_columns(day.field) | switched_columns(day.direction, day.sunlit)
        residual = generator.normal(0.0, _NOISE, day.strength.size) - columns[f"{SWITCHED}[z]"] * DAY_NIGHT
        blocks.append(block_equations(columns, residual, day.span))
    return fit_day_night(concat_equations(blocks)).values[f"{SWITCHED}[z]"]


def _declination(days: Floats) -> Floats:
    """Declination of the Sun, deg, on days since J2000."""
    return np.asarray(np.degrees(np.arcsin(sun_direction(days)[:, 2])))


FIGURES = (
    Figure(
        "day-night.duty",
        SECTION,
        "sunlit part of the orbit near local noon and midnight, days 2852 and 2979",
        "1",
        "Yin 2010, section 4.3: the shortest daytime",
        (0.4, 0.4),
        0.05,
        "derived",
        "Geometry gives 0.60 to 0.62 at least; 0.39 is the part of the night.",
        lambda scene: tuple(duty(scene, NOON, MIDNIGHT)),
    ),
    Figure(
        "day-night.night",
        SECTION,
        "part of the orbit in the shadow on the same days",
        "1",
        "geometry; what the 0.4 of Yin 2010, section 4.3, is when day and night are exchanged",
        (0.39, 0.39),
        0.015,
        "derived",
        "The longest night, not the shortest day.",
        lambda scene: tuple(1.0 - duty(scene, NOON, MIDNIGHT)),
        printed=False,
    ),
    Figure(
        "day-night.daytime",
        SECTION,
        "daytime of an orbit near local noon and midnight, days 2852 and 2979",
        "min",
        "Yin 2010, section 4.1: about 45 min",
        (45.0, 45.0),
        5.0,
        "derived",
        "55 to 58 min by geometry; no orbit has less day than night.",
        lambda scene: daytime(scene, NOON, MIDNIGHT),
    ),
    Figure(
        "day-night.daytime-oblique",
        SECTION,
        "daytime of an orbit at local times 09, 03, 15, 21",
        "min",
        "Yin 2010, section 4.1: about 60 min",
        (60.0, 60.0, 60.0, 60.0),
        5.0,
        "derived",
        "Between orbital noon and full sun.",
        lambda scene: daytime(scene, *_OBLIQUE),
    ),
    Figure(
        "day-night.full-sun",
        SECTION,
        "least sunlit part of the orbit at local times 06 and 18 over a year",
        "1",
        "Yin 2010, sections 4.1 and 4.3: 1, sunlight all the time",
        1.0,
        0.05,
        "derived",
        "True near the equinoxes; it needs the Sun 71 degrees off the orbit plane, at solstice it is lower.",
        least_duty_at_dawn,
    ),
    Figure(
        "day-night.amplitude",
        SECTION,
        "difference of the slopes of dB on Bz/F by day and by night",
        "nT",
        "Yin 2010, Fig. 4.21: 0.18 and -0.47",
        DAY_NIGHT,
        0.005,
        "needs_mission_data",
        "CHAMP's own field, read off its dB; tried: put in, see day-night.slopes.",
    ),
    Figure(
        "day-night.recovered",
        SECTION,
        "the same field put into seven days with 0.1 nT of noise, and fitted beside the nine parameters",
        "nT",
        "Yin 2010, Fig. 4.21: 0.18 and -0.47",
        DAY_NIGHT,
        # Three times the scatter over seeds.
        0.012,
        "recovered_from_injection",
        "The estimator returns what was put in: this proves it, not the figure.",
        lambda scene: scene.once(recovered_field)[0],
    ),
    Figure(
        "day-night.xz",
        SECTION,
        "shift of the angle xz on days 2852 and 2979 by the day/night field of 0.65 nT on z",
        "arcsec",
        "Yin 2010, section 4.3: angles of 0.000534 and -0.000649 deg",
        (1.9, -2.3),
        0.05,
        "derived",
        "Both signs and the order are right; a square wave of 0.65 nT does more, one of 0.4 nT would do.",
        lambda scene: noon_and_midnight(scene, "day_night_z", XZ),
    ),
    Figure(
        "day-night.xz-square-wave",
        SECTION,
        "the same, as geometry makes one expect it",
        "arcsec",
        "theory of section 4.3 in the IGRF; the thesis prints the angles of CHAMP",
        (3.4, -3.4),
        0.2,
        "derived",
        "A field by day along z is e_z times a wave like e_x, the signal of xz.",
        lambda scene: noon_and_midnight(scene, "day_night_z", XZ),
        printed=False,
    ),
    Figure(
        "day-night.wander",
        SECTION,
        "amplitude of 260.5 days in the daily angle xz, the same field ignored, and in the model",
        "arcsec",
        "theory of section 4.3 in the IGRF; the thesis names the field as the reason of the wander",
        (3.4, 0.0),
        (0.3, 0.1),
        "recovered_from_injection",
        "65 days of 780: the wander is there while the field is ignored and gone with it in the model.",
        lambda scene: scene.once(wander),
        printed=False,
    ),
    Figure(
        "day-night.scale-x",
        SECTION,
        "shift of the scale factor x on the same days by the same field on x",
        "ppm",
        "theory of section 4.3 in the IGRF; the thesis prints none",
        (-12.0, 12.0),
        1.0,
        "derived",
        "A field by day along x is e_x times a wave like e_x, the signal of the scale factor.",
        lambda scene: noon_and_midnight(scene, "day_night_x", "scale_factor[x]"),
        printed=False,
    ),
)
