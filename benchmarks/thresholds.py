"""Jumps by the published thresholds: neighbours compared (Venus Express paper, equations 6 and 7).

A step must exceed some six standard deviations of a sample, where `jumps.find_jumps` sees a part of one.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from inflight.arrays import Floats
from inflight.dual import Rows
from inflight.errors import SettingsError


def false_alarm_probability(threshold: float, *, components: str = "sum") -> float:
    """Return how often white noise alone exceeds the published thresholds.

    Parameters
    ----------
    threshold : float
        In standard deviations of one component of the difference, one sample.
    components : str
        ``sum`` for ``|d Bx| + |d By| + |d Bz|`` (equation 6), ``any`` for one at least (equation 7).

    Raises
    ------
    SettingsError
    """
    if components not in ("sum", "any"):
        raise SettingsError(
            f"components is {components!r}", remedy="'sum' (equation 6) or 'any' (equation 7)"
        )
    # The step between two samples has twice the variance of one.
    normal = threshold / np.sqrt(2.0)
    if components == "any":
        return float(1.0 - (1.0 - 2.0 * stats.norm.sf(normal)) ** 3)
    grid = np.linspace(0.0, normal, 2001)
    width = grid[1] - grid[0]
    one = 2.0 * stats.norm.pdf(grid)
    below = 2.0 * stats.norm.cdf(grid) - 1.0
    two = np.array([np.trapezoid(one[: k + 1] * one[k::-1], dx=width) for k in range(grid.size)])
    return float(1.0 - np.trapezoid(two * below[::-1], dx=width))


def published_jumps(
    difference: Floats, *, sum_threshold: float | None = None, component_threshold: float | None = None
) -> Rows:
    """Return the samples that differ from the one before by more than a threshold (equations 6 and 7).

    Parameters
    ----------
    difference : ndarray, shape (time, axis)
        nT; a missing sample makes no jump.
    sum_threshold, component_threshold : float, optional
        nT. The paper prints none: `false_alarm_probability` tells what a multiple of the noise means.

    Returns
    -------
    ndarray of int64, shape (jump,)
        Rows of the first samples after a jump.

    Raises
    ------
    SettingsError
        Neither threshold is given.
    """
    if sum_threshold is None and component_threshold is None:
        raise SettingsError("no threshold of a jump is given", remedy="give one for the sum or a component")
    step = np.abs(np.diff(difference, axis=0))
    over = np.zeros(len(step), dtype=bool)
    if sum_threshold is not None:
        over |= step.sum(axis=1) > sum_threshold
    if component_threshold is not None:
        over |= (step > component_threshold).any(axis=1)
    return np.flatnonzero(over).astype(np.int64) + 1
