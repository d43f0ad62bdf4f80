"""What two sensors at rest do by themselves, slowly: flicker noise and drifting offsets.

White noise is seen where a spacecraft rests; what changes as slowly as units do cannot be told from them by
the difference alone. So much is therefore allowed for, and no correction is made of less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats

#: How far two sensors drift apart within minutes, by their temperatures, and in an hour, which grows with the
#: root of time; nT, rms about the mean of the time. Offsets of space fluxgates move by some 0.1 nT in a day,
#: and by about 1 nT in a month.
AT_ONCE, DRIFT = 0.03, 0.03
#: Sensors are not alike: how much a pair wanders has Student's distribution with so many degrees of freedom.
TAIL = 3.0
#: Flicker noise of the difference in a record beside the white noise of one sample, one standard deviation.
FLICKER = 0.5
#: Series that are drawn of each.
DRAWS = 3


def drift_in(seconds: float, hourly: float = DRIFT) -> float:
    """Return how far two sensors drift apart in a time, nT, rms about its mean."""
    return float(np.hypot(AT_ONCE, hourly * np.sqrt(max(seconds, 0.0) / 3600.0)))


@dataclass(frozen=True)
class Wandering:
    """How sensors wander in a record: draws of flicker noise and of a walk, and a line; each (time, draw).

    Attributes
    ----------
    flicker : ndarray
        Beside white noise of size one.
    walk : ndarray
        A random walk whose ends are as far apart as the rms of the line.
    line : ndarray, shape (time, 1)
        A straight line of rms one. A pair that drifts steadily does not walk, and the other way round.
    """

    flicker: Floats
    walk: Floats
    line: Floats


def wandering(count: int, draws: int = DRAWS) -> Wandering:
    """Return how sensors wander in a record of `count` samples."""
    random = np.random.default_rng(5)
    frequency = np.fft.rfftfreq(count)
    spectrum = random.normal(size=(draws, frequency.size)) + 1j * random.normal(size=(draws, frequency.size))
    spectrum[:, 1:] /= np.sqrt(frequency[1:])
    spectrum[:, 0] = 0.0
    flicker = np.fft.irfft(spectrum, count, axis=1).T
    walk = np.cumsum(random.normal(0.0, 1.0 / np.sqrt(count), (count, draws)), axis=0)
    line = np.sqrt(12.0) * (np.arange(count) / count - 0.5)
    return Wandering(np.asarray(FLICKER * flicker / flicker.std(axis=0)), walk, line[:, None])
