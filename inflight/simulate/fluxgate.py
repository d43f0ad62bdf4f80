"""The fluxgate: from the field at the sensor to its reading, the thesis' chain run backwards exactly."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from inflight.simulate.grid import Float
from inflight.simulate.orbit import mjd
from inflight.simulate.parameters import Parameters
from inflight.simulate.randomness import drift, generator


def scale_factors(seconds: Float, parameters: Parameters, effects: Collection[str]) -> Float:
    """Return ``l0 = la + lb ln(MJD - 150)``, shape (time, 3) (Yin 2010, 3.3; correction side)."""
    days = mjd(seconds) if "ageing" in effects else np.full_like(seconds, parameters.scale_frozen_mjd)
    growth = np.log(days - parameters.scale_epoch)
    return np.asarray(parameters.scale_constant + growth[:, None] * np.array(parameters.scale_log))


def nine_parameters(
    seconds: float, parameters: Parameters, effects: Collection[str]
) -> dict[str, list[float]]:
    """Return scale factors, angles (deg) and offsets (nT) of ``B = K (E - E0)`` at one TT2000.

    K is the unit-diagonal angle matrix times the scale factors, so its entry xy is
    ``l_y cos a_xy``: the angles here are ``arccos`` of K's entries and differ from the thesis' by up
    to 0.6 arcsec. Fields constant in spacecraft axes are not in the offsets.
    """
    scale = scale_factors(np.array([seconds]), parameters, effects)[0]
    cosines = np.cos(np.radians(parameters.angles)) * ("misalignment" in effects)
    return {
        "scale_factor": scale.tolist(),
        "misalignment": np.degrees(np.arccos(cosines * scale[[1, 2, 2]])).tolist(),
        "offset": [value * ("offset" in effects) for value in parameters.offset],
    }


def thermal_factors(coil: Float, converter: Float, parameters: Parameters, effects: Collection[str]) -> Float:
    """Return ``1 - lT1 dT - lT2 dT^2``, shape (time, 3) (Yin 2010, 2.4 step 4a).

    `coil` is the temperature that acts and `converter` that of the electronics, degC, (time,).
    """
    factor = np.ones((coil.size, 3))
    if "temperature" in effects:
        excess = (coil - parameters.temperature_reference)[:, None]
        factor -= excess * parameters.temperature_linear + parameters.temperature_quadratic * excess**2
    if "adc_temperature" in effects:
        factor -= (converter - 20.0)[:, None] * np.array(parameters.adc_temperature_linear)
    return factor


def solve_reading(corrected: Float, linear: Float, quadratic: Float, cubic: Float) -> Float:
    """Return E' with ``linear E' + quadratic E'^2 + cubic E'^3 = corrected``, by Newton's method.

    All of one shape or broadcastable; nT, 1, 1/nT, 1/nT^2. A start without non-linearity is wrong by
    about 0.1 nT and each step leaves 1e-11 of the square of that, so two reach rounding.
    """
    reading = corrected / linear
    for _ in range(2):
        slope = linear + reading * (2.0 * quadratic + 3.0 * cubic * reading)
        excess = reading * (linear + reading * (quadratic + cubic * reading)) - corrected
        reading = reading - excess / slope
    return reading


def reading(
    field: Float,
    scale: Float,
    factor: Float,
    offset: Float,
    *,
    parameters: Parameters,
    effects: Collection[str],
) -> Float:
    """Return the noiseless reading of the fluxgate.

    The chain of Yin (2010), 2.4, backwards: angles, temperature, non-linear scale, offset.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        Whole field at the sensor, nT, spacecraft axes (the sensor's z is the spacecraft's z).
    scale, factor : ndarray, shape (time, 3)
        `scale_factors` and `thermal_factors`.
    offset : ndarray, shape (time, 3)
        E0, nT.

    Returns
    -------
    ndarray, shape (time, 3)
        nT.
    """
    x, y, z = field.T
    if "misalignment" in effects:
        xy, xz, yz = np.cos(np.radians(parameters.angles))
        y = y - yz * z
        x = x - xy * y - xz * z
    cold = np.column_stack([x, y, z]) / factor
    nonlinear = "nonlinearity" in effects
    quadratic = np.array(parameters.quadratic) * nonlinear
    cubic = np.array(parameters.cubic) * nonlinear
    return solve_reading(cold, scale, quadratic, cubic) + offset


def offsets(
    seconds: Float, coil: Float, parameters: Parameters, effects: Collection[str], seed: int
) -> Float:
    """Return E0 with all that moves it, nT, shape (time, 3)."""
    offset = np.zeros((seconds.size, 3))
    if "offset" in effects:
        offset += parameters.offset
    if "hysteresis" in effects:
        offset += play(coil, parameters.hysteresis_width)[:, None] * parameters.hysteresis_field
    if "offset_drift" in effects:
        rms = (parameters.offset_drift_rms,) * 3
        slow = drift(seconds[::60], seed, "offset drift", rms, periods=(5 * 86400.0, 60 * 86400.0))
        offset += slow.repeat(60, axis=0)[: seconds.size] * parameters.offset_axes
    if "offset_steps" in effects:
        # Resets came on Wednesdays, MJD mod 7 = 4, here at 10:00 UTC.
        weeks = np.floor((mjd(seconds) - 4.0 - 10.0 / 24.0) / 7.0).astype(np.int64)
        steps = {
            week: generator(seed, "offset steps", int(week)).standard_normal(3) for week in np.unique(weeks)
        }
        offset += (
            parameters.offset_step_rms
            * np.array([steps[week] for week in np.unique(weeks)])[weeks - weeks[0]]
            * parameters.offset_axes
        )
    return offset


def play(drive: Float, width: float) -> Float:
    """Return the play operator of a series: it follows only after `width` / 2 of slack, shape (time,)."""
    follower = np.empty_like(drive)
    state = float(drive[0])
    for index, value in enumerate(drive.tolist()):
        state = min(max(state, value - width / 2), value + width / 2)
        follower[index] = state
    return follower
