"""What changed from one calibration table to another: each parameter, in its unit, in sigmas and in nT.

Takes two tables of the same parameters, whatever their intervals: they are compared in the spans in which one
row of each holds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from inflight.arrays import Floats
from inflight.calibration.scalar import PARAMETER_UNITS
from inflight.calibration.table import STRENGTH, calibrated_field, nine_columns, sphere
from inflight.errors import CalibrationError
from inflight.time import Int64

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class ParameterChange:
    """By how much one parameter changed.

    Attributes
    ----------
    parameter, unit : str
    rms, largest : float
        In its unit, over the time that both tables hold; `largest` has its sign.
    at : int
        TT2000, where the largest change begins.
    sigmas : float
        Largest change over the larger of both tables' sigmas; NaN where neither has one.
    field : float
        Rms of what the change does to the calibrated field, nT; NaN where the table does not tell.
    """

    parameter: str
    unit: str
    rms: float
    largest: float
    at: int
    sigmas: float
    field: float


@dataclass(frozen=True)
class TableChanges:
    """Differences of two tables, after less before, in spans in which a row of each holds.

    Attributes
    ----------
    start, end : ndarray of int64, shape (span,)
        Half-open TT2000.
    parameters, units : tuple of str
        Those that both tables have.
    change, sigma : ndarray, shape (span, parameter)
        In `units`; the larger sigma of both.
    field_each : ndarray, shape (span, parameter)
        What the change of each parameter alone does to the calibrated field, nT, rms over directions of a
        field of `strength`; of a parameter in nT that is its change. NaN where the table is not one of the
        nine parameters of a vector sensor.
    field : ndarray, shape (span,)
        What all changes together do, nT; NaN likewise.
    strength : float
        nT.
    gained, lost : tuple of str
        Parameters that only the later, or only the earlier table has.
    """

    start: Int64
    end: Int64
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    change: Floats
    sigma: Floats
    field_each: Floats
    field: Floats
    strength: float
    gained: tuple[str, ...]
    lost: tuple[str, ...]

    def rows(self) -> list[ParameterChange]:
        """Return the parameters that changed, those that changed by most sigmas first."""
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.where(self.sigma > 0, np.abs(self.change) / self.sigma, np.nan)
        length = (self.end - self.start).astype(np.float64)
        out = []
        for at, (name, unit) in enumerate(zip(self.parameters, self.units, strict=True)):
            change = self.change[:, at]
            known = np.isfinite(change)
            if not change[known].any():
                continue
            place = int(np.nanargmax(np.abs(change)))
            known_ratio = relative[np.isfinite(relative[:, at]), at]
            out.append(
                ParameterChange(
                    parameter=name,
                    unit=unit,
                    rms=_rms(change[known], length[known]),
                    largest=float(change[place]),
                    at=int(self.start[place]),
                    sigmas=float(known_ratio.max()) if known_ratio.size else float("nan"),
                    field=_rms(self.field_each[known, at], length[known]),
                )
            )
        return sorted(out, key=lambda one: -np.nan_to_num(one.sigmas))

    def field_rms(self) -> float:
        """Return the rms of `field` over time, nT."""
        return _rms(self.field, (self.end - self.start).astype(np.float64))


def table_changes(before: xr.Dataset, after: xr.Dataset, strength: float = STRENGTH) -> TableChanges:
    """Compare two calibration tables.

    Parameters
    ----------
    before, after : xarray.Dataset
        dims interval, parameter: `value`; `sigma`, `start`, `end` (TT2000), `units` (parameter).
    strength : float
        Of the field in which changes of scale factors and angles are told in nT.

    Raises
    ------
    CalibrationError
        When a table has no values by interval and parameter, when they share no parameter, or hold at no
        common time.
    """
    for table in (before, after):
        if "value" not in table or table["value"].dims != ("interval", "parameter"):
            kind = str(table.attrs.get("kind", "")) or "other"
            raise CalibrationError(
                f"a table of kind {kind!r} has no values by interval and parameter",
                remedy="compare the products made with it: 'inflight catalog diff BEFORE AFTER'",
            )
    names, others = (tuple(map(str, table["parameter"].values)) for table in (before, after))
    shared = tuple(name for name in names if name in others)
    if not shared:
        raise CalibrationError("the tables share no parameter", remedy="compare tables of one sensor")
    units, later_units = (_units(table.sel(parameter=list(shared))) for table in (before, after))
    if units != later_units:
        raise CalibrationError(f"units changed from {units} to {later_units}")
    start, end, old, new = _common_spans(before, after)
    if not start.size:
        raise CalibrationError("the tables hold at no common time", remedy="compare tables of one span")
    one, other = (
        table.sel(parameter=list(shared)).isel(interval=rows) for table, rows in ((before, old), (after, new))
    )
    first, second = one["value"].values, other["value"].values
    sigma = np.fmax(*(_sigma(table) for table in (one, other)))
    each, whole = _in_field(shared, units, first, second, strength)
    return TableChanges(
        start=start,
        end=end,
        parameters=shared,
        units=units,
        change=second - first,
        sigma=sigma,
        field_each=each,
        field=whole,
        strength=strength,
        gained=tuple(name for name in others if name not in names),
        lost=tuple(name for name in names if name not in others),
    )


def _units(table: xr.Dataset) -> tuple[str, ...]:
    if "units" in table:
        return tuple(map(str, table["units"].values))
    return (str(table["value"].attrs.get("units", "")),) * table.sizes["parameter"]


def _sigma(table: xr.Dataset) -> Floats:
    values = table["value"].values
    return table["sigma"].values if "sigma" in table else np.full(values.shape, np.nan)


def _common_spans(before: xr.Dataset, after: xr.Dataset) -> tuple[Int64, Int64, Int64, Int64]:
    """Return spans in which both tables hold, and the row of each that does."""
    edges = np.unique(
        np.concatenate([table[one].values for table in (before, after) for one in ("start", "end")])
    )
    start, end = edges[:-1], edges[1:]
    rows = []
    for table in (before, after):
        at = np.searchsorted(table["start"].values, start, side="right") - 1
        inside = (at >= 0) & (start < table["end"].values[at])
        rows.append(np.where(inside, at, -1))
    both = (rows[0] >= 0) & (rows[1] >= 0)
    return start[both], end[both], rows[0][both], rows[1][both]


def _in_field(
    names: tuple[str, ...], units: tuple[str, ...], before: Floats, after: Floats, strength: float
) -> tuple[Floats, Floats]:
    """Return what changes do to the field, each alone (span, parameter) and together (span,); nT."""
    each = np.full(before.shape, np.nan)
    in_nt = np.array([unit == "nT" for unit in units])
    each[:, in_nt] = np.abs(after - before)[:, in_nt]
    try:
        order = nine_columns(list(names))
    except CalibrationError:
        order = []
    if tuple(units[place] for place in order) != PARAMETER_UNITS:
        return each, np.full(len(before), np.nan)
    directions, share = sphere()
    readings = strength * directions
    reference = calibrated_field(before[:, order], readings)

    def effect(value: Floats) -> Floats:
        apart = calibrated_field(value[:, order], readings) - reference
        return np.asarray(np.sqrt(np.sum(apart**2, axis=2) @ share))

    for place in order:
        changed = before.copy()
        changed[:, place] = after[:, place]
        each[:, place] = effect(changed)
    return each, effect(after)


def _rms(values: Floats, weights: Floats) -> float:
    return float(np.sqrt(np.average(values**2, weights=weights)))
