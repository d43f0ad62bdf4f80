"""How daily parameters behave over a mission: running means with gaps, and slow trends (Yin 2010, ch. 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration.robust import BIWEIGHT_WIDTH, robust_sigma
from inflight.errors import CalibrationError
from inflight.estimators.longrun import long_run_covariance, memory_of
from inflight.estimators.robust_fit import robust_fit
from inflight.estimators.running import windowed

#: Least part of a window's days that have a value, and how far their mean time may lie from the middle, in
#: windows: at the ends of a mission and beside a long gap a mean is that of another time.
COVERAGE, _LEAN = 0.6, 0.05
_FEWEST = 5
#: Harmonics of the window that its mean does not see.
_REPEATS = 3


@dataclass(frozen=True)
class RunningMean:
    """Centred running mean of a daily parameter; all (day,).

    Attributes
    ----------
    mjd, value, sigma : ndarray
        NaN where the window holds too few days, or leans to one side.
    coverage : ndarray
        Part of the window's days that have a value.
    window : float
        Days.
    """

    mjd: Floats
    value: Floats
    sigma: Floats
    coverage: Floats
    window: float
    unit: str = ""

    def table(self) -> xr.Dataset:
        """Return the means: dim interval (a day each)."""
        return xr.Dataset(
            {
                "value": ("interval", self.value, {"units": self.unit}),
                "sigma": ("interval", self.sigma, {"units": self.unit}),
                "coverage": ("interval", self.coverage),
                "mjd": ("interval", self.mjd, {"units": "d"}),
            },
            attrs={"window_days": self.window, "units": self.unit},
        )


def running_mean(
    mjd: Floats, value: Floats, window: float, *, coverage: float = COVERAGE, unit: str = ""
) -> RunningMean:
    """Return the mean of the days within half a window on either side, each day alike.

    Days count alike, whatever their sigma, so that a window of one turn of local time (260.5 d) removes
    what repeats with it. The uncertainty is that of a mean of correlated days, from the scatter about the
    running mean, less what repeats with the window, and its memory. The window must lie within the span; gaps
    inside it may not lean it to one side.

    Parameters
    ----------
    mjd : ndarray, shape (day,)
        Middles of the days, rising; days may be missing.
    value : ndarray, shape (day,)
        NaN in gaps.
    window : float
        Days.
    coverage : float
        Least part of the window's days that must have a value.

    Raises
    ------
    CalibrationError
        When no window has enough days.
    """
    known = np.isfinite(value)
    if not known.any():
        raise CalibrationError("no day has a value", remedy="use a longer span")
    place = np.rint(mjd - mjd[0]).astype(np.int64)
    daily, weight = np.full((int(place[-1]) + 1, 1), np.nan), np.zeros(int(place[-1]) + 1)
    daily[place[known], 0], weight[place[known]] = value[known], 1.0
    means = windowed(daily, weight, window)
    mean, count, share, lean = (
        one[place] for one in (means.mean[:, 0], means.weight, means.coverage, means.lean)
    )
    inside = (mjd - window / 2 >= mjd[known].min() - 1.0) & (mjd + window / 2 <= mjd[known].max() + 1.0)
    defined = inside & (share >= coverage) & (np.abs(lean) <= _LEAN * window)
    if not defined.any():
        raise CalibrationError(
            f"no window of {window:g} days has {100 * coverage:.0f} % of its days, evenly on both sides",
            remedy="use a shorter window, or a longer span",
        )
    left = _without_repeats(mjd, np.where(defined & known, value - mean, np.nan), window)
    sigma = np.sqrt(_variance_of_day(left, float(np.ptp(mjd)) / window) / np.maximum(count, 1.0))
    nan = np.nan
    return RunningMean(
        mjd, np.where(defined, mean, nan), np.where(defined, sigma, nan), share, float(window), unit
    )


def _without_repeats(mjd: Floats, left: Floats, window: float) -> Floats:
    """Take out what repeats with the window: it does not enter the window's mean, whatever its size."""
    known = np.isfinite(left)
    turns = [2 * np.pi * k * mjd / window for k in range(1, _REPEATS + 1)]
    rows = np.stack([wave(turn) for turn in turns for wave in (np.cos, np.sin)], axis=1)
    if known.sum() < 2 * rows.shape[1]:
        return left
    return np.asarray(left - rows @ np.linalg.lstsq(rows[known], left[known])[0])


def _variance_of_day(left: Floats, means: float) -> float:
    """Return the long-run variance of a day: what n days' mean has is this over n.

    As many independent means were taken out as windows fit into the span.
    """
    known = left[np.isfinite(left)]
    if known.size < _FEWEST:
        return float("nan")
    spread = robust_sigma(known - np.median(known))
    held = np.clip(known, -BIWEIGHT_WIDTH * spread, BIWEIGHT_WIDTH * spread) if spread > 0 else known
    return float(long_run_covariance(held[:, None], means)[0, 0]) / known.size


@dataclass(frozen=True)
class Slope:
    """A straight line through a daily parameter, with waves of given periods beside it.

    Attributes
    ----------
    slope, sigma : float
        Unit a day.
    value, sigma_value : float
        At `mjd`, the mean day.
    memory : int
        Steps after which the values have forgotten themselves; the sigma has it.
    days, outlying : int
    """

    slope: float
    sigma: float
    value: float
    sigma_value: float
    mjd: float
    memory: int
    days: int
    outlying: int
    unit: str = ""

    def table(self) -> xr.Dataset:
        """Return slope and value: dim parameter."""
        return xr.Dataset(
            {
                "value": ("parameter", np.array([self.slope, self.value])),
                "sigma": ("parameter", np.array([self.sigma, self.sigma_value])),
                "units": ("parameter", np.array([f"{self.unit}/d", self.unit])),
            },
            coords={"parameter": ["slope", "value"]},
            attrs={"mjd": self.mjd, "days": self.days, "memory": self.memory},
        )


def slope_of(
    mjd: Floats, value: Floats, sigma: Floats, periods: Sequence[float] = (), unit: str = ""
) -> Slope:
    """Fit a straight line robustly; its uncertainty knows the correlation of days.

    Parameters
    ----------
    mjd, value, sigma : ndarray, shape (day,)
        Days, values (NaN in gaps), standard deviations.
    periods : sequence of float
        Days; waves fitted beside the line, such as those that `parameter_spectrum` resolves.

    Raises
    ------
    CalibrationError
        When fewer days than unknowns and five have a value.
    """
    use = np.isfinite(value) & np.isfinite(sigma) & (sigma > 0)
    unknowns = 2 + 2 * len(periods)
    if use.sum() < unknowns + _FEWEST:
        raise CalibrationError(
            f"{int(use.sum())} days with a value for {unknowns} unknowns", remedy="use a longer span"
        )
    t, y, own = mjd[use], value[use], sigma[use]
    centre, span = float(t.mean()), max(float(np.ptp(t)), 1.0)
    turns = [2 * np.pi * (t - centre) / period for period in periods]
    columns = [
        (t - centre) / span,
        np.ones_like(t),
        *(wave(turn) for turn in turns for wave in (np.cos, np.sin)),
    ]
    rows = np.stack(columns, axis=1)
    fit = robust_fit(rows, y, own**2, unknowns)
    errors = np.sqrt(np.diag(fit.covariance))
    return Slope(
        float(fit.value[0]) / span,
        float(errors[0]) / span,
        float(fit.value[1]),
        float(errors[1]),
        centre,
        int(memory_of(fit.left[:, None])[0]),
        int(use.sum()),
        fit.outlying,
        unit,
    )
