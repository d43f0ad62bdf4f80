"""Bending of a boom from two magnetometers on it (Farrell et al. 1995, section VI, Fig. 6).

Both triads see one spin-plane field; the outer one, turned by the bend, sees it at another phase:
``dph = arg(Z1_out / Z1_in)``. What the field does between two spins is in both and cancels.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import CalibrationError, SamplesError
from inflight.estimators.longrun import sigma_of_mean
from inflight.spin.fits import SpinFits
from inflight.spin.regression import FEWEST, fit_line, noise_variance
from inflight.time import DAY, Int64


@dataclass(frozen=True)
class BoomBending:
    """Azimuth of the outer triad from the inner one in windows of time.

    Attributes
    ----------
    start, end : ndarray of int64, shape (window,)
        TT2000.
    value, sigma : ndarray, shape (window,)
        Radians, positive from XA to YA, less `mounted`.
    mounted : float
        Difference of the azimuths as mounted, radians.
    fits : ndarray of int64, shape (window,)
        Spin fits of both triads in each window.
    """

    start: Int64
    end: Int64
    value: Floats
    sigma: Floats
    mounted: float
    fits: Int64

    @property
    def time(self) -> Int64:
        """Middles of the windows, TT2000; (window,)."""
        return np.asarray(self.start + (self.end - self.start) // 2)

    def table(self) -> xr.Dataset:
        """Return `value` and `sigma` along ``window``, radians."""
        return xr.Dataset(
            {
                "value": ("window", self.value, {"units": "rad"}),
                "sigma": ("window", self.sigma, {"units": "rad"}),
                "start": ("window", self.start, {"scale": "TT2000"}),
                "end": ("window", self.end, {"scale": "TT2000"}),
                "fits": ("window", self.fits),
            },
            attrs={"mounted_rad": self.mounted},
        )


def boom_bending(
    outer: SpinFits, inner: SpinFits, *, window: float | None = None, mounted: float = 0.0
) -> BoomBending:
    """Return the bend of the boom by the spin phase of its outer against its inner magnetometer.

    Parameters
    ----------
    outer, inner : SpinFits
        Of both triads, of the same phase; their first component is sensor 1. Fits of the same turns are
        compared.
    window : float, optional
        Days of one value; the whole span when absent.
    mounted : float
        Azimuth of the outer sensor 1 from the inner one before the flight, radians.

    Raises
    ------
    CalibrationError
        When a window has fewer than ten spins with both.
    """
    if outer.spins != inner.spins:
        raise SamplesError(
            f"fits of {outer.spins} and of {inner.spins} spins found", remedy="fit both over as many"
        )
    _, a, b = np.intersect1d(outer.turn, inner.turn, return_indices=True)
    good = outer.determined[a, 0] & inner.determined[b, 0]
    a, b = a[good], b[good]
    if a.size < FEWEST:
        raise CalibrationError(
            f"{a.size} spins have fits of both magnetometers, at least {FEWEST} needed",
            remedy="take a longer span, or see whether both were fitted against one phase",
        )
    noise = noise_variance(inner)[b, 0, 1:3].sum(axis=-1)
    line = fit_line(inner.phasor[b, 0], outer.phasor[a, 0], noise)
    # One window's angle is that of its weighted sum of Z_in* Z_out.
    product = line.weight * np.conj(inner.phasor[b, 0]) * outer.phasor[a, 0]
    step = np.zeros(a.size) if window is None else (outer.time[a] - outer.time[a][0]) // round(window * DAY)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(step)) + 1, [a.size]])
    found = [_angle(product[low:high]) for low, high in pairwise(edges)]
    value, sigma = np.array(found).T
    turned = (value - mounted + np.pi) % (2 * np.pi) - np.pi
    starts, ends = outer.start[a][edges[:-1]], outer.end[a][edges[1:] - 1] + 1
    return BoomBending(starts, ends, turned, sigma, mounted, np.diff(edges))


def _angle(product: np.ndarray) -> tuple[float, float]:
    """Return the angle of a sum of complex numbers and its standard deviation."""
    if product.size < FEWEST:
        raise CalibrationError(
            f"a window has {product.size} spins with both magnetometers, at least {FEWEST} needed",
            remedy="take longer windows",
        )
    total = product.mean()
    turned = (product * np.conj(total)).imag / abs(total) ** 2
    return float(np.angle(total)), sigma_of_mean(turned)
