"""What a residual looks like: its size, its noise floor, and the coordinates it depends on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt
from scipy import signal

from inflight.arrays import Floats
from inflight.calibration.robust import TO_SIGMA
from inflight.noise import NO_FLOOR, NoiseFloor, joined_floor, noise_floor

__all__ = [
    "BINS",
    "MIN_BLOCKS",
    "NO_FLOOR",
    "Dependence",
    "NoiseFloor",
    "Size",
    "dependence",
    "joined",
    "joined_floor",
    "noise_floor",
    "size_of",
    "spectrum",
    "strongest",
]

#: Samples of a spectrum's segment at most and at least, and the segments a shorter record is cut into: of
#: fewer, one bad sample would cost all.
_SEGMENT, _SHORTEST_SEGMENT, _SEGMENTS = 4096, 64, 8
#: Bins of a dependence, and the fewest blocks its uncertainty is taken from.
BINS = 24
MIN_BLOCKS = 6


@dataclass(frozen=True)
class Size:
    """Size of a residual, nT, over its finite samples."""

    count: int
    mean: float
    std: float
    rms: float
    robust: float
    least: float
    largest: float

    def as_json(self) -> dict[str, float | int]:
        """Return the fields by name."""
        return asdict(self)


def size_of(residual: Floats) -> Size:
    """Return the size of a residual (time,) in nT; NaN are left out."""
    finite = residual[np.isfinite(residual)]
    if finite.size == 0:
        nan = float("nan")
        return Size(0, nan, nan, nan, nan, nan, nan)
    middle = np.median(finite)
    return Size(
        int(finite.size),
        float(finite.mean()),
        float(finite.std()),
        float(np.sqrt(np.mean(finite**2))),
        float(TO_SIGMA * np.median(np.abs(finite - middle))),
        float(finite.min()),
        float(finite.max()),
    )


def joined(sizes: Sequence[Size]) -> Size:
    """Return the size of several residuals together; the robust sigma is the median of theirs."""
    filled = [one for one in sizes if one.count]
    if not filled:
        return size_of(np.empty(0))
    count = np.array([one.count for one in filled], dtype=np.float64)
    mean = float(np.sum(count * [one.mean for one in filled]) / count.sum())
    square = float(np.sum(count * [one.rms**2 for one in filled]) / count.sum())
    # From the parts' own spreads: the square less the squared mean cancels where the mean is large.
    spread = float(np.sum(count * [one.std**2 + (one.mean - mean) ** 2 for one in filled]) / count.sum())
    return Size(
        int(count.sum()),
        mean,
        float(np.sqrt(spread)),
        float(np.sqrt(square)),
        float(np.median([one.robust for one in filled])),
        min(one.least for one in filled),
        max(one.largest for one in filled),
    )


def spectrum(residual: Floats, cadence: float) -> tuple[Floats, Floats]:
    """Return frequencies (Hz) and power density (nT^2/Hz) of a residual by Welch's method.

    Parameters
    ----------
    residual : ndarray, shape (time,)
        nT; segments with a NaN are left out.
    cadence : float
        Seconds between samples.

    Returns
    -------
    tuple of ndarray
        Empty when no whole segment is there.
    """
    length = min(max(residual.size // _SEGMENTS, _SHORTEST_SEGMENT), _SEGMENT)
    starts = range(0, residual.size - length + 1, max(length // 2, 1))
    parts = [residual[at : at + length] for at in starts]
    whole = [part for part in parts if np.isfinite(part).all()]
    if not whole:
        return np.empty(0), np.empty(0)
    levelled = signal.detrend(np.array(whole), axis=1)
    frequency, power = signal.periodogram(levelled, fs=1.0 / cadence, window="hann", detrend=False)
    return np.asarray(frequency[1:]), np.asarray(power.mean(axis=0)[1:])


@dataclass(frozen=True)
class Dependence:
    """How a residual depends on one coordinate: means of bins with the uncertainty between blocks.

    Attributes
    ----------
    coordinate, unit : str
        What it depends on.
    centre, mean, sigma : ndarray, shape (bin,)
        Middle of each bin, mean residual less its overall mean (nT), standard error.
    amplitude : float
        rms of the dependence, its noise taken off, nT.
    sigma_amplitude : float
        Its standard error, nT.
    """

    coordinate: str
    unit: str
    centre: Floats
    mean: Floats
    sigma: Floats
    amplitude: float
    sigma_amplitude: float

    @property
    def sentence(self) -> str:
        """Say where the model fails."""
        low, high = int(np.argmin(self.mean)), int(np.argmax(self.mean))
        unit = f" {self.unit}" if self.unit not in ("", "1") else ""
        return (
            f"the residual follows {self.coordinate}: {self.mean[low]:+.3f} nT near "
            f"{self.centre[low]:.4g}{unit}, {self.mean[high]:+.3f} nT near {self.centre[high]:.4g}{unit} "
            f"(rms {self.amplitude:.3f} nT, {self.amplitude / max(self.sigma_amplitude, 1e-12):.0f} sigma)"
        )


def dependence(
    name: str, unit: str, coordinate: Floats, residual: Floats, block: npt.NDArray[np.int64]
) -> Dependence | None:
    """Measure how a residual depends on a coordinate.

    Parameters
    ----------
    name, unit : str
        Of the coordinate.
    coordinate, residual : ndarray, shape (sample,)
        NaN are left out; residual in nT.
    block : ndarray of int, shape (sample,)
        Block of each sample; blocks are taken as independent, samples are not.

    Returns
    -------
    Dependence or None
        None when the coordinate does not vary, or there are fewer than `MIN_BLOCKS` blocks.
    """
    good = np.isfinite(coordinate) & np.isfinite(residual)
    x, y, block = coordinate[good], residual[good], block[good]
    blocks, which = np.unique(block, return_inverse=True)
    if blocks.size < MIN_BLOCKS:
        return None
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, BINS + 1)))
    if edges.size < 3 or edges[-1] <= edges[0]:
        return None
    bins = edges.size - 1
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, bins - 1)
    cell = which * bins + index
    count = np.bincount(cell, minlength=blocks.size * bins).reshape(blocks.size, bins)
    total = np.bincount(cell, weights=y - y.mean(), minlength=blocks.size * bins).reshape(blocks.size, bins)
    each = count.sum(axis=0)
    mean = total.sum(axis=0) / each
    # Jackknife over blocks: what the means would be without one of them.
    with np.errstate(invalid="ignore", divide="ignore"):
        without = np.where(each - count > 0, (total.sum(axis=0) - total) / (each - count), mean)
    spread = without - without.mean(axis=0)
    factor = (blocks.size - 1) / blocks.size
    sigma = np.sqrt(factor * np.sum(spread**2, axis=0))
    share = each / each.sum()
    amplitude = np.sqrt(max(float(share @ (mean**2 - sigma**2)), 0.0))
    each_amplitude = np.sqrt(np.maximum((without**2) @ share, 0.0))
    sigma_amplitude = float(np.sqrt(factor * np.sum((each_amplitude - each_amplitude.mean()) ** 2)))
    centre = np.bincount(index, weights=x, minlength=bins) / each
    return Dependence(name, unit, centre, mean, sigma, float(amplitude), max(sigma_amplitude, 1e-9))


def strongest(found: Sequence[Dependence], count: int = 3) -> list[Dependence]:
    """Return the dependences that stand out by five sigma, largest first."""
    clear = [one for one in found if one.amplitude > 5.0 * one.sigma_amplitude]
    return sorted(clear, key=lambda one: -one.amplitude)[:count]
