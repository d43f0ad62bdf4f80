"""Superposed epochs: what the residual does when a current steps, and the field per ampere that follows.

Takes a day's residual, direction and current; makes stored epochs, their fit and their stacked curves.

At a step of the current I by dI the residual ``dB = |B_v| - F`` changes by ``e.(A_v - A_s) dI``, with
e the field's direction and A (nT/A) the current's field at the vector and at the scalar sensor (Yin
2010, section 3.4.1 and eq. 3.1). Everything else in dB changes smoothly, with the orbit. So each epoch
gives one number, the contrast ``w.dB`` of the samples around the step, with weights w that are blind to
a polynomial drift and give 1 for a unit step. The same weights applied to ``e_j I_k`` give the columns
of the fit, so that the slow change of direction and current in the window is in the model exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.effects import AXES
from inflight.errors import SamplesError
from inflight.lsq import ClusteredFit, Mask, Series, grams_by_cluster, robust_contrast, solve_clusters
from inflight.residual import CurrentSteps
from inflight.time import SECOND, Int64, day_of


@dataclass(frozen=True, kw_only=True)
class EpochSettings:
    """Which epochs count, and how their mean curves are resampled.

    Attributes
    ----------
    least_side : float
        Part of the samples needed on each side of a step for it to count; assumed.
    bootstraps : int
        Resamplings of days.
    """

    least_side: float = 0.5
    bootstraps: int = 400


EPOCH_SETTINGS = EpochSettings()


@dataclass(frozen=True)
class Windows:
    """What of the samples around a step is used.

    Attributes
    ----------
    length : float
        Seconds before the transition and after it; whole periods of the torquers' 20 s.
    margin : float, optional
        Seconds more on both sides of the transition that are left out; the current's cadence when absent.
    order : int
        Order of the drift that is common to both sides. Order 2 costs no more than 1 when both sides
        are whole. A cubic drift c t^3 leaves ``0.4 c length^3``, and ``2 c length^3`` with 25 s left out
        on either side of a step: 0.7 pT for 0.1 nT three times an orbit. Order 3 leaves none of it and
        doubles the noise.
    field : bool
        A constant field of the spacecraft, three components of e, counts as drift too: for windows in
        which the field's direction turns, some minutes and more.
    bin : float
        Seconds of a point of the stacked curves.
    shape : str
        ``step``: a step between two levels. ``current``: the current's own course, for excursions;
        the window is then the excursion and its own length on both sides, nothing is left out.
    """

    length: float = 80.0
    margin: float | None = None
    order: int = 2
    field: bool = False
    bin: float = 5.0
    shape: Literal["step", "current"] = "step"

    @property
    def lags(self) -> Floats:
        """Middles of the bins of stacked curves, s after the step."""
        count = int(np.ceil(self.length / self.bin))
        return np.asarray((np.arange(-count, count) + 0.5) * self.bin)


def extract_epochs(
    samples: xr.Dataset,
    residual: Floats,
    steps: CurrentSteps,
    *,
    channel: str,
    others: Sequence[str] = (),
    windows: Windows | None = None,
) -> xr.Dataset:
    """Return the epochs of one span, such as a day: all that the fits need, and small enough to store.

    Parameters
    ----------
    samples : xarray.Dataset
        `tt2000` (time); `field` (time, axis) nT; the channels (time) with `units`; `local_time`,
        `orbit_phase`, `latitude`, `sunlit`, `sun_direction` where known; samples of `weight` 0 are left out.
    residual : ndarray, shape (time,)
        ``dB = |B_vector| - F``, nT, corrected for all that is known but the currents asked for.
    steps : CurrentSteps
        Of `channel`.
    channel : str
        The current that steps.
    others : sequence of str
        Channels whose steps at the same times are measured: what steps together is not separated.
    windows : Windows, optional

    Returns
    -------
    xarray.Dataset
        dims epoch, current, axis, lag. `contrast` (epoch) nT with `sigma`; `column` (epoch, current, axis)
        A, contrasts of ``e_j I_k``; `step` (epoch, current) A, contrasts of the currents; `before`, `after`
        (epoch, current), `residual_before`, `residual_after` (epoch), `direction_before`, `direction_after`
        (epoch, axis): plain means; `placebo` (epoch) nT and `placebo_column`: the same contrast where the
        current does not step, NaN where there is no such place; `curve` (epoch, lag) nT less the drift,
        `current_curve`; `time`, `start`, `end` TT2000, `day`, `count`; places of the orbit.

    Raises
    ------
    SamplesError
        A variable is missing or has another shape.
    """
    series = Series.of(samples, residual, (channel, *others))
    chosen = windows or Windows()
    rows = [row for index in range(len(steps)) if (row := _epoch(series, steps, index, chosen)) is not None]
    if not rows:
        rows = [_empty_row(series, chosen)]
        return _epoch_dataset(rows, series, chosen).isel(epoch=slice(0, 0))
    return _epoch_dataset(rows, series, chosen)


def concat_epochs(parts: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return the epochs of several days together, in order of time.

    Raises
    ------
    SamplesError
        There is no epoch at all, or the days were made with different channels or windows.
    """
    filled = [part for part in parts if part.sizes["epoch"]]
    if not filled:
        raise SamplesError(
            f"no epoch in {len(parts)} days",
            remedy="take more days, or a channel whose current steps",
        )
    for name in ("current", "lag"):
        if any(not np.array_equal(part[name].values, filled[0][name].values) for part in filled):
            raise SamplesError(f"epochs differ in '{name}'", remedy="make all days with the same settings")
    return in_order_of_time(filled, "epoch", "time")


def in_order_of_time(parts: Sequence[xr.Dataset], rows: str, time: str) -> xr.Dataset:
    """Return the rows of several Datasets, by one of their variables, copied only where need be."""
    joined = (
        parts[0]
        if len(parts) == 1
        else xr.concat(list(parts), rows, data_vars="minimal", join="exact", combine_attrs="override")
    )
    stamps = joined[time].values
    if np.all(stamps[1:] >= stamps[:-1]):
        return joined
    return joined.isel({rows: np.argsort(stamps, kind="stable")})


def _epoch(series: Series, steps: CurrentSteps, index: int, windows: Windows) -> dict[str, object] | None:
    """Return the numbers of one epoch, or None where there are too few samples around it."""
    low, high = _own_span(steps, index, windows)
    part = series.part(low, high)
    seconds = (series.stamps[part] - steps.time[index]) / SECOND
    usable, shape = _usable_and_shape(series, part, steps, index, windows)
    if not _has_both_sides(seconds[usable], seconds, usable, windows):
        return None
    drift = _drift(series, part, seconds, windows)
    fit = robust_contrast(drift, series.residual[part], shape, usable)
    if fit is None:
        return None
    contrast, kept, noise = fit
    at = np.arange(part.start, part.stop)[kept]
    row: dict[str, object] = {
        "contrast": float(contrast.weight @ series.residual[at]),
        "sigma": noise * float(np.linalg.norm(contrast.weight)),
        "column": _columns(series, at, contrast.weight),
        "step": contrast.weight @ series.currents[at],
        "count": int(kept.sum()),
        "time": int(steps.time[index]),
        "start": int(steps.start[index]),
        "end": int(steps.end[index]),
    }
    for name, side in (("before", at[seconds[kept] < 0]), ("after", at[seconds[kept] >= 0])):
        row[name] = series.currents[side].mean(axis=0)
        row[f"residual_{name}"] = float(series.residual[side].mean())
        row[f"direction_{name}"] = series.direction[side].mean(axis=0)
    near = min(int(np.searchsorted(series.stamps, steps.time[index])), series.stamps.size - 1)
    row |= {name: values[near] for name, values in series.places.items()}
    row["placebo"], row["placebo_column"] = _placebo(series, steps, index, windows)
    flat = series.residual[part] - drift @ contrast.common(series.residual[part][kept])
    row["curve"], row["current_curve"] = (
        _binned_by_lag(values, seconds, windows) for values in (flat, series.currents[part, 0])
    )
    return row


def _own_span(steps: CurrentSteps, index: int, windows: Windows) -> tuple[int, int]:
    """Return the span of an epoch, ending where a neighbouring step begins."""
    start, end = int(steps.start[index]), int(steps.end[index])
    reach = end - start if windows.shape == "current" else round(windows.length * SECOND)
    margin = 0 if windows.shape == "current" else _margin(steps, windows)
    low, high = start - margin - reach, end + margin + reach
    if windows.shape == "step":
        low = max(low, int(steps.end[index - 1]) + margin) if index else low
        high = min(high, int(steps.start[index + 1]) - margin) if index + 1 < len(steps) else high
    return low, max(high, low)


def _margin(steps: CurrentSteps, windows: Windows) -> int:
    return round((steps.cadence if windows.margin is None else windows.margin) * SECOND)


def _drift(series: Series, part: slice, seconds: Floats, windows: Windows) -> Floats:
    """Return the drift that both sides share: powers of time, and the direction if wanted; (time, part)."""
    span = max(float(np.abs(seconds).max(initial=0.0)), 1e-9)
    powers = (seconds[:, None] / span) ** np.arange(windows.order + 1)
    return np.hstack([powers, series.direction[part]]) if windows.field else powers


def _usable_and_shape(
    series: Series, part: slice, steps: CurrentSteps, index: int, windows: Windows
) -> tuple[Mask, Floats]:
    """Return which samples of a part can be used, and the shape searched for; (time,) each."""
    stamps = series.stamps[part]
    usable = (
        np.isfinite(series.residual[part])
        & np.isfinite(series.direction[part]).all(axis=1)
        & np.isfinite(series.currents[part, 0])
    )
    if windows.shape == "current":
        return usable, np.nan_to_num(series.currents[part, 0]) / max(abs(float(steps.size[index])), 1e-12)
    margin = _margin(steps, windows)
    usable &= (stamps < steps.start[index] - margin) | (stamps >= steps.end[index] + margin)
    # A unit step, so that the contrast is the change of the residual itself.
    return usable, (stamps > steps.time[index]).astype(np.float64)


def _has_both_sides(used: Floats, seconds: Floats, usable: Mask, windows: Windows) -> bool:
    """Return whether both sides of a step have samples enough; `used` are the times (s) of usable ones."""
    if windows.shape == "current":
        return bool(used.size > 0.5 * seconds.size and min((used < 0).sum(), (used > 0).sum()) > 2)
    # The usual spacing of samples gives how many there should be.
    spacing = float(np.median(np.diff(seconds))) if seconds.size > 1 else np.inf
    least = max(EPOCH_SETTINGS.least_side * windows.length / spacing, 3.0)
    return bool((used < 0).sum() >= least and (used > 0).sum() >= least)


def _columns(series: Series, at: Int64, weight: Floats) -> Floats:
    """Return the contrasts of e_j I_k; (current, axis)."""
    return np.asarray(np.einsum("t,tk,tj->kj", weight, series.currents[at], series.direction[at]))


def _placebo(series: Series, steps: CurrentSteps, index: int, windows: Windows) -> tuple[float, Floats]:
    """Return the contrast where the current does not step: one epoch's length later, or else earlier."""
    low, high = _own_span(steps, index, windows)
    for sign in (1, -1):
        shift = sign * (high - low)
        if np.any((steps.end >= low + shift) & (steps.start < high + shift)):
            continue
        part = series.part(low + shift, high + shift)
        own = series.part(low, high)
        if part.stop - part.start != own.stop - own.start:
            continue
        seconds = (series.stamps[own] - steps.time[index]) / SECOND
        here, shape = _usable_and_shape(series, own, steps, index, windows)
        usable = np.isfinite(series.residual[part]) & np.isfinite(series.currents[part, 0]) & here
        usable &= np.isfinite(series.direction[part]).all(axis=1)
        if not _has_both_sides(seconds[usable], seconds, usable, windows):
            continue
        drift = _drift(series, part, seconds, windows)
        fit = robust_contrast(drift, series.residual[part], shape, usable)
        if fit is not None:
            at = np.arange(part.start, part.stop)[fit[1]]
            return float(fit[0].weight @ series.residual[at]), _columns(series, at, fit[0].weight)
    return float("nan"), np.full((len(series.names), 3), np.nan)


def _binned_by_lag(values: Floats, seconds: Floats, windows: Windows) -> Floats:
    """Return means of a series in the bins of lag; (lag,), NaN where there is nothing."""
    lags = windows.lags
    place = np.floor((seconds - lags[0]) / windows.bin + 0.5).astype(np.int64)
    good = np.isfinite(values) & (place >= 0) & (place < lags.size)
    count = np.bincount(place[good], minlength=lags.size)
    total = np.bincount(place[good], weights=values[good], minlength=lags.size)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _empty_row(series: Series, windows: Windows) -> dict[str, object]:
    width, lags = len(series.names), windows.lags.size
    row: dict[str, object] = dict.fromkeys(
        ("contrast", "sigma", "placebo", "residual_before", "residual_after"), 0.0
    )
    row |= dict.fromkeys(("count", "time", "start", "end"), 0)
    row |= {name: np.zeros(width) for name in ("step", "before", "after")}
    row |= {name: np.zeros((width, 3)) for name in ("column", "placebo_column")}
    row |= {name: np.zeros(3) for name in ("direction_before", "direction_after")}
    row |= {name: np.zeros(lags) for name in ("curve", "current_curve")}
    return row | {name: np.zeros(values.shape[1:]) for name, values in series.places.items()}


#: Variable -> dims after ``epoch``, unit.
_VARIABLES: dict[str, tuple[tuple[str, ...], str]] = {
    "contrast": ((), "nT"),
    "sigma": ((), "nT"),
    "placebo": ((), "nT"),
    "residual_before": ((), "nT"),
    "residual_after": ((), "nT"),
    "column": (("current", "axis"), "A"),
    "placebo_column": (("current", "axis"), "A"),
    "step": (("current",), "A"),
    "before": (("current",), "A"),
    "after": (("current",), "A"),
    "direction_before": (("axis",), "1"),
    "direction_after": (("axis",), "1"),
    "curve": (("lag",), "nT"),
    "current_curve": (("lag",), "A"),
    "count": ((), "1"),
    "time": ((), "ns"),
    "start": ((), "ns"),
    "end": ((), "ns"),
    "local_time": ((), "h"),
    "orbit_phase": ((), "deg"),
    "latitude": ((), "deg"),
    "sunlit": ((), "1"),
    "sun_direction": (("axis",), "1"),
}


def _epoch_dataset(rows: Sequence[dict[str, object]], series: Series, windows: Windows) -> xr.Dataset:
    variables = {
        name: (("epoch", *dims), np.array([row[name] for row in rows]), {"units": unit})
        for name, (dims, unit) in _VARIABLES.items()
        if name in rows[0]
    }
    found = xr.Dataset(
        variables,
        coords={
            "current": list(series.names),
            "axis": list(AXES),
            "lag": ("lag", windows.lags, {"units": "s"}),
        },
        attrs={"window_s": windows.length, "order": windows.order, "shape": windows.shape},
    )
    day = day_of(found["time"].values).astype("datetime64[D]").astype(np.int64)
    return found.assign(
        day=("epoch", day, {"description": "UTC day, days since 1970-01-01"}),
        unit=("current", np.array(series.units, dtype="U16")),
    )


#: What is known of a current's field beforehand: nT/A, as for the effect `solar_array`.
PRIOR = 1.0

#: The channel that says what of the Sun is seen, 0 to 1; where epochs hold it, a field of day and night is
#: fitted beside every current. Its own prior is nT.
LIGHT = "sunlit"


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
    light : ClusteredFit or None
        Field of day and night that was fitted beside them, nT; None where the epochs know no light.
    confounding : tuple of Confounding
        Channels that were not fitted.
    epochs, days : int
    placebo : float
        Rms of the contrasts where the current does not step, over their white sigma: above 1 the noise
        is not white or the drift is stiffer than the model; the covariance, from days, holds it.
    """

    currents: tuple[str, ...]
    fit: ClusteredFit
    light: ClusteredFit | None
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
        """Return `value`, `sigma`, `retained`, `determined` (current, axis), `covariance`, confounding.

        `day_night`, `day_night_sigma` and `day_night_determined` (axis) are the field fitted beside, nT.
        """
        light = {}
        if self.light is not None:
            light = {
                "day_night": ("axis", self.light.value, {"units": "nT", "at": "difference"}),
                "day_night_sigma": ("axis", self.light.sigma, {"units": "nT"}),
                "day_night_determined": ("axis", self.light.determined),
            }
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
                **light,
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

    A field of day and night, three components more, is fitted beside where the epochs hold `sunlit`: steps
    in the light and of several sizes tell the two apart, and where all steps are alike and at the edge of
    the shadow the sigma says that they are not told apart.

    Parameters
    ----------
    epochs : xarray.Dataset
        Of `extract_epochs`, all days joined.
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
    whole = fit_contrasts(epochs, columns, prior_sigma=prior_sigma, fewest=fewest)
    fit, light = whole.of(slice(columns.shape[1])), whole.of(slice(columns.shape[1], None))
    placebo_columns = epochs["placebo_column"].sel(current=list(names)).values.reshape(columns.shape)
    standardised = (epochs["placebo"].values - placebo_columns @ fit.value) / epochs["sigma"].values
    good = np.isfinite(standardised)
    placebo = float(np.sqrt(np.mean(standardised[good] ** 2))) if good.any() else float("nan")
    return StepFit(
        names,
        fit,
        light if light.value.size else None,
        confounding_of(epochs, names),
        epochs.sizes["epoch"],
        fit.clusters,
        placebo,
    )


def fit_contrasts(
    epochs: xr.Dataset, columns: Floats, *, prior_sigma: float = PRIOR, fewest: int = 5
) -> ClusteredFit:
    """Fit any columns (epoch, column) in A to the contrasts, days as clusters; values in nT/A.

    Those of `light_columns` are fitted beside, and are the last of the values. Epochs with a column that is
    NaN, where a channel is missing, are left out.
    """
    wide = np.hstack([columns, light_columns(epochs)])
    whole = np.isfinite(wide).all(axis=1)
    gram, rows = grams_by_cluster(
        wide[whole],
        epochs["contrast"].values[whole],
        weights_of(epochs)[whole],
        epochs["day"].values[whole],
    )
    return solve_clusters(gram, rows, np.full(wide.shape[1], prior_sigma), fewest=fewest)


def light_columns(epochs: xr.Dataset) -> Floats:
    """Return the contrasts of a field of day and night; (epoch, 3), (epoch, 0) where no light is known."""
    if LIGHT not in epochs["current"].values:
        return np.zeros((epochs.sizes["epoch"], 0))
    columns = np.asarray(epochs["column"].sel(current=LIGHT).values)
    # Where the light stays as it is, its contrast is rounding.
    columns = np.where(np.abs(columns) < 1e-9, 0.0, columns)
    return columns if np.isfinite(columns).all(axis=1).any() else columns[:, :0]


def weights_of(epochs: xr.Dataset) -> Floats:
    """Return one over the variance of each contrast, nT^-2; (epoch,).

    A sigma below half the usual one is that: few samples can agree by chance.
    """
    sigma = epochs["sigma"].values
    return np.asarray(1.0 / np.maximum(sigma, 0.5 * np.median(sigma)) ** 2)


def confounding_of(epochs: xr.Dataset, fitted: Sequence[str]) -> tuple[Confounding, ...]:
    """Return how the channels that are not fitted step together with the first that is."""
    main = epochs["step"].sel(current=fitted[0]).values
    found = []
    for name in epochs["current"].values:
        if name in (*fitted, LIGHT):
            continue
        other = epochs["step"].sel(current=name).values
        # The rounding errors of a channel that is constant are no steps.
        level = np.abs(epochs["before"].sel(current=name).values)
        other = np.where(np.abs(other) <= 1e-9 * level, 0.0, other)
        weight = np.where(np.isfinite(other), weights_of(epochs), 0.0)
        other = np.nan_to_num(other)
        own = float(np.sum(weight * main**2))
        both, theirs = float(np.sum(weight * main * other)), float(np.sum(weight * other**2))
        correlation = both / np.sqrt(own * theirs) if own * theirs > 0 else 0.0
        unit = str(epochs["unit"].sel(current=name).values)
        found.append(Confounding(str(name), unit, correlation, both / own if own > 0 else 0.0))
    return tuple(found)


@dataclass(frozen=True)
class EpochStack:
    """Mean curves around the steps with the band that resampling days gives.

    Attributes
    ----------
    lag : ndarray, shape (lag,)
        s after the step.
    residual, low, high : ndarray, shape (lag,)
        nT; the band holds 68 % of the resampled means.
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


def stack_epochs(
    epochs: xr.Dataset,
    value: Floats | None = None,
    *,
    seed: int = 0,
    bootstraps: int = EPOCH_SETTINGS.bootstraps,
) -> EpochStack:
    """Superpose the curves of the epochs of one direction; days are resampled, not epochs.

    Parameters
    ----------
    epochs : xarray.Dataset
        Stored epochs, of drops or of rises; their curves are averaged less the mean before.
    value : ndarray, shape (epoch, 3) or (3,), optional
        A fitted coefficient, nT/A: curves whose step it expects to be negative change sign, so that
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
    curves = _subtract_mean_before(epochs["curve"].values, lag)
    if value is not None:
        expected = np.einsum(
            "ej,ej->e", epochs["column"].values[:, 0], np.broadcast_to(value, (which.size, 3))
        )
        curves *= np.where(expected < 0, -1.0, 1.0)[:, None]
    sums, counts = _day_sums(curves, which)
    currents, filled = _day_sums(_subtract_mean_before(epochs["current_curve"].values, lag), which)
    random = np.random.default_rng(seed)
    share = random.multinomial(days.size, np.full(days.size, 1.0 / days.size), size=bootstraps)
    resampled = (share @ sums) / np.maximum(share @ counts, 1.0)
    low, high = np.percentile(resampled, [15.865, 84.135], axis=0)
    mean = sums.sum(axis=0) / np.maximum(counts.sum(axis=0), 1.0)
    current = currents.sum(axis=0) / np.maximum(filled.sum(axis=0), 1.0)
    return EpochStack(lag, mean, low, high, current, epochs.sizes["epoch"], int(days.size))


def _subtract_mean_before(curves: Floats, lag: Floats) -> Floats:
    """Return the curves (epoch, lag) less their own mean before the step."""
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
