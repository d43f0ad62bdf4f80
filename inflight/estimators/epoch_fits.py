"""Fits and stacked curves of stored epochs: the field per ampere between the sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import SamplesError
from inflight.estimators.clusters import ClusteredFit, grams_by_cluster, solve_clusters
from inflight.estimators.epochs import AXES

#: What is known of a current's field beforehand: nT/A, as for the effect `solar_array`.
PRIOR = 1.0
#: Resamplings of days.
_BOOTSTRAPS = 400


@dataclass(frozen=True)
class Confounding:
    """How another channel steps when the current does.

    Attributes
    ----------
    channel, unit : str
    correlation : float
        Of the two steps about zero, not about their means: in [-1, 1].
    slope : float
        Step of the other for a unit step of the current, in its unit per A; the fitted coefficient
        holds this many times the other's.
    """

    channel: str
    unit: str
    correlation: float
    slope: float


@dataclass(frozen=True)
class StepFit:
    """Field of one or more currents at the vector sensor minus that at the scalar sensor.

    Attributes
    ----------
    currents : tuple of str
    fit : ClusteredFit
        Values nT/A in the order current, axis.
    confounding : tuple of Confounding
        Channels that were not fitted.
    epochs, days : int
    placebo : float
        Rms of the contrasts where the current does not step, over their white sigma: above 1 the noise
        is not white or the drift is stiffer than the model; the covariance, from days, knows it.
    """

    currents: tuple[str, ...]
    fit: ClusteredFit
    confounding: tuple[Confounding, ...]
    epochs: int
    days: int
    placebo: float

    @property
    def value(self) -> Floats:
        """Vector minus scalar sensor, nT/A; (current, axis), axes of the samples' field."""
        return self.fit.value.reshape(-1, 3)

    @property
    def sigma(self) -> Floats:
        """Standard deviation, nT/A; (current, axis)."""
        return self.fit.sigma.reshape(-1, 3)

    def table(self) -> xr.Dataset:
        """Return `value`, `sigma`, `retained`, `determined` (current, axis), `covariance`, confounding."""
        dims = ("current", "axis")
        shape = (len(self.currents), 3)
        covariance = self.fit.covariance.reshape(*shape, *shape)
        return xr.Dataset(
            {
                "value": (dims, self.value, {"units": "nT/A", "at": "difference"}),
                "sigma": (dims, self.sigma, {"units": "nT/A"}),
                "covariance": ((*dims, "other_current", "other_axis"), covariance, {"units": "nT2/A2"}),
                "retained": (dims, self.fit.retained.reshape(shape)),
                "determined": (dims, self.fit.determined.reshape(shape)),
                "correlation": ("confounder", np.array([one.correlation for one in self.confounding])),
                "slope": ("confounder", np.array([one.slope for one in self.confounding])),
            },
            coords={
                "current": list(self.currents),
                "axis": list(AXES),
                "confounder": [one.channel for one in self.confounding],
            },
            attrs={"epochs": self.epochs, "days": self.days, "placebo": self.placebo},
        )


def fit_step(
    epochs: xr.Dataset, currents: Sequence[str] = (), *, prior_sigma: float = PRIOR, fewest: int = 5
) -> StepFit:
    """Fit ``A_vector - A_scalar`` to stored epochs.

    Parameters
    ----------
    epochs : xarray.Dataset
        Of `epochs_of`, all days joined.
    currents : sequence of str
        Currents fitted together; the one that steps when absent.
    prior_sigma : float
        What is known of each component beforehand, nT/A. Drops that all happen at one place of the
        orbit see one direction of the field: the components across it stay at 0 +- this.
    fewest : int
        Days needed.

    Returns
    -------
    StepFit
        In the axes of the samples' `field`.

    Raises
    ------
    CalibrationError
        Fewer days than `fewest`.
    SamplesError
        No epoch, or a current that the epochs do not have.
    """
    names = tuple(currents) or (str(epochs["current"].values[0]),)
    unknown = [name for name in names if name not in epochs["current"].values]
    if unknown or not epochs.sizes["epoch"]:
        raise SamplesError(
            f"{epochs.sizes['epoch']} epochs of the channels {list(epochs['current'].values)}, "
            f"{list(names)} wanted",
            remedy="name the channels when the epochs are made, and take more days",
        )
    columns = epochs["column"].sel(current=list(names)).values.reshape(epochs.sizes["epoch"], -1)
    fit = fit_contrasts(epochs, columns, prior_sigma=prior_sigma, fewest=fewest)
    placebo = _placebo(epochs, names, fit.value)
    return StepFit(names, fit, confounding_of(epochs, names), epochs.sizes["epoch"], fit.clusters, placebo)


def fit_contrasts(
    epochs: xr.Dataset, columns: Floats, *, prior_sigma: float = PRIOR, fewest: int = 5
) -> ClusteredFit:
    """Fit any columns (epoch, column) in A to the contrasts, days as clusters; values in nT/A.

    Epochs with a column that is NaN, where a channel is missing, are left out.
    """
    whole = np.isfinite(columns).all(axis=1)
    gram, rows = grams_by_cluster(
        columns[whole],
        epochs["contrast"].values[whole],
        weights_of(epochs)[whole],
        epochs["day"].values[whole],
    )
    return solve_clusters(gram, rows, np.full(columns.shape[1], prior_sigma), fewest=fewest)


def weights_of(epochs: xr.Dataset) -> Floats:
    """Return one over the variance of each contrast, nT^-2; (epoch,).

    A sigma below half the usual one is that: few samples can agree by chance.
    """
    sigma = epochs["sigma"].values
    return np.asarray(1.0 / np.maximum(sigma, 0.5 * np.median(sigma)) ** 2)


def _placebo(epochs: xr.Dataset, names: Sequence[str], value: Floats) -> float:
    columns = epochs["placebo_column"].sel(current=list(names)).values.reshape(epochs.sizes["epoch"], -1)
    pull = (epochs["placebo"].values - columns @ value) / epochs["sigma"].values
    good = np.isfinite(pull)
    return float(np.sqrt(np.mean(pull[good] ** 2))) if good.any() else float("nan")


def confounding_of(epochs: xr.Dataset, fitted: Sequence[str]) -> tuple[Confounding, ...]:
    """Return how the channels that are not fitted step together with the first that is."""
    main = epochs["step"].sel(current=fitted[0]).values
    found = []
    for name in epochs["current"].values:
        if name in fitted:
            continue
        other = _real_steps(epochs, str(name))
        weight = np.where(np.isfinite(other), weights_of(epochs), 0.0)
        other = np.nan_to_num(other)
        own = float(np.sum(weight * main**2))
        both, theirs = float(np.sum(weight * main * other)), float(np.sum(weight * other**2))
        correlation = both / np.sqrt(own * theirs) if own * theirs > 0 else 0.0
        unit = str(epochs["unit"].sel(current=name).values)
        found.append(Confounding(str(name), unit, correlation, both / own if own > 0 else 0.0))
    return tuple(found)


def _real_steps(epochs: xr.Dataset, name: str) -> Floats:
    """Return the steps of a channel; the rounding errors of one that is constant are none."""
    step = epochs["step"].sel(current=name).values
    level = np.abs(epochs["before"].sel(current=name).values)
    return np.where(np.abs(step) <= 1e-9 * level, 0.0, step)


@dataclass(frozen=True)
class Stack:
    """Mean curves around the steps with the band that resampling days gives.

    Attributes
    ----------
    lag : ndarray, shape (lag,)
        s after the step.
    residual, low, high : ndarray, shape (lag,)
        nT for a unit `per`; the band holds 68 % of the resampled means.
    current : ndarray, shape (lag,)
        A, relative to its level before the step.
    epochs, days : int
    """

    lag: Floats
    residual: Floats
    low: Floats
    high: Floats
    current: Floats
    epochs: int
    days: int

    def table(self) -> xr.Dataset:
        """Return `value`, `low`, `high`, `sigma` and `current` along ``lag``."""
        curves = {
            "value": (self.residual, "nT"),
            "low": (self.low, "nT"),
            "high": (self.high, "nT"),
            "sigma": (0.5 * (self.high - self.low), "nT"),
            "current": (self.current, "A"),
        }
        return xr.Dataset(
            {name: ("lag", values, {"units": unit}) for name, (values, unit) in curves.items()},
            coords={"lag": ("lag", self.lag, {"units": "s"})},
            attrs={"epochs": self.epochs, "days": self.days},
        )


def stack(
    epochs: xr.Dataset, value: Floats | None = None, *, seed: int = 0, bootstraps: int = _BOOTSTRAPS
) -> Stack:
    """Superpose the curves of the epochs of one direction; days are resampled, not epochs.

    Parameters
    ----------
    epochs : xarray.Dataset
        Stored epochs, of drops or of rises; their curves are averaged less the mean before.
    value : ndarray, shape (epoch, 3) or (3,), optional
        A fitted coefficient, nT/A: curves whose step it expects to be negative are turned over, so that
        places of the orbit with the field one way and the other do not cancel. A coefficient fitted to
        the same epochs favours its own noise, where it is not known to many sigma. Absent, curves are
        left as they are.
    seed : int
        Of the resampling.
    bootstraps : int
        Resamplings.

    Raises
    ------
    SamplesError
        Epochs of fewer than two days.
    """
    days, which = np.unique(epochs["day"].values, return_inverse=True)
    if days.size < 2:
        raise SamplesError(
            f"epochs of {days.size} days, at least 2 needed for a band", remedy="take more days"
        )
    lag = epochs["lag"].values
    curves = _less_before(epochs["curve"].values, lag)
    if value is not None:
        expected = np.einsum(
            "ej,ej->e", epochs["column"].values[:, 0], np.broadcast_to(value, (which.size, 3))
        )
        curves *= np.where(expected < 0, -1.0, 1.0)[:, None]
    sums, counts = _day_sums(curves, which)
    currents, filled = _day_sums(_less_before(epochs["current_curve"].values, lag), which)
    random = np.random.default_rng(seed)
    share = random.multinomial(days.size, np.full(days.size, 1.0 / days.size), size=bootstraps)
    resampled = (share @ sums) / np.maximum(share @ counts, 1.0)
    low, high = np.percentile(resampled, [15.865, 84.135], axis=0)
    mean = sums.sum(axis=0) / np.maximum(counts.sum(axis=0), 1.0)
    current = currents.sum(axis=0) / np.maximum(filled.sum(axis=0), 1.0)
    return Stack(lag, mean, low, high, current, epochs.sizes["epoch"], int(days.size))


def _less_before(curves: Floats, lag: Floats) -> Floats:
    known = np.isfinite(curves) & (lag < 0)
    mean = np.where(known, curves, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    return np.asarray(curves - mean[:, None])


def _day_sums(curves: Floats, which: npt.NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Return sums and counts of the finite values of each day; (day, lag) each."""
    sums = np.zeros((int(which.max()) + 1, curves.shape[1]))
    counts = np.zeros_like(sums)
    np.add.at(sums, which, np.nan_to_num(curves))
    np.add.at(counts, which, np.isfinite(curves).astype(np.float64))
    return sums, counts
