"""Figures of the scalar calibration itself (Yin 2010, chapter 2)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from inflight.arrays import Floats
from inflight.calibration import (
    PARAMETER_SCALE,
    fit_difference,
    fit_squares,
    grams,
    kernel_parameters,
    kernel_scale,
    to_sensor_angles,
)
from inflight.model import Dependence
from inflight.scorecard.figure import Figure, Within
from inflight.scorecard.scene import MJD_ZERO, Scene
from inflight.time import DAY, day_bounds

SECTION = "scalar-calibration"
#: Continuous parameters (Yin 2010, section 3.3): l = la + lb ln(MJD - 150), angles in deg, offsets in nT.
SCALE_CONSTANT = np.array([1.00025304, 1.00111601, 1.00102659])
SCALE_LOG = np.array([2.8960e-4, 2.9990e-4, 2.9850e-4])
SCALE_ORIGIN = 150
ANGLES = np.array([90.02613, 90.05986, 90.03873])
OFFSETS = np.array([26.970, 19.843, 21.625])
#: Day at which the raw readings of one pass are made: late, when the scale factors are farthest from 1.
LATE = 3000
#: Noise of the comparison of the three forms, nT, and its seed.
_NOISE, _SEED = 0.1, 1
#: Turns after which both linear forms stand still.
_TURNS = 8


def scale_factors(mjd: float) -> Floats:
    """Return CHAMP's continuous scale factors at a day number of the thesis; (3,)."""
    origin = day_bounds(MJD_ZERO + SCALE_ORIGIN)[0]
    now = origin + round((mjd - SCALE_ORIGIN) * DAY)
    one, log = Dependence("log", t0=origin).basis(now)
    return np.asarray(SCALE_CONSTANT * one + SCALE_LOG * log)


def champ_parameters(mjd: float) -> Floats:
    """Return CHAMP's nine continuous parameters; (9,)."""
    return np.concatenate([scale_factors(mjd), ANGLES, OFFSETS])


def _k_of(value: Floats) -> Floats:
    c = np.cos(np.deg2rad(value[3:6]))
    return np.array([[value[0], c[0], c[1]], [0.0, value[1], c[2]], [0.0, 0.0, value[2]]])


def _passes(scene: Scene, fit: Callable[..., Floats], passes: int) -> tuple[float, float]:
    """Largest residual (nT) and error of a scale factor (ppm) after some passes from raw readings."""
    day, truth = scene.day(LATE), champ_parameters(LATE)
    reading = np.linalg.solve(_k_of(truth), day.field.T).T + truth[6:]
    found = fit(reading, day.strength, passes)
    residual = np.linalg.norm((reading - found[6:]) @ _k_of(found).T, axis=1) - day.strength
    return float(np.abs(residual).max()), float(np.abs(found - truth)[:3].max() * 1e6)


def _worst_residual(scene: Scene, fit: Callable[..., Floats], passes: int) -> float:
    return scene.once(_passes, fit, passes)[0]


def _apart(scene: Scene) -> tuple[float, float]:
    """Largest distance of the two iterated linear forms from exact least squares: ppm, nT."""
    day, truth = scene.day(LATE), champ_parameters(LATE)
    reading = np.linalg.solve(_k_of(truth), day.field.T).T + truth[6:]
    scalar = day.strength + np.random.default_rng(_SEED).normal(0.0, _NOISE, day.strength.size)
    forms = [fit(reading, scalar, _TURNS) for fit in (fit_difference, fit_squares)]
    exact = _exact(reading, scalar, forms[0])
    off = np.array([form - exact for form in forms])
    return float(np.abs(off[:, :3]).max() * 1e6), float(np.abs(off[:, 6:]).max())


def _exact(reading: Floats, scalar: Floats, start: Floats) -> Floats:
    """Least squares by the product's own Gauss-Newton rows, without its robust weights and priors."""
    value, edges = start.copy(), np.array([0, scalar.size], dtype=np.int64)
    still = np.zeros((1, 3))
    for _ in range(_TURNS):
        gram, _, _ = grams(
            kernel_parameters(value),
            np.ascontiguousarray(reading),
            still,
            np.ascontiguousarray(scalar),
            np.inf,
            kernel_scale(value),
            edges,
        )
        value = value - np.linalg.solve(gram[0, :-1, :-1], gram[0, :-1, -1]) * PARAMETER_SCALE
    return value


def _between_axes(scene: Scene) -> tuple[float, ...]:
    return tuple(to_sensor_angles(scale_factors(LATE), ANGLES).between_axes)


FIGURES = (
    Figure(
        "angles.between-axes",
        SECTION,
        "angles between the sensor's axes xy, xz, yz that belong to the printed misalignment angles",
        "deg",
        "geometry of eq. 2.2; Yin 2010, section 3.3 prints 90.02613, 90.05986, 90.03873",
        (89.97387, 89.94014, 89.96127),
        # Scale factors of 1.0025 take the second order to 0.0002 deg.
        0.0003,
        "derived",
        "The printed angles are arccosines of entries of K: the axes stand on the other side of 90 degrees.",
        _between_axes,
        printed=False,
    ),
    Figure(
        "difference-form.one-pass",
        SECTION,
        "largest residual, and error of a scale factor, after one pass of eq. 2.7 from raw readings",
        "nT, ppm",
        "theory of eq. 2.7 on the IGRF, day 3000; the thesis prints none",
        (0.8, 17.0),
        (0.05, 0.5),
        "derived",
        "The form is linear in products of parameters that are 0.25 % and 0.06 degrees from nominal.",
        lambda scene: scene.once(_passes, fit_difference, 1),
        printed=False,
    ),
    Figure(
        "difference-form.second-pass",
        SECTION,
        "largest residual after a second pass of eq. 2.7",
        "nT",
        "theory of eq. 2.7 on the IGRF, day 3000; the thesis prints none",
        1e-4,
        Within(0.0, 1e-4),
        "derived",
        "Repeated on its own result the form loses nothing.",
        partial(_worst_residual, fit=fit_difference, passes=2),
        printed=False,
    ),
    Figure(
        "squares-form.one-pass",
        SECTION,
        "largest residual of F^2 = P.M + Q with Q left out",
        "nT",
        "theory of section 2.2 on the IGRF, day 3000; the thesis prints none",
        0.1,
        0.05,
        "derived",
        "Q holds the squares of offsets and angles.",
        partial(_worst_residual, fit=fit_squares, passes=1),
        printed=False,
    ),
    Figure(
        "squares-form.second-pass",
        SECTION,
        "largest residual of F^2 = P.M + Q with the Q of the first pass",
        "nT",
        "theory of section 2.2 on the IGRF, day 3000; the thesis prints none",
        1e-4,
        Within(0.0, 1e-4),
        "derived",
        "One turn of Q is enough, and Q is right as printed.",
        partial(_worst_residual, fit=fit_squares, passes=2),
        printed=False,
    ),
    Figure(
        "forms.agreement",
        SECTION,
        "largest distance of both iterated linear forms from exact least squares: scale factors, offsets",
        "ppm, nT",
        "theory: all three minimise the same sum; 0.1 nT of noise, day 3000",
        (0.0, 0.0),
        (0.001, 1e-4),
        "derived",
        "Iterated, the two published forms and Gauss-Newton on dB are one estimator.",
        lambda scene: scene.once(_apart),
        printed=False,
    ),
    Figure(
        "temperature.linear",
        SECTION,
        "linear temperature coefficients of the coil",
        "ppm/K",
        "Yin 2010, section 2.4",
        (29.6, 30.37, 30.46),
        (0.05, 0.005, 0.005),
        "needs_mission_data",
        "Measured on CHAMP's coil on the ground; tried: put in, see temperature.recovered.",
    ),
)
