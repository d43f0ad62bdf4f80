"""What could pass for a hidden cause: computed from the truth, for the score alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
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
#: The nine parameters are fitted anew every so often: the standard processing's interval (Yin 2010, 2.6).
INTERVAL_DAYS = 15.0
#: Samples that rivals are compared on.
COMPARED = 12_000


def nine_columns(world: World, rows: slice) -> np.ndarray:
    """Return the residual's derivatives by the nine parameters, up to factors; (row, 9)."""
    u, b = world.direction[rows], world.field[rows]
    angles = [u[:, 0] * b[:, 1], u[:, 0] * b[:, 2], u[:, 1] * b[:, 2]]
    return np.column_stack([u * b, *angles, u])


@dataclass(frozen=True)
class Calibration:
    """The nine parameters fitted anew every interval, on every so manyth sample.

    `rows` thin the base grid; `pieces` are an interval's thinned samples and the orthonormal columns of
    what is fitted there.
    """

    rows: slice
    share: float
    pieces: tuple[tuple[slice, np.ndarray], ...]

    @classmethod
    def of(cls, world: World, beside: tuple[np.ndarray, ...] = ()) -> Calibration:
        """Return the calibration of a world; contributions `beside` the nine are fitted with them."""
        rows = slice(0, None, max(1, world.strength.size // COMPARED))
        columns = np.column_stack([nine_columns(world, rows), *(one[rows] for one in beside)])
        days = world.track.seconds[rows] / 86_400.0
        # A rest shorter than half an interval joins the one before it.
        count = max(1, round(float(world.track.seconds[-1]) / 86_400.0 / INTERVAL_DAYS))
        edges = np.searchsorted(days, [INTERVAL_DAYS * k for k in range(count)]).tolist()
        spans = [slice(a, b) for a, b in pairwise([*edges, days.size])]
        share = world.strength.size / days.size
        return cls(rows, share, tuple((span, np.linalg.qr(_unit(columns[span]))[0]) for span in spans))

    def left_of(self, values: np.ndarray) -> np.ndarray:
        """Return what the fits leave of thinned values, (row,) or (row, column)."""
        out = values.astype(np.float64, copy=True)
        for span, q in self.pieces:
            out[span] -= q @ (q.T @ values[span])
        return out


@lru_cache(maxsize=1)
def nine_alone(world: World) -> Calibration:
    """Return the calibration of a world with nothing beside the nine: every size tried asks for it."""
    return Calibration.of(world)


def retained(world: World, seen: np.ndarray, beside: tuple[np.ndarray, ...] = ()) -> np.ndarray:
    """Return what the calibration (and what is `beside`) leaves of a contribution, thinned; nT."""
    calibration = Calibration.of(world, beside) if beside else nine_alone(world)
    return calibration.left_of(seen[calibration.rows])


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
    calibration = nine_alone(world)
    rows = calibration.rows
    u, b = world.direction[rows], world.field[rows]
    left = calibration.left_of(cause.seen(world)[rows])
    found = []
    for name, channel in channels.items():
        tried = [
            calibration.left_of(shape * series[rows][:, None])
            for series in _responses(channel, world.track.step)
            for shape in (u, u * b)
        ]
        best = min((_unexplained(columns, left) for columns in tried), default=np.inf)
        if calibration.share * best / sigma**2 < ALIKE:
            family = FAMILY.get(channel.kind, channel.kind)
            delta = float(calibration.share * best / sigma**2)
            found.append({"channel": name, "family": family, "delta_chi2": delta})
    return found


def _responses(channel: Channel, step: float) -> list[np.ndarray]:
    if channel.values.ndim > 1 or channel.values.std() == 0:
        return []
    return [low_pass(channel.values, lag, step) if lag else channel.values for lag in LAGS]


def _unexplained(columns: np.ndarray, left: np.ndarray) -> float:
    value, *_ = np.linalg.lstsq(_unit(columns), left, rcond=1e-6)
    rest = left - _unit(columns) @ value
    return float(rest @ rest)


def _unit(columns: np.ndarray) -> np.ndarray:
    return columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
