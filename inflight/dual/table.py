"""A training as a Dataset, for a certified table with validity, and back."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from inflight.dual.drift import DriftRate
from inflight.dual.training import Training
from inflight.errors import CalibrationError

_VERSION = 2
#: Dims of the arrays of a training, and their units.
_ARRAYS = {
    "number": (("state",), ""),
    "centre": (("state", "axis"), "nT"),
    "centre_covariance": (("state", "axis", "other"), "nT2"),
    "correction": (("state", "axis"), "nT"),
    "covariance": (("state", "axis", "other"), "nT2"),
    "segments": (("state",), ""),
    "seconds": (("state",), "s"),
    "transitions": (("state", "next"), ""),
    "occupancy": (("state", "unit"), ""),
    "unit": (("unit", "axis"), "nT"),
    "unit_correction": (("unit", "axis"), "nT"),
    "unit_covariance": (("unit", "axis", "other"), "nT2"),
    "drift": (("axis",), "nT"),
    "design": (("state", "parameter"), ""),
    "value": (("parameter", "axis"), "nT"),
    "joint": (("parameter", "axis", "other_parameter", "other"), "nT2"),
    "unit_number": (("unit",), ""),
}
_RATES = {"slope": "nT2 s-2", "bend": "nT2 s-3", "value": "nT2 s-1"}
_NUMBERS = ("scatter", "excess")


def to_dataset(training: Training) -> xr.Dataset:
    """Return a training as a Dataset: dims state, next, unit, parameter, axis, other, other_parameter.

    The states' numbers are the variable ``number``; ``start`` and ``end`` are those of the readings, TT2000.
    """
    arrays: dict[str, Any] = {
        name: (dims, getattr(training, name), {"units": unit} if unit else {})
        for name, (dims, unit) in _ARRAYS.items()
    }
    for name, unit in _RATES.items():
        arrays[f"drift_{name}"] = (("axis",), getattr(training.drift_rate, name), {"units": unit})
    for name in ("start", "end"):
        arrays[name] = ((), np.int64(getattr(training, name)), {"scale": "TT2000"})
    attrs: dict[str, Any] = {name: float(getattr(training, name)) for name in _NUMBERS}
    attrs |= {
        "dual_training": _VERSION,
        "constant_known": int(training.constant_known),
        "reference": int(training.reference),
        "next_number": int(training.next_number),
        "next_unit": int(training.next_unit),
        "carried": int(training.carried),
        "sureness": float(training.sureness),
        "reason": training.reason,
    }
    axes = {"axis": ["x", "y", "z"], "other": ["x", "y", "z"]}
    return xr.Dataset(arrays, coords=axes, attrs=attrs)


def from_dataset(table: xr.Dataset) -> Training:
    """Return the training of a Dataset that `to_dataset` made.

    Raises
    ------
    CalibrationError
        The Dataset is no training, or of a later version.
    """
    version = table.attrs.get("dual_training")
    if version != _VERSION:
        raise CalibrationError(
            f"version {version} of a table of two sensors' states found, {_VERSION} expected",
            remedy="train anew, or take the table of a training",
        )
    arrays: dict[str, Any] = {name: np.asarray(table[name].values) for name in _ARRAYS}
    numbers: dict[str, Any] = {name: float(table.attrs[name]) for name in _NUMBERS}
    rate = DriftRate(*(np.asarray(table[f"drift_{name}"].values) for name in DriftRate._fields))
    return Training(
        **arrays,
        **numbers,
        drift_rate=rate,
        start=int(table["start"]),
        end=int(table["end"]),
        constant_known=bool(table.attrs["constant_known"]),
        reference=int(table.attrs["reference"]),
        next_number=int(table.attrs["next_number"]),
        next_unit=int(table.attrs["next_unit"]),
        carried=bool(table.attrs["carried"]),
        # Tables of before say nothing of it.
        sureness=float(table.attrs.get("sureness", 1.0)),
        reason=str(table.attrs["reason"]),
    )
