"""What the errors of numbers that a calibration holds do to the parameters that it fits.

Takes a model whose numbers have a sigma, and a day's samples; makes products of their columns with those of
the nine parameters (`held_products`), and of these, or of their sums, how far a sigma of each moves the nine
(`held_shifts_of_each`, `held_shifts`). With X the columns of the nine and z that of a number, which is off by
c, least squares moves the nine by ``(X^T X)^-1 X^T z c`` (see `inflight.mission_fit.crosstalk`). The error is
the same at all times: no number of days makes it smaller.

A number of the scalar sensor, its clock, bias and the fields at it, moves the nine and no more. One of the
vector sensor changes the corrected field itself, too, and the nine make part of that good: its shift stands
in the table by itself (`with_held_numbers`), so that a product joins both (`inflight.calibration.product`).
Orientations move nothing here, a field's strength has none, and a wrong place of a dipole leaves the
difference of both sensors as it is: these errors are the product's alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from inflight.arrays import Floats
from inflight.calibration import PARAMETER_SCALE, NormalEquations, vector_sensor_of
from inflight.design import DesignRows, Term, design_matrix, sensor_matrices
from inflight.frames import direction_of
from inflight.lsq import regression_coefficients, solve_scaled
from inflight.mission_fit.daily_equations import free_terms, with_nine_parameters
from inflight.model import Model, delay_number, rows_of
from inflight.time import SECOND

if TYPE_CHECKING:
    import xarray as xr

#: Rows of a day that products are made of: a minute apart, fields of an orbit and its rates are the same.
_ROWS = 1440


@dataclass(frozen=True)
class HeldNumber:
    """A number that a calibration holds: its column's name, the role of its sensor, and one sigma."""

    name: str
    role: str
    sigma: float


def held_terms(model: Model) -> tuple[Term, ...]:
    """Return the effects' numbers that have a sigma of their own and that no block fits, free or not."""
    found = []
    for entry in model.effects:
        known = {
            name: timed.sigma[:, 0]
            for name, timed in entry.parameters.items()
            if timed.time == "constant" and timed.has_own_sigma and np.all(np.isfinite(timed.sigma))
        }
        known = {name: sigma for name, sigma in known.items() if np.any(sigma > 0)}
        if known and entry.sensor.role in ("vector", "scalar"):
            sigma = tuple(float(one) for each in known.values() for one in each)
            found.append(Term(entry.name, entry, tuple(known), sigma))
    return tuple(found)


def held_numbers_of(model: Model) -> tuple[HeldNumber, ...]:
    """Return the numbers of `held_terms`, and behind them the sensors' delays that have a sigma (s)."""
    found = [
        HeldNumber(name, term.entry.sensor.role, sigma)
        for term in held_terms(model)
        for name, sigma in zip(term.columns, term.sigma, strict=True)
    ]
    found += [
        HeldNumber(delay_number(sensor), role, sensor.sigma.delay / SECOND)
        for role, sensor in model.known_layout.sensors.items()
        if role in ("vector", "scalar") and sensor.sigma.delay
    ]
    return tuple(found)


def held_products(model: Model, samples: xr.Dataset, value: Floats, count: float) -> Floats:
    """Return products of the columns of the nine with one sigma of each held number.

    Parameters
    ----------
    model : Model
    samples : xarray.Dataset
        Aligned raw samples of a day.
    value : ndarray, shape (9,)
        The day's own nine, physical units.
    count : float
        Sum of the weights of the day's Gram matrix, to which the products are scaled.

    Returns
    -------
    ndarray, shape (number, 9)
        nT^2, columns of the nine scaled as in `NormalEquations.from_fit`; in the order of `held_numbers_of`.
    """
    terms, numbers = held_terms(model), held_numbers_of(model)
    if not numbers or not count:
        return np.zeros((len(numbers), PARAMETER_SCALE.size))
    fitted = with_nine_parameters(model, value)
    few = samples.isel(time=slice(None, None, max(1, samples.sizes["time"] // _ROWS)))
    rows = rows_of(fitted, few)
    stamps = np.asarray(few["tt2000"].values)
    seen = rows.good & np.isfinite(rows.residual).all(axis=1)
    field = np.where(seen[:, None], rows.field, 1.0)
    along = direction_of(field)
    at = few.assign(
        field=(("time", "axis"), field, {"units": "nT"}),
        field_direction=(("time", "axis"), along, {"units": "1"}),
    )
    matrices = sensor_matrices(fitted, int(stamps[stamps.size // 2]))
    binned = DesignRows(at, rows.residual, rows.directions, matrices, seen.astype(np.float64))
    own = next(term for term in free_terms(fitted) if term.entry.name == vector_sensor_of(fitted).name)
    columns = design_matrix([own, *held_terms(fitted)], binned)[seen, 0]
    nine, others = columns[:, : PARAMETER_SCALE.size], columns[:, PARAMETER_SCALE.size :]
    # In units of their steps: from those to one sigma, and to the scale of the nine.
    sigma = np.array([one / step for term in terms for one, step in zip(term.sigma, term.scale, strict=True)])
    # As columns are: what is taken out of the vector's strength, which holds t dF/dt when it is late by t.
    seconds, strength = stamps[seen] / SECOND, np.linalg.norm(field[seen], axis=1)
    rate = np.gradient(strength, seconds) if seconds.size > 1 else np.zeros(seconds.size)
    late = [rate * one.sigma * (-1 if one.role == "vector" else 1) for one in numbers[sigma.size :]]
    others = np.column_stack([others * sigma, *late])
    scale = PARAMETER_SCALE / np.array(own.scale)
    return np.asarray(others.T @ (nine * scale) * (count / max(int(seen.sum()), 1)))


def held_shifts(equations: NormalEquations, products: Floats, prior_sigma: Floats, noise: float) -> Floats:
    """Return by how much one sigma of each held number moves the nine, fitted to all blocks together.

    Parameters
    ----------
    equations : NormalEquations
        Of the nine.
    products : ndarray, shape (block, number, 9)
        Of the same blocks.
    prior_sigma : ndarray, shape (9,)
        What is known of the nine beforehand, physical units; 0 fixes one.
    noise : float
        Of a row, nT.

    Returns
    -------
    ndarray, shape (number, 9)
        Physical units. Their outer products, summed, are what the numbers add to the covariance.
    """
    together = products.sum(axis=0)[None]
    return np.asarray(_shifts(equations.total[None], together, prior_sigma[None], np.array([noise]))[0])


def held_shifts_of_each(
    equations: NormalEquations, products: Floats, prior_sigma: Floats, noise: Floats
) -> Floats:
    """Return by how much one sigma of each held number moves the nine, fitted to each block by itself.

    Parameters
    ----------
    equations, products
        As of `held_shifts`.
    prior_sigma : ndarray, shape (block, 9)
    noise : ndarray, shape (block,)

    Returns
    -------
    ndarray, shape (block, number, 9)
        As of `held_shifts` block by block.
    """
    return _shifts(equations.gram, products, prior_sigma, noise)


def _shifts(grams: Floats, products: Floats, prior_sigma: Floats, noise: Floats) -> Floats:
    """Return the shifts of equations that are solved each for itself; (equations, number, 9)."""
    out = np.zeros(products.shape)
    if not products.size:
        return out
    with np.errstate(divide="ignore", invalid="ignore"):
        precision = (noise[:, None] * PARAMETER_SCALE / prior_sigma) ** 2
    # Those with the same parameters fixed are solved together.
    for fixed in np.unique(np.isfinite(precision), axis=0):
        alike = np.flatnonzero((np.isfinite(precision) == fixed).all(axis=1))
        right = products[alike].swapaxes(1, 2)
        found = solve_scaled(grams[alike, :-1, :-1], right, cut=0.0, precision=precision[alike])
        out[alike] = found.swapaxes(1, 2) * PARAMETER_SCALE
    return out


def held_variance(
    equations: NormalEquations, fitted: Sequence[str], held: Sequence[str], covariance: Floats
) -> Floats:
    """Return what errors of held numbers add to the covariance of each block's own fit.

    Parameters
    ----------
    equations : NormalEquations
        Of blocks (days).
    fitted, held : sequence of str
        Columns that each block is solved for, and columns that it takes as given.
    covariance : ndarray, shape (held, held) or (block, held, held)
        Of the numbers held, physical units.

    Returns
    -------
    ndarray, shape (block, fitted, fitted)
        Physical units: ``S C S^T`` with the shifts S of `inflight.mission_fit.crosstalk`.
    """
    wide, count = [*fitted, *held], len(fitted)
    places, scale = np.arange(len(wide)), equations.scale[equations.index(wide)]
    shift = regression_coefficients(equations.rows(wide, wide), places[:count], places[count:])
    shift = shift * scale[:count, None] / scale[count:]
    return np.asarray(shift @ covariance @ np.swapaxes(shift, 1, 2))


def with_held_numbers(
    table: xr.Dataset, shifts: Sequence[Floats], numbers: Sequence[HeldNumber]
) -> xr.Dataset:
    """Return a table with what its errors have in common with those of the vector sensor's numbers.

    Parameters
    ----------
    table : xarray.Dataset
        Its covariance holds the shifts of all numbers.
    shifts : sequence of ndarray, shape (number, 9)
        Of each interval, as `held_shifts`; empty where nothing was fitted.
    numbers : sequence of HeldNumber
        Of the model, as `held_numbers_of`.

    Returns
    -------
    xarray.Dataset
        With `number_shift` (interval, number, parameter), the covariance of a parameter with a number in
        units of its sigma, and `number_sigma` (number). What is held too low leaves the parameters too high.
    """
    own = [place for place, one in enumerate(numbers) if one.role == "vector"]
    if not own:
        return table
    none = np.zeros((len(numbers), table.sizes["parameter"]))
    each = np.stack([one if one.size else none for one in shifts])[:, own]
    return table.assign(
        number_shift=(("interval", "number", "parameter"), -each),
        number_sigma=("number", np.array([numbers[place].sigma for place in own])),
    ).assign_coords(number=[numbers[place].name for place in own])
