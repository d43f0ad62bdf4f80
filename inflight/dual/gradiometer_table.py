"""A gradiometer beside the states of a table, and its correction with a constant that days share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.dual.bands import gradiometer_correction
from inflight.dual.correction import Correction
from inflight.dual.gradiometer import Gradiometer
from inflight.dual.mixing import Mixing
from inflight.dual.readings import Readings

#: What the variables' names begin with.
_NAME = "gradiometer_"
_MATRIX, _ELEMENTS = ("axis", "other"), ("element", "other_element")


def gradiometer_variables(gradiometer: Gradiometer, readings: Readings) -> xr.Dataset:
    """Return a gradiometer as variables of a table.

    Parameters
    ----------
    readings : Readings
        Those it was fitted to: their median is where its correction is zero.
    """
    mixing = gradiometer.mixing
    arrays = {
        "matrix": (_MATRIX, mixing.matrix, {"units": "1"}),
        "leak": (_MATRIX, mixing.leak, {"units": "1"}),
        "noise": (_MATRIX, gradiometer.noise, {"units": "nT2"}),
        "leak_covariance": (_ELEMENTS, mixing.leak_covariance, {"units": "1"}),
        "covariance": (_ELEMENTS, gradiometer.covariance, {"units": "1"}),
        "middle": (("axis",), _middle(gradiometer, readings), {"units": "nT"}),
    }
    attrs = {f"{_NAME}share": float(mixing.share), f"{_NAME}form": gradiometer.form}
    return xr.Dataset({_NAME + name: one for name, one in arrays.items()}, attrs=attrs)


def has_gradiometer(table: xr.Dataset) -> bool:
    """Return True when a table holds a gradiometer."""
    return f"{_NAME}matrix" in table


def gradiometer_of(table: xr.Dataset) -> Gradiometer:
    """Return the gradiometer of a table, of form ``matrix``."""
    told = {
        name: np.asarray(table[_NAME + name].values)
        for name in ("matrix", "leak", "noise", "leak_covariance", "covariance")
    }
    share = float(table.attrs[f"{_NAME}share"])
    mixing = Mixing(told["matrix"], told["leak"], told["leak_covariance"], share)
    return Gradiometer(
        "matrix", mixing, told["covariance"], told["matrix"].ravel(), told["covariance"], told["noise"]
    )


def correction_by_gradiometer(table: xr.Dataset, readings: Readings) -> Correction:
    """Return the correction of a table's gradiometer; its constant is that of the whole table."""
    gradiometer = gradiometer_of(table)
    found = gradiometer_correction(gradiometer, readings)
    if not readings.good.any():
        return found
    away = _middle(gradiometer, readings) - np.asarray(table[f"{_NAME}middle"].values)
    return replace(found, field=found.field + gradiometer.matrix @ away)


def _middle(gradiometer: Gradiometer, readings: Readings) -> Floats:
    return np.asarray(np.median(gradiometer.stray(readings)[readings.good], axis=0))
