"""What trends are fitted to: normal equations of blocks, made from a table too, with robust weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NormalEquations
from inflight.calibration.equations import RESIDUAL
from inflight.calibration.robust import robust_sigma
from inflight.errors import CalibrationError
from inflight.model.dependence import Dependence
from inflight.time import DAY, Int64

TREND_KINDS = ("constant", "linear", "parabola", "log", "spline")
#: Blocks up to this many robust standard deviations from the trend keep their weight; from the second
#: number on they have none.
_FAR, _LOST = 4.0, 8.0
#: Blocks that are solved together.
_AT_ONCE = 256
#: Fewest blocks whose scatter tells an outlying one.
_FEWEST = 8


def middles(equations: NormalEquations) -> Int64:
    """Return the TT2000 of the middles of the blocks; (block,)."""
    data = equations.dataset
    return np.asarray(data["start"].values // 2 + data["end"].values // 2)


def at_one_reference(equations: NormalEquations) -> NormalEquations:
    """Return the equations with the residuals of all blocks referred to the first one's reference."""
    apart = np.ptp(equations.dataset["reference"].values, axis=0).any()
    return equations.at(equations.reference) if apart else equations


def make_trend(kind: str, times: Int64, t0: int | None = None, per: int = DAY, knots: int = 5) -> Dependence:
    """Return a kind of trend for a span of times.

    Parameters
    ----------
    kind : str
        constant, linear, parabola (``a + b x + c x^2``, ``x = (t - t0)/per``), log
        (``a + b ln((t - t0)/per)``, Yin 2010 section 3.2) or spline (natural cubic).
    times : ndarray of int64, shape (block,)
        TT2000; a spline has its knots at equal parts of them, so that gaps hold none.
    t0 : int, optional
        Origin; for linear and parabola the middle of the times when absent.

    Raises
    ------
    CalibrationError
        For an unknown kind, a logarithm without an origin before the times, or too few times for a spline.
    """
    if kind not in TREND_KINDS:
        raise CalibrationError(f"trend {kind!r} is unknown", remedy=f"one of {', '.join(TREND_KINDS)}")
    if kind == "constant":
        return Dependence()
    if kind == "spline":
        places = np.quantile(times.astype(np.float64), np.linspace(0, 1, knots)).astype(np.int64)
        if np.unique(places).size < max(knots, 2):
            raise CalibrationError(f"{times.size} times make no {knots} knots", remedy="ask for fewer knots")
        return Dependence("spline", at=tuple(int(place) for place in places))
    if kind == "log" and (t0 is None or t0 >= times.min()):
        raise CalibrationError(
            "a logarithm of time needs an origin before its first time", remedy="give t0, or have it fitted"
        )
    origin = int(times.min() // 2 + times.max() // 2) if t0 is None else t0
    return Dependence(kind, origin, per)


def equations_of_table(table: xr.Dataset) -> NormalEquations:
    """Return normal equations that hold what a calibration table says: generalised least squares.

    An interval with values v and covariance C gives the equations ``|C^-1/2 (p - v)|^2``: a residual of
    unit variance. Values that are NaN or not `determined` (they lean on their prior) are left out with
    their part of the covariance.

    Parameters
    ----------
    table : xarray.Dataset
        dims interval, parameter(, other): `value`, `covariance` or `sigma`, `start`, `end` (TT2000), and
        `determined` where known.

    Raises
    ------
    CalibrationError
        When nothing in the table is determined.
    """
    value = table["value"].values
    known = np.isfinite(value) & np.isfinite(table["sigma"].values) & (table["sigma"].values > 0)
    if "determined" in table:
        known &= table["determined"].values
    if not known.any():
        raise CalibrationError("the table determines no parameter", remedy="use longer intervals")
    seen = np.where(known, table["sigma"].values, np.nan)
    # A parameter that no interval knows has an empty column, of any unit.
    scale = np.array([np.median(one[np.isfinite(one)]) if np.isfinite(one).any() else 1.0 for one in seen.T])
    centre = np.array(
        [np.median(one[use]) if use.any() else 0.0 for one, use in zip(value.T, known.T, strict=True)]
    )
    grams = np.array(
        [_gram(value[i], _covariance(table, i), known[i], scale, centre) for i in range(len(value))]
    )
    return _as_equations(table, grams, known.sum(axis=1), scale, centre)


def _covariance(table: xr.Dataset, index: int) -> Floats:
    if "covariance" in table:
        return np.asarray(table["covariance"].values[index])
    return np.asarray(np.diag(table["sigma"].values[index] ** 2))


def _gram(value: Floats, covariance: Floats, known: np.ndarray, scale: Floats, centre: Floats) -> Floats:
    use = np.flatnonzero(known)
    gram = np.zeros((scale.size + 1, scale.size + 1))
    if use.size == 0:
        return gram
    unit = scale[use]
    information = np.linalg.inv(covariance[np.ix_(use, use)] / np.outer(unit, unit))
    away = (value[use] - centre[use]) / unit
    gram[np.ix_(use, use)] = information
    gram[use, -1] = gram[-1, use] = -information @ away
    gram[-1, -1] = away @ information @ away
    return gram


def _as_equations(
    table: xr.Dataset, grams: Floats, count: Floats, scale: Floats, centre: Floats
) -> NormalEquations:
    names = [*(str(name) for name in table["parameter"].values), RESIDUAL]
    # The stated covariances say how far scores scatter within an interval: variance one.
    scatter = grams.copy()
    scatter[:, -1, :] = scatter[:, :, -1] = 0.0
    row = ("block", "column", "other")
    reference = np.broadcast_to(np.append(centre, 0.0), (len(grams), centre.size + 1))
    kept = {name: table.attrs.get(name, "") for name in ("comparison", "model")}
    dataset = xr.Dataset(
        {
            "gram": (row, grams, {"units": "1"}),
            "scatter": (row, scatter, {"units": "1"}),
            "reference": (("block", "column"), reference),
            "start": ("block", np.asarray(table["start"].values, dtype=np.int64)),
            "end": ("block", np.asarray(table["end"].values, dtype=np.int64)),
            "count": ("block", count.astype(np.float64)),
            "scale": ("column", np.append(scale, 1.0)),
        },
        coords={"column": names, "other": names},
        attrs={**kept, "filter": "table"},
    )
    return NormalEquations(dataset.isel(block=np.flatnonzero(count > 0)))


def own_wish(equations: NormalEquations, value: Floats, prior_sigma: Floats) -> Floats:
    """Return how far each block lies from given parameters: by how much its own fit would lower its sum.

    Parameters
    ----------
    value : ndarray, shape (block, column)
        Physical units.
    prior_sigma : ndarray, shape (column,)
        Directions that a block does not know better than this are no wish of its own.

    Returns
    -------
    ndarray, shape (block,)
        Square root of the drop of the sum of squares.
    """
    data = equations.dataset
    scale, gram = data["scale"].values[:-1], data["gram"].values
    change = (value - data["reference"].values[:, :-1]) / scale
    matrix = gram[:, :-1, :-1]
    scores = gram[:, :-1, -1] + np.matmul(matrix, change[:, :, None])[:, :, 0]
    own = gram[:, -1, -1] / np.maximum(data["count"].values, 1.0)
    variance = max(float(np.median(own)), 1e-30)
    with np.errstate(divide="ignore"):
        held = np.where(prior_sigma > 0, variance * (scale / prior_sigma) ** 2, np.inf)
    free = np.flatnonzero(np.isfinite(held))
    out = np.empty(len(scores))
    # Some blocks at a time: a matrix of each of three thousand days would fill the memory.
    for first in range(0, len(scores), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        steadied = matrix[part][:, free[:, None], free] + np.diag(held[free])
        score = scores[part][:, free]
        wish = np.linalg.solve(steadied, score[:, :, None])[:, :, 0]
        out[part] = np.sqrt(np.maximum(np.einsum("bi,bi->b", wish, score), 0.0))
    return out


def outlier_weights(distance: Floats) -> Floats:
    """Return a weight a block, 0 to 1, from distances (block,): only far ones lose their say.

    The scale is the spread of the distances themselves, so that what wanders from day to day is no outlier.
    """
    if distance.size < _FEWEST:
        return np.ones_like(distance)
    centre = float(np.median(distance))
    spread = robust_sigma(distance - centre)
    # Distances of few dimensions scatter by at least a part of their size.
    z = (distance - centre) / max(spread, 0.1 * centre, 1e-300)
    return np.asarray(np.clip((_LOST - z) / (_LOST - _FAR), 0.0, 1.0))


def values_at(trends: Mapping[str, Dependence], coefficients: Mapping[str, Floats], times: Int64) -> Floats:
    """Return the parameters that trends give at times; (time, parameter)."""
    return np.stack([trends[name].basis(times, name) @ coefficients[name] for name in trends], axis=1)


def check_names(equations: NormalEquations, names: Sequence[str]) -> None:
    """Refuse trends of parameters that the equations do not hold.

    Raises
    ------
    CalibrationError
    """
    if stray := [name for name in names if name not in equations.columns]:
        raise CalibrationError(
            f"no parameter {stray[0]!r} among {', '.join(equations.columns)}", remedy="name one of these"
        )
