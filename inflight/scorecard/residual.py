"""Figures of cross-talk in the residual: time shift, scalar bias, resets (Yin 2010, sections 4.1 and 4.2)."""

from __future__ import annotations

import numpy as np

from inflight.calibration import concat_equations
from inflight.mission_fit import SWITCHED, CrossTalkTable, IgnoredCause, correlation, cross_talk, orbit_period
from inflight.scorecard.figure import Figure, Within
from inflight.scorecard.scene import DAYS, MJD_ZERO, NOON, Scene

SECTION = "residual"
XZ = "misalignment[xz]"
#: 10 ms, 0.4 nT, and the day/night field of Fig. 4.21, whose two slopes differ by so much.
LAG, BIAS, DAY_NIGHT = 0.010, 0.4, 0.47 + 0.18
_CAUSES = (
    IgnoredCause("time_shift", LAG, "s", "lag"),
    IgnoredCause("bias", BIAS, "nT", "bias"),
    IgnoredCause(f"{SWITCHED}[x]", DAY_NIGHT, "nT", "day_night_x"),
    IgnoredCause(f"{SWITCHED}[z]", DAY_NIGHT, "nT", "day_night_z"),
)
_SCALES = ("scale_factor[x]", "scale_factor[y]", "scale_factor[z]")
#: The rate of k3 per time shift as the thesis rounds it, 1/s.
_ROUNDED_RATE = 0.002
_ARCSEC = 180.0 * 3600.0 / np.pi
#: Wednesdays that the thesis names: of a reset (section 4.1.2) and after the clock fault (section 4.2.2).
_RESETS = (2517, 3168)


def ignored_causes(scene: Scene, *days: int) -> CrossTalkTable:
    """Return what each cause does when it is ignored, the days being one calibration."""
    return cross_talk(concat_equations([scene.equations(mjd) for mjd in days]), _CAUSES)


def _mission(scene: Scene) -> CrossTalkTable:
    return scene.once(ignored_causes, *DAYS)


def _rms(scene: Scene, cause: str) -> tuple[float, float]:
    """Rms residual of a cause and what of it is left, nT."""
    found = _mission(scene)
    row = [one.name for one in found.ignored].index(cause)
    return float(found.before[row]), float(found.after[row])


def lag_correlation(scene: Scene) -> float:
    """Return the correlation of Bx Bz with dF/dt, mean of days."""
    days = [scene.day(mjd) for mjd in DAYS]
    return float(np.mean([correlation(day.field[:, 0] * day.field[:, 2], day.rate) for day in days]))


def lag_rate(scene: Scene) -> float:
    """Return dk3/dt_s beside all nine parameters, 1/s: an angle falls where its cosine grows."""
    return -_mission(scene).of("lag", XZ) / _ARCSEC / LAG


def lag_shift_of_dipole(scene: Scene) -> float:
    """Return the shift of a_xz by the lag over the poles of a dipole, arcsec.

    On the argument of latitude, sine s and cosine c, Bx = B c, Bz = 2 B s, F = B sqrt(1 + 3 s^2): dF/dt is
    ``3 n B s c / sqrt(..)``, the column of k3 ``2 B s c / sqrt(..)``, so that k3 = 1.5 n t_s exactly.
    """
    motion = 2.0 * np.pi / orbit_period(scene.day(NOON).altitude)
    return float(-1.5 * motion * LAG * _ARCSEC)


def common_scale(scene: Scene) -> float:
    """Return by how much all scale factors grow alike for the bias: least squares of it on F, ppm."""
    strength = np.concatenate([scene.day(mjd).strength for mjd in DAYS])
    return float(BIAS * strength.sum() / (strength @ strength) * 1e6)


def _weekdays(scene: Scene) -> tuple[float, ...]:
    """Return MJD mod 7 of the named days, as far as the calendar makes them Wednesdays."""
    wednesday = [(MJD_ZERO + mjd).item().isoweekday() == 3 for mjd in _RESETS]
    return tuple(float(mjd % 7) if is_one else np.nan for mjd, is_one in zip(_RESETS, wednesday, strict=True))


FIGURES = (
    Figure(
        "lag.correlation",
        SECTION,
        "correlation of Bx Bz with dF/dt",
        "1",
        "Yin 2010, section 4.2.2",
        0.8868,
        Within(0.87, 0.91),
        "derived",
        "Geometry of the main field along a polar orbit; days scatter by 0.005.",
        lag_correlation,
    ),
    Figure(
        "lag.rate",
        SECTION,
        "change of k3 per time shift",
        "1/s",
        "Yin 2010, section 4.2.2, where the ratio is printed upside down",
        _ROUNDED_RATE,
        0.0005,
        "derived",
        "0.00156 1/s rounds to the printed digit, which carries an error of a quarter.",
        lag_rate,
    ),
    Figure(
        "lag.xz",
        SECTION,
        "shift of the angle xz by a time shift of 10 ms",
        "arcsec",
        "Yin 2010, section 4.2.2",
        -4.1,
        0.05,
        "derived",
        "The sign is right; the size is the rounded rate's, the unrounded one gives -3.2.",
        lambda scene: _mission(scene).of("lag", XZ),
    ),
    Figure(
        "lag.xz-rounded",
        SECTION,
        "the same from the rate as it is printed",
        "arcsec",
        "Yin 2010, section 4.2.2",
        -4.1,
        0.05,
        "derived",
        "This is how the thesis came to -4.1.",
        lambda scene: -_ROUNDED_RATE * LAG * _ARCSEC,
    ),
    Figure(
        "lag.xz-exact",
        SECTION,
        "the same by least squares of all nine parameters in the IGRF",
        "arcsec",
        "theory of section 4.2.2; the thesis prints the rounded one",
        -3.2,
        0.1,
        "derived",
        "Days lie between -3.16 and -3.28.",
        lambda scene: _mission(scene).of("lag", XZ),
        printed=False,
    ),
    Figure(
        "lag.xz-dipole",
        SECTION,
        "the same over the poles of a dipole",
        "arcsec",
        "theory of section 4.2.2: 1.5 times the mean motion times the time shift; the thesis prints none",
        -3.5,
        0.05,
        "derived",
        "In a dipole the two signals are one.",
        lag_shift_of_dipole,
        printed=False,
    ),
    Figure(
        "lag.rms",
        SECTION,
        "rms residual of a time shift of 10 ms, and what the nine parameters leave of it",
        "nT",
        "theory of section 4.2.2 in the IGRF; the thesis prints none",
        (0.20, 0.08),
        (0.01, 0.01),
        "derived",
        "A calibration hides four fifths of the square of a clock error, and gives it to the angle.",
        lambda scene: _rms(scene, "lag"),
        printed=False,
    ),
    Figure(
        "bias.scale-factors",
        SECTION,
        "growth of the scale factors x, y, z by 0.4 nT added to the scalar reading",
        "ppm",
        "theory of section 4.2.1 in the IGRF; the thesis shows it in Fig. 4.16 and prints none",
        (15.0, 29.0, 8.0),
        (1.0, 3.0, 0.5),
        "derived",
        "The weak y component answers most.",
        lambda scene: tuple(_mission(scene).of("bias", name) for name in _SCALES),
        printed=False,
    ),
    Figure(
        "bias.common",
        SECTION,
        "the same when all three grow alike",
        "ppm",
        "theory of section 4.2.1 in the IGRF; the thesis prints none",
        10.0,
        0.5,
        "derived",
        "The bias over the field's strength.",
        common_scale,
        printed=False,
    ),
    Figure(
        "bias.rms",
        SECTION,
        "rms residual of a bias of 0.4 nT, and what the nine parameters leave of it",
        "nT",
        "theory of section 4.2.1 in the IGRF; the thesis prints none",
        (0.4, 0.05),
        (0.005, 0.005),
        "derived",
        "What is left, 1/8, is all that tells a bias from the scale factors.",
        lambda scene: _rms(scene, "bias"),
        printed=False,
    ),
    Figure(
        "resets.weekday",
        SECTION,
        "day number modulo 7 of the resets on Wednesdays, days 2517 and 3168",
        "1",
        "calendar; Yin 2010, sections 4.1.2 and 4.2.2 name the days",
        (4.0, 4.0),
        0.0,
        "derived",
        "Day 0 is Saturday, 2000-01-01; both named days are Wednesdays.",
        _weekdays,
        printed=False,
    ),
    Figure(
        "clock-fault",
        SECTION,
        "time shift of the clock fault of days 3164 to 3167",
        "s",
        "Yin 2010, section 4.2.2, Fig. 4.18",
        0.012,
        0.0005,
        "needs_mission_data",
        "A fault of CHAMP's clocks; tried: put in and found, see clock-fault.recovered.",
    ),
    Figure(
        "offset.drift",
        SECTION,
        "drift of the z offset over the mission",
        "nT/d",
        "Yin 2010, section 4.1.2",
        -0.00024,
        0.000005,
        "needs_mission_data",
        "CHAMP's sensor or body; tried: put in, see offset.drift-recovered.",
    ),
)
