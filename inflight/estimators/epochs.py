"""Superposed epochs: what the residual does when a current steps.

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
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import SamplesError
from inflight.estimators.contrasts import Chosen, Series, robust_contrast
from inflight.estimators.current_steps import CurrentSteps
from inflight.time import SECOND, Int64, day_of

AXES = ("x", "y", "z")
#: Part of the samples wanted on each side of a step for it to count.
_LEAST_SIDE = 0.5


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


def epochs_of(
    samples: xr.Dataset,
    residual: Floats,
    steps: CurrentSteps,
    *,
    channel: str,
    others: Sequence[str] = (),
    windows: Windows | None = None,
) -> xr.Dataset:
    """Return the epochs of one span, a day say: all that the fits need, and small enough to store.

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
        Channels whose steps at the same times are measured: what steps together is not told apart.
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
        return _dataset(rows, series, chosen).isel(epoch=slice(0, 0))
    return _dataset(rows, series, chosen)


def join_epochs(parts: Sequence[xr.Dataset]) -> xr.Dataset:
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
    joined = xr.concat(filled, "epoch", data_vars="minimal", join="exact", combine_attrs="override")
    return joined.isel(epoch=np.argsort(joined["time"].values, kind="stable"))


def _epoch(series: Series, steps: CurrentSteps, index: int, windows: Windows) -> dict[str, object] | None:
    """Return the numbers of one epoch, or None where too little is left around it."""
    low, high = _own_span(steps, index, windows)
    part = series.part(low, high)
    seconds = (series.stamps[part] - steps.time[index]) / SECOND
    usable, shape = _usable(series, part, steps, index, windows)
    if not _both_sides(seconds[usable], seconds, usable, windows):
        return None
    drift = _drift(series, part, seconds, windows)
    fit = robust_contrast(drift, series.residual[part], shape, usable)
    if fit is None:
        return None
    contrast, kept, noise = fit
    at = np.arange(part.start, part.stop)[kept]
    columns = _columns(series, at, contrast.weight)
    row: dict[str, object] = {
        "contrast": float(contrast.weight @ series.residual[at]),
        "sigma": noise * float(np.linalg.norm(contrast.weight)),
        "column": columns,
        "step": contrast.weight @ series.currents[at],
        "count": int(kept.sum()),
        "time": int(steps.time[index]),
        "start": int(steps.start[index]),
        "end": int(steps.end[index]),
    }
    row |= _means(series, at, seconds[kept])
    row |= _places(series, int(np.searchsorted(series.stamps, steps.time[index])))
    row["placebo"], row["placebo_column"] = _placebo(series, steps, index, windows)
    flat = series.residual[part] - drift @ contrast.common(series.residual[part][kept])
    row["curve"], row["current_curve"] = _curves((flat, series.currents[part, 0]), seconds, windows)
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
    """Return what both sides share: powers of time, and the direction where asked for; (time, part)."""
    span = max(float(np.abs(seconds).max(initial=0.0)), 1e-9)
    powers = (seconds[:, None] / span) ** np.arange(windows.order + 1)
    return np.hstack([powers, series.direction[part]]) if windows.field else powers


def _usable(
    series: Series, part: slice, steps: CurrentSteps, index: int, windows: Windows
) -> tuple[Chosen, Floats]:
    """Return which samples of a part can be used, and the shape looked for; (time,) each."""
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


def _both_sides(used: Floats, seconds: Floats, usable: Chosen, windows: Windows) -> bool:
    if windows.shape == "current":
        return bool(used.size > 0.5 * seconds.size and min((used < 0).sum(), (used > 0).sum()) > 2)
    # The usual spacing of samples tells how many there should be.
    wanted = max(_LEAST_SIDE * windows.length / _spacing(seconds), 3.0)
    return bool((used < 0).sum() >= wanted and (used > 0).sum() >= wanted)


def _spacing(seconds: Floats) -> float:
    """Return the median distance of neighbours, s."""
    steps = np.diff(seconds)
    if not steps.size:
        return np.inf
    # Nearly always all are alike.
    return float(steps[0]) if np.ptp(steps) == 0.0 else float(np.median(steps))


def _columns(series: Series, at: Int64, weight: Floats) -> Floats:
    """Return the contrasts of e_j I_k; (current, axis)."""
    return np.asarray(np.einsum("t,tk,tj->kj", weight, series.currents[at], series.direction[at]))


def _means(series: Series, at: Int64, seconds: Floats) -> dict[str, object]:
    found: dict[str, object] = {}
    for name, side in (("before", seconds < 0), ("after", seconds >= 0)):
        found[name] = series.currents[at[side]].mean(axis=0)
        found[f"residual_{name}"] = float(series.residual[at[side]].mean())
        found[f"direction_{name}"] = series.direction[at[side]].mean(axis=0)
    return found


def _places(series: Series, near: int) -> dict[str, object]:
    index = min(near, series.stamps.size - 1)
    return {name: values[index] for name, values in series.places.items()}


def _placebo(series: Series, steps: CurrentSteps, index: int, windows: Windows) -> tuple[float, Floats]:
    """Return the contrast where the current does not step: one epoch's length later, or else earlier."""
    low, high = _own_span(steps, index, windows)
    nothing = float("nan"), np.full((len(series.names), 3), np.nan)
    for sign in (1, -1):
        shift = sign * (high - low)
        if np.any((steps.end >= low + shift) & (steps.start < high + shift)):
            continue
        part = series.part(low + shift, high + shift)
        own = series.part(low, high)
        if part.stop - part.start != own.stop - own.start:
            continue
        seconds = (series.stamps[own] - steps.time[index]) / SECOND
        here, shape = _usable(series, own, steps, index, windows)
        usable = np.isfinite(series.residual[part]) & np.isfinite(series.currents[part, 0]) & here
        usable &= np.isfinite(series.direction[part]).all(axis=1)
        if not _both_sides(seconds[usable], seconds, usable, windows):
            continue
        drift = _drift(series, part, seconds, windows)
        fit = robust_contrast(drift, series.residual[part], shape, usable)
        if fit is not None:
            at = np.arange(part.start, part.stop)[fit[1]]
            return float(fit[0].weight @ series.residual[at]), _columns(series, at, fit[0].weight)
    return nothing


def _curves(series: tuple[Floats, Floats], seconds: Floats, windows: Windows) -> tuple[Floats, Floats]:
    """Return means of two series in the bins of lag; (lag,) each, NaN where there is nothing."""
    lags = windows.lags
    place = np.floor((seconds - lags[0]) / windows.bin + 0.5).astype(np.int64)
    curves = []
    for values in series:
        good = np.isfinite(values) & (place >= 0) & (place < lags.size)
        count = np.bincount(place[good], minlength=lags.size)
        total = np.bincount(place[good], weights=values[good], minlength=lags.size)
        curves.append(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    return curves[0], curves[1]


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


def _dataset(rows: Sequence[dict[str, object]], series: Series, windows: Windows) -> xr.Dataset:
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
