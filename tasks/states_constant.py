"""The constant part of the corrections: the same in all windows where the data tell it, else told.

Corrections by states are relative to one state, and windows that know it go on from each other. A gradiometer
is told from changes alone, and its constant is arbitrary: it is put where the states of the same window have
it, so that the field does not step where one method follows the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.dual.bands import quadratic
from inflight.dual.correction import Correction
from inflight.dual.gradiometer_table import correction_by_gradiometer, gradiometer_of
from inflight.dual.processing import SURE, process
from inflight.dual.readings import Readings
from inflight.dual.slow_part import leaves_slow_alone
from inflight.dual.table import from_dataset
from inflight.time import day_of

#: What the gradiometer takes off in each state of its window, nT.
IN_STATES = "gradiometer_in_states"
#: What is said of the constant part of a field.
MEASURED, ABSOLUTE = "as measured", "absolute"


def gradiometer_in_states(table: xr.Dataset, readings: Readings) -> xr.Dataset:
    """Return a table with what its gradiometer takes off in each of its states; (state, axis), nT.

    Parameters
    ----------
    table : Dataset
        With states and a gradiometer.
    readings : Readings
        Those it was learnt from.

    Returns
    -------
    Dataset
        With variable `gradiometer_in_states`, NaN for states in which no sample surely is.
    """
    training = from_dataset(table)
    mean = np.full((len(training), 3), np.nan)
    if len(training) and readings.good.any():
        taken = correction_by_gradiometer(table, readings)
        states = process(readings, training)
        sure = taken.known & (states.probability >= SURE)
        for row, number in enumerate(training.number.tolist()):
            inside = sure & (states.state == number)
            if inside.any():
                mean[row] = taken.field[inside].mean(axis=0)
    return table.assign({IN_STATES: (("state", "axis"), mean, {"units": "nT"})})


def gradiometer_with_states(table: xr.Dataset, readings: Readings) -> Correction:
    """Return the correction by a table's gradiometer, with the constant part and the numbers of its states.

    The field is the gradiometer's; flags about states do not concern it. Where only what is quick will be
    taken off, the error of the constant is none of its own.
    """
    found = correction_by_gradiometer(table, readings)
    training = from_dataset(table)
    if not len(training) or not readings.good.any():
        return found
    states = process(readings, training)
    told = replace(found, state=states.state, probability=states.probability)
    constant = _constant(table)
    if constant is None:
        return told
    value, sigma = constant
    return replace(
        told,
        field=told.field + value,
        covariance=told.covariance + (not leaves_slow_alone(table)) * np.diag(sigma**2),
        constant_known=training.constant_known,
    )


def constant_part(table: xr.Dataset) -> Floats:
    """Return the constant that a table's correction has, nT, but for one that is always the same; (axis,).

    It moves when the window is joined to those before it.
    """
    if str(table.attrs["method"]) == "gradiometer":
        constant = _constant(table)
        return np.zeros(3) if constant is None else constant[0]
    training = from_dataset(table)
    # All states move alike.
    return training.correction[0] if len(training) else np.zeros(3)


def constant_of(table: xr.Dataset) -> str:
    """Return what the constant part of the field is that a table makes: where it changes the field may step.

    Returns
    -------
    str
        ``as measured`` where nothing is taken off, or only what changes quickly; ``absolute`` where the
        ambient field was known,
        ``relative to state N``, or ``that of the window from DAY alone`` where a gradiometer has no state
        to go by.
    """
    if str(table.attrs["applied"]) != "yes" or leaves_slow_alone(table):
        return MEASURED
    if str(table.attrs["method"]) == "gradiometer" and _constant(table) is None:
        return f"that of the window from {day_of(int(table['start']))!s:.10} alone"
    if table.attrs["constant_known"]:
        return ABSOLUTE
    return f"relative to state {int(table.attrs['reference'])}"


def constant_changes(constants: Mapping[np.datetime64, str]) -> list[dict[str, str]]:
    """Return where the constant part of the field becomes another: fields ``day``, ``before``, ``after``.

    Parameters
    ----------
    constants : mapping of day to str
        As `constant_of` tells.
    """
    days = sorted(constants)
    return [
        {"day": str(day), "before": constants[last], "after": constants[day]}
        for last, day in pairwise(days)
        if constants[last] != constants[day]
    ]


def constant_sentences(changes: Sequence[Mapping[str, str]]) -> list[str]:
    """Return in words where the field may step by a constant."""
    return [
        f"at the beginning of {one['day']} the field may step by a constant: before it is {one['before']}, "
        f"from then on {one['after']}"
        for one in changes
    ]


def _constant(table: xr.Dataset) -> tuple[Floats, Floats] | None:
    """Return what is added to the gradiometer's correction, and its standard deviation; (axis,), nT.

    Each state says how far its correction is from what the gradiometer takes off there: the mean by their
    errors. What all states have in common does not average out: the error is that of one state, or by how
    much they differ where that is more.
    """
    if IN_STATES not in table:
        return None
    taken = np.asarray(table[IN_STATES].values)
    seen = np.flatnonzero(np.isfinite(taken).all(axis=1))
    if not seen.size:
        return None
    training = from_dataset(table)
    centre, seconds = training.centre[seen], np.maximum(training.seconds[seen], 1.0)
    away = centre - np.average(centre, axis=0, weights=seconds)
    spread = training.covariance[seen] + quadratic(gradiometer_of(table).covariance, away)
    variance = np.einsum("sii->si", spread) + training.scatter**2 + 1e-12
    weight = 1.0 / variance
    weight /= weight.sum(axis=0)
    apart = training.correction[seen] - taken[seen]
    value = np.sum(weight * apart, axis=0)
    scatter = np.sum(weight * (apart - value) ** 2, axis=0)
    return value, np.sqrt(np.maximum(np.sum(weight * variance, axis=0), scatter))
