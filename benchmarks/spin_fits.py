"""A day of spin fits against the loop people write, and against reading the day's memory.

``python -m benchmarks spin_fits`` prints it: 28 800 spins of 12 readings, three components. The loop makes
one ``numpy.linalg.lstsq`` a spin for all three components at once; rivals take turns, and processor times
count, because the machine may be shared.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.measured import Row, table
from inflight.arrays import Floats
from inflight.spin import fit_spins
from inflight.time import SECOND, Int64

SPINS, READINGS, PERIOD = 28_800, 12, 3.0
_ROUNDS = 5


def day() -> tuple[Int64, Floats, Floats]:
    """Return times, readings (time, 3) in nT and phase of a day at 4 Hz."""
    rng = np.random.default_rng(0)
    samples = SPINS * READINGS
    phase = (np.arange(samples) + 0.5) * 2.0 * np.pi / READINGS
    field = np.stack([100 * np.cos(phase - 0.3), -100 * np.sin(phase - 0.3), np.full(samples, 30.0)], axis=1)
    stamps = (np.arange(samples) * (PERIOD / READINGS * SECOND)).astype(np.int64)
    return stamps, field + 0.1 * rng.standard_normal(field.shape), phase


def loop(field: Floats, phase: Floats) -> Floats:
    """Return the coefficients (spin, component, 3) by one lstsq a spin."""
    turn = np.floor(phase / (2.0 * np.pi)).astype(np.int64)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(turn)) + 1, [turn.size]])
    out = np.empty((edges.size - 1, field.shape[1], 3))
    for k in range(edges.size - 1):
        own = slice(edges[k], edges[k + 1])
        shapes = np.stack([np.ones(edges[k + 1] - edges[k]), np.sin(phase[own]), np.cos(phase[own])], axis=1)
        out[k] = np.linalg.lstsq(shapes, field[own], rcond=None)[0].T
    return out


def spin_fit_rows() -> list[Row]:
    """Return what was measured: processor times, a row each."""
    stamps, field, phase = day()
    rivals: dict[str, Callable[[], object]] = {
        "one lstsq a spin": lambda: loop(field, phase),
        "all at once": lambda: fit_spins(stamps, field, phase, robust=False),
        "all at once, robust": lambda: fit_spins(stamps, field, phase),
        # What has to be looked at once: times, readings and phase.
        "reading the memory": lambda: (stamps.sum(), field.sum(), phase.sum()),
        "sin and cos alone": lambda: (np.sin(phase), np.cos(phase)),
    }
    fit_spins(stamps[:600], field[:600], phase[:600])
    took: dict[str, list[float]] = {name: [] for name in rivals}
    for _ in range(_ROUNDS):
        for name, rival in rivals.items():
            before = time.process_time()
            rival()
            took[name].append(time.process_time() - before)
    apart = np.abs(fit_spins(stamps, field, phase, robust=False).value - loop(field, phase)).max()
    against: dict[str, Any] = {
        "floor_s": float(np.median(took["reading the memory"])),
        "floor": "spin fits: times, readings and phase summed in memory; processor times",
        "naive_s": float(np.median(took["one lstsq a spin"])),
        "naive": f"spin fits: one numpy.linalg.lstsq a spin; largest difference {apart:.1e} nT",
    }
    return [Row(what=f"{SPINS} spins, {name}", seconds=spent, **against) for name, spent in took.items()]


if __name__ == "__main__":
    print("\n".join(table(spin_fit_rows())))
