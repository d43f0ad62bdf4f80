"""A linear fit that outliers do not move, with errors that know the correlation of the values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.calibration.robust import biweight, biweight_slope, robust_sigma
from inflight.estimators.longrun import long_run_covariance

_TURNS = 12


@dataclass(frozen=True)
class RobustFit:
    """A fit by biweights.

    Attributes
    ----------
    value, covariance : ndarray, shape (column,), (column, column)
    left : ndarray, shape (row,)
        Values less the fit.
    say : ndarray, shape (row,)
        1 for a value that counts wholly, 0 for one that does not.
    scatter : float
        Robust standard deviation of the values beyond their stated errors.
    """

    value: Floats
    covariance: Floats
    left: Floats
    say: Floats
    scatter: float

    @property
    def outlying(self) -> int:
        """How many values lost most of their say."""
        return int(np.sum(self.say < 0.2))


def robust_fit(rows: Floats, value: Floats, variance: Floats, functions: float) -> RobustFit:
    """Fit values by rows.

    Parameters
    ----------
    rows : ndarray, shape (row, column)
        In order of time.
    value, variance : ndarray, shape (row,)
        Values and the variances stated for them.
    functions : float
        As in `long_run_covariance`.
    """
    size = np.maximum(np.abs(rows).max(axis=0), 1e-300)
    unit = rows / size
    say, extra = np.ones(value.size), 0.0
    for _ in range(_TURNS):
        sigma2 = variance + extra
        root = np.sqrt(say / sigma2)
        found = np.linalg.lstsq(unit * root[:, None], value * root)[0]
        left = value - unit @ found
        usual = robust_sigma(left)
        extra = max(usual**2 - float(np.median(variance)), 1e-12 * float(np.median(variance)))
        pull = left / np.sqrt(variance + extra)
        say = biweight(pull)
    slope = biweight_slope(pull) / (variance + extra)
    weight = say / (variance + extra)
    bread = np.linalg.inv(_at_least((unit * slope[:, None]).T @ unit, (unit * weight[:, None]).T @ unit))
    scores = unit * (weight * left)[:, None]
    covariance = bread @ long_run_covariance(scores, functions) @ bread
    return RobustFit(found / size, covariance / np.outer(size, size), left, say, float(np.sqrt(extra)))


def _at_least(slopes: Floats, weights: Floats) -> Floats:
    """Return the sum of slopes, or a part of that of the weights where outliers make it small."""
    share = float(np.trace(slopes) / max(np.trace(weights), 1e-300))
    return slopes if share > 0.3 else 0.3 * weights
