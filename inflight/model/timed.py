"""Values in time: how a parameter depends on time is the model's business, never an effect's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.effects.base import Parameter
from inflight.errors import ModelError
from inflight.time import parse_duration, parse_utc, to_tt2000, to_utc

#: Coefficients of each time dependence, a component.
COEFFICIENTS = {"constant": 1, "linear": 2, "log": 2, "block": 1}


@dataclass(frozen=True)
class TimedValue:
    """A parameter of a model: its coefficients, what is known of them, and how they depend on time.

    Attributes
    ----------
    parameter : Parameter
        What the effect says of it.
    time : str
        constant; linear ``a + b (t - t0)/per``; log ``a + b ln((t - t0)/per)`` (Yin 2010, section
        3.2); block: one value a calibration interval, held in a table.
    value, sigma : ndarray, shape (component, coefficient)
        Value and standard deviation; for block, those known beforehand.
    free : bool
        Whether a fit may move it.
    t0 : int
        Origin, TT2000 nanoseconds.
    per : int
        Unit of time, nanoseconds.
    table : xarray.Dataset, optional
        Bound calibration table of a block parameter.
    key : str
        ``effect.parameter``, the name in tables.
    table_name : str
        What the model YAML says of the table its values lie in; kept, for a reader.
    """

    parameter: Parameter
    time: str
    value: Floats
    sigma: Floats
    free: bool = True
    t0: int = 0
    per: int = 86_400_000_000_000
    table: xr.Dataset | None = None
    key: str = ""
    table_name: str = ""

    def at(self, tt2000: npt.ArrayLike) -> Floats:
        """Return the value at a time, shape (component,), or at times, shape (time, component).

        Raises
        ------
        ModelError
            When a log trend is asked before its origin, or a time lies outside the bound table.
        """
        if self.time == "constant" or (self.time == "block" and self.table is None):
            return self.value[:, 0]
        t = np.asarray(tt2000, dtype=np.int64)
        if self.time == "block":
            return self._from_table(t)
        return np.asarray(self._basis(t) @ self.value.T)

    def _basis(self, t: npt.NDArray[np.int64]) -> Floats:
        """Return (1, f(t)); shape (..., coefficient)."""
        elapsed = (t - self.t0) / self.per
        if self.time == "log":
            if np.any(elapsed <= 0):
                raise ModelError(
                    f"'{self.key}' follows a logarithm that begins at {to_utc(self.t0)}, asked for before it",
                    remedy="use time: constant there, or an earlier t0",
                )
            elapsed = np.log(elapsed)
        return np.stack([np.ones_like(elapsed), elapsed], axis=-1)

    def _from_table(self, t: npt.NDArray[np.int64]) -> Floats:
        table = self.table
        assert table is not None
        names = component_names(self.key, self.parameter)
        start = table["start"].values
        index = np.searchsorted(start, t, side="right") - 1
        inside = (index >= 0) & (t < table["end"].values[np.clip(index, 0, None)])
        if not np.all(inside):
            first = np.atleast_1d(t)[~np.atleast_1d(inside)][0]
            raise ModelError(
                f"the calibration table for '{self.key}' is not valid at {to_utc(first)}",
                remedy="reprocess the span, or certify a table for it",
            )
        values = table["value"].sel(parameter=names).values
        return np.asarray(values[index])

    def bind(self, table: xr.Dataset) -> TimedValue:
        """Return a copy that takes its values from a calibration table, when the table has it."""
        names = component_names(self.key, self.parameter)
        if self.time != "block" or not set(names) <= set(table["parameter"].values.tolist()):
            return self
        return replace(self, table=table)

    def as_yaml(self) -> dict[str, Any]:
        """Return the mapping the model YAML holds for it."""
        axes = self.parameter.axes
        found: dict[str, Any] = {"time": self.time, "unit": self.parameter.unit}
        if self.time in ("log", "linear"):
            found |= {"t0": f"{to_utc(self.t0)}Z", "per": f"{self.per} ns"}
        found["value"] = _as_yaml(self.value, axes)
        if not np.array_equal(self.sigma, _default_sigma(self.parameter, self.sigma.shape[1])):
            found["sigma"] = _as_yaml(self.sigma, axes)
        if self.table_name:
            found["table"] = self.table_name
        found["free"] = self.free
        return found


def component_names(key: str, parameter: Parameter) -> list[str]:
    """Return the names of a parameter's components: ``effect.parameter[axis]``."""
    return [f"{key}[{axis}]" for axis in parameter.axes] if parameter.axes else [key]


def parse_timed(key: str, parameter: Parameter, given: Any) -> TimedValue:
    """Read a parameter's entry of the model YAML; a bare number or list is a constant.

    Raises
    ------
    ModelError
        Naming the parameter and what is wrong.
    """
    entry = dict(given) if isinstance(given, dict) else {"value": given}
    known = {"time", "unit", "value", "sigma", "free", "t0", "per", "table"}
    if unknown := set(entry) - known:
        raise ModelError(
            f"'{key}' has unknown keys {sorted(unknown)}", remedy=f"known are {', '.join(sorted(known))}"
        )
    time = str(entry.get("time", "constant"))
    if time not in COEFFICIENTS:
        raise ModelError(f"'{key}': time {time!r} is unknown", remedy=f"one of {', '.join(COEFFICIENTS)}")
    unit = str(entry.get("unit", parameter.unit))
    if unit != parameter.unit:
        raise ModelError(
            f"'{key}' is given in {unit}, it is in {parameter.unit}", remedy="convert the values"
        )
    count = COEFFICIENTS[time]
    value = _coefficients(key, parameter, entry.get("value"), count, parameter.default_values)
    sigma = _coefficients(key, parameter, entry.get("sigma"), count, _default_sigma(parameter, 1)[:, 0])
    if count > 1 and "t0" not in entry:
        raise ModelError(f"'{key}' changes with time but has no 't0'", remedy="say from when: t0: 2000-05-30")
    if np.isnan(sigma).any() or np.any(sigma < 0) or np.isnan(value).any():
        raise ModelError(
            f"'{key}' has a value or sigma that is no number, or a sigma below 0", remedy="correct it"
        )
    return TimedValue(
        parameter,
        time,
        value,
        sigma,
        free=bool(entry.get("free", time == "block")),
        t0=int(to_tt2000(parse_utc(entry["t0"]))) if "t0" in entry else 0,
        per=parse_duration(_with_number(str(entry.get("per", "1 d")))),
        key=key,
        table_name=str(entry.get("table", "")),
    )


def _default_sigma(parameter: Parameter, count: int) -> Floats:
    """Return what the effect says is known beforehand; (component, coefficient)."""
    sigma = np.zeros((parameter.size, count))
    sigma[:, 0] = parameter.sigma
    return sigma


def _with_number(text: str) -> str:
    return text if text.strip()[:1].isdigit() else f"1 {text}"


def _coefficients(key: str, parameter: Parameter, given: Any, count: int, default: Floats) -> Floats:
    """Return an array (component, coefficient) from a number, a list, or a mapping by axis."""
    if given is None:
        filled = np.zeros((parameter.size, count))
        filled[:, 0] = default
        return filled
    if isinstance(given, dict):
        if set(given) != set(parameter.axes or ()):
            axes = ", ".join(parameter.axes or ("no axes",))
            raise ModelError(
                f"'{key}' has components {', '.join(given)}, expected {axes}", remedy="name each"
            )
        given = [given[axis] for axis in parameter.axes or ()]
    try:
        array = np.asarray(given, dtype=np.float64)
        if count > 1 and array.shape == (count,) and parameter.size > 1:
            raise ValueError
        if array.ndim < 2 and count == 1:
            return np.array(np.broadcast_to(array.reshape(-1, 1), (parameter.size, 1)))
        return array.reshape(parameter.size, count)
    except ValueError:
        raise ModelError(
            f"'{key}': {given!r} does not give {parameter.size} components of {count} coefficients",
            remedy="write a list, or a mapping by axis",
        ) from None


def _as_yaml(array: Floats, axes: tuple[str, ...] | None) -> Any:
    plain = [row[0] if len(row) == 1 else row for row in array.tolist()]
    return dict(zip(axes, plain, strict=True)) if axes else plain[0]
