"""Spacecraft with switching units, two sensors and an ambient field like that of the solar wind."""

from dataclasses import dataclass

import numpy as np

from inflight.dual import Readings
from inflight.time import SECOND

#: Table 1 of the Venus Express paper: B_out - B_in and the correction *added* to the outboard sensor, x, nT.
OUT_LESS_IN = np.array([-9.39, -6.71, -4.05, 0.5, 2.89, 2.72])
ADDED_OUTBOARD = np.array([-6.18, -6.12, -1.68, 0.5, 2.49, 3.63])
ADDED_INBOARD = np.array([-15.57, -12.83, -5.73, 1.0, 5.38, 6.35])


@dataclass(frozen=True)
class Case:
    """Readings and what is true of them: switched units (time, unit), fields at both sensors (time, axis)."""

    readings: Readings
    on: np.ndarray
    ambient: np.ndarray
    stray: np.ndarray
    unit_difference: np.ndarray
    unit_outboard: np.ndarray

    def part(self, rows: slice) -> "Case":
        return Case(
            self.readings.select(rows),
            self.on[rows],
            self.ambient[rows],
            self.stray[rows],
            self.unit_difference,
            self.unit_outboard,
        )

    @property
    def code(self) -> np.ndarray:
        """A number of the true state of each sample."""
        return (self.on @ 2 ** np.arange(self.on.shape[1])).astype(int)


def power_law(random: np.random.Generator, count: int, rms: float, slope: float = 5 / 3) -> np.ndarray:
    """Return a field (time, axis) whose power falls with the frequency, flat below 1e-4 cycles."""
    frequency = np.fft.rfftfreq(count)
    size = np.where(frequency > 0, np.maximum(frequency, 1e-4), np.inf) ** (-slope / 2)
    wave = random.normal(size=(2, frequency.size, 3)) * size[:, None]
    series = np.fft.irfft(wave[0] + 1j * wave[1], count, axis=0)
    return rms * series / series.std(axis=0)


def switched(
    random: np.random.Generator, count: int, units: int, switches: int, together: float
) -> np.ndarray:
    """Return which units are on (time, unit); a part of the switches moves two at once."""
    at = np.sort(random.choice(np.arange(100, count - 100, 60), switches, replace=False))
    toggled = np.zeros((count, units), dtype=int)
    for place in at:
        number = 2 if units > 1 and random.random() < together else 1
        toggled[place, random.choice(units, number, replace=False)] = 1
    return np.cumsum(toggled, axis=0) % 2


def case(
    seed: int,
    *,
    count: int = 40_000,
    rate: float = 1.0,
    units: int = 4,
    switches: int = 80,
    together: float = 0.1,
    noise: float = 0.05,
    ambient: float = 3.0,
    drift: float = 0.0,
    gaps: int = 0,
    on: np.ndarray | None = None,
    size: float = 4.0,
) -> Case:
    """Return a case: `rate` in Hz, `ambient` rms, `drift` amplitude and `size` of units inboard in nT."""
    random = np.random.default_rng(seed)
    inboard = random.normal(0.0, size, (units, 3))
    outboard = inboard * random.uniform(0.25, 0.6, (units, 3))
    state = switched(random, count, units, switches, together) if on is None else on
    field = power_law(random, count, ambient) + random.normal(0.0, 3.0, 3)
    phase = 2.6 * np.pi * np.arange(count)[:, None] / count + random.uniform(0.0, 6.0, 3)
    wander = drift * (np.sin(phase) - np.sin(phase[0]))
    read = [field + state @ unit + random.normal(0.0, noise, (count, 3)) for unit in (inboard, outboard)]
    keep = np.ones(count, dtype=bool)
    for first in random.integers(0, count - 2_000, gaps):
        keep[first : first + random.integers(5, 1_500)] = False
    stamps = (np.arange(count) * (SECOND / rate)).astype(np.int64)
    return Case(
        Readings(stamps[keep], (read[0] + wander)[keep], read[1][keep]),
        state[keep],
        field[keep],
        (state @ outboard)[keep],
        inboard - outboard,
        outboard,
    )


def six_states(seed: int, count: int = 12_000, ambient: float = 1.0) -> tuple[Case, np.ndarray]:
    """Return the paper's six states in x, each twice, and the number (time,) of the state; noise 0.02 nT."""
    random = np.random.default_rng(seed)
    order = np.concatenate([random.permutation(6), random.permutation(6), np.arange(6), np.arange(6)[::-1]])
    number = order.repeat(count // order.size)
    one = np.eye(6)[number]
    outboard = np.zeros((6, 3))
    outboard[:, 0] = -ADDED_OUTBOARD
    inboard = np.zeros((6, 3))
    inboard[:, 0] = -ADDED_INBOARD
    # The paper shows x; the others are what lets 5 and 6 be told, here a little only.
    inboard[:, 1], outboard[:, 1] = 0.3 * np.arange(6), 0.1 * np.arange(6)
    field = power_law(random, number.size, ambient)
    read = [field + one @ unit + random.normal(0.0, 0.02, field.shape) for unit in (inboard, outboard)]
    stamps = np.arange(number.size, dtype=np.int64) * SECOND
    made = Case(Readings(stamps, read[0], read[1]), one, field, one @ outboard, inboard - outboard, outboard)
    return made, number
