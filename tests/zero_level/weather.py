"""Another nature than `nature`, built from what spacecraft report and not from what the estimators assume.

The wind is parcels of exponential length, each with its own direction and size, between which the field
turns at one size (rotational discontinuity) or jumps (tangential). In a parcel the direction walks on the
sphere in steps whose size is itself intermittent, compressions follow the local *mean* field with the inverse
of the pressure, weak turbulence is added to all components, and magnetic holes and a shock come by. In the
sheath trains of mirror modes of uneven period ride on transverse waves. So size and direction are not
independent draws, spectra have no single slope, and increments have wide tails. Samples are missing in gaps,
readings are quantised.
"""

import numpy as np
from nature import stamps, unit
from scipy.signal import lfilter

PARKER = np.array([-0.7, 0.7, 0.1])
RESOLUTION = 0.005


def cascade(count, generator, levels=9, spread=0.35):
    """Return intermittent strengths (count,) of mean square 1: a random multiplicative cascade."""
    strength = np.ones(1)
    for _ in range(levels):
        strength = np.repeat(strength, 2)
        strength = strength * np.exp(spread * generator.normal(size=strength.size))
    place = np.linspace(0, strength.size, count, endpoint=False).astype(int)
    return strength[place] / np.sqrt(np.mean(strength[place] ** 2))


def walk(count, generator, memory, columns=3, tails=4.0):
    """Return a walk (count, columns) that forgets after `memory` samples, with steps of wide tails."""
    steps = generator.standard_t(tails, size=(count, columns)) * cascade(count, generator)[:, None]
    steps *= np.sqrt((tails - 2) / tails * 2.0 / memory)
    steps[0] = generator.normal(size=columns)
    return lfilter([1.0], [1.0, 1.0 / memory - 1.0], steps, axis=0)


def parcels(count, generator, mean_length):
    """Return the parcel of each sample and how many there are."""
    edges = np.cumsum(generator.exponential(mean_length, size=4 * int(count / mean_length) + 20))
    of = np.searchsorted(edges, np.arange(count))
    return of, int(of[-1]) + 1


def smoothed(values, width):
    """Return a series (count, columns) smoothed over `width` samples, at its ends too."""
    padded = np.concatenate(
        [np.repeat(values[:1], width, axis=0), values, np.repeat(values[-1:], width, axis=0)]
    )
    kernel = np.ones(width) / width
    out = np.column_stack([np.convolve(one, kernel, mode="same") for one in padded.T])
    return out[width:-width]


def wind(seed, hours=24.0, cadence=16.0, size=5.0, turning=0.35, compressed=0.06, gaps=0.1, shock=True):
    """Return times and field (time, 3) of a day of solar wind, nT; gaps have no samples."""
    generator = np.random.default_rng([seed, 77])
    count = round(hours * 3600 / cadence)
    of, many = parcels(count, generator, 1500.0 / cadence)
    sector = np.where(np.cumsum(generator.random(many) < 0.03) % 2, -1.0, 1.0)[:, None]
    direction = unit(sector * PARKER + 0.45 * generator.standard_t(5, size=(many, 3)))
    strength = size * np.exp(0.12 * generator.normal(size=many))
    # Half of the boundaries are rotational: the size goes on.
    for parcel in np.flatnonzero(generator.random(many) < 0.5):
        strength[parcel] = strength[max(parcel - 1, 0)]
    mean = smoothed(direction[of], max(round(40.0 / cadence), 1))
    scale = smoothed(strength[of][:, None], max(round(40.0 / cadence), 1))[:, 0]
    alfvenic = np.exp(0.5 * generator.normal(size=many))[of][:, None] * turning
    bent = unit(unit(mean) + alfvenic * walk(count, generator, 1200.0 / cadence))
    pressure = compressed * walk(count, generator, 400.0 / cadence, 1)[:, 0]
    field = scale[:, None] * (bent - 0.5 * pressure[:, None] * unit(mean))
    field += 0.02 * size * walk(count, generator, 200.0 / cadence)
    field = with_holes(field, generator, cadence)
    if shock and generator.random() < 0.5:
        at = int(generator.integers(count // 4, count))
        field[at:] *= (
            1.0 + generator.uniform(0.5, 1.5) * np.exp(-np.arange(count - at) * cadence / 2e4)[:, None]
        )
    return delivered(field, generator, cadence, gaps)


def with_holes(field, generator, cadence, every=1800.0):
    """Return the field with magnetic holes: dips of the size with little turning."""
    out, place = field.copy(), np.arange(len(field)) * cadence
    for middle in generator.uniform(0, place[-1], size=generator.poisson(place[-1] / every)):
        width, depth = generator.uniform(10.0, 60.0), generator.uniform(0.2, 0.8)
        out *= (1.0 - depth * np.exp(-0.5 * ((place - middle) / width) ** 2))[:, None]
    return out


def sheath(seed, hours=12.0, cadence=4.0, size=22.0, gaps=0.05):
    """Return times and field (time, 3) of trains of mirror modes under waves and discontinuities, nT."""
    generator = np.random.default_rng([seed, 78])
    count = round(hours * 3600 / cadence)
    of, many = parcels(count, generator, 1200.0 / cadence)
    draped = unit(
        np.cumsum(0.35 * generator.normal(size=(many, 3)), axis=0) + 2.0 * unit(generator.normal(size=3))
    )
    mean = unit(smoothed(draped[of], max(round(60.0 / cadence), 1)))
    period = np.exp(np.log(25.0) + 0.4 * walk(count, generator, 300.0 / cadence, 1)[:, 0])
    phase = np.cumsum(2.0 * np.pi * cadence / period)
    train = np.clip(0.6 + 0.5 * walk(count, generator, 900.0 / cadence, 1)[:, 0], 0.0, 1.5)
    peaks = train * (np.exp(np.cos(phase)) - 1.27) / 0.8
    along = 1.0 + 0.22 * peaks
    waves = 0.06 * walk(count, generator, 20.0 / cadence)
    waves -= np.sum(waves * mean, axis=1, keepdims=True) * mean
    field = size * (np.maximum(along, 0.15)[:, None] * mean + waves)
    field += 0.02 * size * walk(count, generator, 60.0 / cadence)
    return delivered(field, generator, cadence, gaps)


def delivered(field, generator, cadence, gaps, noise=0.02):
    """Return times and readings as delivered: noise, resolution, gaps of minutes to an hour."""
    times = stamps(len(field), cadence)
    reading = field + noise * generator.normal(size=field.shape)
    reading = RESOLUTION * np.rint(reading / RESOLUTION)
    kept = np.ones(len(field), dtype=bool)
    while kept.mean() > 1.0 - gaps:
        at, length = int(generator.integers(0, kept.size)), generator.exponential(900.0) / cadence
        kept[at : at + int(length) + 1] = False
    return times[kept], reading[kept]
