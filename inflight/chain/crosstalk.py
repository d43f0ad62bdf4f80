"""Cross-talk of a whole mission: what one unit of a cause that is ignored does to everything else.

Two answers from the same stored equations. With the nine parameters alone, as a scalar calibration fits them,
a cause goes into them as far as they can imitate it (Yin 2010, section 4.2). With everything of the model
fitted together the others share what one of them ignores: with C the covariance, leaving out a parameter j of
size c moves parameter i by ``-C_ij / C_jj c``, which is the same least squares written with the inverse.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NormalEquations
from inflight.chain.wide import terms_of
from inflight.errors import CalibrationError
from inflight.estimators.absorption import correlation_of
from inflight.estimators.crosstalk import SHOWN, CrossTalkTable, Ignored, cross_talk
from inflight.estimators.rows import NINE, NINE_UNITS
from inflight.model import Model

#: How much of a cause is asked about, by its unit: 10 ms, 1 ppm/K, ...
SIZES = {
    "s": 0.01,
    "s^2": 0.01,
    "1": 1e-6,
    "deg": 1.0 / 3600.0,
    "1/K": 1e-6,
    "1/K^2": 1e-8,
    "1/nT": 1e-12,
    "1/nT^2": 1e-16,
}
#: The bias of the thesis' example, nT.
_BIAS = 0.4
#: Parts of the span, of which each is left out once for the error.
_PARTS = 10


def causes_of(columns: Sequence[str], units: Mapping[str, str], model: Model) -> list[Ignored]:
    """Return columns as causes of a size that people ask about; of a scalar bias 0.4 nT.

    Parameters
    ----------
    columns : sequence of str
        Of the equations.
    units : mapping of str to str
        Of columns; nT where none is told.
    model : Model
        Tells which cause is a bias of the scalar sensor.
    """
    biases = {f"{entry.name}.bias" for entry in model.effects if entry.effect.name == "scalar_bias"}
    found = []
    for name in columns:
        unit = units.get(name, "nT")
        size = _BIAS if name in biases else SIZES.get(unit, 1.0)
        found.append(Ignored(name, size, unit))
    return found


def of_the_nine(equations: NormalEquations, units: Mapping[str, str], model: Model) -> CrossTalkTable:
    """Return what every other column, ignored, does to the nine parameters fitted alone.

    Parameters
    ----------
    equations : NormalEquations
        Of days, the model's columns and any beside them.
    units, model
        As `causes_of`.
    """
    nine = equations.columns[:9]
    causes = causes_of(equations.columns[9:], units, model)
    if not causes:
        raise CalibrationError(
            "the model has nothing but the nine parameters that data may move",
            remedy="give an effect a sigma in the model's file",
        )
    told = dict(zip(nine, (NINE_UNITS[name] for name in NINE), strict=True))
    return cross_talk(equations.filled, causes, nine, told)


def of_everything(equations: NormalEquations, units: Mapping[str, str], model: Model) -> xr.Dataset:
    """Return what each parameter, ignored, does to all others that are fitted together.

    Parameters
    ----------
    equations : NormalEquations
        Of days, the model's columns alone; what is known beforehand of them holds them.
    units, model
        As `causes_of`.

    Returns
    -------
    xarray.Dataset
        dims ignored, parameter: `value` and `sigma`, from leaving out tenths of the span, in `units`
        (parameter); `correlation` of both errors; `size`, `size_units` (ignored). NaN where both are one.

    Raises
    ------
    CalibrationError
        When there is no block.
    """
    filled = equations.filled
    if not len(filled):
        raise CalibrationError("no day tells anything", remedy="see the failed days of the chain")
    sigma = np.array([one for term in terms_of(model) for one in term.sigma])
    data = filled.dataset
    scale, gram = data["scale"].values[:-1], data["gram"].values
    prior, names = sigma / scale, filled.columns
    causes = causes_of(names, units, model)
    shown = [SHOWN.get(units.get(name, ""), (1.0, units.get(name, ""))) for name in names]
    factor = scale * np.array([one for one, _ in shown])
    size = np.array([one.size for one in causes]) / scale
    total, count = gram.sum(axis=0), float(data["count"].values.sum())
    parts = np.array_split(np.arange(len(gram)), min(_PARTS, len(gram)))
    whole = _covariance(total, count, prior)
    value = _shifts(whole) * np.outer(size, factor)
    if len(parts) > 1:
        rest = [(gram[part].sum(axis=0), float(data["count"].values[part].sum())) for part in parts]
        others = np.array([_shifts(_covariance(total - one, count - rows, prior)) for one, rows in rest])
        spread = others - others.mean(axis=0)
        error = np.sqrt((len(parts) - 1) / len(parts) * np.sum(spread**2, axis=0)) * np.outer(size, factor)
    else:
        error = np.full_like(value, np.nan)
    both = ("ignored", "parameter")
    return xr.Dataset(
        {
            "value": (both, value),
            "sigma": (both, error),
            "correlation": (both, correlation_of(whole)),
            "units": ("parameter", np.array([unit for _, unit in shown], dtype="U16")),
            "size": ("ignored", np.array([one.size for one in causes])),
            "size_units": ("ignored", np.array([one.unit for one in causes], dtype="U16")),
        },
        coords={"ignored": names, "parameter": names},
        attrs={"blocks": len(filled)},
    )


def _covariance(gram: Floats, count: float, prior: Floats) -> Floats:
    """Return the covariance of all columns, scaled, for white residuals; 0 for what is fixed."""
    free = np.flatnonzero(prior > 0)
    matrix, unit = gram[:-1, :-1][np.ix_(free, free)], prior[free]
    found = np.zeros_like(gram[:-1, :-1])
    variance = float(gram[-1, -1]) / max(count, 1.0)
    for _ in range(2):
        bread = np.linalg.inv(matrix * np.outer(unit, unit) / variance + np.eye(free.size))
        answer = -unit * (bread @ (unit * gram[free, -1])) / variance
        own = float(gram[-1, -1] + 2 * answer @ gram[free, -1] + answer @ matrix @ answer)
        variance = max(own, 1e-30) / max(count, 1.0)
    found[np.ix_(free, free)] = bread * np.outer(unit, unit)
    return found


def _shifts(covariance: Floats) -> Floats:
    """Return by how much parameters (second) move for one scaled unit of an ignored one (first)."""
    own = np.diag(covariance)
    found = -covariance / np.where(own > 0, own, np.inf)[:, None]
    np.fill_diagonal(found, np.nan)
    return np.asarray(found)
