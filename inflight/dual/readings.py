"""The readings of two sensors on one time base, their difference and its noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.calibration.robust import TO_SIGMA
from inflight.errors import SamplesError
from inflight.time import GAP, SECOND, Int64, usual_step

#: The noise is estimated from about this many samples, in stretches spread evenly over the record.
_NOISE_SAMPLES = 200_000
_STRETCH = 2_000
#: Standard deviation of a Gaussian over the size that three quarters of its values stay below.
_THREE_QUARTERS = 0.86930
#: Changes along one direction, beside those along another, below which a sensor does not see it; power.
_BLIND = 1e-10
#: Samples that tell so.
_FEWEST = 16
#: Squared distance of the 99 % ellipsoid in three axes, and the part of the variance that is left inside.
_INSIDE, _KEPT = 11.345, 0.9647


@dataclass(frozen=True)
class Readings:
    """Readings of an inboard and an outboard sensor at the same moments; spacecraft axes.

    Attributes
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000, strictly increasing; gaps stay gaps.
    inboard, outboard : ndarray, shape (time, axis)
        nT; NaN where a reading is missing.

    Raises
    ------
    SamplesError
        When the shapes do not agree or the stamps do not increase.
    """

    stamps: Int64
    inboard: Floats
    outboard: Floats

    def __post_init__(self) -> None:
        count = self.stamps.size
        for name, field in (("inboard", self.inboard), ("outboard", self.outboard)):
            if field.shape != (count, 3):
                raise SamplesError(
                    f"{name} readings of shape {field.shape} for {count} stamps, expected ({count}, 3)",
                    remedy="put both sensors on one time base, in spacecraft axes",
                )
        if count > 1 and not bool(np.all(self.stamps[1:] > self.stamps[:-1])):
            raise SamplesError("the stamps do not increase", remedy="sort the samples and drop double ones")

    def __len__(self) -> int:
        return int(self.stamps.size)

    @cached_property
    def difference(self) -> Floats:
        """``d = B_in - B_out`` (Venus Express paper, equation 3); (time, axis), nT."""
        return np.asarray(self.inboard - self.outboard)

    @cached_property
    def good(self) -> npt.NDArray[np.bool_]:
        """Where both sensors have all three components; (time,)."""
        d = self.difference
        return np.asarray(np.isfinite(d[:, 0]) & np.isfinite(d[:, 1]) & np.isfinite(d[:, 2]))

    @cached_property
    def step(self) -> int:
        """Usual distance of neighbouring stamps, ns."""
        return usual_step(self.stamps, SECOND)

    def samples_in(self, seconds: float) -> int:
        """Return how many samples there are in a time, at least one."""
        return max(round(seconds * SECOND / self.step), 1)

    @cached_property
    def noise(self) -> Floats:
        """Covariance of the white noise of the difference; (axis, axis), nT^2."""
        return white_covariance(self.difference[self.good])

    @cached_property
    def broken(self) -> str:
        """Why these are no readings of two sensors; empty where they may be.

        Noise alone moves all axes: one that stands still is stuck, turned into whatever axes.
        """
        if np.count_nonzero(self.good) < _FEWEST:
            return ""
        moves = [
            np.linalg.eigvalsh(change.T @ change)
            for change in (
                np.diff(one[self.good], axis=0) for one in (self.inboard, self.outboard, self.difference)
            )
        ]
        for name, power in zip(("inboard", "outboard"), moves, strict=False):
            if power[0] <= _BLIND * power[-1]:
                return f"the {name} sensor reads one value along an axis"
        alike = moves[2] <= _BLIND**2 * moves[1][-1]
        if alike.all():
            return "the difference of both sensors never changes"
        return "the difference of both sensors never changes along an axis" if alike.any() else ""

    def span(self, start: int, end: int) -> Readings:
        """Return the readings of the half-open TT2000 span ``[start, end)``."""
        first, last = np.searchsorted(self.stamps, [start, end])
        return self.part(slice(int(first), int(last)))

    def part(self, rows: slice | npt.NDArray[np.bool_]) -> Readings:
        """Return some of the readings, in their order."""
        return Readings(self.stamps[rows], self.inboard[rows], self.outboard[rows])

    def pieces(self) -> list[slice]:
        """Return the rows of stretches without a gap in the stamps; missing readings do not end one."""
        if not len(self):
            return []
        cuts = np.flatnonzero(np.diff(self.stamps) > GAP * self.step) + 1
        edges = [0, *cuts.tolist(), len(self)]
        return [slice(first, last) for first, last in pairwise(edges)]


def white_covariance(values: Floats) -> Floats:
    """Return the covariance of the white noise of a series, whatever its steps and slow part; nT^2.

    Parameters
    ----------
    values : ndarray, shape (time, axis)
        Finite.

    Returns
    -------
    ndarray, shape (axis, axis)
        The `robust_covariance` of second differences ``v[t-1] - 2 v[t] + v[t+1]``, whose variance is six
        times that of white noise. Zero for fewer than three samples.
    """
    if len(values) < 3:
        return np.zeros((values.shape[1], values.shape[1]))
    return robust_covariance(_bends(values)) / 6.0


def robust_covariance(values: Floats) -> Floats:
    """Return the covariance about zero of values (time, axis) by medians; (axis, axis).

    The median and the upper quartile of the absolute values, whichever tells more, of each axis and, for
    pairs of axes, of sum and difference (Gnanadesikan and Kettenring 1972). Values most of which are zero
    have no such median: their mean square is taken.
    """
    width = values.shape[1]
    covariance = np.zeros((width, width))
    variance = np.array([_square_scale(one) for one in values.T])
    unit = values / np.sqrt(np.where(variance > 0, variance, 1.0))
    for i in range(width):
        covariance[i, i] = variance[i]
        for j in range(i):
            wide, narrow = _square_scale(unit[:, i] + unit[:, j]), _square_scale(unit[:, i] - unit[:, j])
            share = (wide - narrow) / (wide + narrow) if wide + narrow > 0 else 0.0
            covariance[i, j] = covariance[j, i] = share * np.sqrt(variance[i] * variance[j])
    return _positive(covariance)


def _bends(values: Floats) -> Floats:
    """Return second differences, of stretches spread over a long record."""
    if len(values) <= _NOISE_SAMPLES:
        return np.asarray(values[:-2] - 2.0 * values[1:-1] + values[2:])
    starts = np.linspace(0, len(values) - _STRETCH, _NOISE_SAMPLES // _STRETCH).astype(np.int64)
    parts = np.stack([values[first : first + _STRETCH] for first in starts])
    return np.asarray(parts[:, :-2] - 2.0 * parts[:, 1:-1] + parts[:, 2:]).reshape(-1, values.shape[1])


def trimmed_covariance(values: Floats) -> Floats:
    """Return the covariance about zero of values (time, axis) without the farthest; (axis, axis).

    Those within the 99 % ellipsoid of the `robust_covariance` are taken, and what Gaussian values lose by
    that is put back: as sure as the plain covariance nearly, which the medians are not.
    """
    first = robust_covariance(values)
    if not first.max() > 0:
        return first
    weight = np.linalg.inv(first + 1e-12 * np.trace(first) * np.eye(len(first)))
    near = values[np.einsum("ti,ij,tj->t", values, weight, values) < _INSIDE]
    return np.asarray(near.T @ near / max(len(near), 1) / _KEPT)


def _square_scale(values: Floats) -> float:
    size = np.abs(values)
    half, most = size.size // 2, (3 * size.size) // 4
    ranked = np.partition(size, (half, most))
    # Of readings coarser than their noise the median alone may be zero, or one step too small.
    scale = max(TO_SIGMA * float(ranked[half]), _THREE_QUARTERS * float(ranked[most]))
    return scale**2 if scale > 0 else float(np.mean(values**2))


def _positive(matrix: Floats) -> Floats:
    """Return the nearest matrix without negative eigenvalues: medians of pairs need not fit together."""
    value, vector = np.linalg.eigh(matrix)
    return np.asarray((vector * np.clip(value, 1e-3 * value.max(), None)) @ vector.T)
