"""Columns of the residual: what one unit of each parameter changes, at the library's cadence.

Sign: a column is the derivative of the corrected residual by the parameter, so that ``y + X d`` is
the residual after a change d, as in `inflight.calibration.equations`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.comparison import RowFilter
from inflight.diagnosis.library import Term, within_span
from inflight.effects.base import multiply
from inflight.effects.spinning_sensor import SpinningSensor
from inflight.effects.vector_sensor import VectorSensor
from inflight.model import Model
from inflight.plain import PlainSamples

#: Effects that are the equation of a whole sensor: what stands before them is turned by their matrix.
EQUATIONS = (VectorSensor, SpinningSensor)
#: Roles whose reading is a vector.
_VECTORS = ("vector", "inboard", "outboard")


@dataclass(frozen=True)
class Rows:
    """Everything columns are made from, for one block of samples.

    Attributes
    ----------
    samples : xarray.Dataset
        Readings, `field`, `field_direction`, channels and geometry on the library's time base.
    residual : ndarray, shape (time, row)
        nT, at the values the columns are linearised at.
    directions : dict of str to ndarray, shape (time, row, axis)
        Change of each row by a field added at a sensor.
    turn : dict of str to ndarray, shape (9,)
        What the sensor's own equation behind an effect does to a change of its reading, row by row.
    weight : ndarray, shape (time,)
        Good native samples of each over the usual number; 0 where there are none.
    kept : RowFilter, optional
        The filter the residual went through; columns go through it, too.
    """

    samples: xr.Dataset
    residual: Floats
    directions: Mapping[str, Floats]
    turn: Mapping[str, Floats]
    weight: Floats
    kept: RowFilter | None = None


def turns_of(model: Model, tt2000: int) -> dict[str, Floats]:
    """Return the matrix of every sensor that has an equation, row by row; (9,) each."""
    found = {}
    for entry in model.effects:
        if isinstance(entry.effect, EQUATIONS):
            values = entry.values(tt2000)
            still = np.zeros((3, 3))
            unit = entry.effect.correct(np.eye(3), xr.Dataset(), values, entry.sensor)
            nought = entry.effect.correct(still, xr.Dataset(), values, entry.sensor)
            found[entry.sensor.name] = np.ascontiguousarray((unit - nought).T).reshape(9)
    return found


def term_columns(term: Term, rows: Rows) -> Floats:
    """Return the columns of a term; (time, row, column), nT per scaled unit.

    Raises
    ------
    SamplesError
        When a channel is not in the samples.
    """
    entry = term.entry
    kinds = entry.effect.parameters()
    times = rows.samples["tt2000"].values
    values = {name: np.array(value) for name, value in entry.values(times).items()}
    out = []
    for name in term.parameters:
        for index in range(kinds[name].size):
            step = kinds[name].step
            if entry.is_additive:
                out.append(_additive(term, rows, values, name, index, step))
            else:
                out.append(_differenced(term, rows, values, name, index, step))
    # Columns lie one after another: each is written, and later multiplied, as one run of memory.
    made = np.stack(out)
    if term.span:
        made[:, ~within_span(times, term.span)] = 0.0
    return np.moveaxis(made, 0, -1)


def _changed(values: Mapping[str, Floats], name: str, index: int, step: float) -> dict[str, Floats]:
    moved = dict(values)
    moved[name] = np.array(values[name], dtype=np.float64)
    moved[name][..., index] += step
    return moved


def _additive(
    term: Term, rows: Rows, values: Mapping[str, Floats], name: str, index: int, step: float
) -> Floats:
    """Column of an effect that only adds a field: one evaluation, it is linear."""
    entry = term.entry
    others = {key: value * 0.0 if _is_linear(term, key) else value for key, value in values.items()}
    others[name] = others[name] * 0.0
    field = entry.effect.field(rows.samples, _changed(others, name, index, step), entry.sensor)
    return np.asarray(-np.einsum("tra,ta->tr", rows.directions[entry.sensor.name], field))


def _is_linear(term: Term, name: str) -> bool:
    return name in term.parameters


def _differenced(
    term: Term, rows: Rows, values: Mapping[str, Floats], name: str, index: int, step: float
) -> Floats:
    """Column of an effect inside an instrument's equation: a central difference of its correction."""
    entry = term.entry
    reading = np.asarray(rows.samples[entry.sensor.role].values, dtype=np.float64)
    up, down = (
        entry.effect.correct(reading, rows.samples, _changed(values, name, index, sign * step), entry.sensor)
        for sign in (1.0, -1.0)
    )
    change = (up - down) / 2.0
    if entry.sensor.role not in _VECTORS:
        return np.asarray(-change[:, None])
    if not isinstance(entry.effect, EQUATIONS) and entry.sensor.name in rows.turn:
        change = multiply(rows.turn[entry.sensor.name], change)
    return np.asarray(np.einsum("tra,ta->tr", rows.directions[entry.sensor.name], change))


def design(terms: Sequence[Term], rows: Rows) -> Floats:
    """Return the columns of terms side by side; (time, row, column), 0 where a sample has no weight.

    Values that are not there are 0: a channel's gap must not cost the samples of all others.
    """
    if not terms:
        return np.zeros((*rows.residual.shape, 0))
    # Effects only look variables up: a thousand columns would spend their time in a Dataset's indexing.
    light = replace(rows, samples=cast("xr.Dataset", PlainSamples.of(rows.samples)))
    found = np.concatenate([np.moveaxis(term_columns(term, light), -1, 0) for term in terms])
    unused = rows.weight <= 0
    if unused.any():
        found[:, unused] = 0.0
    for column in found:
        if not np.isfinite(column.sum()):
            column[~np.isfinite(column)] = 0.0
    made = np.moveaxis(found, 0, -1)
    if rows.kept is None:
        return made
    return np.nan_to_num(rows.kept.keep(made, rows.samples["tt2000"].values, ~unused))
