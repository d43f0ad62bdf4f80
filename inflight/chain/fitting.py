"""Fits of all days with more columns than the model has, everything else as the continuous fit had it."""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.calibration import NormalEquations
from inflight.chain.continuous import Continuous
from inflight.estimators.trends import TrendFit, fit_trends


def fitted_beside(
    wide: NormalEquations, equations: NormalEquations, found: Continuous, sigma: Floats
) -> TrendFit:
    """Fit all columns to all days, with the trends of the continuous fit and the weights it gave to days.

    Parameters
    ----------
    wide : NormalEquations
        The days' equations with more columns, of all days or some.
    equations : NormalEquations
        Those the continuous fit was made from.
    found : Continuous
    sigma : ndarray, shape (column,)
        What is known beforehand of each, physical units.
    """
    of = dict(zip(equations.dataset["start"].values.tolist(), found.fit.weight.tolist(), strict=True))
    weight = np.array([of[one] for one in wide.dataset["start"].values.tolist()])
    trends = {name: one for name, one in found.fit.trends.items() if one.count > 1}
    return fit_trends(wide, trends, sigma, weight, found.fit.units)
