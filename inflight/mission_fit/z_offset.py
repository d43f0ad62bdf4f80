"""The offset along z of each day from the spread of the residual (Yin 2010, eq. 3.6).

An offset Z0 of the vector sensor adds ``Z0 e_z`` to the residual dB, with ``e = B/|B|``: over a day
``std(dB)^2 = a Z0^2 + noise^2`` with ``a = var(e_z)``: 2/3 for a polar orbit in a dipole, about 0.6655 in
the Earth's field. The spread gives ``|Z0|`` alone; the sign is that of the slope of dB on e_z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.lsq import (
    BIWEIGHT_WIDTH,
    SOLVER_SETTINGS,
    RobustFit,
    biweight,
    biweight_slope,
    gram_inverse,
    long_run_covariance,
    robust_sigma,
    sandwich,
)


@dataclass(frozen=True, kw_only=True)
class SpreadSettings:
    """What a day's spread needs, and how a fit where both sides err settles.

    Attributes
    ----------
    sub_blocks : int
        Spans of a day whose means are nearly independent: 20 minutes.
    fewest_samples : int
        Fewest samples of a day; assumed.
    fewest_days : int
        Fewest days of a regression; assumed.
    passes : int
        Passes of the fit; assumed.
    """

    sub_blocks: int = 72
    fewest_samples: int = 300
    fewest_days: int = 5
    passes: int = 20


SPREAD_SETTINGS = SpreadSettings()

#: Statistics of a day whose errors belong together, as in `covariance`.
STATISTICS = ("mean", "variance", "slope")


def day_statistics(
    residual: Floats, direction: Floats, start: int, end: int, good: np.ndarray | None = None, axis: int = 2
) -> xr.Dataset:
    """Return the statistics of one day's residual that an offset changes.

    Parameters
    ----------
    residual : ndarray, shape (time,)
        dB = |B_vector| - F, nT; NaN where missing.
    direction : ndarray, shape (time, 3)
        B/|B|, axes of the vector sensor.
    start, end : int
        TT2000 of the day, half-open.
    good : ndarray of bool, shape (time,), optional
        Samples to use; those far off are left out in any case.
    axis : int
        Axis of the offset, 2 for z.

    Returns
    -------
    xarray.Dataset
        dim interval (1): `mean`, `variance` (nT^2), `slope` of dB on e_axis (nT), `rest` (nT^2, the
        variance it leaves), their `covariance` (statistic, other; correlated in time); `direction_mean`,
        `direction_square` (axis); `geometry` = var(e_axis); `count`, `start`, `end`.

    Raises
    ------
    CalibrationError
        When fewer than 300 samples are usable.
    """
    use = np.isfinite(residual) & np.isfinite(direction).all(axis=1)
    use &= True if good is None else good
    if use.any():
        away = np.abs(residual - np.median(residual[use]))
        use &= away <= BIWEIGHT_WIDTH * robust_sigma(away[use], floor=1e-9)
    count = int(use.sum())
    if count < SPREAD_SETTINGS.fewest_samples:
        raise CalibrationError(
            f"{count} usable samples for a day's spread, {SPREAD_SETTINGS.fewest_samples} needed",
            remedy="see the day's coverage and flags",
        )
    y, e = residual[use], direction[use]
    mean, centre = float(y.mean()), e[:, axis] - e[:, axis].mean()
    geometry = float(np.mean(centre**2))
    slope = float(np.mean(centre * y) / geometry)
    rest = y - mean - slope * centre
    # The orbit is not random: of the spread only what the noise adds to the square is uncertain.
    spread = 2.0 * slope * centre * rest + rest**2 - np.var(rest)
    influence = np.stack([rest, spread, centre * rest / geometry], axis=1) / count
    sums = np.array([part.sum(axis=0) for part in np.array_split(influence, SPREAD_SETTINGS.sub_blocks)])
    numbers = {"mean": mean, "variance": float(np.var(y)), "slope": slope, "rest": float(np.var(rest))}
    numbers |= {"geometry": geometry, "count": float(count)}
    each = ("interval", "axis")
    return xr.Dataset(
        {name: ("interval", np.array([value])) for name, value in numbers.items()}
        | {
            "covariance": (("interval", "statistic", "other"), long_run_covariance(sums, 2)[None]),
            "direction_mean": (each, e.mean(axis=0)[None]),
            "direction_square": (each, np.mean(e**2, axis=0)[None]),
            "start": ("interval", np.array([start], dtype=np.int64), {"scale": "TT2000"}),
            "end": ("interval", np.array([end], dtype=np.int64), {"scale": "TT2000"}),
        },
        coords={"statistic": list(STATISTICS), "other": list(STATISTICS), "axis": ["x", "y", "z"]},
        attrs={"offset_axis": "xyz"[axis]},
    )


@dataclass(frozen=True)
class SpreadLaw:
    """``std(dB)^2 = factor * offset^2 + noise`` over days.

    Attributes
    ----------
    factor, noise : float
        1 and nT^2.
    covariance : ndarray, shape (2, 2)
        Of (factor, noise), with their correlation in time.
    geometry : float
        Mean of var(e_axis) of the same days: what the factor should be.
    scatter : float
        Robust standard deviation of the days about the law, nT^2.
    days, outlying : int
        Days used, and those of them that are down-weighted to less than a fifth.
    """

    factor: float
    noise: float
    covariance: Floats
    geometry: float
    scatter: float
    days: int
    outlying: int

    def table(self) -> xr.Dataset:
        """Return factor and noise: dim parameter."""
        return xr.Dataset(
            {
                "value": ("parameter", np.array([self.factor, self.noise])),
                "sigma": ("parameter", np.sqrt(np.diag(self.covariance))),
                "covariance": (("parameter", "other"), self.covariance),
                "units": ("parameter", np.array(["1", "nT2"])),
            },
            coords={"parameter": ["factor", "noise"], "other": ["factor", "noise"]},
            attrs={"geometry": self.geometry, "days": self.days, "outlying": self.outlying},
        )


def fit_spread_law(statistics: xr.Dataset, offset: Floats, sigma: Floats) -> SpreadLaw:
    """Fit ``std^2 = a Z0^2 + noise^2`` over days whose offset is known by other means (Yin 2010, eq. 3.6).

    Parameters
    ----------
    statistics : xarray.Dataset
        `day_statistics` of the days along ``interval``.
    offset, sigma : ndarray, shape (interval,)
        Offset of each day that is still in the residual (nT), such as that of a daily calibration less the
        one applied, and its standard deviation. The square of the latter is subtracted from the former's.

    Raises
    ------
    CalibrationError
        When fewer than five days have an offset, or all the same one.
    """
    known = np.isfinite(offset) & np.isfinite(sigma)
    square = offset[known] ** 2 - sigma[known] ** 2
    if known.sum() < SPREAD_SETTINGS.fewest_days or np.ptp(square) == 0:
        raise CalibrationError(
            f"{int(known.sum())} days with an offset do not tell how the spread follows it",
            remedy="use five or more days of different offsets",
        )
    spread = statistics["variance"].values[known]
    own = statistics["covariance"].values[known, 1, 1]
    found = _fit_both_with_errors(square, spread, own, sigma[known])
    geometry = float(statistics["geometry"].values[known].mean())
    return SpreadLaw(
        float(found.value[0]),
        float(found.value[1]),
        found.covariance,
        geometry,
        found.scatter,
        int(known.sum()),
        found.outlying,
    )


def _fit_both_with_errors(square: Floats, spread: Floats, variance: Floats, sigma: Floats) -> RobustFit:
    """Fit ``spread = a square + noise`` where both err (York et al. 2004), by biweights.

    The square of an offset Z with the error s errs by ``4 Z^2 s^2 + 2 s^4``; Z is taken from the law
    itself, since weights that follow the errors would bias it.
    """
    robust_weight, extra = np.ones(square.size), 0.0
    value = np.array([2.0 / 3.0, float(np.min(spread))])
    for _ in range(SPREAD_SETTINGS.passes):
        # Where nothing follows the offsets, there is no law to take them from.
        true = np.maximum((spread - value[1]) / value[0], 0.0) if value[0] else np.zeros_like(spread)
        of_x = 4.0 * true * sigma**2 + 2.0 * sigma**4
        total = variance + extra + value[0] ** 2 * of_x
        weight = robust_weight / total
        x, y = (float(np.average(one, weights=weight)) for one in (square, spread))
        adjusted = ((square - x) * (variance + extra) + value[0] * (spread - y) * of_x) / total
        slope = np.sum(weight * adjusted * (spread - y)) / np.sum(weight * adjusted * (square - x))
        value = np.array([slope, y - slope * x])
        residual = spread - slope * square - value[1]
        standardised = residual / np.sqrt(total)
        extra = max(extra + (robust_sigma(standardised) ** 2 - 1.0) * float(np.median(total)), 0.0)
        robust_weight = biweight(standardised)
    instrument = np.stack([adjusted + x, np.ones_like(x + adjusted)], axis=1)
    rows = np.stack([square, np.ones_like(square)], axis=1)
    slopes = biweight_slope(standardised) / total
    bread = np.linalg.inv((instrument * slopes[:, None]).T @ rows)
    scores = instrument * (weight * residual)[:, None]
    # Few days near zero offset determine the noise: their scatter may be small by chance.
    stated = gram_inverse((instrument * weight[:, None]).T @ instrument, SOLVER_SETTINGS.eigen_cut)
    covariance = sandwich(bread, long_run_covariance(scores, 2.0), stated)
    return RobustFit(value, covariance, residual, robust_weight, float(np.sqrt(extra)))


@dataclass(frozen=True)
class OffsetsFromSpread:
    """Daily offsets from the spread of the residual; all along ``interval``.

    Attributes
    ----------
    size, sigma_size : ndarray
        ``|Z0|`` and its standard deviation, nT; NaN where the spread is below the noise.
    value, sigma : ndarray
        With its sign, nT; the standard deviation holds the chance that the sign is wrong. Where there is
        nothing is seen the value is 0 and sigma the smallest size that would be.
    wrong_sign : ndarray
        Chance that the sign is wrong, 0 to 0.5.
    seen : ndarray of bool
        The spread is above the noise.
    slope, sigma_slope : ndarray
        The slope of dB on the direction, an offset of its own: nT.
    start, end : ndarray of int64
        TT2000.
    axis : str
    """

    size: Floats
    sigma_size: Floats
    value: Floats
    sigma: Floats
    wrong_sign: Floats
    seen: np.ndarray
    slope: Floats
    sigma_slope: Floats
    start: np.ndarray
    end: np.ndarray
    axis: str = "z"

    def table(self) -> xr.Dataset:
        """Return daily corrections: dims interval, parameter; reading less `value` is the corrected one."""
        each = ("interval", "parameter")
        return xr.Dataset(
            {
                "value": (each, self.value[:, None]),
                "sigma": (each, self.sigma[:, None]),
                "determined": (each, self.seen[:, None]),
                "wrong_sign": (each, self.wrong_sign[:, None]),
                "slope": (each, self.slope[:, None]),
                "sigma_slope": (each, self.sigma_slope[:, None]),
                "units": ("parameter", np.array(["nT"])),
                "start": ("interval", self.start, {"scale": "TT2000"}),
                "end": ("interval", self.end, {"scale": "TT2000"}),
            },
            coords={"parameter": [f"offset_from_spread[{self.axis}]"]},
        )


def offsets_from_spread(
    statistics: xr.Dataset, noise: float, sigma_noise: float = 0.0, factor: float | None = None
) -> OffsetsFromSpread:
    """Invert the law of the spread for each day.

    Parameters
    ----------
    statistics : xarray.Dataset
        `day_statistics` along ``interval``.
    noise, sigma_noise : float
        Variance of the residual without an offset and its standard deviation, nT^2, such as
        `SpreadLaw.noise` or `residual_noise`.
    factor : float, optional
        Of the law; each day's own var(e_axis) when absent.

    Returns
    -------
    OffsetsFromSpread
        Nothing is seen on days whose spread is not above the noise: ``|Z0|`` of a negative square is no
        number.
    """
    a = statistics["geometry"].values if factor is None else np.full(statistics.sizes["interval"], factor)
    covariance = statistics["covariance"].values
    excess = statistics["variance"].values - noise
    sigma_excess = np.sqrt(covariance[:, 1, 1] + sigma_noise**2)
    seen = excess > 0
    size = np.sqrt(np.where(seen, excess, np.nan) / a)
    # Of a root from that of its square, also where the square is near zero: ``(x + d)^2 = x^2 + sigma``
    # solved for d is sigma / 2x where x is large, sqrt(sigma) at zero.
    root = np.sqrt(np.maximum(excess / a, 0.0))
    sigma_size = np.sqrt(root**2 + sigma_excess / a) - root
    slope, sigma_slope = statistics["slope"].values, np.sqrt(covariance[:, 2, 2])
    wrong = scipy.stats.norm.sf(np.abs(slope) / np.maximum(sigma_slope, 1e-30))
    value = np.where(seen, np.sign(slope) * size, 0.0)
    # The truth is on the other side with the chance of a wrong sign, twice the size away.
    both = np.sqrt(sigma_size**2 + 4.0 * np.nan_to_num(size) ** 2 * wrong)
    return OffsetsFromSpread(
        size,
        np.where(seen, sigma_size, np.nan),
        value,
        np.where(seen, both, sigma_size),
        np.where(seen, wrong, 0.5),
        seen,
        slope,
        sigma_slope,
        statistics["start"].values,
        statistics["end"].values,
        str(statistics.attrs.get("offset_axis", "z")),
    )


def residual_noise(statistics: xr.Dataset) -> tuple[float, float]:
    """Return the residual's variance without an offset, and its standard deviation, from the days themselves.

    The median over days of what the slope on the direction leaves; nT^2.
    """
    rest = statistics["rest"].values
    spread = robust_sigma(rest - np.median(rest))
    # The standard deviation of a median is sqrt(pi / 2) times that of a mean.
    return float(np.median(rest)), 1.2533 * spread / np.sqrt(max(rest.size, 1))
