"""Correcting a million samples of two sensors: time and memory, compared with reading the memory once.

``python -m benchmarks.dual`` prints it: 10 Hz, three components each, 4 units that switch 300 times, and an
ambient field that wanders. The least of several processor times counts, because the machine may be shared.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable

import numpy as np

from benchmarks.thresholds import published_jumps
from inflight.arrays import Floats
from inflight.dual import Readings, Training, correction_by_states, train
from inflight.time import SECOND

SAMPLES, UNITS, SWITCHES, TRAINED = 1_000_000, 4, 300, 200_000
_ROUNDS = 5


def mission() -> tuple[Readings, Floats]:
    """Return readings of both sensors and the true stray field at the outboard one (time, axis), nT."""
    random = np.random.default_rng(0)
    inboard = random.normal(0.0, 4.0, (UNITS, 3))
    outboard = inboard * random.uniform(0.25, 0.6, (UNITS, 3))
    toggled = np.zeros((SAMPLES, UNITS), dtype=np.int64)
    at = random.choice(np.arange(500, SAMPLES - 500, 200), SWITCHES, replace=False)
    toggled[at, random.integers(0, UNITS, SWITCHES)] = 1
    on = np.cumsum(toggled, axis=0) % 2
    ambient = 0.01 * np.cumsum(random.normal(size=(SAMPLES, 3)), axis=0)
    read = [ambient + on @ unit + random.normal(0.0, 0.05, (SAMPLES, 3)) for unit in (inboard, outboard)]
    stamps = np.arange(SAMPLES, dtype=np.int64) * (SECOND // 10)
    return Readings(stamps, read[0], read[1]), np.asarray(on @ outboard)


def peak_memory(task: Callable[[], object]) -> float:
    """Return the most memory that a task holds at once, less what was there before, MB."""
    tracemalloc.start()
    task()
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return most / 1e6


def processing_time() -> list[str]:
    """Return what was measured, a line each."""
    readings, stray = mission()
    training: Training = train(readings.select(slice(0, TRAINED)))
    found = correction_by_states(readings, training)

    # A new object each time: what is derived of readings is cached with them.
    def again() -> Readings:
        return readings.select(slice(None))

    rivals: dict[str, Callable[[], object]] = {
        "processing": lambda: correction_by_states(again(), training),
        "published thresholds": lambda: published_jumps(again().difference, sum_threshold=0.7),
        "reading the memory": lambda: (readings.inboard.sum(), readings.outboard.sum()),
    }
    least = dict.fromkeys(rivals, np.inf)
    for _ in range(_ROUNDS):
        for name, rival in rivals.items():
            before = time.process_time()
            rival()
            least[name] = min(least[name], time.process_time() - before)
    remaining = found.field - stray
    remaining -= np.nanmean(remaining, axis=0)
    return [
        f"{SAMPLES} samples x 2 sensors x 3 axes, {SWITCHES} switches of {UNITS} units",
        *(f"{name:>22}: {took:8.3f} s" for name, took in least.items()),
        f"{'memory of processing':>22}: {peak_memory(rivals['processing']):8.0f} MB"
        f" (readings {2 * readings.inboard.nbytes / 1e6:.0f} MB)",
        f"{'known samples':>22}: {np.mean(found.state >= 0):8.4f}",
        f"{'stray field left':>22}: {np.sqrt(np.nanmean(remaining**2)):8.3f} nT of {np.std(stray):.3f} nT",
    ]


if __name__ == "__main__":
    print("\n".join(processing_time()))
