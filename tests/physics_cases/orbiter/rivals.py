"""What could pass for a hidden cause: computed from the truth, for the score alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from .causes import FAMILY, Cause, World
from .house import Channel
from .response import low_pass

#: Responses of a rival channel that are tried, s.
LAGS = (0.0, 150.0, 400.0, 1000.0, 2500.0)
#: A rival whose best likeness leaves less than this (in sums of squares over the noise variance) is as good
#: as the truth: the difference of two fits' losses is then below two of its own standard deviations.
ALIKE = 16.0
#: Samples that rivals are compared on.
COMPARED = 12_000


def nine_columns(world: World, rows: slice) -> np.ndarray:
    """Return the residual's derivatives by the nine parameters, up to factors; (row, 9)."""
    u, b = world.direction[rows], world.field[rows]
    angles = [u[:, 0] * b[:, 1], u[:, 0] * b[:, 2], u[:, 1] * b[:, 2]]
    return np.column_stack([u * b, *angles, u])


def thinned(world: World) -> slice:
    """Return every so manyth sample."""
    return slice(0, None, max(1, world.strength.size // COMPARED))


def retained(world: World, seen: np.ndarray, beside: tuple[np.ndarray, ...] = ()) -> np.ndarray:
    """Return what the nine parameters (and what is `beside`) leave of a contribution, thinned; nT."""
    rows = thinned(world)
    base = np.column_stack([nine_columns(world, rows), *(one[rows] for one in beside)])
    q, _ = np.linalg.qr(base / np.linalg.norm(base, axis=0))
    left = seen[rows] - q @ (q.T @ seen[rows])
    return np.asarray(left)


def equivalents(
    world: World, cause: Cause, channels: dict[str, Channel], sigma: float
) -> list[dict[str, Any]]:
    """Return the channels whose field (or gain), perhaps delayed, is as good an explanation as the truth.

    Parameters
    ----------
    channels : dict of Channel
        Everything delivered, by its delivered name; and what the geometry gives.
    sigma : float
        White noise of the residual, nT.
    """
    rows = thinned(world)
    share = world.strength.size / world.strength[rows].size
    u, b = world.direction[rows], world.field[rows]
    q, _ = np.linalg.qr(_unit(nine_columns(world, rows)))
    left = retained(world, cause.seen(world))
    found = []
    for name, channel in channels.items():
        best = np.inf
        for series in _responses(channel, world.track.step):
            for columns in (u * series[rows][:, None], u * b * series[rows][:, None]):
                best = min(best, share * _unexplained(q, columns, left) / sigma**2)
        if best < ALIKE:
            family = FAMILY.get(channel.kind, channel.kind)
            found.append({"channel": name, "family": family, "delta_chi2": float(best)})
    return found


def _responses(channel: Channel, step: float) -> list[np.ndarray]:
    if channel.values.ndim > 1 or channel.values.std() == 0:
        return []
    return [low_pass(channel.values, lag, step) if lag else channel.values for lag in LAGS]


def _unexplained(q: np.ndarray, columns: np.ndarray, left: np.ndarray) -> float:
    own = columns - q @ (q.T @ columns)
    value, *_ = np.linalg.lstsq(_unit(own), left, rcond=1e-6)
    rest = left - _unit(own) @ value
    return float(rest @ rest)


def _unit(columns: np.ndarray) -> np.ndarray:
    return columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
