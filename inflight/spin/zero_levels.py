"""Zero levels over time from the intercepts of spin fits, beside those from before the flight."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import xarray as xr
from scipy import stats

from inflight.arrays import Floats
from inflight.errors import CalibrationError, SamplesError
from inflight.estimators.longrun import sigma_of_mean
from inflight.spin.regression import Line, Points, group_means
from inflight.time import DAY, Int64, utc_text

#: Points of a window whose scatter tells the error of its mean; with fewer the whole span's is taken.
_OWN_SCATTER = 30


@dataclass(frozen=True)
class Intercepts:
    """Zero levels of the spin-plane sensors, one row a window.

    Attributes
    ----------
    start, end : ndarray of int64, shape (window,)
        TT2000 of the first and after the last reading.
    intercept : ndarray, shape (window, 2)
        nT: ``O1 - dth1 O3``.
    zero, sigma : ndarray, shape (window, 2)
        nT: the zero level with what is known of O3, and its standard deviation.
    common : ndarray, shape (window, 2)
        Part of `sigma` that all windows share with the slope's error: by how much the zero level moves for
        one sigma of the slope.
    spin_axis_zero : tuple of float
        O3 and its sigma, nT; (0, NaN) when nothing is known of it.
    """

    start: Int64
    end: Int64
    intercept: Floats
    zero: Floats
    sigma: Floats
    common: Floats
    spin_axis_zero: tuple[float, float]

    @property
    def time(self) -> Int64:
        """Middles of the windows, TT2000; (window,)."""
        return np.asarray(self.start + (self.end - self.start) // 2)

    def table(self) -> xr.Dataset:
        """Return `value` and `sigma` (nT): dims window, sensor."""
        both = ("window", "sensor")
        return xr.Dataset(
            {
                "value": (both, self.zero, {"units": "nT"}),
                "sigma": (both, self.sigma, {"units": "nT"}),
                "intercept": (both, self.intercept, {"units": "nT"}),
                "common": (both, self.common, {"units": "nT"}),
                "window_start": ("window", self.start, {"scale": "TT2000"}),
                "window_end": ("window", self.end, {"scale": "TT2000"}),
            },
            coords={"sensor": [1, 2]},
            attrs={
                "spin_axis_zero": self.spin_axis_zero[0],
                "spin_axis_zero_sigma": self.spin_axis_zero[1],
            },
        )

    def told(self) -> str:
        """Say the last window's zero levels."""
        both = " and ".join(
            f"{value:+.3f} +- {sigma:.3f} nT"
            for value, sigma in zip(self.zero[-1], self.sigma[-1], strict=True)
        )
        name = "zero levels" if np.isfinite(self.spin_axis_zero[1]) else "intercepts (O3 not known)"
        return f"{name} {both}" + (f" in the last of {len(self.zero)} windows" if len(self.zero) > 1 else "")

    def against(self, preflight: Floats, preflight_sigma: float = 0.0) -> ZeroDrift:
        """Return how the zero levels have moved since before the flight, and their rate.

        Parameters
        ----------
        preflight : ndarray, shape (2,)
            Zero levels of sensors 1 and 2 before the flight, nT.
        preflight_sigma : float
            Their standard deviation, nT.
        """
        before = np.asarray(preflight, dtype=np.float64)
        if before.shape != (2,):
            raise SamplesError(f"{before.size} zero levels found", remedy="give those of sensors 1 and 2")
        change_sigma = np.hypot(self.sigma, preflight_sigma)
        rate, rate_sigma = _rates(self)
        return ZeroDrift(self, before, self.zero - before, change_sigma, rate, rate_sigma)


@dataclass(frozen=True)
class ZeroDrift:
    """Zero levels against those from before the flight; arrays (window, 2) or (2,), nT and nT a day.

    `rate` is NaN with fewer than three windows.
    """

    levels: Intercepts
    preflight: Floats
    change: Floats
    change_sigma: Floats
    rate: Floats
    rate_sigma: Floats

    def table(self) -> xr.Dataset:
        """Return the zero levels, their change since before the flight and their rate."""
        both = ("window", "sensor")
        return self.levels.table().assign(
            {
                "change": (both, self.change, {"units": "nT"}),
                "change_sigma": (both, self.change_sigma, {"units": "nT"}),
                "preflight": ("sensor", self.preflight, {"units": "nT"}),
                "rate": ("sensor", self.rate, {"units": "nT/d"}),
                "rate_sigma": ("sensor", self.rate_sigma, {"units": "nT/d"}),
            }
        )

    def told(self) -> str:
        """Say what has moved, a line a sensor."""
        when = utc_text(int(self.levels.time[-1]))
        rows = []
        for k in range(2):
            text = f"sensor {k + 1}: {self.change[-1, k]:+.3f} +- {self.change_sigma[-1, k]:.3f} nT"
            text += f" from before the flight to {when}"
            if np.isfinite(self.rate[k]):
                text += f", {self.rate[k]:+.4f} +- {self.rate_sigma[k]:.4f} nT a day"
            rows.append(text)
        return "; ".join(rows)


def intercepts_of(
    points: Points,
    lines: list[Line],
    slope_sigma: Floats,
    group: Int64,
    spin_axis_zero: tuple[float, float] | None,
) -> Intercepts:
    """Return every window's intercepts from the lines of both sensors.

    Parameters
    ----------
    points : Points
    lines : list of Line
        Of sensors 1 and 2 against sensor 3.
    slope_sigma : ndarray, shape (2,)
    group : ndarray of int64, shape (point,)
        Window of each point.
    spin_axis_zero : tuple of float, optional
        O3 and its sigma, nT.
    """
    known = (0.0, float("nan")) if spin_axis_zero is None else spin_axis_zero
    windows, constant = int(group[-1]) + 1, points.constant
    shape = (windows, 2)
    intercept, own, common = np.empty(shape), np.empty(shape), np.empty(shape)
    for k, line in enumerate(lines):
        means = group_means(constant[:, k] + 1j * constant[:, 2], line.weight, group)
        slope = line.slope.real
        intercept[:, k] = means.real - slope * means.imag
        common[:, k] = (known[0] - means.imag) * slope_sigma[k]
        own[:, k] = _errors_of_means(line, group, windows)
    slopes = np.array([line.slope.real for line in lines])
    sigma = np.sqrt(own**2 + common**2 + (slopes * np.nan_to_num(known[1])) ** 2)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(group)) + 1, [group.size]])
    return Intercepts(
        points.start[edges[:-1]],
        points.end[edges[1:] - 1] + 1,
        intercept,
        intercept + slopes * known[0],
        sigma,
        common,
        known,
    )


def _errors_of_means(line: Line, group: Int64, windows: int) -> Floats:
    """Return the standard deviation of each window's mean residual, correlation in time respected."""
    left, weight = line.left.real, line.weight
    edges = np.searchsorted(group, np.arange(windows + 1))
    # Scaled so that the mean of a window's entries is its weighted mean.
    mean_weight = np.bincount(group, weight) / np.bincount(group)
    parts = left * weight / mean_weight[group]
    whole = sigma_of_mean(parts) * np.sqrt(parts.size)
    return np.array(
        [
            sigma_of_mean(parts[a:b]) if b - a >= _OWN_SCATTER else whole / np.sqrt(b - a)
            for a, b in pairwise(edges)
        ]
    )


def _rates(levels: Intercepts) -> tuple[Floats, Floats]:
    """Return the rates of both zero levels and their sigma, nT a day; NaN with fewer than three windows."""
    nan = np.full(2, np.nan)
    if len(levels.zero) < 3:
        return nan, nan
    days = (levels.time - levels.time[0]) / DAY
    rate, sigma = np.empty(2), np.empty(2)
    for k in range(2):
        own = levels.sigma[:, k] ** 2 - levels.common[:, k] ** 2
        if not np.all(own > 0):
            raise CalibrationError("a zero level without scatter", remedy="give fits of real readings")
        away = days - np.average(days, weights=1.0 / own)
        part = away / own / np.sum(away**2 / own)
        rate[k] = part @ levels.zero[:, k]
        left = levels.zero[:, k] - np.average(levels.zero[:, k], weights=1.0 / own) - rate[k] * away
        # Zero levels that wander more than their errors let the rate be no surer than they wander.
        freedom = days.size - 2
        excess = max(float(np.sum(left**2 / own)) / freedom, 1.0)
        wide = float(stats.t.ppf(0.8413, freedom))
        sigma[k] = np.hypot(wide * np.sqrt(part**2 @ own * excess), part @ levels.common[:, k])
    return rate, sigma
