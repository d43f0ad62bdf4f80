"""Cross-talk: what an ignored cause does to the parameters that are fitted without it.

With X the columns of the fitted parameters and z that of a cause, both derivatives of the corrected
residual, a cause of size c that is in the readings but not in the model leaves ``-z c`` in the
residual. Least squares gives ``p = (X^T X)^-1 X^T z c``: the parameters stand in for the cause
as far as they can, and ``z c - X p`` remains. It is straight in c and needs Gram matrices only, so the
table follows from stored normal equations (Yin 2010, section 4.2; derived here).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NINE_PARAMETER_NAMES, NINE_PARAMETER_UNITS, NormalEquations
from inflight.errors import CalibrationError, SamplesError
from inflight.lsq import regression_coefficients

#: Units in which shifts of the nine are shown: unit of the column -> factor and shown unit.
DISPLAY_UNITS = {"1": (1e6, "ppm"), "deg": (3600.0, "arcsec"), "nT": (1.0, "nT")}


@dataclass(frozen=True)
class IgnoredCause:
    """A cause that is in the readings and not in the model.

    Attributes
    ----------
    column : str
        Its column in the normal equations.
    size : float
        How large it is, in `unit`.
    unit : str
    name : str
        For tables; the column when empty.
    """

    column: str
    size: float = 1.0
    unit: str = "nT"
    name: str = ""

    @property
    def label(self) -> str:
        """Name, size and unit in one."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.name or self.column} = {self.size:g}{unit}"


@dataclass(frozen=True)
class CrossTalkTable:
    """Shifts of fitted parameters by ignored causes.

    Attributes
    ----------
    ignored : tuple of Ignored
    parameters, units : tuple of str
        What is fitted, and the unit of its shift.
    shift : ndarray, shape (ignored, parameter)
        All blocks as one calibration.
    scatter : ndarray, shape (ignored, parameter)
        Standard deviation of the shift from block to block, each calibrated by itself; NaN for one block.
    blocks : int
    before, after : ndarray, shape (ignored,)
        Rms residual that the cause makes, and that remains when the parameters are fitted, nT.
    """

    ignored: tuple[IgnoredCause, ...]
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    shift: Floats
    scatter: Floats
    blocks: int
    before: Floats
    after: Floats

    @classmethod
    def of_table(cls, table: xr.Dataset, names: Sequence[str] = ()) -> CrossTalkTable:
        """Return the shifts that a table was made of, of some causes by name or of all."""
        part = table.sel(ignored=list(names)) if names else table
        rows = zip(*(part[name].values.tolist() for name in ("ignored", "size", "size_units")), strict=True)
        return cls(
            tuple(IgnoredCause(*row) for row in rows),
            tuple(map(str, part["parameter"].values)),
            tuple(map(str, part["units"].values)),
            part["value"].values,
            part["scatter"].values,
            int(part.attrs["blocks"]),
            part["before"].values,
            part["after"].values,
        )

    @property
    def sigma(self) -> Floats:
        """Standard error of the mean shift over blocks; (ignored, parameter)."""
        return np.asarray(self.scatter / np.sqrt(self.blocks))

    @property
    def retained(self) -> Floats:
        """Part of the cause's square that no parameter can explain; (ignored,) in [0, 1]."""
        whole = np.where(self.before > 0, self.before, np.inf)
        return np.asarray((self.after / whole) ** 2)

    def of(self, ignored: str, parameter: str) -> float:
        """Return one shift, by the cause's name or column and the end of the parameter's name."""
        row = [one.name or one.column for one in self.ignored].index(ignored)
        column = [name.endswith(parameter) for name in self.parameters].index(True)
        return float(self.shift[row, column])

    def table(self) -> xr.Dataset:
        """Return the table.

        Returns
        -------
        xarray.Dataset
            dims ignored, parameter: `value`, `sigma`, `scatter` in the units of `units` (parameter);
            `size`, `size_units`, `before`, `after` (nT rms), `retained` (ignored).
        """
        both, each = ("ignored", "parameter"), ("ignored",)
        return xr.Dataset(
            {
                "value": (both, self.shift),
                "sigma": (both, self.sigma),
                "scatter": (both, self.scatter),
                "units": ("parameter", np.array(self.units, dtype="U8")),
                "size": (each, np.array([one.size for one in self.ignored])),
                "size_units": (each, np.array([one.unit for one in self.ignored], dtype="U8")),
                "before": (each, self.before, {"units": "nT"}),
                "after": (each, self.after, {"units": "nT"}),
                "retained": (each, self.retained, {"units": "1"}),
            },
            coords={
                "ignored": [one.name or one.column for one in self.ignored],
                "parameter": list(self.parameters),
            },
            attrs={"blocks": self.blocks},
        )


def cross_talk(
    equations: NormalEquations,
    ignored: Sequence[IgnoredCause],
    fitted: Sequence[str] = NINE_PARAMETER_NAMES,
    units: Mapping[str, str] | None = None,
) -> CrossTalkTable:
    """Return what each ignored cause does to the fitted parameters, alone.

    Parameters
    ----------
    equations : NormalEquations
        With the columns of both, see `inflight.calibration.normal_equations.block_equations`; the residual
        they hold does not matter.
    ignored : sequence of Ignored
        Each by itself; effects add up.
    fitted : sequence of str
        Columns that are fitted; the nine when left out.
    units : mapping of str to str, optional
        Unit of fitted columns that are none of the nine; ``1`` becomes ppm and ``deg`` arcsec.

    Raises
    ------
    CalibrationError
        When a column is missing, there is no block, or a cause is among the fitted.
    """
    both = sorted({one.column for one in ignored} & set(fitted))
    if both:
        raise CalibrationError(
            f"{both} are fitted and ignored at once", remedy="leave them out of one of the two"
        )
    if not len(equations):
        raise CalibrationError("there is no block of normal equations", remedy="give at least one")
    own, other = equations.index(fitted), equations.index([one.column for one in ignored])
    scale = equations.scale
    size = np.array([one.size for one in ignored])
    known = NINE_PARAMETER_UNITS | dict(units or {})
    shown = [DISPLAY_UNITS.get(known.get(name, ""), (1.0, known.get(name, ""))) for name in fitted]
    # From one scaled unit of the cause to its size, from scaled to shown units of the parameter.
    factor = scale[own][:, None] * np.array([one for one, _ in shown])[:, None] * size / scale[other]
    count, wide = float(equations.count.sum()), np.concatenate([own, other])
    total = equations.total
    slopes = regression_coefficients(total, own, other)
    each = equations.rows(wide, wide)
    places = np.arange(wide.size)
    single = (regression_coefficients(each, places[: own.size], places[own.size :]) * factor).swapaxes(1, 2)
    scatter = single.std(axis=0, ddof=1) if len(single) > 1 else np.full(single.shape[1:], np.nan)
    before = np.diag(total)[other]
    explained = np.einsum("fi,fi->i", slopes, total[np.ix_(own, other)])
    unit = (size / scale[other]) ** 2 / count
    return CrossTalkTable(
        tuple(ignored),
        tuple(fitted),
        tuple(unit for _, unit in shown),
        (slopes * factor).T,
        scatter,
        len(equations),
        np.sqrt(before * unit),
        np.sqrt(np.clip(before - explained, 0.0, None) * unit),
    )


def correlation(first: Floats, second: Floats) -> float:
    """Return the correlation of two series or columns (time,) about their means; pairs with NaN are left out.

    Raises
    ------
    SamplesError
        When fewer than three pairs are finite, or one of the series is constant.
    """
    both = np.isfinite(first) & np.isfinite(second)
    if both.sum() < 3:
        raise SamplesError(
            f"{int(both.sum())} pairs of finite samples, three needed", remedy="give longer series"
        )
    a, b = first[both] - first[both].mean(), second[both] - second[both].mean()
    whole = float(np.sqrt((a @ a) * (b @ b)))
    if whole <= 0:
        raise SamplesError(
            "a constant series correlates with nothing", remedy="give series that vary over the span"
        )
    return float(a @ b / whole)
