"""Normal equations with more columns than the nine: rows of any columns, summed block by block.

Sign: a column is the derivative of the corrected residual dB = |B| - F by its parameter, as in
`inflight.calibration.equations`; a field that a cause *adds* to the vector sensor has the column
``-e . field``, one that it adds to the scalar reading the column ``+field``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration.equations import RESIDUAL, NormalEquations
from inflight.calibration.robust import biweight, robust_sigma
from inflight.calibration.scalar import SUB_BLOCKS, score_scatter
from inflight.calibration.sensor import SCALE, UNITS, Reference, kernel_parameters
from inflight.effects.base import AXES
from inflight.errors import CalibrationError
from inflight.estimators.absorption import gram_inverse
from inflight.geometry import direction_of
from inflight.time import Int64

#: Nine parameters of a perfect sensor: scale factors, angles (deg), offsets (nT).
PERFECT = np.array([1.0] * 3 + [90.0] * 3 + [0.0] * 3)
#: Names of the nine columns, in order, and their units.
NINE = tuple(Reference(PERFECT, np.zeros(9)).columns)
NINE_UNITS = dict(zip(NINE, UNITS, strict=True))
#: Turns of the robust weights; they settle in three or four.
_TURNS = 6
#: Scaled prior sigma with which the scores of sub-blocks are steadied: wider than anything fitted.
_WIDE = 1e4


def nine_columns(field: Floats, value: Floats = PERFECT) -> dict[str, Floats]:
    """Return what one unit of each of the nine parameters adds to the corrected residual.

    Derivatives of |K (E - E0)| (Yin 2010, eq. 2.5) at the corrected field B, with e = B/|B| and
    E - E0 = K^-1 B: ``e_i (E - E0)_j`` for K_ij, ``-K^T e`` for E0; an angle a enters as cos a.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        Corrected field, nT, orthogonal sensor axes.
    value : ndarray, shape (9,)
        Where the derivative is taken: scale factors, angles (deg), offsets (nT).

    Returns
    -------
    dict of str to ndarray, shape (time,)
        nT per 1, per deg and per nT.
    """
    k = kernel_parameters(value)
    matrix = np.array([[k[0], k[3], k[4]], [0.0, k[1], k[5]], [0.0, 0.0, k[2]]])
    reading = np.linalg.solve(matrix, field.T)
    x, y, z = direction_of(field).T
    turn = -np.sin(np.deg2rad(value[3:6])) * np.pi / 180.0
    scale = [x * reading[0], y * reading[1], z * reading[2]]
    angles = [x * reading[1] * turn[0], x * reading[2] * turn[1], y * reading[2] * turn[2]]
    offsets = list(-matrix.T @ np.stack([x, y, z]))
    return dict(zip(NINE, [*scale, *angles, *offsets], strict=True))


def field_columns(
    name: str, direction: Floats, series: Floats, axes: Sequence[str] = AXES
) -> dict[str, Floats]:
    """Return the columns of a field at the vector sensor that follows a series, one an axis.

    Parameters
    ----------
    name : str
        ``effect.parameter``; columns are ``name[axis]``.
    direction : ndarray, shape (time, 3)
        Of the field, sensor axes.
    series : ndarray, shape (time,)
        What the field is in proportion to.
    axes : sequence of str
        Which of x, y, z.

    Returns
    -------
    dict of str to ndarray, shape (time,)
        ``-e_axis series``: nT per nT and unit of the series.
    """
    return {f"{name}[{axis}]": -direction[:, AXES.index(axis)] * series for axis in axes}


def block_equations(
    columns: Mapping[str, Floats],
    residual: Floats,
    span: tuple[int, int],
    good: Floats | None = None,
    robust: bool = True,
    attributes: Mapping[str, Any] | None = None,
) -> NormalEquations:
    """Return the normal equations of one block.

    Parameters
    ----------
    columns : mapping of str to ndarray, shape (time,)
        As `nine_columns` and `field_columns` make them, physical units.
    residual : ndarray, shape (time,)
        nT, at the values the columns were made at, which become the reference 0.
    span : tuple of int
        Half-open TT2000 span of the block.
    good : ndarray, shape (time,), optional
        Weight of each row, 0 to leave it out; rows that are not finite are left out by themselves.
    robust : bool
        Weigh rows down that lie far from a fit of all columns (Tukey's biweight).
    attributes : mapping, optional
        Of the Dataset; comparison, model and filter must agree where equations are added.

    Raises
    ------
    CalibrationError
        When fewer rows are usable than there are columns.
    """
    names = [*columns, RESIDUAL]
    scale = np.array([SCALE[NINE.index(name)] if name in NINE else 1.0 for name in names])
    rows = np.column_stack([*columns.values(), residual]) * scale
    given = np.ones(len(rows)) if good is None else np.asarray(good, dtype=np.float64)
    use = np.isfinite(rows).all(axis=1) & (given > 0)
    if use.sum() <= len(names):
        raise CalibrationError(
            f"{int(use.sum())} usable rows for {len(columns)} columns",
            remedy="take a longer block, or see the coverage and flags of this one",
        )
    rows, weight = rows[use], given[use]
    if robust:
        weight = weight * _biweight(rows, weight)
    parts = np.array_split(rows * np.sqrt(weight)[:, None], min(SUB_BLOCKS, len(rows)))
    grams = np.array([part.T @ part for part in parts])
    return _assembled(grams, float(weight.sum()), names, scale, span, dict(attributes or {}))


def _biweight(rows: Floats, weight: Floats) -> Floats:
    """Weights of rows [columns | residual] about their own fit; (row,) in [0, 1]."""
    found = np.ones(len(rows))
    for _ in range(_TURNS):
        gram = (rows * (weight * found)[:, None]).T @ rows
        change = -gram_inverse(gram[:-1, :-1]) @ gram[:-1, -1]
        rest = rows[:, -1] + rows[:, :-1] @ change
        found = biweight(rest / robust_sigma(rest, floor=1e-9))
    return found


def _assembled(
    grams: Floats, count: float, names: list[str], scale: Floats, span: tuple[int, int], attrs: dict[str, Any]
) -> NormalEquations:
    total = grams.sum(axis=0)
    change = -gram_inverse(total[:-1, :-1]) @ total[:-1, -1]
    scatter = np.zeros_like(total)
    scatter[:-1, :-1] = score_scatter(grams, change, np.full(len(names) - 1, _WIDE))
    row, still = ("block", "column", "other"), np.zeros((1, len(names)))
    dataset = xr.Dataset(
        {
            "gram": (row, total[None], {"units": "nT2"}),
            "scatter": (row, scatter[None], {"units": "nT4", "sub_blocks": len(grams)}),
            "reference": (("block", "column"), still),
            "linearised_at": (("block", "column"), still),
            "start": ("block", np.array([span[0]], dtype=np.int64), {"units": "ns", "scale": "TT2000"}),
            "end": ("block", np.array([span[1]], dtype=np.int64), {"units": "ns", "scale": "TT2000"}),
            "count": ("block", np.array([count])),
            "scale": ("column", scale),
        },
        coords={"column": names, "other": names},
        attrs=attrs,
    )
    return NormalEquations(dataset)


def joined(equations: Sequence[NormalEquations]) -> NormalEquations:
    """Return the equations of all blocks, in order of time.

    Raises
    ------
    CalibrationError
        When there are none, or they do not belong together.
    """
    if not equations:
        raise CalibrationError("there are no normal equations to join", remedy="give at least one block")
    if len(equations) == 1:
        return equations[0]
    # By halves: one after the other would copy all blocks again for each.
    half = len(equations) // 2
    return joined(equations[:half]) + joined(equations[half:])


def places(equations: NormalEquations, names: Sequence[str]) -> Int64:
    """Return where columns stand among all, the residual included.

    Raises
    ------
    CalibrationError
        When one is not there.
    """
    known = [str(name) for name in equations.dataset["column"].values]
    missing = [name for name in names if name not in known]
    if missing:
        raise CalibrationError(
            f"no columns {missing} among {known}", remedy="form the normal equations with these columns"
        )
    return np.array([known.index(name) for name in names], dtype=np.int64)
