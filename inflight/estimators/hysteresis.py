"""A daily parameter against temperature, while it rises and while it falls: the loop and its area.

A parameter that lags behind the temperature, or follows it with play, has two values at one
temperature (Yin 2010, ch. 4). The area between the branches is its measure: 0 for any function of the
temperature alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.dependence import jackknife
from inflight.errors import CalibrationError

#: Days on either side that tell whether the temperature rises, and the fewest of them.
_AROUND, _FEWEST_AROUND = 4.0, 4
#: Bins, and blocks of time of the jackknife; fewest days of a bin of a branch, and of common bins.
_BINS, _BLOCKS, _FEWEST_DAYS, _FEWEST_BINS = 8, 20, 3, 3
#: Quantiles of the temperature that the bins reach to: branches do not overlap beyond.
_REACH = (0.03, 0.97)


@dataclass(frozen=True)
class HysteresisLoop:
    """Means of a parameter in bins of temperature on both branches.

    Attributes
    ----------
    centre : ndarray, shape (bin,)
        Middle of the bins, degC.
    rising, falling : ndarray, shape (bin,)
        Mean value of each branch, moved to the middle of the bin; NaN where it has too few days.
    sigma_rising, sigma_falling : ndarray, shape (bin,)
    area, sigma : float
        Integral of (rising - falling) over the temperature, unit of the parameter times K; its standard
        deviation from a jackknife over blocks of time.
    correlation : float
        Of the parameter with the temperature.
    days : tuple of int
        On the rising and on the falling branch.
    unit : str
    """

    centre: Floats
    rising: Floats
    falling: Floats
    sigma_rising: Floats
    sigma_falling: Floats
    area: float
    sigma: float
    correlation: float
    days: tuple[int, int]
    unit: str

    @property
    def is_open(self) -> bool:
        """True when the area is three sigma."""
        return abs(self.area) > 3.0 * self.sigma

    def table(self) -> xr.Dataset:
        """Return the area, and the branches along bin."""
        branch = ("bin", "branch")
        return xr.Dataset(
            {
                "value": ("parameter", np.array([self.area])),
                "sigma": ("parameter", np.array([self.sigma])),
                "units": ("parameter", np.array([f"{self.unit} K"])),
                "mean": (branch, np.stack([self.rising, self.falling], axis=1)),
                "sigma_mean": (branch, np.stack([self.sigma_rising, self.sigma_falling], axis=1)),
                "temperature": ("bin", self.centre, {"units": "degC"}),
            },
            coords={"parameter": ["loop_area"], "branch": ["rising", "falling"]},
            attrs={"correlation": self.correlation},
        )


def rate_of(mjd: Floats, temperature: Floats) -> Floats:
    """Return the slope of the temperature around each day, K/d; NaN where too few days are near (day,)."""
    known = np.isfinite(temperature)
    low = np.searchsorted(mjd, mjd - _AROUND)
    high = np.searchsorted(mjd, mjd + _AROUND, side="right")
    sums = {}
    away = np.where(known, mjd - mjd[0], 0.0)
    warm = np.where(known, temperature - np.nanmean(temperature), 0.0)
    for name, series in {"1": known * 1.0, "t": away, "T": warm, "tt": away**2, "tT": away * warm}.items():
        total = np.concatenate([[0.0], np.cumsum(series)])
        sums[name] = total[high] - total[low]
    count = np.maximum(sums["1"], 1.0)
    spread = sums["tt"] - sums["t"] ** 2 / count
    shared = sums["tT"] - sums["t"] * sums["T"] / count
    slope = np.divide(shared, spread, out=np.full_like(spread, np.nan), where=spread > 1e-6)
    return np.where(sums["1"] >= _FEWEST_AROUND, slope, np.nan)


def hysteresis_loop(mjd: Floats, temperature: Floats, value: Floats, unit: str = "") -> HysteresisLoop:
    """Return the loop of a daily parameter against temperature.

    A parabola of the temperature is taken out before bins are made, and put back at their middles: days of
    the two branches lie differently within a bin.

    Parameters
    ----------
    mjd, temperature, value : ndarray, shape (day,)
        Middles of days (rising), their mean temperature (degC) and the parameter; NaN in gaps.

    Raises
    ------
    CalibrationError
        When the branches share fewer than three bins.
    """
    rate = rate_of(mjd, temperature)
    use = np.isfinite(rate) & np.isfinite(value) & np.isfinite(temperature) & (rate != 0)
    if use.sum() < 2 * _FEWEST_BINS * _FEWEST_DAYS:
        raise CalibrationError(f"{int(use.sum())} days make no loop", remedy="use a longer span")
    warm, up = temperature[use], rate[use] > 0
    curve = np.polynomial.Polynomial.fit(warm, value[use], 2)
    low, high = (float(edge) for edge in np.quantile(warm, _REACH))
    edges = np.linspace(low, high, _BINS + 1)
    count, total = _sums(value[use] - curve(warm), np.digitize(warm, edges) - 1, up)
    enough = count.sum(axis=0) >= _FEWEST_DAYS
    common = enough.reshape(2, _BINS).all(axis=0)
    if common.sum() < _FEWEST_BINS:
        raise CalibrationError(
            f"rising and falling temperature share {int(common.sum())} bins of {_BINS}",
            remedy="use a span with whole cycles of temperature",
        )
    mean = _means(total.sum(axis=0), count.sum(axis=0))
    without = _means(total.sum(axis=0) - total, count.sum(axis=0) - count)
    width, centre = (high - low) / _BINS, 0.5 * (edges[1:] + edges[:-1])
    sigma = np.where(enough, jackknife(without), np.nan)
    shown = np.where(enough, mean, np.nan)
    return HysteresisLoop(
        centre,
        shown[:_BINS] + curve(centre),
        shown[_BINS:] + curve(centre),
        sigma[:_BINS],
        sigma[_BINS:],
        float(_area(mean[None], common, width)[0]),
        float(jackknife(_area(without, common, width)[:, None])[0]),
        float(np.corrcoef(warm, value[use])[0, 1]),
        (int(up.sum()), int((~up).sum())),
        unit,
    )


def _sums(left: Floats, place: np.ndarray, up: np.ndarray) -> tuple[Floats, Floats]:
    """Return counts and sums in cells of (block of time, rising bins then falling bins)."""
    inside = (place >= 0) & (place < _BINS)
    cell = np.where(up, place, place + _BINS)[inside]
    block = (np.arange(left.size) * _BLOCKS // left.size)[inside]
    shape = (_BLOCKS, 2 * _BINS)
    index, size = block * 2 * _BINS + cell, _BLOCKS * 2 * _BINS
    count = np.bincount(index, minlength=size).reshape(shape).astype(np.float64)
    total = np.bincount(index, weights=left[inside], minlength=size).reshape(shape)
    return count, np.asarray(total, dtype=np.float64)


def _means(total: Floats, count: Floats) -> Floats:
    return np.asarray(total / np.maximum(count, 1.0))


def _area(means: Floats, common: np.ndarray, width: float) -> Floats:
    """Return the areas of loops (loop, branch * bin) over the bins that both branches have; (loop,)."""
    apart = means[:, :_BINS] - means[:, _BINS:]
    return np.asarray(apart[:, common].sum(axis=1) * width)
