"""One channel of a file in the mission YAML's unit: shape, fill, scaling, unit, range.

A unit the file states is checked against the YAML and converted; a file's own VALIDMIN and VALIDMAX are
not applied, because delivered files often carry wrong ones: `range` in the YAML decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.catalog.readers.source import Array, Float, Source, Variable, as_floats, is_missing
from inflight.errors import ContentError
from inflight.instruments import Channel
from inflight.units import factor_and_offset

Mask = npt.NDArray[np.bool_]


def read_channel(source: Source, name: str, channel: Channel, shape: tuple[int, ...]) -> tuple[Float, Mask]:
    """Read one channel.

    Parameters
    ----------
    source : Source
        An open file.
    name : str
        The channel's name, for errors.
    channel : Channel
        Its description in the mission YAML.
    shape : tuple of int
        Shape of the file's times: (row,) or (report, sample).

    Returns
    -------
    values : ndarray
        (row,) or (row, axis), in `channel.unit`, NaN where missing, stale or out of range. float32 and small
        integers stay float32 (exact), everything else is float64.
    outside : ndarray of bool
        Rows with a reading out of `channel.range`, of `shape`.

    Raises
    ------
    ContentError
        Naming file, channel, and what was found.
    """
    request = _Request(source, name, channel, shape)
    if channel.variables is not None:
        values = np.stack([_series(request, variable, 0) for variable in channel.variables], axis=-1)
    else:
        values = _series(request, channel.variable or "", len(channel.axis_names))
    if channel.columns is not None:
        order, sign = channel.columns
        values = values[..., order] * np.asarray(sign, dtype=values.dtype)
    outside = np.zeros(values.shape, dtype=bool)
    if channel.range is not None:
        with np.errstate(invalid="ignore"):
            outside = np.asarray((values < channel.range[0]) | (values > channel.range[1]))
        values[outside] = np.nan
    rows = int(np.prod(shape))
    by_row = outside.reshape(rows, -1).any(axis=1).reshape(shape)
    values = values.reshape((rows, *values.shape[len(shape) :]))
    if channel.most_repeats is not None:
        values[repeats(values) > channel.most_repeats] = np.nan
    return values, np.asarray(by_row)


def repeats(values: Float) -> npt.NDArray[np.int64]:
    """Return how often each reading's run holds its number, 1 for the first of a run; (row,) or (row, axis).

    A missing reading begins a run of its own.
    """
    flat = values.reshape(len(values), -1)
    out = np.ones(flat.shape, dtype=np.int64)
    for column, run in zip(flat.T, out.T, strict=True):
        first = np.flatnonzero(np.concatenate([[True], column[1:] != column[:-1]]))
        length = np.diff(np.append(first, column.size))
        run[:] = np.repeat(length, length)
        run[first] = 1
    return out.reshape(values.shape)


def read_for_expression(source: Source, name: str, shape: tuple[int, ...]) -> Array:
    """Read a variable for `good_when`; one value a report is repeated for its samples."""
    variable = source.read(name)
    values = np.asarray(variable.values)
    if variable.scale != (1.0, 0.0):
        values = as_floats(variable)
    if len(shape) == 2 and values.ndim == 1 and len(values) == shape[0]:
        values = values[:, None]
    if len(values) != shape[0]:
        raise ContentError(
            f"variable {name!r} of 'good_when' has shape {values.shape}, the times {shape}",
            remedy="use a variable with one value a row",
            file=str(source.path),
        )
    return values


@dataclass(frozen=True)
class _Request:
    """A channel to be read, and the shape of the times it belongs to."""

    source: Source
    name: str
    channel: Channel
    shape: tuple[int, ...]

    def error(self, message: str, remedy: str) -> ContentError:
        return ContentError(message, remedy=remedy, file=str(self.source.path), channel=self.name)


def _series(request: _Request, variable_name: str, axes: int) -> Float:
    """Read one variable in `channel.unit`: shape of the times, and axes when there are any."""
    variable = request.source.read(variable_name, request.name)
    picked = _pick(request, variable, variable_name, axes)
    # The YAML's fill values are the file's numbers, before any scaling.
    missing = is_missing(picked.values, tuple(request.channel.fill or ()))
    try:
        values = as_floats(picked)
    except ValueError as error:
        raise request.error(
            f"variable {variable_name!r} holds text where numbers belong ({error})",
            "correct the channel in the mission YAML or repair the file",
        ) from None
    values[missing] = np.nan
    if request.channel.factor != 1.0:
        values = np.asarray(values.astype(np.float64) * request.channel.factor)
    unit, goal = request.channel.file_unit or variable.unit, request.channel.unit
    if unit is None:
        return values
    try:
        factor, offset = factor_and_offset(unit, goal)
    except ValueError as error:
        raise request.error(
            f"the file's unit is {unit!r}, the mission YAML's {goal!r} ({error})",
            "correct 'unit', or state the file's true unit in 'file_unit'",
        ) from None
    if (factor, offset) == (1.0, 0.0):
        return values
    return np.asarray(values.astype(np.float64) * factor + offset)


def _pick(request: _Request, variable: Variable, variable_name: str, axes: int) -> Variable:
    """Return the variable in the shape the YAML promises; raise `ContentError` when it has another."""
    values, shape, column = variable.values, request.shape, request.channel.column
    goal = (*shape, axes) if axes else shape
    found = f"variable {variable_name!r} has shape {values.shape}, {goal} is expected"
    if values.shape[: len(shape)] != shape:
        raise request.error(
            f"{found} for times {shape}",
            "correct 'variable' or 'time'; 'flatten: true' joins (report, sample)",
        )
    if values.ndim == len(shape) + 1:
        if column is not None and column < values.shape[-1]:
            values = values[..., column]
        elif not axes and values.shape[-1] == 1:
            values = values[..., 0]
    if values.shape != goal:
        named = f" for axes {', '.join(request.channel.axis_names)}" if axes else ""
        raise request.error(f"{found}{named}", "correct 'axes', or choose one column with 'column'")
    return Variable(values, variable.unit, variable.fill, variable.scale)
