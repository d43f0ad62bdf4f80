"""Figures of continuous processing (Yin 2010, sections 3.1 to 3.3, 3.5 and 3.6)."""

from __future__ import annotations

from functools import partial

import numpy as np

from inflight.arrays import Floats
from inflight.mission_fit import day_statistics
from inflight.scorecard.figure import Figure, Within
from inflight.scorecard.scalar_calibration import scale_factors
from inflight.scorecard.scene import DAYS, Scene

SECTION = "continuous-parameters"
#: Field strength at which ageing is told in nT: high latitudes on CHAMP's orbit.
_STRONG = 50_000.0
#: Days between updates of the standard processing.
_UPDATE = 15
#: Samples of an orbit of 5550 s, every 30 s.
_ORBIT = 185


def ageing(mjd: float) -> float:
    """Return by how much |B| grows until the next update by the ageing of the scale factors alone, nT."""
    return float((scale_factors(mjd + _UPDATE) - scale_factors(mjd)).mean() * _STRONG)


def offset_slope(direction: Floats, axis: int) -> float:
    """Return a of ``std^2(dB) = a E0^2 + noise^2`` for an offset on one axis.

    An offset of 1 nT adds e_i to dB: the spread of a day without any noise (Yin 2010, eq. 3.6).

    Parameters
    ----------
    direction : ndarray, shape (time, 3)
        Unit vectors of the field, evenly spaced.
    """
    day = day_statistics(direction[:, axis], direction, 0, 1, axis=axis)
    return float(day["variance"].item())


def _dipole_slope(scene: Scene) -> float:
    """Return a of a Z offset on a circular orbit over the poles of a dipole."""
    colatitude = np.linspace(0.0, 2.0 * np.pi, 100_000, endpoint=False)
    along, down = np.sin(colatitude), 2.0 * np.cos(colatitude)
    field = np.stack([along, np.zeros_like(along), down], axis=1)
    return offset_slope(field / np.linalg.norm(field, axis=1, keepdims=True), 2)


def _mean_slope(scene: Scene, axis: int) -> float:
    return float(np.mean([offset_slope(scene.day(mjd).direction, axis) for mjd in DAYS]))


def _slopes_of_orbits(scene: Scene) -> tuple[float, float]:
    every = [
        float(day.direction[start : start + _ORBIT, 2].var())
        for day in (scene.day(mjd) for mjd in DAYS)
        for start in range(0, len(day.direction) - _ORBIT, _ORBIT)
    ]
    return min(every), max(every)


FIGURES = (
    Figure(
        "ageing.day-500",
        SECTION,
        "growth of |B| at 50 000 nT between updates 15 days apart by ageing alone, day 500",
        "nT",
        "the logarithm of Yin 2010, section 3.3; the thesis prints no jump",
        0.62,
        0.005,
        "derived",
        "The mean lb of the three axes times the logarithm of (515 - 150)/(500 - 150).",
        lambda scene: ageing(500),
        printed=False,
    ),
    Figure(
        "ageing.day-3000",
        SECTION,
        "growth of |B| at 50 000 nT between updates 15 days apart by ageing alone, day 3000",
        "nT",
        "the logarithm of Yin 2010, section 3.3; the thesis prints no jump",
        0.08,
        0.005,
        "derived",
        "Eight years on the same sensor ages eight times more slowly.",
        lambda scene: ageing(3000),
        printed=False,
    ),
    Figure(
        "z-offset.slope-dipole",
        SECTION,
        "a of std^2(dB) = a Z0^2 + noise^2 over the poles of a dipole",
        "1",
        "Yin 2010, section 3.5: 2/3",
        2.0 / 3.0,
        1e-4,
        "derived",
        "The mean of 4 cos^2/(1 + 3 cos^2) over the orbit.",
        _dipole_slope,
    ),
    Figure(
        "z-offset.slope",
        SECTION,
        "the same a in the IGRF along CHAMP's orbit, mean of days over the mission",
        "1",
        "Yin 2010, eq. 3.6",
        0.6655,
        Within(0.655, 0.68),
        "derived",
        "Geometry alone gives it: single days scatter by 0.01; the regression itself needs CHAMP's dB.",
        partial(_mean_slope, axis=2),
    ),
    Figure(
        "z-offset.slope-orbits",
        SECTION,
        "smallest and largest a of a single orbit",
        "1",
        "geometry of the IGRF along CHAMP's orbit; the thesis prints none",
        (0.63, 0.69),
        Within(0.63, 0.69),
        "derived",
        "Longitude matters: single orbits scatter three times as much as days.",
        lambda scene: scene.once(_slopes_of_orbits),
        printed=False,
    ),
    Figure(
        "z-offset.slope-xy",
        SECTION,
        "a of an offset on x, on y, instead",
        "1",
        "geometry of the IGRF along CHAMP's orbit; the thesis prints none",
        (0.313, 0.02),
        (0.005, 0.001),
        "derived",
        "An x offset shows half as much as one on z, a y offset hardly at all.",
        lambda scene: (_mean_slope(scene, 0), _mean_slope(scene, 1)),
        printed=False,
    ),
    Figure(
        "z-offset.noise",
        SECTION,
        "noise^2 of the same regression: what the other parameters leave",
        "nT^2",
        "Yin 2010, eq. 3.6",
        0.0390,
        0.00005,
        "needs_mission_data",
        "A property of CHAMP's residual; tried: put in, see z-offset.regression.",
    ),
    Figure(
        "residual.bounds",
        SECTION,
        "|dB| with continuous parameters; with a daily Z offset; its standard deviation fully corrected",
        "nT",
        "Yin 2010, sections 3.3, 3.5 and chapter 5",
        (1.0, 0.5, 0.1),
        (0.5, 0.05, 0.05),
        "needs_mission_data",
        "The size of CHAMP's own residual; tried: its last step on noise put in, see distribution.size.",
    ),
    Figure(
        "scale-factors.constant",
        SECTION,
        "la of l = la + lb ln(MJD - 150), axes x, y, z",
        "1",
        "Yin 2010, section 3.3",
        (1.00025304, 1.00111601, 1.00102659),
        5e-9,
        "needs_mission_data",
        "A fit to eight years of CHAMP; tried: put in, see scale-factors.constant-recovered.",
    ),
    Figure(
        "scale-factors.logarithm",
        SECTION,
        "lb of l = la + lb ln(MJD - 150), axes x, y, z",
        "1",
        "Yin 2010, section 3.3",
        (2.8960e-4, 2.9990e-4, 2.9850e-4),
        5e-9,
        "needs_mission_data",
        "A fit to eight years of CHAMP; tried: put in, see scale-factors.logarithm-recovered.",
    ),
    Figure(
        "offsets",
        SECTION,
        "constant offsets x, y, z",
        "nT",
        "Yin 2010, section 3.3",
        (26.970, 19.843, 21.625),
        0.0005,
        "needs_mission_data",
        "Averages over eight years of CHAMP; tried: put in, see offsets.recovered.",
    ),
    Figure(
        "angles",
        SECTION,
        "constant misalignment angles xy, xz, yz",
        "deg",
        "Yin 2010, section 3.3",
        (90.02613, 90.05986, 90.03873),
        5e-6,
        "needs_mission_data",
        "From the ground, confirmed in flight; tried: put in, see angles.recovered.",
    ),
    Figure(
        "shifts",
        SECTION,
        "lag of the coil temperature; time shift between the sensors",
        "s",
        "Yin 2010, section 3.3",
        (100.0, 0.015),
        (0.5, 0.0005),
        "needs_mission_data",
        "Both are fitted to CHAMP; tried: put in, see temperature.lag-recovered and time-shift.recovered.",
    ),
)
