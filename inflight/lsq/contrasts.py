"""Robust line fits, contrasts of samples around a step, and running means.

- `robust_fit` takes rows, values and their stated variances; makes coefficients that outliers do not
  move (Tukey's biweight) with a covariance that respects correlation in time.
- `robust_contrast` takes the residual around a change of a current; makes one number of it: a weighted
  sum of the samples that is 0 for any drift and 1 for a unit step.
- `window_means` takes daily values; makes their weighted means in a window that moves over the days, whose
  end days count by the part of them inside. The running mean of a parameter and the filled running mean
  of a current are made of it (`inflight.mission_fit`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.errors import SamplesError, SettingsError
from inflight.frames import direction_of
from inflight.lsq.covariance import long_run_covariance, sandwich
from inflight.lsq.robust import biweight, biweight_slope, robust_sigma
from inflight.lsq.solver import SOLVER_SETTINGS, gram_inverse
from inflight.time import Int64
from inflight.units import factor_and_offset

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True, kw_only=True)
class ContrastSettings:
    """How robust fits settle and what counts as an outlier.

    Attributes
    ----------
    passes : int
        Passes of the biweights; assumed.
    least_slope : float
        Part of the weights' sum that the slopes of the influence sum to at least; assumed.
    outlier_passes : int
        Passes of leaving outliers of a contrast out; assumed.
    outlier : float
        Samples so many robust sigmas off the fitted drift and step are left out; assumed.
    nothing : float
        A column of which the others leave less than this part of its square is one of theirs: rounding.
    """

    passes: int = 12
    least_slope: float = 0.3
    outlier_passes: int = 3
    outlier: float = 6.0
    nothing: float = 1e-24


CONTRAST_SETTINGS = ContrastSettings()


@dataclass(frozen=True)
class RobustFit:
    """A fit by biweights.

    Attributes
    ----------
    value, covariance : ndarray, shape (column,), (column, column)
    residual : ndarray, shape (row,)
        Values less the fit.
    robust_weight : ndarray, shape (row,)
        1 for a value of full weight, 0 for one that is left out.
    scatter : float
        Robust standard deviation of the values beyond their stated errors.
    """

    value: Floats
    covariance: Floats
    residual: Floats
    robust_weight: Floats
    scatter: float

    @property
    def outlying(self) -> int:
        """Number of values that are weighted down to less than a fifth."""
        return int(np.sum(self.robust_weight < 0.2))


def robust_fit(rows: Floats, value: Floats, variance: Floats, functions: float) -> RobustFit:
    """Fit values by rows.

    Parameters
    ----------
    rows : ndarray, shape (row, column)
        In order of time.
    value, variance : ndarray, shape (row,)
        Values and the variances stated for them.
    functions : float
        As in `long_run_covariance`.
    """
    size = np.maximum(np.abs(rows).max(axis=0), 1e-300)
    unit = rows / size
    robust_weight, extra = np.ones(value.size), 0.0
    for _ in range(CONTRAST_SETTINGS.passes):
        sigma2 = variance + extra
        root = np.sqrt(robust_weight / sigma2)
        found = np.linalg.lstsq(unit * root[:, None], value * root)[0]
        residual = value - unit @ found
        usual = robust_sigma(residual)
        extra = max(usual**2 - float(np.median(variance)), 1e-12 * float(np.median(variance)))
        standardised = residual / np.sqrt(variance + extra)
        robust_weight = biweight(standardised)
    slope = biweight_slope(standardised) / (variance + extra)
    weight = robust_weight / (variance + extra)
    slopes, weights = (unit * slope[:, None]).T @ unit, (unit * weight[:, None]).T @ unit
    # Where outliers make the sum of slopes small, a part of that of the weights takes its place.
    if not np.trace(slopes) / max(float(np.trace(weights)), 1e-300) > CONTRAST_SETTINGS.least_slope:
        slopes = CONTRAST_SETTINGS.least_slope * weights
    bread = gram_inverse(slopes, SOLVER_SETTINGS.eigen_cut)
    scores = unit * (weight * residual)[:, None]
    covariance = sandwich(bread, long_run_covariance(scores, functions))
    return RobustFit(
        found / size, covariance / np.outer(size, size), residual, robust_weight, float(np.sqrt(extra))
    )


Mask = npt.NDArray[np.bool_]


#: Places of the orbit kept with each epoch where the samples know them.
_PLACES = ("local_time", "orbit_phase", "latitude", "sunlit", "sun_direction")


@dataclass(frozen=True)
class Series:
    """The samples as arrays, missing ones NaN."""

    stamps: Int64
    residual: Floats
    direction: Floats
    currents: Floats
    names: tuple[str, ...]
    units: tuple[str, ...]
    places: dict[str, Floats]

    @classmethod
    def of(cls, samples: xr.Dataset, residual: Floats, names: tuple[str, ...]) -> Series:
        """Return the arrays of samples, residual and channels; what has weight 0 is missing.

        Raises
        ------
        SamplesError
            A variable is missing or has another shape.
        """
        missing = [name for name in ("tt2000", "field", *names) if name not in samples]
        if missing:
            raise SamplesError(f"samples have no {missing}", remedy="align these channels first")
        count = samples.sizes["time"]
        values = np.asarray(residual, dtype=np.float64)
        if values.shape != (count,):
            raise SamplesError(f"the residual has shape {values.shape}, ({count},) expected")
        if "weight" in samples:
            values = np.where(samples["weight"].values > 0, values, np.nan)
        field = np.asarray(samples["field"].values, dtype=np.float64)
        direction = direction_of(field)
        for name in names:
            if samples[name].ndim != 1:
                raise SamplesError(
                    f"has dims {samples[name].dims}, one current expected",
                    channel=name,
                    remedy="take one axis",
                )
        found = [to_amperes(samples[name]) for name in names]
        places = {name: samples[name].values.astype(np.float64) for name in _PLACES if name in samples}
        return cls(
            np.asarray(samples["tt2000"].values, dtype=np.int64),
            values,
            direction,
            np.column_stack([series for series, _ in found]),
            names,
            tuple(unit for _, unit in found),
            places,
        )

    def part(self, start: int, end: int) -> slice:
        """Return the samples in a half-open span."""
        return slice(*(int(i) for i in np.searchsorted(self.stamps, [start, end])))


def to_amperes(series: xr.DataArray) -> tuple[Floats, str]:
    """Return a channel (time, ...) in A where it is a current, else as it is, and its unit."""
    unit = str(series.attrs.get("units", "1"))
    try:
        factor, offset = factor_and_offset(unit, "A")
    except ValueError:
        return series.values.astype(np.float64), unit
    return factor * series.values.astype(np.float64) + offset, "A"


@dataclass(frozen=True)
class Contrast:
    """Weights over some samples: their sum is 0 for any drift and 1 for the shape."""

    weight: Floats
    drift: Floats
    basis: Floats
    used: Floats

    @classmethod
    def of(cls, drift: Floats, shape: Floats) -> Contrast | None:
        """Return the contrast for a shape (time,) against a drift (time, part); None where it is drift."""
        basis = _orthonormal(drift)
        own = shape - (basis @ shape) @ basis
        power = float(own @ own)
        if shape.size < drift.shape[1] + 3 or power <= 1e-9 * float(shape @ shape):
            return None
        return cls(own / power, drift, basis, shape)

    def residual(self, values: Floats) -> Floats:
        """Return values less drift and shape; (time,)."""
        rest = self._without_shape(values)
        return np.asarray(rest - (self.basis @ rest) @ self.basis)

    def common(self, values: Floats) -> Floats:
        """Return the coefficients of the drift in values; (part,)."""
        return np.asarray(np.linalg.lstsq(self.drift, self._without_shape(values))[0])

    def _without_shape(self, values: Floats) -> Floats:
        return np.asarray(values - float(self.weight @ values) * self.used)


def _orthonormal(drift: Floats) -> Floats:
    """Return an orthonormal basis of a few columns (time, part) as rows; zeros for what adds nothing.

    Gram and Schmidt, twice: for a few columns of a hundred samples a library's call costs more than its work.
    """
    basis = np.zeros((drift.shape[1], len(drift)))
    for place, column in enumerate(drift.T):
        rest, own = column, basis[:place]
        for _ in range(2):
            rest = rest - (own @ rest) @ own
        power = float(rest @ rest)
        if power > CONTRAST_SETTINGS.nothing * float(column @ column):
            basis[place] = rest / np.sqrt(power)
    return basis


def robust_contrast(
    drift: Floats, values: Floats, shape: Floats, usable: Mask
) -> tuple[Contrast, Mask, float] | None:
    """Return the contrast without outliers, the samples kept, and the noise of one."""
    kept = usable
    contrast = Contrast.of(drift[kept], shape[kept])
    for _ in range(CONTRAST_SETTINGS.outlier_passes):
        if contrast is None:
            return None
        residual = contrast.residual(values[kept])
        limit = CONTRAST_SETTINGS.outlier * robust_sigma(residual)
        far = np.abs(residual) > max(limit, 1e-12)
        if not far.any():
            break
        kept = kept.copy()
        kept[np.flatnonzero(kept)[far]] = False
        contrast = Contrast.of(drift[kept], shape[kept])
    if contrast is None:
        return None
    residual = contrast.residual(values[kept])
    freedom = max(residual.size - drift.shape[1] - 1, 1)
    return contrast, kept, float(np.sqrt(np.sum(residual**2) / freedom))


@dataclass(frozen=True)
class WindowMeans:
    """Means over windows; a window without a day has the mean 0 and no coverage.

    Attributes
    ----------
    mean, spread : ndarray, shape (day, column)
        Weighted mean of the values and their standard deviation within the window.
    weight : ndarray, shape (day,)
        Sum of the weights inside.
    coverage : ndarray, shape (day,)
        The same as a part of what a window without gaps would have, in [0, 1].
    lean : ndarray, shape (day,)
        Mean time of the window's days less its middle, days.
    """

    mean: Floats
    spread: Floats
    weight: Floats
    coverage: Floats
    lean: Floats


def window_means(daily: Floats, weight: Floats, window: float) -> WindowMeans:
    """Return the means of the days within half a window on either side of each.

    Parameters
    ----------
    daily : ndarray, shape (day, column)
        One row a day, no day left out; NaN where the weight is 0.
    weight : ndarray, shape (day,)
        0 for none, 1 for a usual day.
    window : float
        Days; the days at its ends weigh by the part of them inside, so that a window of 260.5 d removes what
        repeats in 260.5 d.

    Raises
    ------
    SettingsError
        For a window shorter than a day.
    """
    if not window >= 1.0:
        raise SettingsError(f"a window of {window:g} d found", remedy="take one day or more")
    half = int(np.ceil(0.5 * window - 0.5))
    offset = np.arange(-half, half + 1)
    kernel = np.clip(0.5 * window + 0.5 - np.abs(offset), 0.0, 1.0)
    known = np.where(weight[:, None] > 0, daily, 0.0) * weight[:, None]
    inside = np.clip(_convolve_same(weight, kernel), 0.0, None)
    total = np.maximum(inside, 1e-12)
    mean = np.stack([_convolve_same(column, kernel) for column in known.T], axis=1) / total[:, None]
    squares = np.where(weight[:, None] > 0, daily, 0.0) * known
    square = np.stack([_convolve_same(column, kernel) for column in squares.T], axis=1) / total[:, None]
    return WindowMeans(
        mean,
        np.sqrt(np.clip(square - mean**2, 0.0, None)),
        inside,
        np.clip(inside / kernel.sum(), 0.0, 1.0),
        # A convolution turns the kernel over: a day that is later weighs with the negative of its offset.
        -_convolve_same(weight, kernel * offset) / total,
    )


def _convolve_same(series: Floats, kernel: Floats) -> Floats:
    """Return the convolution at the places of the series, however short it is."""
    half = kernel.size // 2
    return np.asarray(np.convolve(series, kernel)[half : half + series.size])
