"""The body's remanent field from the mean torquer current (Yin 2010, section 3.4.4).

Torquers hold the attitude against the torque on the body's own magnetic moment, so over a whole cycle
of local time their mean moment is the body's with the other sign. The body's moment makes the field
``B = eta (0, mean I_y, mean I_z)`` at the scalar sensor. Eta is positive although the moments cancel,
because the torquers' own field per ampere is negative there across the boom (-10.7 and -11.6 nT/A), and
7.1 nT/A is 0.66 and 0.61 of that: the body's moment is 1.16 times farther from the sensor than the
coils. Along the boom the sign of the factor would turn; the mean I_x is taken as 0. The field is
subtracted *with* the torquers' own and *instead of* a constant remanent field.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration.robust import TO_SIGMA
from inflight.errors import CalibrationError, SamplesError, SettingsError
from inflight.estimators.clusters import ClusteredFit, solve_clusters
from inflight.estimators.running import windowed
from inflight.time import Int64, day_bounds

#: nT/A at the scalar sensor, from the test on ground (Yin 2010: 0.0071 nT/mA).
ETA = 7.1
#: Days of the running mean: the local time falls by 24 h.
WINDOW = 260.0
AXES = ("x", "y", "z")
#: How a value came about; codes of `CarriedMean.state`.
STATES = ("whole", "partial", "interpolated", "held")
#: A window counts as whole from this coverage on.
_WHOLE = 0.999


@dataclass(frozen=True)
class CarriedMean:
    """Running mean of daily means; every day from the first to the last has a value.

    Attributes
    ----------
    day : ndarray of int64, shape (day,)
        Days since 1970-01-01.
    value, sigma : ndarray, shape (day, 3)
        A.
    coverage : ndarray, shape (day,)
        Part of the window around the day that has data, in [0, 1].
    state : ndarray of int8, shape (day,)
        Codes of `STATES`: *whole* window; *partial*, the mean of what is there; *interpolated* between
        days with enough coverage; *held* at the nearest such day, at the ends of the record.
    daily : ndarray, shape (day, 3)
        The daily means, A; NaN where there are none.
    window : float
        Days.
    """

    day: Int64
    value: Floats
    sigma: Floats
    coverage: Floats
    state: npt.NDArray[np.int8]
    daily: Floats
    window: float

    @property
    def sentence(self) -> str:
        """What was done with ends and gaps, in words."""
        count = {name: int(np.sum(self.state == code)) for code, name in enumerate(STATES)}
        told = ", ".join(f"{number} {name}" for name, number in count.items() if number)
        return f"running mean of {self.window:g} d over {self.day.size} days: {told}"

    def table(self) -> xr.Dataset:
        """Return `value`, `sigma` (interval, axis) A, `coverage` and `state`, one interval a day."""
        dims = ("interval", "axis")
        return _by_day(self.day).assign(
            value=(dims, self.value, {"units": "A"}),
            sigma=(dims, self.sigma, {"units": "A"}),
            daily=(dims, self.daily, {"units": "A"}),
            coverage=("interval", self.coverage),
            state=("interval", self.state, {"flag_meanings": " ".join(STATES)}),
        )


def _by_day(day: Int64) -> xr.Dataset:
    bounds = np.array([day_bounds(np.datetime64(int(one), "D")) for one in day], dtype=np.int64)
    return xr.Dataset(
        {
            "start": ("interval", bounds[:, 0], {"scale": "TT2000"}),
            "end": ("interval", bounds[:, 1], {"scale": "TT2000"}),
        },
        coords={"axis": list(AXES)},
    )


def carried_mean(
    day: Int64, value: Floats, count: Floats, *, window: float = WINDOW, least: float = 0.9
) -> CarriedMean:
    """Return the centred running mean of daily mean currents, carried to the days that have none.

    Parameters
    ----------
    day : ndarray of int64, shape (given,)
        Days since 1970-01-01, each once, in any order; days may be missing.
    value : ndarray, shape (given, 3)
        Daily means of the torquer currents, A; NaN for none.
    count : ndarray, shape (given,)
        Samples behind each. A day weighs by them, at most like a usual day.
    window : float
        Days; the days at its ends weigh by the part of them inside.
    least : float
        Part of the window that must have data. Below it nothing is averaged: such days are
        interpolated, or held at the ends, with a sigma that grows as the mean itself was seen to change.

    Returns
    -------
    CarriedMean
        `sigma` holds the scatter of days, ``(1 - coverage)`` times the spread of the daily values in
        the window (the missing part may be any part of the local time's cycle), and the change of the
        mean over the time a value was carried.

    Raises
    ------
    SamplesError
        Shapes differ, a day is given twice, or nowhere is the window covered.
    """
    daily, weight = _every_day(day, value, count)
    first = int(np.min(day))
    means = windowed(daily, weight, window)
    mean, spread, coverage = means.mean, means.spread, means.coverage
    good = coverage >= least
    if not good.any():
        raise SamplesError(
            f"the window of {window:g} d has at most {coverage.max():.0%} of its days within {len(daily)}; "
            f"{least:.0%} needed",
            remedy="take a longer span, a shorter window, or lower 'least'",
        )
    scatter = _scatter_of_days(daily)
    sigma = np.hypot(
        scatter / np.sqrt(np.maximum(means.weight, 1e-12))[:, None], (1.0 - coverage)[:, None] * spread
    )
    state = np.where(coverage >= _WHOLE, 0, 1).astype(np.int8)
    mean, sigma, state = _carried(mean, sigma, state, good, spread[good].max(axis=0))
    days = first + np.arange(daily.shape[0], dtype=np.int64)
    return CarriedMean(days, mean, sigma, coverage, state, daily, window)


def _every_day(day: Int64, value: Floats, count: Floats) -> tuple[Floats, Floats]:
    """Return daily values (day, 3) and weights (day,) with no day left out."""
    given = np.asarray(day, dtype=np.int64)
    if np.shape(value) != (given.size, 3) or np.shape(count) != given.shape or not given.size:
        raise SamplesError(
            f"days have shape {given.shape}, values {np.shape(value)}, counts {np.shape(count)}",
            remedy="give one mean of three currents and one count a day",
        )
    if np.unique(given).size != given.size:
        raise SamplesError("a day is given twice", remedy="join the parts of a day first")
    place = given - given.min()
    daily = np.full((int(place.max()) + 1, 3), np.nan)
    daily[place] = value
    weight = np.zeros(daily.shape[0])
    weight[place] = count
    weight = np.where(np.isfinite(daily).all(axis=1), weight, 0.0)
    if not np.any(weight > 0):
        raise SamplesError("no day has a mean current", remedy="take days with torquer currents")
    return daily, np.minimum(weight / np.median(weight[weight > 0]), 1.0)


def _scatter_of_days(daily: Floats) -> Floats:
    """Return the part of the daily values' scatter that neighbours do not share; (3,).

    Not the long-run variance of `behaviour.running_mean`: what the currents' days share repeats with the
    local time, and the window takes it out.
    """
    steps = np.abs(np.diff(daily, axis=0))
    steps = steps[np.isfinite(steps).all(axis=1)]
    if not len(steps):
        return np.zeros(3)
    return np.asarray(TO_SIGMA * np.median(steps, axis=0) / np.sqrt(2.0))


def _carried(
    mean: Floats,
    sigma: Floats,
    state: npt.NDArray[np.int8],
    good: npt.NDArray[np.bool_],
    unknown: Floats,
) -> tuple[Floats, Floats, npt.NDArray[np.int8]]:
    """Interpolate and hold where the window was not covered; sigma grows as the mean can have changed."""
    at = np.flatnonzero(good)
    index = np.arange(good.size)
    filled = np.stack([np.interp(index, at, mean[at, i]) for i in range(3)], axis=1)
    width = np.stack([np.interp(index, at, sigma[at, i]) for i in range(3)], axis=1)
    away = np.min(np.abs(index[:, None] - _neighbours(index, at)), axis=1)
    change = _change_over(mean, good, int(away.max()), unknown)[away]
    state = np.where(good, state, np.where((index < at[0]) | (index > at[-1]), 3, 2)).astype(np.int8)
    return filled, np.hypot(width, change), state


def _neighbours(index: Int64, at: Int64) -> Int64:
    """Return the nearest covered days before and after each; (day, 2)."""
    after = np.clip(np.searchsorted(at, index), 0, at.size - 1)
    before = np.clip(np.searchsorted(at, index, side="right") - 1, 0, at.size - 1)
    return np.stack([at[before], at[after]], axis=1)


def _change_over(mean: Floats, good: npt.NDArray[np.bool_], longest: int, unknown: Floats) -> Floats:
    """Return by how much (rms) the running mean changes over 0, 1, ... `longest` days; (day + 1, 3).

    Beyond the lags that the covered days show it grows in proportion; with none it is `unknown`.
    """
    change = np.zeros((longest + 1, 3))
    seen = 0
    for lag in range(1, longest + 1):
        both = good[lag:] & good[:-lag]
        if both.sum() >= 3:
            change[lag] = np.sqrt(np.mean((mean[lag:][both] - mean[:-lag][both]) ** 2, axis=0))
            seen = lag
        else:
            change[lag] = change[seen] * lag / seen if seen else unknown
    return change


def remanent_field(mean: CarriedMean, *, eta: float = ETA, eta_sigma: float = 0.0) -> xr.Dataset:
    """Return the body's remanent field at the scalar sensor, one interval a day.

    Parameters
    ----------
    mean : CarriedMean
    eta, eta_sigma : float
        nT/A at the scalar sensor.

    Returns
    -------
    xarray.Dataset
        dims interval, axis: `value`, `sigma` nT at the scalar sensor, spacecraft axes: added to its
        reading as e.value, subtracted with the torquers' own field; `covariance` (interval, axis, other);
        `coverage`, `state`, `start`, `end`.
    """
    across = np.array([0.0, 1.0, 1.0])
    current, spread = mean.value * across, mean.sigma * across
    # Eta is common to both components.
    covariance = eta**2 * np.einsum("ti,ij->tij", spread**2, np.eye(3))
    covariance = covariance + eta_sigma**2 * np.einsum("ti,tj->tij", current, current)
    dims = ("interval", "axis")
    told = mean.table()
    return told.drop_vars("daily").assign(
        value=(dims, eta * current, {"units": "nT", "at": "scalar"}),
        sigma=(dims, np.sqrt(np.einsum("tii->ti", covariance)), {"units": "nT"}),
        covariance=((*dims, "other"), covariance, {"units": "nT2"}),
        eta=((), eta, {"units": "nT/A"}),
    )


@dataclass(frozen=True)
class EtaFit:
    """How the residual follows the mean torquer current.

    Attributes
    ----------
    fit : ClusteredFit
        Constant field x, y, z of the residual (nT), then the difference below.
    blocks : float
        Days of a cluster.
    """

    fit: ClusteredFit
    blocks: float

    @property
    def difference(self) -> float:
        """Eta at the vector sensor minus eta at the scalar sensor, nT/A: all that dB can tell."""
        return float(self.fit.value[3])

    @property
    def difference_sigma(self) -> float:
        """Standard deviation, nT/A."""
        return float(self.fit.sigma[3])

    def at_scalar(self, vector_over_scalar: float) -> tuple[float, float]:
        """Return eta at the scalar sensor and its sigma, nT/A.

        Parameters
        ----------
        vector_over_scalar : float
            The body's field at the vector sensor over that at the scalar sensor: ``(r_s/r_v)^3`` for
            a dipole on the boom's axis, 2.5625 for 4.75 and 6.5 m.

        Raises
        ------
        SettingsError
            For 1: the difference then holds nothing of the field.
        """
        share = vector_over_scalar - 1.0
        if abs(share) < 1e-6:
            raise SettingsError("both sensors see the same field", remedy="take eta from ground tests")
        return self.difference / share, self.difference_sigma / abs(share)


def fit_eta(day: Int64, gram: Floats, rows: Floats, mean: CarriedMean, *, block: int = 60) -> EtaFit:
    """Fit dB to ``e.(0, mean I_y, mean I_z)`` and a constant field.

    A constant remanent field looks like an offset of the vector sensor, so only the change of the mean
    current tells, and only while the offsets are held constant. A drift of theirs of the same course
    is not told apart. Days whose running mean was interpolated or held are left out. The error of the
    running mean itself, which lasts for a window, is in the sigma.

    Parameters
    ----------
    day : ndarray of int64, shape (given,)
        Days since 1970-01-01.
    gram : ndarray, shape (given, 4, 4)
        Of [e_x, e_y, e_z | dB], dB in nT, of each day.
    rows : ndarray, shape (given,)
        Samples behind each.
    mean : CarriedMean
    block : int
        Days of a cluster: at least three times as long as the residual's slow errors last.

    Raises
    ------
    CalibrationError
        The mean current does not change, or there are too few days.
    """
    place = np.asarray(day) - mean.day[0]
    inside = (place >= 0) & (place < mean.day.size)
    inside[inside] = mean.state[place[inside]] < 2
    chosen = place[inside]
    if not chosen.size:
        raise CalibrationError("no day has a running mean of its own", remedy="take a longer span")
    current = mean.value[chosen] * [0.0, 1.0, 1.0]
    centre = current.mean(axis=0)
    spread = float(np.sqrt(np.mean(np.sum((current - centre) ** 2, axis=1))))
    if spread <= 1e-9 * max(float(np.linalg.norm(centre)), 1e-12):
        raise CalibrationError(
            "the mean torquer current does not change: eta is not told from an offset",
            remedy="take a longer span, or eta from ground tests",
        )
    turn = np.zeros((chosen.size, 5, 4))
    turn[:, [0, 1, 2, 4], [0, 1, 2, 3]] = 1.0
    # In units of the current's own change, so that the system is as well scaled as it can be.
    turn[:, 3, :3] = (current - centre) / spread
    wide = turn @ np.asarray(gram)[inside] @ turn.transpose(0, 2, 1)
    _, which = np.unique((chosen - chosen[0]) // block, return_inverse=True)
    total = np.zeros((int(which.max()) + 1, 5, 5))
    np.add.at(total, which, wide)
    fit = solve_clusters(total, np.bincount(which, weights=np.asarray(rows)[inside]).astype(np.float64))
    scale = np.array([1.0, 1.0, 1.0, 1.0 / spread])
    covariance = fit.covariance * np.outer(scale, scale)
    of_mean = float(np.sqrt(np.mean(np.sum(mean.sigma[chosen][:, 1:] ** 2, axis=1)) / 2.0))
    independent = max(1.0, chosen.size / mean.window)
    covariance[3, 3] += (fit.value[3] / spread * of_mean / spread) ** 2 / independent
    return EtaFit(
        ClusteredFit(
            fit.value * scale,
            covariance,
            fit.retained,
            fit.determined,
            fit.variance,
            fit.clusters,
            fit.rows,
        ),
        float(block),
    )
