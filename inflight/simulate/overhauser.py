"""The Overhauser magnetometer: modulus of the field at its place, bandwidth, bias and oscillator."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from inflight.simulate.grid import Float
from inflight.simulate.orbit import mjd
from inflight.simulate.parameters import Parameters
from inflight.simulate.randomness import drift


def sampling_delay(seconds: float, parameters: Parameters, effects: Collection[str]) -> float:
    """Return by how many seconds a sample precedes its stamp at this TT2000 (Yin 2010, 2.5)."""
    delay = parameters.time_shift if "time_shift" in effects else 0.0
    first, last = parameters.clock_fault_days
    if "clock_fault" in effects and first <= round(float(mjd(np.array(seconds)))) < last:
        delay += parameters.clock_fault
    return delay


def oscillator_ratio(
    seconds: Float, electronics: Float, parameters: Parameters, effects: Collection[str], seed: int
) -> Float:
    """Return f_ovm / f_ref, shape (time,); 1 when the effect is absent."""
    if "oscillator" not in effects:
        return np.ones_like(seconds)
    slow = drift(seconds[::60], seed, "oscillator", (parameters.oscillator_wander,), periods=(86400.0, 6e6))
    slow = slow.repeat(60, axis=0)[: seconds.size, 0]
    warm = parameters.oscillator_temperature * (electronics - 20.0)
    return np.asarray(1.0 + parameters.oscillator_offset + slow + warm)


def strength(field: Float, stray: Float, parameters: Parameters, effects: Collection[str]) -> Float:
    """Return the modulus of all that the sensor is in, nT, shape (time,).

    Heading and induced fields (Yin 2010, 2.5) are added as vectors, not projected.
    """
    total = field + stray
    if "heading" in effects:
        total = total + np.array(parameters.heading)
    if "induced" in effects:
        total = total + field * (np.array(parameters.induced_first) + np.array(parameters.induced_second))
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", total, total)))


def low_pass(series: Float, bandwidth: float, cadence: float) -> Float:
    """Return a series through a Gaussian filter without delay, -3 dB at `bandwidth` Hz.

    The ends are continued by odd reflection, which keeps level and slope.
    """
    spread = np.sqrt(np.log(2.0)) / (2.0 * np.pi * bandwidth * cadence)
    reach = int(np.ceil(4.0 * spread))
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / spread) ** 2)
    before = 2.0 * series[0] - series[reach:0:-1]
    after = 2.0 * series[-1] - series[-2 : -reach - 2 : -1]
    return np.convolve(np.concatenate([before, series, after]), taps / taps.sum(), mode="valid")


def reading(
    strength_seen: Float, ratio: Float, parameters: Parameters, effects: Collection[str], cadence: float
) -> Float:
    """Return the noiseless reading, nT, shape (time,).

    ``(filtered strength + bias) f_ref / f_ovm``: multiplying by f_ovm / f_ref corrects it.
    """
    filtered = strength_seen
    if "scalar_filter" in effects:
        filtered = low_pass(strength_seen, parameters.scalar_bandwidth, cadence)
    bias = parameters.scalar_bias if "scalar_bias" in effects else 0.0
    return (filtered + bias) / ratio
