"""The solar current's field against local time: one coefficient, two panels, or three (Yin 2010, 3.4.1).

The current is that of the whole array; which loops carry it depends on the panels that are lit, so
its coefficient turns with the local time of the orbit. Models of the coefficient, in columns of the
stored epochs' ``e_j I``:

*constant*     one vector;
*two_panels*   the schedule by local time: with p quarters of the cycle since the ascending node was at
               9 h and falling, the second panel, then ``(A1 sin th + A2 cos th)/(sin th + cos th)`` with th
               rising to 90 degrees, the first panel, then th falling;
*two_sides*, *three_panels*   the mean of the panels weighted by the light on each, the cosine of the
               Sun's direction from its normal times its area; three panels have the top besides.

Which one holds is decided on days that were not fitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.effects import (
    AXES,
    PANEL_CYCLE_DAYS,
    PANEL_CYCLE_START_H,
    SIDE_NORMALS,
    TOP_NORMAL,
    panel_illumination,
    panel_weights_at,
)
from inflight.errors import SamplesError
from inflight.lsq import ClusteredFit, grams_by_cluster, mean_of_clusters, solve_clusters
from inflight.mission_fit.superposed_epochs import PRIOR, fit_contrasts, light_columns, weights_of
from inflight.time import DAY, utc_text

MODELS = ("constant", "two_panels", "two_sides", "three_panels")


@dataclass(frozen=True, kw_only=True)
class PanelSettings:
    """When models of the panels tie.

    Attributes
    ----------
    tie : float
        A model is no worse than the best while it is within so many sigmas of it: a level of 5 %.
    """

    tie: float = 2.0


PANEL_SETTINGS = PanelSettings()


@dataclass(frozen=True)
class LocalTimeDependence:
    """Coefficient in bins of local time, vector minus scalar sensor.

    Attributes
    ----------
    local_time : ndarray, shape (bin,)
        Middles, h.
    value, sigma : ndarray, shape (bin, 3)
        nT/A; NaN where there are too few days.
    determined : ndarray of bool, shape (bin, 3)
    epochs : ndarray of int, shape (bin,)
    """

    local_time: Floats
    value: Floats
    sigma: Floats
    determined: npt.NDArray[np.bool_]
    epochs: npt.NDArray[np.int64]

    def table(self) -> xr.Dataset:
        """Return `value`, `sigma`, `determined` (bin, axis) and `epochs` (bin)."""
        dims = ("bin", "axis")
        return xr.Dataset(
            {
                "value": (dims, self.value, {"units": "nT/A", "at": "difference"}),
                "sigma": (dims, self.sigma, {"units": "nT/A"}),
                "determined": (dims, self.determined),
                "epochs": ("bin", self.epochs),
                "local_time": ("bin", self.local_time, {"units": "h"}),
            },
            coords={"axis": list(AXES)},
        )


def fit_by_local_time(
    epochs: xr.Dataset, local_time: Floats, *, bins: int = 12, prior_sigma: float = PRIOR, fewest: int = 5
) -> LocalTimeDependence:
    """Fit the coefficient in bins of the orbit's local time.

    Parameters
    ----------
    epochs : xarray.Dataset
        Stored epochs; their first current.
    local_time : ndarray, shape (epoch,)
        h, of the ascending node.
    bins : int
        Over 24 h.
    prior_sigma : float
        nT/A: within a bin the steps may all see one direction of the field.
    fewest : int
        Days a bin needs.
    """
    place = np.minimum((np.asarray(local_time) % 24.0 * bins / 24.0).astype(np.int64), bins - 1)
    value, sigma = np.full((bins, 3), np.nan), np.full((bins, 3), np.nan)
    determined = np.zeros((bins, 3), dtype=np.bool_)
    day = epochs["day"].values
    for index in range(bins):
        inside = np.flatnonzero(place == index)
        if np.unique(day[inside]).size < fewest:
            continue
        part = epochs.isel(epoch=inside)
        columns = _direction_columns(part)
        fit = fit_contrasts(part, columns, prior_sigma=prior_sigma, fewest=fewest).of(slice(3))
        value[index], sigma[index], determined[index] = fit.value, fit.sigma, fit.determined
    middle = (np.arange(bins) + 0.5) * 24.0 / bins
    return LocalTimeDependence(middle, value, sigma, determined, np.bincount(place, minlength=bins))


@dataclass(frozen=True)
class PanelModel:
    """A fitted model of the coefficient.

    Attributes
    ----------
    name : str
        One of `MODELS`.
    fit : ClusteredFit
        nT/A in the order panel, axis.
    score : float
        Mean square of held-out contrasts over their variance; 1 for a perfect model of white noise.
    behind : float
        Score minus that of the best model.
    behind_sigma : float
        Its standard deviation over days.
    """

    name: str
    fit: ClusteredFit
    score: float
    behind: float
    behind_sigma: float

    @property
    def value(self) -> Floats:
        """Vector minus scalar sensor, nT/A; (panel, axis)."""
        return self.fit.value.reshape(-1, 3)

    @property
    def sigma(self) -> Floats:
        """Standard deviation, nT/A; (panel, axis)."""
        return self.fit.sigma.reshape(-1, 3)

    @property
    def ties(self) -> bool:
        """True when held-out days do not separate it from the best."""
        return self.behind <= PANEL_SETTINGS.tie * self.behind_sigma


@dataclass(frozen=True)
class PanelChoice:
    """All models, the best on held-out days first; the simplest of those that tie is `chosen`."""

    models: tuple[PanelModel, ...]
    sentence: str
    normals: tuple[tuple[float, ...], ...]
    areas: tuple[float, ...] | None
    begin: int

    @property
    def chosen(self) -> PanelModel:
        """The model with the fewest numbers among those that tie with the best."""
        return min((one for one in self.models if one.ties), key=lambda one: one.fit.value.size)

    def table(self) -> xr.Dataset:
        """Return `value`, `sigma` (panel, axis), `covariance` of the chosen model; scores (model) of all."""
        chosen = self.chosen
        dims, shape = ("panel", "axis"), chosen.value.shape
        scores = {
            name: ("model", np.array([getattr(one, name) for one in self.models]))
            for name in ("score", "behind", "behind_sigma", "ties")
        }
        return xr.Dataset(
            {
                "value": (dims, chosen.value, {"units": "nT/A", "at": "difference"}),
                "sigma": (dims, chosen.sigma, {"units": "nT/A"}),
                "covariance": (
                    (*dims, "other_panel", "other_axis"),
                    chosen.fit.covariance.reshape(*shape, *shape),
                    {"units": "nT2/A2"},
                ),
                **scores,
            },
            coords={"model": [one.name for one in self.models], "axis": list(AXES)},
            attrs={"chosen": chosen.name, "sentence": self.sentence},
        )

    def as_effect(self, name: str | None = None) -> dict[str, object]:
        """Return the effect with this coefficient, `solar_array` or a field of a channel, as a model has it.

        Parameters
        ----------
        name : str, optional
            Another model than the chosen one.

        Returns
        -------
        dict
            ``effect``, its options, and the values in the effect's own order. They are the difference
            of the sensors.
        """
        model = next(one for one in self.models if one.name == name) if name else self.chosen
        values = [float(number) for number in model.fit.value]
        if model.name == "constant":
            return {"effect": "channel_field", "channel": "solar_current", "coefficient": values}
        if model.name == "two_panels":
            return {
                "effect": "solar_array",
                "since": utc_text(self.begin),
                "cycle": f"{PANEL_CYCLE_DAYS} d",
                "panels": values,
            }
        panels = self.normals[: len(values) // 3]
        entry: dict[str, object] = {
            "effect": "solar_array",
            "normals": [list(row) for row in panels],
            "panels": values,
        }
        return entry | ({"areas": list(self.areas[: len(panels)])} if self.areas else {})


def select_panel_model(
    epochs: xr.Dataset,
    local_time: Floats | None = None,
    *,
    normals: Sequence[Sequence[float]] = (*SIDE_NORMALS, TOP_NORMAL),
    areas: Sequence[float] | None = None,
    folds: int = 5,
    prior_sigma: float = PRIOR,
) -> PanelChoice:
    """Fit all models that the epochs allow and judge them on contiguous days that were not fitted.

    Parameters
    ----------
    epochs : xarray.Dataset
        Stored epochs; `sun_direction` (epoch, axis) where known.
    local_time : ndarray, shape (epoch,), optional
        h, of the ascending node.
    normals : sequence of three vectors
        The two sides, then the top, axes of `sun_direction`.
    areas : sequence of float, optional
        Of the three panels, relative; equal when absent.
    folds : int
        Parts of the span.
    prior_sigma : float
        nT/A.

    Raises
    ------
    SamplesError
        The epochs know neither local time nor the Sun's direction.
    CalibrationError
        Too few days.
    """
    columns = _model_columns(epochs, local_time, normals, areas)
    weight, day = weights_of(epochs), epochs["day"].values
    fits = {
        name: fit_contrasts(epochs, one, prior_sigma=prior_sigma).of(slice(one.shape[1]))
        for name, one in columns.items()
    }
    light = light_columns(epochs)
    squares = {
        name: held_out(np.hstack([one, light]), epochs["contrast"].values, weight, day, folds, prior_sigma)
        for name, one in columns.items()
    }
    best = min(squares, key=lambda name: float(squares[name].mean()))
    ranked = []
    for name, fit in fits.items():
        behind, sigma = mean_of_clusters(squares[name] - squares[best], np.ones(day.size), day)
        ranked.append(PanelModel(name, fit, float(squares[name].mean()), behind, sigma))
    models = tuple(sorted(ranked, key=lambda model: model.score))
    begin = int(epochs["time"].values[0])
    if local_time is not None:
        begin -= round(float(((PANEL_CYCLE_START_H - local_time[0]) % 24.0) / 24.0 * PANEL_CYCLE_DAYS) * DAY)
    rows = tuple(tuple(float(x) for x in row) for row in normals)
    return PanelChoice(models, _sentence(models), rows, tuple(areas) if areas is not None else None, begin)


def held_out(
    columns: Floats,
    observed: Floats,
    weight: Floats,
    day: npt.NDArray[np.int64],
    folds: int,
    prior_sigma: float,
) -> Floats:
    """Return the square of each row's misfit, weighted, when its fold was not fitted; (epoch,).

    Folds are contiguous days of about equal number.
    """
    days = np.unique(day)
    misfit = np.empty_like(observed)
    for part in np.array_split(days, min(folds, days.size)):
        out = np.isin(day, part)
        gram, rows = grams_by_cluster(columns[~out], observed[~out], weight[~out], day[~out])
        fit = solve_clusters(gram, rows, np.full(columns.shape[1], prior_sigma))
        misfit[out] = observed[out] - columns[out] @ fit.value
    return np.asarray(weight * misfit**2)


def _direction_columns(epochs: xr.Dataset) -> Floats:
    """Return the contrasts of e_j I of the first current; (epoch, 3) A."""
    return np.asarray(epochs["column"].values[:, 0, :])


def _model_columns(
    epochs: xr.Dataset,
    local_time: Floats | None,
    normals: Sequence[Sequence[float]],
    areas: Sequence[float] | None,
) -> Mapping[str, Floats]:
    """Return the columns (epoch, column) of each model for which the epochs hold what it needs."""
    single = _direction_columns(epochs)
    shares: dict[str, Floats] = {}
    if local_time is not None:
        shares["two_panels"] = panel_weights_at(local_time)
    if "sun_direction" in epochs:
        sun = epochs["sun_direction"].values
        shares["two_sides"] = panel_illumination(sun, normals[:2], None if areas is None else areas[:2])
        shares["three_panels"] = panel_illumination(sun, normals, areas)
    if not shares:
        raise SamplesError(
            "epochs know neither local time nor the Sun's direction",
            remedy="give the mission an orbit (and an attitude), and make the epochs anew",
        )
    return {"constant": single} | {
        name: (share[:, :, None] * single[:, None, :]).reshape(len(single), -1)
        for name, share in shares.items()
    }


def _sentence(models: tuple[PanelModel, ...]) -> str:
    """Return which models predict held-out days best, tie and do worse."""
    best = models[0]
    ties = [one.name for one in models[1:] if one.ties]
    worse = [f"{one.name} by {one.behind / one.behind_sigma:.1f} sigma" for one in models[1:] if not one.ties]
    text = f"{best.name} predicts held-out days best"
    text += f", {_listed(ties)} as well within two sigma" if ties else ""
    return text + (f"; worse {'are' if len(worse) > 1 else 'is'} {_listed(worse)}" if worse else "")


def _listed(names: Sequence[str]) -> str:
    """Return names as a sentence lists them: a, b and c."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
