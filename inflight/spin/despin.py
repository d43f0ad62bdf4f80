"""From axes that spin to axes that do not (Farrell et al. 1995, eq. 1), and the tone that is left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import SamplesError
from inflight.spin.fits import spin_fits
from inflight.time import Int64


def despin(field: Floats, phase: Floats) -> Floats:
    """Turn apparent vectors into payload axes: XP towards the Sun in the spin plane, ZP the spin axis.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        nT, apparent axes (they spin).
    phase : ndarray, shape (time,)
        Angle of XA from XP towards YP, radians; NaN gives NaN in the spin plane only.

    Returns
    -------
    ndarray, shape (time, 3)
        nT, payload axes.
    """
    return _turned(field, phase)


def respin(field: Floats, phase: Floats) -> Floats:
    """Turn payload vectors (time, 3) into apparent axes: the inverse of `despin`."""
    return _turned(field, -phase)


def _turned(field: Floats, angle: Floats) -> Floats:
    if field.ndim != 2 or field.shape[1] != 3 or angle.shape != field.shape[:1]:
        raise SamplesError(
            f"a field of shape {field.shape} and a phase of shape {angle.shape} found",
            remedy="give (time, 3) and (time,)",
        )
    cosine, sine = np.cos(angle), np.sin(angle)
    out = np.empty_like(field, dtype=np.float64)
    out[:, 0] = cosine * field[:, 0] - sine * field[:, 1]
    out[:, 1] = sine * field[:, 0] + cosine * field[:, 1]
    out[:, 2] = field[:, 2]
    return out


@dataclass(frozen=True)
class SpinTones:
    """Tones that are left at the spin period and at half of it, nT; arrays of shape (component,).

    Attributes
    ----------
    once, twice : ndarray
        Steady amplitude: the mean phasor, which fluctuations of nature do not add up in.
    once_sigma, twice_sigma : ndarray
        Standard deviation of either part of the mean phasor, from the scatter between fits.
    fits : int
    """

    once: Floats
    twice: Floats
    once_sigma: Floats
    twice_sigma: Floats
    fits: int

    def table(self) -> xr.Dataset:
        """Return `value` and `sigma`: dims tone, component."""
        return xr.Dataset(
            {
                "value": (("tone", "component"), np.stack([self.once, self.twice]), {"units": "nT"}),
                "sigma": (
                    ("tone", "component"),
                    np.stack([self.once_sigma, self.twice_sigma]),
                    {"units": "nT"},
                ),
            },
            coords={"tone": ["spin", "twice the spin"]},
            attrs={"fits": self.fits},
        )


def spin_tones(stamps: Int64, field: Floats, phase: Floats, *, spins: int = 1) -> SpinTones:
    """Measure the steady tone at the spin period in a field that should have none.

    Parameters
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000.
    field : ndarray, shape (time, component)
        nT: a despun field, Bz, or the modulus of the spin-plane field.
    phase : ndarray, shape (time,)
        Radians.
    spins : int
        Turns of one fit.
    """
    fits = spin_fits(stamps, field, phase, spins=spins, harmonics=2)
    whole = fits.whole
    means, sigmas = [], []
    for each in (whole.phasor, whole.double):
        means.append(np.abs(each.mean(axis=0)))
        sigmas.append(np.sqrt(0.5 * np.mean(np.abs(each - each.mean(axis=0)) ** 2, axis=0) / len(whole)))
    return SpinTones(means[0], means[1], sigmas[0], sigmas[1], len(whole))
