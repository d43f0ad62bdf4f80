"""Channels that act on nothing, and look as if they might."""

from __future__ import annotations

import numpy as np

from .house import Channel
from .orbit import Track
from .response import low_pass, ornstein, telegraph

KINDS = ("orbital", "walk", "copy", "thermal", "counter", "switch", "daily", "noise")
#: What a decoy says it is; most say nothing.
TOLD = ("other", "other", "temperature", "current", "voltage", "other")


def make_decoys(
    track: Track, house: dict[str, Channel], acting: set[str], count: int, rng: np.random.Generator
) -> list[Channel]:
    """Return so many decoys; near-copies are of channels that do not act."""
    idle = [c for c in house.values() if c.name not in acting and c.values.ndim == 1]
    order = rng.permutation(np.arange(count) % len(KINDS))
    return [_decoy(KINDS[kind], index, track, idle, rng) for index, kind in enumerate(order)]


def near_copy(source: Channel, name: str, share: float, rng: np.random.Generator) -> Channel:
    """Return a channel that differs from another by noise of a share of its variance."""
    spread = float(source.values.std())
    noise = ornstein(rng, source.values.size, 10.0, 400.0, spread * np.sqrt(share))
    return Channel(
        name, source.values + noise, source.unit, source.kind, source.instrument, source.resolution
    )


def _decoy(kind: str, index: int, track: Track, idle: list[Channel], rng: np.random.Generator) -> Channel:
    name = f"decoy_{index:03d}"
    if kind == "copy":
        return near_copy(idle[rng.integers(len(idle))], name, 10 ** rng.uniform(-3.0, -1.0), rng)
    values = _series(kind, track, rng)
    told = TOLD[rng.integers(len(TOLD))]
    unit = {"temperature": "degC", "current": "mA", "voltage": "V"}.get(told, "1")
    size = 10 ** rng.uniform(0.0, 2.0) / max(float(values.std()), 1e-9)
    return Channel(name, size * values, unit, told, "misc", float(f"{size * values.std() / 2000:.0e}"))


def _series(kind: str, track: Track, rng: np.random.Generator) -> np.ndarray:
    t, step, count = track.seconds, track.step, track.seconds.size
    if kind == "orbital":
        harmonic, phase = rng.integers(1, 5), rng.uniform(0, 2 * np.pi)
        return np.cos(harmonic * track.argument + phase) + ornstein(rng, count, step, 300.0, 0.1)
    if kind == "walk":
        return np.cumsum(rng.normal(0.0, 1.0, count)) / np.sqrt(count)
    if kind == "thermal":
        drive = track.sunlit * np.maximum(track.sun @ rng.normal(size=3), 0.0) + 0.3 * track.sunlit
        return low_pass(drive, rng.uniform(300.0, 20_000.0), step) + ornstein(
            rng, count, step, 20_000.0, 0.05
        )
    if kind == "counter":
        return np.floor(t / rng.uniform(8.0, 900.0)) % 256.0
    if kind == "switch":
        return telegraph(rng, count, step, rng.uniform(300.0, 9000.0), rng.uniform(300.0, 9000.0))
    if kind == "daily":
        return np.cos(2 * np.pi * t / 86_400.0 + rng.uniform(0, 2 * np.pi)) + ornstein(
            rng, count, step, 3000.0, 0.2
        )
    return rng.normal(0.0, 1.0, count)
