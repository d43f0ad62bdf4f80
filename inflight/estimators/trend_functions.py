"""Trends as functions of time that are orthonormal over the blocks they are fitted to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.model.dependence import Dependence
from inflight.time import Int64


@dataclass(frozen=True)
class Expansion:
    """Functions of time of every parameter, orthonormal over the blocks, and how to return from them.

    Attributes
    ----------
    functions : mapping of str to ndarray, shape (block, function)
        Of parameters that are expanded: not of constants.
    back : ndarray, shape (coefficient, expanded column)
        Coefficients of the trends from those of the orthonormal functions.
    bases : list of ndarray, shape (block, coefficient)
        Trends at the middles of the blocks.
    unit : ndarray, shape (coefficient, parameter)
        Coefficients of a trend that is 1 at all times, for parameters that are expanded.
    """

    trends: dict[str, Dependence]
    columns: tuple[str, ...]
    functions: dict[str, Floats]
    back: Floats
    bases: list[Floats]
    unit: Floats

    @classmethod
    def of(cls, times: Int64, trends: dict[str, Dependence]) -> Expansion:
        """Make the functions of all parameters for blocks with these middles (block,), TT2000."""
        columns, functions, parts, bases, units = [], {}, [], [], []
        for name, trend in trends.items():
            basis = trend.basis(times, name)
            columns += [f"{name}{suffix}" for suffix in trend.suffixes]
            bases.append(basis)
            if trend.count == 1:
                parts.append(np.eye(1))
                units.append(np.zeros(1))
                continue
            inverse = _orthonormal(basis, name)
            functions[name] = basis @ inverse
            parts.append(inverse)
            units.append(np.ones(trend.count) if trend.at else np.eye(trend.count)[0])
        return cls(trends, tuple(columns), functions, _block_diagonal(parts), bases, _stacked(units))

    @property
    def functions_each(self) -> float:
        """Functions of time of each parameter, on average."""
        return len(self.columns) / max(len(self.trends), 1)

    @property
    def owners(self) -> npt.NDArray[np.int64]:
        """Which parameter each function belongs to; (function,)."""
        return np.repeat(np.arange(len(self.bases)), [basis.shape[1] for basis in self.bases])

    @property
    def values(self) -> Floats:
        """The functions at the blocks, constants 1; (block, function)."""
        pairs = zip(self.trends, self.bases, strict=True)
        return np.concatenate([self.functions.get(name, basis) for name, basis in pairs], axis=1)

    def parameters(self, coefficients: Floats) -> Floats:
        """Return what coefficients of the functions (function,) make of parameters; (block, parameter)."""
        ends = np.cumsum([basis.shape[1] for basis in self.bases])
        whole = self.values * coefficients
        return np.asarray(np.add.reduceat(whole, np.append(0, ends[:-1]), axis=1))


def _orthonormal(basis: Floats, name: str) -> Floats:
    """Return what makes the columns of a basis (block, function) orthogonal with unit rms."""
    size = np.sqrt(np.mean(basis**2, axis=0))
    triangle = np.linalg.qr(basis / size, mode="r")
    own = np.abs(np.diag(triangle))
    if len(basis) < basis.shape[1] or own.min() < 1e-9 * own.max():
        raise CalibrationError(
            f"{len(basis)} blocks do not tell the {basis.shape[1]} coefficients of the trend of '{name}'",
            remedy="use a simpler trend, or a longer span",
        )
    return np.asarray(np.linalg.inv(triangle) * np.sqrt(len(basis)) / size[:, None])


def _block_diagonal(parts: list[Floats]) -> Floats:
    out = np.zeros((sum(part.shape[0] for part in parts),) * 2)
    at = 0
    for part in parts:
        out[at : at + len(part), at : at + len(part)] = part
        at += len(part)
    return out


def _stacked(units: list[Floats]) -> Floats:
    out = np.zeros((sum(unit.size for unit in units), len(units)))
    at = 0
    for index, unit in enumerate(units):
        out[at : at + unit.size, index] = unit
        at += unit.size
    return out
