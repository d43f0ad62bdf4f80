"""What drifts within a day: a day's rows hold its scale factors still, and soon after launch they do not.

A scale factor that ages by 5e-6 a day moves the residual by 0.1 nT at both ends of it. How fast it ages the
fit of all days tells, so that each day keeps, beside its equations, the Gram matrix of the columns by which
its residual would follow a drift: the drift is taken out of the equations without a look at a sample.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.calibration import NormalEquations
from inflight.estimators.trend_equations import middles
from inflight.estimators.trends import TrendFit
from inflight.time import DAY

#: Scale factors are the first columns.
SCALES = 3
#: Part of a day over which a trend's rate is taken: shorter than what separates a logarithm from its origin.
_STEP = DAY // 20


@dataclass(frozen=True)
class DayDrift:
    """How the residual of days follows scale factors that drift within the day.

    Attributes
    ----------
    gram : ndarray, shape (block, rate, column + 1 + rate)
        nT^2; products of the drifts' columns, scaled change of the residual for one step of the scale
        factor a day, with the equations' columns, the residual and each other.
    """

    gram: Floats

    def of_blocks(self, index: np.ndarray) -> DayDrift:
        """Return the drift of some blocks."""
        return DayDrift(self.gram[index])

    def taken_out(self, equations: NormalEquations, rate: Floats) -> NormalEquations:
        """Return the equations with a known drift in their residual.

        Parameters
        ----------
        equations : NormalEquations
            Of the same blocks, their residual as it was made: before `NormalEquations.at`.
        rate : ndarray, shape (block, rate)
            Change of each scale factor a day.
        """
        data = equations.dataset
        width = data.sizes["column"]
        step = rate / data["scale"].values[:SCALES]
        gram = data["gram"].values.copy()
        along = np.einsum("bd,bdj->bj", step, self.gram)
        gram[:, -1, :] += along[:, :width]
        gram[:, :, -1] += along[:, :width]
        gram[:, -1, -1] += np.einsum("bd,bd->b", along[:, width:], step)
        return NormalEquations(data.assign(gram=data["gram"].copy(data=gram)))


def rates(fit: TrendFit, equations: NormalEquations) -> Floats:
    """Return how fast the scale factors change in the middles of blocks; (block, rate), a day."""
    times, out = middles(equations), []
    for name in equations.columns[:SCALES]:
        trend, value = fit.trends[name], fit.value[fit.place(name)]
        ends = [trend.basis(times + sign * _STEP, name) @ value for sign in (1, -1)]
        out.append((ends[0] - ends[1]) * (DAY / (2 * _STEP)))
    return np.stack(out, axis=1)
