"""Fourier sums of unevenly sampled turns, many at once: moments of the phase make all normal equations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats

Complex = npt.NDArray[np.complex128]
#: A group is solved when its normal equations are this far from singular: with gaps they may be.
_WORST_CONDITION = 1e6


@dataclass(frozen=True)
class FourierSums:
    """Complex Fourier sums, one a group of samples.

    Attributes
    ----------
    coefficients : ndarray of complex, shape (group, 2 H + 1, column)
        Of exp(i h phase), h from -H to H; NaN where a group has too few samples.
    count : ndarray, shape (group,)
        Samples used.
    """

    coefficients: Complex
    count: Floats

    @property
    def mean(self) -> Complex:
        """The part without phase; (group, column)."""
        return np.asarray(self.coefficients[:, self.coefficients.shape[1] // 2])

    def at(self, phase: Floats) -> Complex:
        """Return the sums at phases (point,), the same for all groups; (group, point, column)."""
        order = self.coefficients.shape[1] // 2
        waves = np.exp(1j * np.outer(phase, np.arange(-order, order + 1)))
        return np.asarray(np.einsum("ph,ghc->gpc", waves, self.coefficients))

    def along(self, phase: Floats, group: npt.NDArray[np.int64]) -> Complex:
        """Return each sample's value of its own group's sum; (time, column)."""
        order = self.coefficients.shape[1] // 2
        out = np.zeros((phase.size, self.coefficients.shape[2]), dtype=np.complex128)
        for place, harmonic in enumerate(range(-order, order + 1)):
            out += self.coefficients[group, place] * np.exp(1j * harmonic * phase)[:, None]
        return out


def fourier_sums(
    values: Complex,
    phase: Floats,
    group: npt.NDArray[np.int64],
    groups: int,
    order: int,
    good: npt.NDArray[np.bool_],
) -> FourierSums:
    """Fit Fourier sums of the phase to each group of samples, by least squares.

    The normal equations of exp(i h phase) are moments of the phase alone, so that a day's turns cost a few
    sums over its samples and one batch of small systems.

    Parameters
    ----------
    values : ndarray of complex, shape (time, column)
    phase : ndarray, shape (time,)
        Radians.
    group : ndarray of int, shape (time,)
        Group of each sample, never falling, below `groups`.
    order : int
        Highest harmonic H.
    good : ndarray of bool, shape (time,)
        Samples to be used.
    """
    used = np.flatnonzero(good)
    starts = np.searchsorted(group[used], np.arange(groups + 1))
    wave, angle = np.exp(1j * phase[used]), np.ones(used.size, dtype=np.complex128)
    data = values[used]
    moments = np.empty((groups, 2 * order + 1), dtype=np.complex128)
    right = np.empty((groups, 2 * order + 1, values.shape[1]), dtype=np.complex128)
    for harmonic in range(2 * order + 1):
        moments[:, harmonic] = _sums(angle[:, None], starts)[:, 0]
        if harmonic <= order:
            right[:, order + harmonic] = _sums(data * np.conj(angle)[:, None], starts)
            right[:, order - harmonic] = _sums(data * angle[:, None], starts)
        angle = angle * wave
    count = moments[:, 0].real.copy()
    return FourierSums(_solved(moments, right, order), count)


def _sums(values: Complex, starts: npt.NDArray[np.int64]) -> Complex:
    """Return the sums of rows from each start to the next; (group, column)."""
    out = np.zeros((starts.size - 1, values.shape[1]), dtype=np.complex128)
    filled = np.flatnonzero(np.diff(starts))
    if filled.size:
        out[filled] = np.add.reduceat(values, starts[filled], axis=0)
    return out


def _solved(moments: Complex, right: Complex, order: int) -> Complex:
    """Solve the groups' normal equations; NaN where they are nearly singular."""
    size = 2 * order + 1
    difference = np.arange(size)[None, :] - np.arange(size)[:, None]
    gram = moments[:, np.abs(difference)]
    gram = np.where(difference[None] < 0, np.conj(gram), gram)
    out = np.full(right.shape, np.nan + 0j)
    enough = moments[:, 0].real >= size
    if enough.any():
        spread = np.linalg.eigvalsh(gram[enough])
        sound = np.flatnonzero(enough)[spread[:, 0] * _WORST_CONDITION > spread[:, -1]]
        if sound.size:
            out[sound] = np.linalg.solve(gram[sound], right[sound])
    return out
