"""What two sensors at rest do by themselves, slowly: flicker noise and drifting offsets.

White noise is seen where a spacecraft rests; what changes as slowly as units do cannot be told from them by
the difference alone. So much is therefore allowed for, and no correction is made of less.
"""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats

#: How far two sensors drift apart within minutes, by their temperatures, and in an hour, which grows with the
#: root of time; nT, one standard deviation. Offsets of space fluxgates move by some 0.1 nT in a day, and by
#: about 1 nT in a month.
AT_ONCE, DRIFT = 0.03, 0.03
#: Sensors are not alike: how far one pair drifts has Student's distribution with so many degrees of freedom.
TAIL = 3.0
#: Flicker noise of the difference in a record beside the white noise of one sample, one standard deviation.
FLICKER = 0.5
#: Series that are drawn of each.
DRAWS = 3


def drift_in(seconds: float, hourly: float = DRIFT) -> float:
    """Return how far two sensors drift apart in a time, nT, one standard deviation."""
    return float(np.hypot(AT_ONCE, hourly * np.sqrt(max(seconds, 0.0) / 3600.0)))


def wanderings(count: int, draws: int = DRAWS) -> tuple[Floats, Floats]:
    """Return how sensors wander in a record of `count` samples.

    Returns
    -------
    flicker : ndarray, shape (time, draws)
        Flicker noise beside white noise of size one.
    drift : ndarray, shape (time, draws)
        A straight line of rms one and a random walk that goes as far from one end to the other, together: on
        short scales the walk is larger, on long ones the line.
    """
    random = np.random.default_rng(5)
    frequency = np.fft.rfftfreq(count)
    spectrum = random.normal(size=(draws, frequency.size)) + 1j * random.normal(size=(draws, frequency.size))
    spectrum[:, 1:] /= np.sqrt(frequency[1:])
    spectrum[:, 0] = 0.0
    flicker = np.fft.irfft(spectrum, count, axis=1).T
    walk = np.cumsum(random.normal(0.0, 1.0 / np.sqrt(count), (count, draws)), axis=0)
    line = np.sqrt(12.0) * (np.arange(count) / count - 0.5)
    return np.asarray(FLICKER * flicker / flicker.std(axis=0)), line[:, None] + walk
