"""Each day's own parameters after the continuous fit: what still wanders once everything else is known.

A day's wide equations are expressed at the values of the continuous fit for that day. The nine parameters
of the vector sensor, and named ones such as the time shift, are then solved for; all others stay there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NormalEquations
from inflight.calibration.robust import TO_SIGMA
from inflight.calibration.solution import residual_sum, retained_fraction
from inflight.chain.continuous import Continuous
from inflight.errors import CalibrationError
from inflight.model import Model

#: Parameters of a day whose part that no other explains is below this are not told by it.
_LEAST_RETAINED = 1e-6
#: Fewest differences of neighbouring days that tell more than the days' own errors.
_FEWEST = 10


def shift_columns(model: Model) -> list[str]:
    """Return the columns of a model's time shifts that data may move."""
    return [
        name
        for entry in model.effects
        if entry.effect.name == "time_shift" and entry.parameters["seconds"].free
        for name in entry.parameters["seconds"].columns
    ]


def daily_parameters(equations: NormalEquations, found: Continuous, names: Sequence[str] = ()) -> xr.Dataset:
    """Solve each day for the nine and for named parameters, everything else at the continuous fit.

    The errors are those of what the day's own bins leave. What is correlated for longer than a bin makes
    neighbouring days differ by more than that: a parameter's errors are widened by as much, where there are
    days enough to tell. The own fit's inflation would be too much: it holds what the continuous fit took out.

    Parameters
    ----------
    equations : NormalEquations
        Wide ones of the days.
    found : Continuous
        Fitted to them.
    names : sequence of str
        Further columns to solve for, such as ``time_shift.seconds``.

    Returns
    -------
    xarray.Dataset
        dims interval, parameter: `value`, `sigma`, `continuous` (what the fit of all days has for the day),
        in `units` (parameter); `determined`; `inflation` (parameter), by which errors were widened;
        `start`, `end` TT2000 (interval). NaN where a day tells nothing. No prior enters.

    Raises
    ------
    CalibrationError
        When a name is none of the equations' columns.
    """
    columns = _chosen(equations, names)
    fit, data = found.fit, equations.dataset
    middle = data["start"].values // 2 + data["end"].values // 2
    order = [list(fit.trends).index(name) for name in equations.columns]
    common = fit.values(middle)[:, order]
    places = [equations.columns.index(name) for name in columns]
    scale = data["scale"].values[:-1]
    steps = (common - data["reference"].values[:, :-1]) / scale
    rows = data["count"].values
    grams = data["gram"].values
    solved = [_solved(*one, places) for one in zip(grams, steps, rows.tolist(), strict=True)]
    change, sigma = (np.array([one[part] for one in solved]) * scale[places] for part in (0, 1))
    inflation = _widening(change / sigma)
    sigma = sigma * inflation
    each = ("interval", "parameter")
    return xr.Dataset(
        {
            "value": (each, common[:, places] + change),
            "sigma": (each, sigma),
            "continuous": (each, common[:, places]),
            "determined": (each, np.isfinite(sigma)),
            "inflation": ("parameter", inflation),
            "units": ("parameter", np.array([fit.units.get(name, "") for name in columns], dtype="U16")),
            "start": ("interval", data["start"].values, {"scale": "TT2000"}),
            "end": ("interval", data["end"].values, {"scale": "TT2000"}),
        },
        coords={"parameter": columns},
        attrs={"trend": found.kind},
    )


def _chosen(equations: NormalEquations, names: Sequence[str]) -> list[str]:
    nine = equations.columns[:9]
    if stray := [name for name in names if name not in equations.columns]:
        raise CalibrationError(
            f"no parameter {stray[0]!r} among {', '.join(equations.columns)}", remedy="name one of these"
        )
    return [*nine, *(name for name in names if name not in nine)]


def _solved(gram: Floats, step: Floats, rows: float, places: list[int]) -> tuple[Floats, Floats]:
    """Return change and sigma of the chosen columns, scaled, after a scaled step of all; NaN when untold."""
    matrix = gram[:-1, :-1]
    cross = (gram[:-1, -1] + matrix @ step)[places]
    own = matrix[np.ix_(places, places)]
    size = np.sqrt(np.clip(np.diag(own), 0.0, None))
    change, sigma = np.full((2, len(places)), np.nan)
    kept = np.flatnonzero((size > 0) & (retained_fraction(own) > _LEAST_RETAINED))
    if rows <= kept.size or not kept.size:
        return change, sigma
    unit = size[kept]
    inverse = np.linalg.inv(own[np.ix_(kept, kept)] / np.outer(unit, unit))
    found = -inverse @ (cross[kept] / unit)
    left = residual_sum(gram, step) + float(found @ (cross[kept] / unit))
    change[kept] = found / unit
    sigma[kept] = np.sqrt(np.diag(inverse) * max(left, 0.0) / (rows - kept.size)) / unit
    return change, sigma


def _widening(pulls: Floats) -> Floats:
    """Return by how much more neighbouring days differ than their errors say, at least 1; (parameter,)."""
    out = np.ones(pulls.shape[1])
    for index, column in enumerate(pulls.T):
        apart = np.abs(np.diff(column[np.isfinite(column)])) / np.sqrt(2.0)
        if apart.size >= _FEWEST:
            out[index] = max(TO_SIGMA * float(np.median(apart)), 1.0)
    return out
