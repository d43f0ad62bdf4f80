"""Currents of the three magneto-torquers."""

from __future__ import annotations

import numpy as np

from inflight.simulate.grid import Float, Sampling
from inflight.simulate.orbit import argument_of_latitude, mjd
from inflight.simulate.parameters import Parameters
from inflight.simulate.randomness import drift, generator
from inflight.time import SECOND

#: Seconds between commands, so an alternating command has the 20 s period of Yin 3.4.3.
COMMAND = 10
_COIL_TIME = 0.4


def mean_current(seconds: Float, parameters: Parameters) -> Float:
    """Return the mean current that holds the remanent moment in balance, A, shape (time, 3)."""
    age = 1.0 - np.exp(-(mjd(seconds) - 196.0) / parameters.torquer_trend_days)
    current = (np.array(parameters.torquer_mean) + age[:, None] * np.array(parameters.torquer_trend)) / 1e3
    return np.asarray(current)


def torquer_currents(times: Sampling, parameters: Parameters, seed: int, day: int) -> Float:
    """Return the currents of the three coils.

    Commands are renewed every 10 s: mean, a part that follows the orbit, an alternating part
    (period 20 s) whose amplitude wanders, and noise. The coils follow with their time constant.

    Parameters
    ----------
    times : Sampling
        Times of one day.
    parameters, seed, day : Parameters, int, int
        The spacecraft, the seed, and the day's number for the noise.

    Returns
    -------
    ndarray, shape (time, 3)
        A.
    """
    first = times.start // (COMMAND * SECOND) - 1
    last = (times.start + times.cadence * times.count) // (COMMAND * SECOND) + 1
    # Commands, numbered by 10 s of TT2000.
    number = np.arange(first, last + 1)
    seconds = np.asarray(number * float(COMMAND), dtype=np.float64)
    angle = argument_of_latitude(seconds, parameters)
    orbital = np.column_stack([np.sin(angle), np.cos(2.0 * angle), np.cos(angle)])
    swing = drift(seconds[::6], seed, "torquer", (0.4, 0.4, 0.4), periods=(900.0, 40000.0)).repeat(6, axis=0)
    swing = (1.0 + swing[: number.size]) * np.where(number % 2, -1.0, 1.0)[:, None]
    noise = generator(seed, "torquer", day).standard_normal((number.size, 3))
    varying = (
        orbital * parameters.torquer_orbital
        + swing * parameters.torquer_modulation
        + noise * parameters.torquer_random
    )
    commands = mean_current(seconds, parameters) + varying / 1e3
    behind = times.tt2000 - first * COMMAND * SECOND
    index, since = np.divmod(behind, COMMAND * SECOND)
    decay = np.exp(-(since / SECOND) / _COIL_TIME)[:, None]
    return np.asarray(commands[index] + (commands[index - 1] - commands[index]) * decay)
