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
AT_ONCE, DRIFT = 0.05, 0.03
#: Flicker noise of the difference in a record beside the white noise of one sample, one standard deviation.
FLICKER = 0.5


def drift_in(seconds: float, hourly: float = DRIFT) -> float:
    """Return how far two sensors drift apart in a time, nT, one standard deviation."""
    return float(np.hypot(AT_ONCE, hourly * np.sqrt(max(seconds, 0.0) / 3600.0)))


def flicker_of_octave(count: int) -> float:
    """Return the variance of flicker noise in one octave of a record, beside that of the white noise."""
    return FLICKER**2 / max(float(np.log2(max(count, 2))), 1.0)


def flicker_of_contrast(block: int, count: int) -> float:
    """Return the variance of flicker noise in contrasts of `block` samples, beside that of white noise."""
    # Means over neighbouring blocks differ by 4 ln 2 times the variance of a factor e of frequency.
    return 2.0 * float(np.log(2.0)) * FLICKER**2 * block / max(float(np.log(count / 2.0)), 1.0)


def drift_of_contrast(block: int, count: int, drift: float) -> float:
    """Return the variance of drift in contrasts of `block` samples, nT^2 an axis.

    A straight line of rms `drift` in the record, nT, and a random walk as far from one end to the other: on
    short scales the walk is larger, on long ones the line.
    """
    line = (np.sqrt(12.0) * drift * block / count) ** 2
    # Means over neighbouring blocks of a walk with steps of variance v differ by 2/3 v block.
    walk = 2.0 / 3.0 * drift**2 * block / count
    return float((line + walk) * block / 2.0)


def wanderings(count: int, draws: int = 4) -> tuple[Floats, Floats]:
    """Return series of a drift and of flicker noise as `drift_of_contrast` and `flicker_of_contrast` have them.

    Returns
    -------
    drift : ndarray, shape (time, 1 + draws)
        A straight line of rms 1 in the record, and random walks that are as far apart at its ends.
    flicker : ndarray, shape (time, draws)
        Beside white noise of size 1.
    """
    random = np.random.default_rng(5)
    line = np.sqrt(12.0) * (np.arange(count) / max(count, 1) - 0.5)
    walks = np.cumsum(random.normal(0.0, 1.0 / np.sqrt(max(count, 1)), (count, draws)), axis=0)
    frequency = np.fft.rfftfreq(count)
    spectrum = random.normal(size=(2, frequency.size, draws))
    shape = np.zeros(frequency.size)
    shape[1:] = 1.0 / np.sqrt(frequency[1:])
    flicker = np.fft.irfft((spectrum[0] + 1j * spectrum[1]) * shape[:, None], count, axis=0)
    size = np.maximum(flicker.std(axis=0), 1e-300)
    return np.column_stack([line, walks]), np.asarray(FLICKER * flicker / size)
