"""The spin period that the field itself shows, as a check of the phase that is used.

The spin-plane field seen from a spinning sensor, ``BX + i BY = Bsp exp(-i (w t - psi))``, is one tone of
negative frequency; a zero level is one at zero. The top of the tone is found in the spectrum, then sharpened
by how its phase moves from one stretch of the record to the next.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy import fft

from inflight.arrays import Floats
from inflight.calibration.robust import TO_SIGMA
from inflight.errors import CalibrationError, SamplesError
from inflight.time import SECOND, Int64

TURN = 2.0 * np.pi
#: A phase is in doubt when its period is this many sigmas from the field's.
_DOUBT = 5.0
#: The tone must stand this much above the median of the spectrum (power); noise alone reaches the logarithm
#: of the number of frequencies, less than 20.
_STANDS_OUT = 50.0
#: Stretches of the record whose phases are compared, at most and at least; turns of the shortest.
_STRETCHES, _FEWEST, _SHORTEST = 40, 4, 4.0
#: Readings fewer than this a record give no spectrum; empty places of the grid fill at most this part.
_LEAST, _MOST_EMPTY = 64, 0.75


@dataclass(frozen=True)
class PeriodCheck:
    """Spin period by the field and by the phase, s.

    Attributes
    ----------
    period, sigma : float
        By the field. The sigma takes the direction of the field to walk; where it comes back, it is an upper
        bound.
    used : float
        Mean period of the phase that is used; NaN when none was given.
    tone : float
        Amplitude of the tone, nT.
    agrees : bool
        False when the two differ by more than five sigmas; True where the field cannot tell.
    aliased : bool
        The readings are slower than twice a turn of the used period: the field cannot tell.
    """

    period: float
    sigma: float
    used: float
    tone: float
    agrees: bool
    aliased: bool

    def table(self) -> xr.Dataset:
        """Return `value`, `sigma` and the period that is used, s."""
        numbers = {"value": self.period, "sigma": self.sigma, "used": self.used}
        return xr.Dataset(
            {name: ((), number, {"units": "s"}) for name, number in numbers.items()},
            attrs={"agrees": int(self.agrees), "tone_nT": self.tone, "told": self.told()},
        )

    def told(self) -> str:
        """Say it in a sentence."""
        if self.aliased:
            return f"readings are too slow to tell a spin of {self.used:.6g} s"
        text = f"the field turns once in {self.period:.7g} +- {self.sigma:.2g} s"
        if np.isnan(self.used):
            return text
        if self.agrees:
            return f"{text}, as the phase does ({self.used:.7g} s)"
        return f"{text}, but the phase once in {self.used:.7g} s: the phase is WRONG"


def check_period(
    stamps: Int64,
    field: Floats,
    phase: Floats | None = None,
    *,
    good: npt.NDArray[np.bool_] | None = None,
) -> PeriodCheck:
    """Estimate the spin period from the spin-plane field, and hold a phase against it.

    Parameters
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000, nearly even; gaps allowed.
    field : ndarray, shape (time, 2 or 3)
        Apparent axes (they spin), nT; the first two are used.
    phase : ndarray, shape (time,), optional
        The phase that is used, radians.
    good : ndarray of bool, shape (time,), optional

    Raises
    ------
    CalibrationError
        Too few readings, or no tone that stands out.
    """
    if field.ndim != 2 or field.shape[1] < 2 or field.shape[0] != stamps.size:
        raise SamplesError(f"a field of shape {field.shape} found", remedy="give (time, 2 or 3)")
    kept = np.isfinite(field[:, :2]).all(axis=1)
    kept &= True if good is None else good
    if np.count_nonzero(kept) < _LEAST:
        raise CalibrationError(
            f"{np.count_nonzero(kept)} readings found, at least {_LEAST} needed", remedy="take a longer span"
        )
    seconds = (stamps[kept] - stamps[kept][0]) / SECOND
    plane = field[kept, 0] + 1j * field[kept, 1]
    # Saturated or wild readings are pulled in: one of them is white, and may stand above any tone.
    plane = _limited(plane - np.median(plane.real) - 1j * np.median(plane.imag))
    cadence = float(np.median(np.diff(seconds)))
    used = _mean_period(stamps, phase)
    if used < 2.0 * cadence:
        nan = float("nan")
        return PeriodCheck(nan, nan, used, nan, agrees=True, aliased=True)
    coarse = _top(seconds, plane, cadence)
    rate, sigma, tone = _sharpened(seconds, plane, coarse)
    period, error = 1.0 / rate, sigma / rate**2
    agrees = np.isnan(used) or abs(used - period) <= _DOUBT * error
    return PeriodCheck(period, error, used, tone, bool(agrees), aliased=False)


def _mean_period(stamps: Int64, phase: Floats | None) -> float:
    if phase is None:
        return float("nan")
    known = np.flatnonzero(np.isfinite(phase))
    turns = (phase[known[-1]] - phase[known[0]]) / TURN if known.size > 1 else 0.0
    return float((stamps[known[-1]] - stamps[known[0]]) / SECOND / turns) if turns > 0 else float("nan")


def _limited(plane: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
    """Pull far readings in to six times the usual size."""
    size = np.abs(plane)
    most = 6.0 * TO_SIGMA * float(np.median(size))
    return np.asarray(plane * np.minimum(1.0, most / np.maximum(size, 1e-300)))


def _top(seconds: Floats, plane: npt.NDArray[np.complex128], cadence: float) -> float:
    """Return the frequency of the highest tone of negative frequency, Hz, on a grid four times as fine."""
    place = np.rint(seconds / cadence).astype(np.int64)
    span = int(place[-1]) + 1
    if place.size < (1.0 - _MOST_EMPTY) * span:
        raise CalibrationError(
            f"{100 * (1 - place.size / span):.0f} % of the record is gaps", remedy="take a span with fewer"
        )
    even = np.zeros(span, dtype=np.complex128)
    even[place] = plane
    size = fft.next_fast_len(4 * span)
    power = np.abs(fft.fft(even, size)) ** 2
    # Negative frequencies, lowest first; those slower than two turns a record are the zero level's.
    falling = power[: size // 2 : -1]
    least = max(2 * size // span, 1)
    best = least + int(np.argmax(falling[least:]))
    if falling[best] < _STANDS_OUT * float(np.median(power)):
        raise CalibrationError(
            "no tone stands out of the spin-plane field",
            remedy="see whether the field spins, which axis is the spin axis, and the sense of the spin",
        )
    return (best + 1) / (size * cadence)


def _sharpened(seconds: Floats, plane: npt.NDArray[np.complex128], rate: float) -> tuple[float, float, float]:
    """Return frequency and its sigma, Hz, and amplitude, from the phases of stretches of the record."""
    length = max(seconds[-1] / _STRETCHES, _SHORTEST / rate)
    number = int(seconds[-1] // length)
    if number < _FEWEST:
        raise CalibrationError(
            f"{seconds[-1] * rate:.1f} turns found, at least {_FEWEST * _SHORTEST:.0f} needed",
            remedy="take a longer span",
        )
    stretch = np.minimum((seconds / length).astype(np.int64), number - 1)
    still = plane * np.exp(1j * TURN * rate * seconds)
    count = np.bincount(stretch, minlength=number)
    parts = [np.bincount(stretch, part, number) for part in (still.real, still.imag)]
    filled = count > 0.25 * np.median(count)
    mean = (parts[0] + 1j * parts[1])[filled] / count[filled]
    middle = np.bincount(stretch, seconds, number)[filled] / count[filled]
    turned = np.unwrap(np.angle(mean)) / TURN
    apart, step = np.diff(middle), np.diff(turned)
    slope = (turned[-1] - turned[0]) / (middle[-1] - middle[0])
    left = step - slope * apart
    # A direction that wanders walks: the ends' difference is the sum of the steps.
    sigma = float(np.sqrt(np.sum(left**2) * left.size / max(left.size - 1, 1))) / (middle[-1] - middle[0])
    # Even without any wander, the phases have the resolution of the arithmetic.
    return rate - slope, max(sigma, 1e-12 * rate), float(np.mean(np.abs(mean)))
