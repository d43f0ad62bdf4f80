"""Lags between those of the bank: a response is a combination of its neighbours' responses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.evidence import Evidence
from inflight.diagnosis.scoring import Index, Present, projected
from inflight.estimators.absorption import half_inverse

#: Angular frequencies a combination must be right at: from two days to a minute.
_SLOWEST, _FASTEST, _FREQUENCIES = 2 * np.pi / 172_800.0, 2 * np.pi / 60.0, 120
#: Lags the profile is drawn at, from a part of the bank's smallest to a multiple of its largest.
_GRID = 60


@lru_cache(maxsize=4096)
def _mixture(lag: float, bank: tuple[float, ...]) -> tuple[float, ...]:
    omega = np.geomspace(_SLOWEST, _FASTEST, _FREQUENCIES)
    known = 1.0 / (1.0 + 1j * omega[:, None] * np.asarray(bank)[None, :])
    wanted = 1.0 / (1.0 + 1j * omega * lag)
    rows = np.concatenate([known.real, known.imag]), np.concatenate([wanted.real, wanted.imag])
    return tuple(np.linalg.lstsq(rows[0], rows[1], rcond=1e-4)[0].tolist())


def mixture(lag: float, bank: Sequence[float]) -> Floats:
    """Return the weights of the bank's responses that together respond with another lag.

    Parameters
    ----------
    lag : float
        Seconds.
    bank : sequence of float
        Time constants of the columns there are, seconds; 0 is the channel itself.

    Returns
    -------
    ndarray, shape (bank,)
        Right to one to three hundredths of the response between neighbours of a bank whose lags grow
        three times a step, to seven where they grow four times.
    """
    return np.array(_mixture(float(lag), tuple(float(one) for one in bank)))


@dataclass(frozen=True)
class LagProfile:
    """How well each lag explains the residual.

    Attributes
    ----------
    lags : ndarray
        Seconds.
    left : ndarray
        Sum of squares left at each, nT^2 (in-sample).
    best, sigma : float
        The lag that leaves least and its jackknife error over folds of blocks, seconds.
    """

    lags: Floats
    left: Floats
    best: float
    sigma: float

    def as_json(self) -> dict[str, object]:
        """Return the fields as plain numbers."""
        return {
            "lags_s": self.lags.tolist(),
            "left_nT2": self.left.tolist(),
            "best_s": self.best,
            "sigma_s": self.sigma,
        }


def profile(
    evidence: Evidence,
    present: Present,
    bank: Mapping[float, Index],
    y: int,
    folds: Sequence[Index],
) -> LagProfile:
    """Return the profile of a response's lag.

    Parameters
    ----------
    bank : mapping of float to ndarray
        Lag in seconds -> its columns, the same number for each.
    folds : sequence of ndarray
        Blocks left out together for the error.
    """
    lags = np.array(sorted(bank))
    largest = float(lags[-1])
    smallest = float(lags[lags > 0][0]) if np.any(lags > 0) else 1.0
    grid = np.concatenate([[0.0], np.geomspace(smallest / 4.0, 1.5 * largest, _GRID)])
    columns = np.concatenate([bank[lag] for lag in lags])
    size = len(bank[lags[0]])
    mixed = np.array([mixture(lag, tuple(lags)) for lag in grid])

    def explained(gram: Floats) -> Floats:
        left = projected(gram, present)
        own = left[np.ix_(columns, columns)].reshape(lags.size, size, lags.size, size)
        cross = left[columns, y].reshape(lags.size, size)
        matrices = np.einsum("gi,iajb,gj->gab", mixed, own, mixed, optimize=True)
        half = half_inverse(matrices)
        return np.asarray(np.sum(np.einsum("gak,ga->gk", half, mixed @ cross) ** 2, axis=1))

    total = evidence.total
    whole = explained(total)
    others = [_peak(grid, explained(total - evidence.gram[fold].sum(axis=0))) for fold in folds]
    best = _peak(grid, whole)
    sigma = jackknife(others)
    base = float(projected(total, present)[y, y])
    return LagProfile(grid, base - whole, best, sigma)


def jackknife(others: Sequence[float]) -> float:
    """Return the standard error of a value from those found with one part left out each time."""
    count = len(others)
    return float(np.sqrt((count - 1) / count * np.sum((np.array(others) - np.mean(others)) ** 2)))


def _peak(grid: Floats, explained: Floats) -> float:
    """Return the lag of the largest sum explained, by a parabola through its neighbours."""
    at = int(np.argmax(explained))
    if at == 0 or at == grid.size - 1:
        return float(grid[at])
    x, v = grid[at - 1 : at + 2], explained[at - 1 : at + 2]
    a, b, _ = np.polyfit(x - x[1], v, 2)
    return float(np.clip(x[1] - b / (2.0 * a), x[0], x[2])) if a < 0 else float(grid[at])
