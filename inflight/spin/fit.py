"""The parameters that the spin tells apart, fitted to folded samples; all else of a model stays in place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration.robust import biweight
from inflight.comparison import rows_of
from inflight.effects.spinning_sensor import SpinningSensor
from inflight.errors import CalibrationError
from inflight.model import Model, ModelEffect

#: Rounds of linearisation and reweighting, and the change, in sigmas, that ends them.
_ROUNDS, _SETTLED = 8, 0.05


@dataclass(frozen=True)
class SpinFit:
    """Fitted values of a spinning sensor.

    Attributes
    ----------
    names : tuple of (str, int)
        Parameter and component of each value.
    value, sigma : ndarray, shape (parameter,)
        In the parameters' own units.
    covariance : ndarray, shape (parameter, parameter)
    model : Model
        With the values, constant in time, put in.
    before, after : float
        Weighted rms of the rows, nT.
    """

    names: tuple[tuple[str, int], ...]
    value: Floats
    sigma: Floats
    covariance: Floats
    model: Model
    before: float
    after: float


def spinning_entry(model: Model) -> ModelEffect | None:
    """Return the model's spinning sensor; None when it has none."""
    return next((entry for entry in model.effects if isinstance(entry.effect, SpinningSensor)), None)


def free_of(entry: ModelEffect) -> tuple[tuple[str, int], ...]:
    """Return parameters and components of a spinning sensor that are free and show in the spin's tones."""
    return tuple(
        (name, index)
        for name, indices in SpinningSensor.SPIN_RELATED.items()
        if entry.parameters[name].free
        for index in indices
    )


def at_values(model: Model, entry: ModelEffect, names: Sequence[tuple[str, int]], value: Floats) -> Model:
    """Return a model whose spinning sensor has values, constant in time."""
    parameters = dict(entry.parameters)
    for (name, index), number in zip(names, value, strict=True):
        told = parameters[name]
        numbers = told.value[:, :1].copy() if told.table is None else told.at(0)[:, None]
        numbers[index] = number
        parameters[name] = replace(told, time="constant", value=numbers, sigma=told.sigma[:, :1], table=None)
    return model.replace(replace(entry, parameters=parameters))


def fit_spin(model: Model, samples: Sequence[xr.Dataset]) -> SpinFit:
    """Fit the free ones of the eight parameters to folded samples by robust weighted least squares.

    Parameters
    ----------
    model : Model
        With a spinning sensor; its values are the start, its sigmas the prior.
    samples : sequence of Dataset
        Folded: see `inflight.folding.fold`.

    Raises
    ------
    CalibrationError
        When there is nothing to fit to.
    """
    entry = spinning_entry(model)
    if entry is None:
        raise CalibrationError("the model has no spinning_sensor", remedy="add one to the model")
    names = free_of(entry)
    kinds = SpinningSensor.parameters()
    middle = int(np.median(np.concatenate([one["tt2000"].values for one in samples])))
    start = np.array([entry.parameters[name].at(middle)[index] for name, index in names])
    sigma = np.array([_prior(entry, name, index) for name, index in names])
    steps = np.array([kinds[name].step for name, _ in names])
    value, weight, before = start.copy(), None, np.nan
    for _ in range(_ROUNDS):
        now = at_values(model, entry, names, value)
        residual, base, interval = _rows(now, samples)
        if weight is None:
            weight, before = base, _rms(residual, base)
        columns = np.stack(
            [
                (
                    _rows(at_values(model, entry, names, value + step), samples)[0]
                    - _rows(at_values(model, entry, names, value - step), samples)[0]
                )
                for step in np.diag(steps)
            ],
            axis=1,
        ) / (2.0 * steps)
        weight = base * _say(residual, base, interval)
        change, covariance = _solved(columns, residual, weight, interval, (start - value), sigma)
        value = value + change
        if np.all(np.abs(change) <= _SETTLED * np.sqrt(np.diag(covariance))):
            break
    fitted = at_values(model, entry, names, value)
    residual, base, _ = _rows(fitted, samples)
    return SpinFit(
        names, value, np.sqrt(np.diag(covariance)), covariance, fitted, before, _rms(residual, base)
    )


def _prior(entry: ModelEffect, name: str, index: int) -> float:
    stated = float(entry.parameters[name].sigma[index, 0])
    return stated if np.isfinite(stated) else SpinningSensor.parameters()[name].sigma


def _rows(model: Model, samples: Sequence[xr.Dataset]) -> tuple[Floats, Floats, Floats]:
    """Return residuals, weights and intervals of all rows, one after another."""
    assert model.layout is not None
    assert model.layout.folding is not None
    length, parts = model.layout.folding.interval_ns, []
    for one in samples:
        rows = rows_of(model, one)
        weight = np.where(rows.good, np.asarray(one["weight"].values), 0.0)
        interval = one["tt2000"].values // length
        wide = rows.residual.shape[1]
        filled = np.where(rows.good[:, None], np.nan_to_num(rows.residual), 0.0)
        parts.append((filled.ravel(), np.repeat(weight, wide), np.repeat(interval, wide)))
    residual, weights, intervals = (np.concatenate(one) for one in zip(*parts, strict=True))
    if not np.any(weights > 0):
        raise CalibrationError(
            "no interval of the days looked at is usable",
            remedy="see 'inflight catalog gaps', the sun pulses and the flags of the deliveries",
        )
    return residual, weights, intervals


def _rms(residual: Floats, weight: Floats) -> float:
    return float(np.sqrt(np.sum(weight * residual**2) / max(np.sum(weight), 1e-300)))


def _say(residual: Floats, weight: Floats, interval: Floats) -> Floats:
    """Return how much each row counts: intervals whose tones stand out of the others lose their say."""
    own, place = np.unique(interval, return_inverse=True)
    square = np.bincount(place, weight * residual**2, own.size)
    total = np.bincount(place, weight > 0, own.size)
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.sqrt(square / total)
    usual = np.nanmedian(size[total > 0])
    pull = np.where(np.isfinite(size), size / max(float(usual), 1e-12), 0.0)
    return np.asarray(biweight(pull)[place])


def _solved(
    columns: Floats, residual: Floats, weight: Floats, interval: Floats, from_prior: Floats, sigma: Floats
) -> tuple[Floats, Floats]:
    """Return the change of the values and their covariance, by the scores of the intervals."""
    gram = (columns * weight[:, None]).T @ columns
    scale = float(np.sum(weight * residual**2)) / max(int(np.sum(weight > 0)), 1)
    prior = np.diag(scale / sigma**2)
    bread = np.linalg.inv(gram + prior)
    change = bread @ (-(columns * weight[:, None]).T @ residual + prior @ from_prior)
    left = residual + columns @ change
    own, place = np.unique(interval, return_inverse=True)
    scores = np.zeros((own.size, columns.shape[1]))
    np.add.at(scores, place, columns * (weight * left)[:, None])
    meat = scores.T @ scores * own.size / max(own.size - columns.shape[1], 1) + scale * prior
    return change, bread @ meat @ bread
