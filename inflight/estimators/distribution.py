"""What is left of the residual, given to the vector as a term of its own (Yin 2010, eq. 3.7).

``B' = (1 - dB'/|B|) B`` with dB' the residual low-passed at a period of 80 s. It makes vector and scalar
agree on slow scales whatever the cause, and so hides errors: it is the last step, and its size is told.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import xarray as xr
from scipy import interpolate, linalg, signal

from inflight.arrays import Floats
from inflight.errors import SamplesError
from inflight.time import SECOND, Int64, usual_step

#: Period at which the filter passes half of the amplitude, s.
PERIOD = 80.0
#: Order of the difference that the filter holds small: it passes 1 / (1 + (f/fc)^6).
ORDER = 3
#: Samples a period at least, and at most before the residual is averaged for the filter.
_COARSEST, _FINEST = 8, 100
#: A stretch shorter than so many periods has no slow part; one of gaps longer than this part ends it.
_SHORTEST, _GAP = 2.0, 0.5
#: Samples this near the end of a stretch, in periods, are an edge.
_EDGE = 2.0


@dataclass(frozen=True)
class Distribution:
    """The last term of a product and what it removes.

    Attributes
    ----------
    correction : ndarray, shape (time, 3)
        Term to subtract from the vector, nT; 0 where it was not done.
    slow : ndarray, shape (time,)
        dB', nT; NaN where it was not done.
    sigma : ndarray, shape (time,)
        Standard deviation of dB' by the residual's own fast noise, nT.
    left : ndarray, shape (time,)
        dB - dB', the residual of B', nT.
    edge : ndarray of bool, shape (time,)
        Within two periods of the end of a stretch: the filter leans to one side there.
    done : ndarray of bool, shape (time,)
        False in stretches shorter than two periods, and in gaps.
    period, cadence : float
        s.
    """

    correction: Floats
    slow: Floats
    sigma: Floats
    left: Floats
    edge: np.ndarray
    done: np.ndarray
    period: float
    cadence: float

    @property
    def rms(self) -> float:
        """Rms of the term along the field, nT: how much it hides."""
        return float(np.sqrt(np.mean(self.slow[self.done] ** 2))) if self.done.any() else float("nan")

    @property
    def rms_left(self) -> float:
        """Rms residual of B', nT."""
        known = self.done & np.isfinite(self.left)
        return float(np.sqrt(np.mean(self.left[known] ** 2))) if known.any() else float("nan")

    def told(self) -> str:
        """Say how much was distributed."""
        share = float(np.mean(self.done))
        return (
            f"{self.rms:.3f} nT rms of the residual were distributed along the field on "
            f"{100 * share:.1f} % of the samples; {self.rms_left:.3f} nT are left, "
            f"faster than {self.period:g} s"
        )

    def table(self) -> xr.Dataset:
        """Return the sizes: dim parameter."""
        names = ["rms_distributed", "rms_left", "share_done", "share_edge"]
        values = [self.rms, self.rms_left, float(self.done.mean()), float(self.edge.mean())]
        return xr.Dataset(
            {
                "value": ("parameter", np.array(values)),
                "sigma": ("parameter", np.array([*self._sigmas(), 0.0, 0.0])),
                "units": ("parameter", np.array(["nT", "nT", "1", "1"])),
            },
            coords={"parameter": names},
            attrs={"period_s": self.period, "told": self.told()},
        )

    def _sigmas(self) -> tuple[float, float]:
        """Return standard deviations of the two rms: what filtered noise alone leaves of chance."""
        slow = int(self.done.sum()) * self.cadence / self.period
        fast = int(self.done.sum())
        return self.rms / np.sqrt(2 * max(slow, 1.0)), self.rms_left / np.sqrt(2 * max(fast, 1))


def distribute(
    field: Floats, residual: Floats, tt2000: Int64, good: np.ndarray | None = None, period: float = PERIOD
) -> Distribution:
    """Return the term that distributes the slow part of the residual along the field.

    The filter minimises ``sum w (dB - dB')^2 + lambda sum (third difference of dB')^2``: zero phase, no
    window, gaps have weight zero. It passes ``1/(1 + (f/fc)^6)`` of the amplitude, as a Butterworth
    filter of third order run forwards and backwards does, and carries parabolas to the ends unharmed.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        Corrected vector, nT.
    residual : ndarray, shape (time,)
        dB = |B| - F, nT; NaN where missing.
    tt2000 : ndarray of int64, shape (time,)
        Rising; at equal steps but for gaps.
    good : ndarray of bool, shape (time,), optional
        Samples the filter may use; others get its value, and keep their own rest.
    period : float
        s, where half of the amplitude is passed.

    Raises
    ------
    SamplesError
        When the cadence is too slow for the period, or stamps do not rise.
    """
    step = np.diff(tt2000)
    cadence = usual_step(tt2000, 0) / SECOND
    if step.size == 0 or np.any(step <= 0):
        raise SamplesError("stamps do not rise", remedy="align the samples first")
    if period < _COARSEST * cadence:
        raise SamplesError(
            f"samples every {cadence:g} s have no low-pass at {period:g} s",
            remedy=f"use a period of at least {_COARSEST * cadence:g} s",
        )
    use = np.isfinite(residual) & (True if good is None else good)
    slow, sigma = np.full(residual.size, np.nan), np.full(residual.size, np.nan)
    edge = np.zeros(residual.size, dtype=bool)
    place = np.rint((tt2000 - tt2000[0]) / (cadence * SECOND)).astype(np.int64)
    for first, last in _stretches(place, use, _GAP * period / cadence):
        if (place[last] - place[first]) * cadence < _SHORTEST * period:
            continue
        span = slice(first, last + 1)
        slow[span], sigma[span] = _filtered(place[span], residual[span], use[span], period / cadence)
        near = np.minimum(place[span] - place[first], place[last] - place[span]) * cadence
        edge[span] = near < _EDGE * period
    strength = np.linalg.norm(field, axis=1)
    done = np.isfinite(slow) & np.isfinite(strength) & (strength > 0)
    term = np.where(done, np.divide(slow, strength, out=np.zeros_like(slow), where=done), 0.0)
    correction = np.where(done[:, None], term[:, None] * np.nan_to_num(field), 0.0)
    return Distribution(correction, slow, sigma, residual - slow, edge, done, period, cadence)


def _stretches(place: Int64, use: np.ndarray, longest: float) -> list[tuple[int, int]]:
    """Return first and last index of runs of used samples without a gap longer than so many steps."""
    index = np.flatnonzero(use)
    if index.size == 0:
        return []
    cuts = np.flatnonzero(np.diff(place[index]) > longest)
    firsts, lasts = np.append(0, cuts + 1), np.append(cuts, index.size - 1)
    return [(int(index[first]), int(index[last])) for first, last in zip(firsts, lasts, strict=True)]


def _filtered(place: Int64, residual: Floats, use: np.ndarray, period: float) -> tuple[Floats, Floats]:
    """Return the slow part of a stretch and its standard deviation; (time,). `period` is in steps."""
    bins = max(1, int(period // _FINEST))
    count = int(place[-1] - place[0]) // bins + 1
    cell = (place - place[0]) // bins
    weight = np.bincount(cell[use], minlength=count).astype(np.float64)
    total = np.bincount(cell[use], weights=residual[use], minlength=count).astype(np.float64)
    smooth = whittaker(total, weight, period / bins, bins)
    centre = np.arange(count) * bins + 0.5 * (bins - 1)
    at = (place - place[0]).astype(np.float64)
    slow = smooth[cell] if bins == 1 else np.asarray(interpolate.CubicSpline(centre, smooth)(at))
    white = float(np.std((residual - slow)[use]))
    ends = np.minimum(at, at[-1] - at) / bins
    gain = edge_gain(round(period / bins))
    noise = white * gain[np.minimum(ends.astype(np.int64), gain.size - 1)] / np.sqrt(bins)
    return slow, noise


def whittaker(total: Floats, weight: Floats, period: float, full: float = 1.0) -> Floats:
    """Return the smooth series of a weighted one; (time,).

    Parameters
    ----------
    total, weight : ndarray, shape (time,)
        Sum of the values and number of them at each step; both 0 in a gap.
    period : float
        Steps, where half the amplitude is passed.
    full : float
        Weight of a step without a gap.
    """
    size = weight.size
    stiffness = full / (2.0 * np.sin(np.pi / period)) ** (2 * ORDER)
    stencil = np.array([(-1.0) ** k for k in range(ORDER + 1)]) * [1, 3, 3, 1]
    band = np.zeros((ORDER + 1, size))
    rows = size - ORDER
    for i in range(ORDER + 1):
        for j in range(i + 1):
            # Row i - j below the diagonal, column j of every difference that reaches it.
            band[i - j, j : j + rows] += stiffness * stencil[i] * stencil[j]
    band[0] += weight
    return np.asarray(linalg.solveh_banded(band, total, lower=True))


@lru_cache(maxsize=8)
def edge_gain(period: int) -> Floats:
    """Return the standard deviation of filtered unit white noise at so many steps from an end; (step,)."""
    size = 6 * period
    unit = np.eye(size)
    columns = np.stack([whittaker(one, np.ones(size), period) for one in unit], axis=1)
    return np.asarray(np.linalg.norm(columns[: size // 2], axis=1))


def passed(period: Floats, at: float = PERIOD, cadence: float = 1.0) -> Floats:
    """Return the part of the amplitude that the filter passes at periods, s (same shape)."""
    ratio = np.sin(np.pi * cadence / np.asarray(period)) / np.sin(np.pi * cadence / at)
    return np.asarray(1.0 / (1.0 + ratio ** (2 * ORDER)))


def left_power(found: Distribution, band: tuple[float, float]) -> float:
    """Return the rms of the residual of B' between two periods (s), nT, from whole done stretches.

    Raises
    ------
    SamplesError
        When no stretch is twice as long as the longer period.
    """
    long, short = max(band), min(band)
    known = found.done & np.isfinite(found.left)
    bounds = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    powers, sizes = [], []
    for first, last in zip(bounds[::2], bounds[1::2], strict=True):
        if (last - first) * found.cadence < 2 * long:
            continue
        frequency, density = signal.periodogram(found.left[first:last], fs=1 / found.cadence, window="hann")
        inside = (frequency >= 1 / long) & (frequency <= 1 / short)
        powers.append(float(density[inside].sum() * frequency[1]))
        sizes.append(last - first)
    if not sizes:
        raise SamplesError(f"no stretch of {2 * long:g} s without a gap", remedy="ask for shorter periods")
    return float(np.sqrt(np.average(powers, weights=sizes)))
