"""How something follows a channel: slowly, or with play."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter


def low_pass(values: np.ndarray, tau: float, step: float, history: float | None = None) -> np.ndarray:
    """Return the first-order response of unit gain to values joined by straight lines; (time,).

    ``tau y' = c - y`` solved exactly between samples. Before the first sample it had settled at
    `history`, the mean of the first 6000 s when absent.
    """
    decay = np.exp(-step / tau)
    ramp = (1.0 - decay) * tau / step
    begin = float(np.mean(values[: max(1, int(6000 / step))])) if history is None else history
    driven = values.copy()
    driven[1:] = (1.0 - ramp) * values[1:] + (ramp - decay) * values[:-1]
    driven[0] = begin
    return np.asarray(lfilter([1.0], [1.0, -decay], driven))


def play(values: np.ndarray, width: float) -> np.ndarray:
    """Return a play (backlash) operator of full width `width`; the output is half a width behind."""
    half, at, out = width / 2, float(values[0]), np.empty_like(values)
    for index, value in enumerate(values.tolist()):
        at = min(max(at, value - half), value + half)
        out[index] = at
    return out


def ornstein(rng: np.random.Generator, count: int, step: float, tau: float, rms: float) -> np.ndarray:
    """Return red noise with correlation time `tau`; (count,)."""
    decay = np.exp(-step / tau)
    shocks = rng.normal(0.0, rms * np.sqrt(1 - decay**2), count)
    shocks[0] = rng.normal(0.0, rms)
    return np.asarray(lfilter([1.0], [1.0, -decay], shocks))


def telegraph(rng: np.random.Generator, count: int, step: float, on: float, off: float) -> np.ndarray:
    """Return a switch of random dwell times of these means, s; 0 or 1, (count,)."""
    changes = int(count * step / (on + off)) * 2 + 40
    dwell = rng.exponential(np.where(np.arange(changes) % 2, on, off))
    edges = np.cumsum(dwell)
    return (np.searchsorted(edges, np.arange(count) * step) % 2).astype(np.float64)
