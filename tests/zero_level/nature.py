"""Simulated fields of the solar wind and the magnetosheath: power laws in time, size and direction apart."""

import numpy as np

SECOND = 1_000_000_000


def power_law(count, generator, columns=1, slope=5.0 / 3.0, longest=450):
    """Return unit-variance series (count, columns) with a power law in frequency, white below 1/longest."""
    size = 2 * count
    frequency = np.fft.rfftfreq(size)
    amplitude = np.maximum(frequency, 1.0 / longest) ** (-slope / 2)
    phases = generator.normal(size=(frequency.size, columns)) + 1j * generator.normal(
        size=(frequency.size, columns)
    )
    series = np.fft.irfft(amplitude[:, None] * phases, size, axis=0)[:count]
    return series / np.sqrt(np.mean(amplitude**2) * 2 * (frequency.size / size**2) * 2)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def turned(generator, count, spread):
    """Return directions (count, 3) that wander about a mean, which wanders itself for hours."""
    mean = unit(generator.normal(size=3))
    slow = power_law(count, generator, 3, longest=4000)
    return unit(mean + 0.5 * spread * slow + spread * power_law(count, generator, 3))


def solar_wind(generator, hours=24.0, cadence=16.0, size=6.0, spread=0.5, compressed=0.1, noise=0.02):
    """Return times and field of Alfvenic turning; the size varies on its own, `compressed` of it (rms)."""
    count = round(hours * 3600 / cadence)
    strength = size * np.exp(compressed * power_law(count, generator)[:, 0])
    field = strength[:, None] * turned(generator, count, spread)
    return stamps(count, cadence), field + noise * generator.normal(size=field.shape)


def magnetosheath(
    generator, hours=20.0, cadence=4.0, size=20.0, squeezed=0.25, turning=0.06, noise=0.02, drape=0.5
):
    """Return times and field of mirror modes: the size varies along a direction that wanders for hours."""
    count = round(hours * 3600 / cadence)
    mean = unit(generator.normal(size=3))
    direction = unit(mean + drape * power_law(count, generator, 3, longest=6000, slope=3.0))
    strength = size * np.exp(squeezed * power_law(count, generator, longest=15)[:, 0])
    field = strength[:, None] * direction + size * turning * power_law(count, generator, 3, longest=100)
    return stamps(count, cadence), field + noise * generator.normal(size=field.shape)


def stamps(count, cadence, start=700_000_000 * SECOND):
    return start + np.arange(count) * round(cadence * SECOND)
