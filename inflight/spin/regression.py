"""Lines through spin fits: errors in both variables, local weights, scores that are correlated in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats
from scipy.ndimage import median_filter

from inflight.arrays import Floats
from inflight.calibration.robust import TO_SIGMA, biweight
from inflight.errors import CalibrationError
from inflight.spin.fits import SpinFits
from inflight.time import Int64

Complexes = npt.NDArray[np.complex128]
#: The scatter around a line is that of this many fits around each: regions differ by orders of magnitude.
_AROUND = 101
#: Rounds of weights and line.
_ROUNDS = 8
#: The quietest part of the fits, whose residual is the instrument's: nature only adds to it.
_QUIET = 10.0
#: A line is refused when noise makes more than this part of the variance along x.
_MOST_NOISE = 0.5
#: Fits that a line needs for a scatter that can be believed.
FEWEST = 10


@dataclass(frozen=True)
class Line:
    """A regression through zero after each group's own mean is taken off (or none is).

    Attributes
    ----------
    slope : complex
        Real for real data.
    scores : ndarray, shape (fit,)
        What each fit adds to the slope's error; their long-run covariance is the slope's.
    weight : ndarray, shape (fit,)
    left : ndarray, shape (fit,)
        Residuals.
    reliability : float
        Part of the weighted variance along x that is no noise.
    plain : complex
        Slope without regard of the errors along x, biased towards zero.
    """

    slope: complex
    scores: Complexes
    weight: Floats
    left: Complexes
    reliability: float
    plain: complex


def fit_line(
    x: Complexes | Floats,
    y: Complexes | Floats,
    noise: Floats,
    group: Int64 | None = None,
) -> Line:
    """Fit ``y = slope x (+ a constant for each group)`` where x has errors of known variance.

    The variance of the noise is taken off the sum of squares along x (Fuller 1987, section 1.2): with the
    scatter along y found from the residual, this is the line that York's and Deming's equations give, without
    their iteration.

    Parameters
    ----------
    x, y : ndarray, shape (fit,)
        Real or complex, finite.
    noise : ndarray, shape (fit,)
        Variance of x, both parts together.
    group : ndarray of int64, shape (fit,), optional
        Number from 0 of the group of each fit, which has its own constant; none has one when absent.

    Raises
    ------
    CalibrationError
        Too few fits, or an x that hardly changes.
    """
    if x.size < FEWEST:
        raise CalibrationError(
            f"{x.size} whole spin fits found, at least {FEWEST} needed", remedy="take a longer span"
        )
    z, v = np.asarray(x, dtype=np.complex128), np.asarray(y, dtype=np.complex128)
    weight = np.ones(x.size)
    for turn in range(_ROUNDS):
        across, along = _centred(v, weight, group), _centred(z, weight, group)
        square = float(np.sum(weight * np.abs(along) ** 2))
        error = float(np.sum(weight * noise))
        cross = complex(np.sum(weight * np.conj(along) * across))
        _refuse_flat(square, error, weight, x.size)
        slope = cross / (square - error)
        left = across - slope * along
        if turn < _ROUNDS - 1:
            weight = _weights(left)
    scores = weight * (np.conj(along) * left + slope * noise) / (square - error)
    return Line(slope, scores, weight, left, 1.0 - error / square, cross / square)


def _refuse_flat(square: float, error: float, weight: Floats, count: int) -> None:
    if not square > 0 or error > _MOST_NOISE * square:
        total = max(float(weight.sum()), 1e-300)
        raise CalibrationError(
            f"what the line is fitted along changes by {np.sqrt(square / total):.3g} nT rms over {count} fits,"
            f" and {np.sqrt(error / total):.3g} nT of that is noise",
            remedy="take a span in which the field changes more, or fits of more spins",
        )


def _centred(values: Complexes, weight: Floats, group: Int64 | None) -> Complexes:
    if group is None:
        return values
    return np.asarray(values - group_means(values, weight, group)[group])


def group_means(values: Complexes, weight: Floats, group: Int64) -> Complexes:
    """Return the weighted mean of each group; groups are numbered from 0."""
    total = np.bincount(group, weight)
    parts = [np.bincount(group, weight * part) for part in (values.real, values.imag)]
    return np.asarray((parts[0] + 1j * parts[1]) / np.where(total > 0, total, np.nan))


def _weights(left: Complexes) -> Floats:
    """Return weights from the scatter around each fit, and less for what lies far outside it."""
    size = np.abs(left)
    width = min(_AROUND, 2 * (size.size // 2) - 1)
    around = TO_SIGMA * median_filter(size, width, mode="nearest")
    floor = 1e-3 * max(float(np.median(size)), 1e-12)
    around = np.maximum(around, floor)
    weight = biweight(size / around) / around**2
    return np.asarray(weight / weight.max()) if weight.max() > 0 else np.ones(size.size)


def instrument_noise(fits: SpinFits) -> Floats:
    """Return the noise of one reading by the residual of the quietest fits; (component,).

    Every fit's residual holds the field's own fluctuations, too; these are no error of C0, which is the mean
    of the field there was. The tenth of the fits with the least residual tell the instrument's, or an upper
    bound of it.
    """
    freedom = fits.count - fits.value.shape[-1]
    known = fits.determined & (freedom > 0)
    rms = np.where(known, fits.rms, np.nan)
    out = np.zeros(rms.shape[1])
    for k in range(rms.shape[1]):
        own = rms[known[:, k], k]
        if own.size:
            usual = float(np.median(freedom[known[:, k], k]))
            level = np.sqrt(stats.chi2.ppf(_QUIET / 100.0, usual) / usual)
            out[k] = float(np.percentile(own, _QUIET)) / level
    return out


def noise_variance(fits: SpinFits) -> Floats:
    """Return what the instrument's noise alone makes of the coefficients' variances; (fit, component, coef)."""
    noise = instrument_noise(fits)
    variance = np.einsum("fkpp->fkp", fits.covariance)
    unit = np.divide(
        variance, fits.rms[..., None] ** 2, out=np.zeros_like(variance), where=fits.rms[..., None] > 0
    )
    return np.asarray(unit * noise[None, :, None] ** 2)
