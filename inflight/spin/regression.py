"""Lines through spin fits: errors in both variables, local weights, scores that are correlated in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats
from scipy.ndimage import median_filter

from inflight.arrays import Floats
from inflight.calibration.robust import TO_SIGMA, WEIGHTED_RMS, biweight, biweight_slope
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
    weight, kept, answer = np.ones(x.size), 1.0, np.ones(x.size)
    for turn in range(_ROUNDS):
        across, along = _centred(v, weight, group), _centred(z, weight, group)
        square = float(np.sum(weight * np.abs(along) ** 2))
        error = kept * float(np.sum(weight * noise))
        cross = complex(np.sum(weight * np.conj(along) * across))
        _refuse_flat(square, error, weight, x.size)
        slope = cross / (square - error)
        left = across - slope * along
        if turn < _ROUNDS - 1:
            weight, answer = _weights(left, real=np.isrealobj(x))
            kept = _kept_noise(weight, left, slope, noise)
    # Weights follow the residuals: the slope gives way by more than they say.
    give = float(np.sum(answer * np.abs(along) ** 2)) / square
    scores = weight * (np.conj(along) * left + slope * kept * noise) / (square - error) / give
    return Line(slope, np.asarray(scores), weight, np.asarray(left), 1.0 - error / square, cross / square)


def _kept_noise(weight: Floats, left: Complexes, slope: complex, noise: Floats) -> float:
    """Return what part of the noise along x the weights have left, which favour small residuals.

    Residuals that are all noise along x keep what the biweight keeps of a Gaussian's variance.
    """
    total = float(np.sum(weight * np.abs(left) ** 2))
    part = abs(slope) ** 2 * float(np.sum(weight * noise)) / total if total > 0 else 0.0
    return 1.0 - min(part, 1.0) * (1.0 - WEIGHTED_RMS**2)


def _refuse_flat(square: float, error: float, weight: Floats, count: int) -> None:
    if not square > 0 or error > _MOST_NOISE * square:
        total = max(float(weight.sum()), 1e-300)
        raise CalibrationError(
            f"what the line is fitted along changes by {np.sqrt(square / total):.3g} nT rms over {count}"
            f" fits, and {np.sqrt(error / total):.3g} nT of that is noise",
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


def _weights(left: Complexes, *, real: bool) -> tuple[Floats, Floats]:
    """Return weights from the scatter between neighbours, less far outside, and by how much these give way.

    From their differences: by residuals from zero, fits of a drifting sensor that happen to be near the line
    would pull it to themselves.
    """
    step = np.abs(np.diff(left, prepend=left[:1] + left[0] - left[1]))
    scatter = TO_SIGMA / np.sqrt(2.0) * _median_around(step)
    scatter = np.maximum(scatter, np.percentile(scatter, _QUIET))
    size = np.abs(left)
    usual = np.maximum(TO_SIGMA * _median_around(size), scatter)
    known = usual > 0
    pull = np.divide(size, usual, out=np.zeros_like(size), where=known)
    base = np.divide(1.0, scatter**2, out=np.ones_like(size), where=scatter > 0)
    weight = base * biweight(pull)
    # In a plane the weight gives way along the residual only.
    answer = base * biweight_slope(pull) if real else 0.5 * (weight + base * biweight_slope(pull))
    most = float(weight.max())
    return (weight / most, answer / most) if most > 0 else (np.ones(size.size), np.ones(size.size))


def _median_around(values: Floats) -> Floats:
    return np.asarray(median_filter(values, min(_AROUND, 2 * (values.size // 2) - 1), mode="nearest"))


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


@dataclass(frozen=True)
class Points:
    """Means of neighbouring fits, what the lines are fitted to; arrays along ``point``, nT.

    Attributes
    ----------
    start, end : ndarray of int64, shape (point,)
        TT2000 of the first and of the last reading.
    constant, phasor : ndarray, shape (point, component)
    noise : ndarray, shape (point, component, coefficient)
        Variances by the instrument's noise.
    doubt : ndarray, shape (component,)
        Relative standard deviation of these.
    """

    start: Int64
    end: Int64
    constant: Floats
    phasor: Complexes
    noise: Floats
    doubt: Floats

    @property
    def time(self) -> Int64:
        """Middles, TT2000; (point,)."""
        return np.asarray(self.start + (self.end - self.start) // 2)

    @classmethod
    def of(cls, fits: SpinFits, unit: Floats, spins: int) -> Points:
        """Return the means of fits over about `spins` spins, less where that leaves too few points.

        Parameters
        ----------
        fits : SpinFits
            Whole ones.
        unit : ndarray, shape (component,)
            nT per unit of the fits.
        spins : int
        """
        together = max(1, min(spins // fits.spins, len(fits) // (2 * FEWEST)))
        block = fits.turn // (together * fits.spins)
        first = np.flatnonzero(np.diff(block, prepend=block[0] - 1))
        count = np.diff(np.append(first, len(fits)))
        # Half a block leaks as much as its fits alone.
        kept = 2 * count >= together
        number = count.reshape(-1, 1)
        constant = np.add.reduceat(fits.constant * unit, first) / number
        phasor = np.add.reduceat(np.asarray(fits.phasor * unit), first) / number
        noise = np.add.reduceat(noise_variance(fits), first) / number[..., None] ** 2 * unit[:, None] ** 2
        start, end = fits.start[first], fits.end[first + count - 1]
        doubt = noise_doubt(fits)
        means = constant[kept], np.asarray(phasor[kept], dtype=np.complex128)
        return cls(start[kept], end[kept], *means, noise[kept], doubt)


def noise_doubt(fits: SpinFits) -> Floats:
    """Return the relative standard deviation of the squares of `instrument_noise`; (component,)."""
    part = _QUIET / 100.0
    out = np.zeros(fits.value.shape[1])
    for k in range(out.size):
        freedom = (fits.count[:, k] - fits.value.shape[-1])[fits.determined[:, k]]
        usual = float(np.median(freedom)) if freedom.size else 0.0
        if usual > 0:
            place = float(stats.chi2.ppf(part, usual))
            spread = np.sqrt(part * (1.0 - part) / freedom.size) / stats.chi2.pdf(place, usual)
            out[k] = float(spread) / place
    return out


def noise_variance(fits: SpinFits) -> Floats:
    """Return the coefficients' variances by the instrument's noise alone; (fit, component, coefficient)."""
    noise = instrument_noise(fits)
    variance = np.einsum("fkpp->fkp", fits.covariance)
    unit = np.divide(
        variance, fits.rms[..., None] ** 2, out=np.zeros_like(variance), where=fits.rms[..., None] > 0
    )
    return np.asarray(unit * noise[None, :, None] ** 2)
