"""What leaves no tone, from a model of the Earth's field near perigee: gains, rotation and third offset.

A field ``D B`` with a turn about the spin axis, a factor in the spin plane and one along the axis has no
tones where B has none (`inflight.spin.update.held_slopes`; Plaschke et al. 2019, section 4, keep the ground's
values). A known field tells D: with f the despun field that ground values of `HELD` give, t the model's, both
means over whole turns in payload axes, ::

    t - f = A(f) d - e - w x t + noise,   A(f) d = (p fx - r fy, p fy + r fx, q fz + s)

(p, q, r, s) = `held_response` d, d the changes of the four, e a uniform field that the model lacks and w what
the stated spin axis is off by, two angles across it. e and w are fitted, each held by what is known of it.
d is always counted from the ground's values: applied once, it leaves nothing to apply again.

What the model lacks besides is no white noise: errors come from the scatter of sums over ten minutes, their
neighbours within an hour and a half correlated (Bartlett's kernel); no error is below that of the scatter
pooled over the four.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from inflight.arrays import Floats, finite_rows
from inflight.frames import cross
from inflight.lsq import bartlett_covariance
from inflight.spin.equation import CalibrationParameters
from inflight.spin.update import held_response
from inflight.time import SECOND, Int64


@dataclass(frozen=True, kw_only=True)
class HeldFitSettings:
    """Numbers of the fit.

    Attributes
    ----------
    segment_ns : int
        Time of a sum, ns (assumed).
    lags : int
        Neighbouring sums that may be correlated: an hour and a half (measured: with an hour errors were a
        tenth smaller and too small).
    taken : int
        Sums that the scatter is short of: three numbers a component are fitted, each of them follows what is
        correlated (derived; measured: without it errors were 1.4 to 1.8 times too small).
    fewest : int
        Fewer sums tell nothing: five and a half hours, three passages of perigee (derived from `taken`).
    axis_sigma : float
        What a stated spin axis may be off by, rad (assumed: a degree).
    passes : int
        The weight of what is known before depends on the noise, which the fit tells (assumed).
    """

    segment_ns: int = 600 * SECOND
    lags: int = 9
    taken: int = 27
    fewest: int = 33
    axis_sigma: float = 0.0175
    passes: int = 3


HELD_FIT_SETTINGS = HeldFitSettings()

#: Columns of the sums: the four, a uniform field, two angles of the axis, and the difference of both fields.
_OWN, _UNIFORM, _AXIS, _LEFT = slice(0, 4), slice(4, 7), slice(7, 9), 9
#: Rows and columns of a sum, the last one for how many means are in it.
SUM_WIDTH = 11


@dataclass(frozen=True)
class HeldFit:
    """Values of `HELD` in a span.

    Attributes
    ----------
    value : ndarray, shape (4,)
        Changes from the ground's values.
    covariance : ndarray, shape (4, 4)
    before, after : float
        Rms of a component of the difference to the model, nT.
    """

    value: Floats
    covariance: Floats
    before: float
    after: float


def sums_near_earth(field: Floats, model: Floats, stamps: Int64, parameters: CalibrationParameters) -> Floats:
    """Return the sums of ten minutes each that `fit_held` is made of; (sum, 11, 11).

    Parameters
    ----------
    field, model : ndarray, shape (mean, 3)
        Means over the same samples, payload axes, nT; rows with NaN are left out.
    stamps : ndarray of int64, shape (mean,)
        Rising.
    parameters : CalibrationParameters
        That `field` is made with.
    """
    known = finite_rows(field) & finite_rows(model)
    field, model, stamps = field[known], model[known], stamps[known]
    columns = np.zeros((stamps.size, 3, SUM_WIDTH))
    plane, along, turn, shift = held_response(parameters)
    columns[:, 0, _OWN] = field[:, :1] * plane - field[:, 1:2] * turn
    columns[:, 1, _OWN] = field[:, 1:2] * plane + field[:, :1] * turn
    columns[:, 2, _OWN] = field[:, 2:] * along + shift
    columns[:, :, _UNIFORM] = -np.eye(3)
    for at, one in enumerate(np.eye(3)[:2]):
        columns[:, :, _AXIS.start + at] = -cross(np.broadcast_to(one, model.shape), model)
    columns[:, :, _LEFT] = model - field
    columns[:, 0, -1] = 1.0
    segment = (stamps - stamps[:1]) // HELD_FIT_SETTINGS.segment_ns
    out = [
        np.einsum("tai,taj->ij", columns[segment == one], columns[segment == one])
        for one in np.unique(segment)
    ]
    return np.array(out).reshape(-1, SUM_WIDTH, SUM_WIDTH)


def fit_held(sums: Floats, value: Floats, sigma: Floats, external_nT: float) -> HeldFit | None:
    """Solve sums for the four of `HELD`; None where they are too few.

    Parameters
    ----------
    sums : ndarray, shape (sum, 11, 11)
        In order of time.
    value, sigma : ndarray, shape (4,)
        What is known before of their changes from the ground's values.
    external_nT : float
        Standard deviation of a uniform field that the model lacks, along each payload axis.
    """
    sums = sums[sums[:, -1, -1] > 0.0]
    if len(sums) < HELD_FIT_SETTINGS.fewest:
        return None
    total, free = sums.sum(axis=0), _LEFT
    count = 3.0 * float(total[-1, -1])
    errors = np.concatenate([sigma, np.full(3, external_nT), np.full(2, HELD_FIT_SETTINGS.axis_sigma)])
    start = np.concatenate([value, np.zeros(5)])
    # In units of what is known before, all columns are of one size and its information is one.
    columns = np.append(errors, 1.0)
    scaled = sums[:, :-1, :-1] * np.outer(columns, columns)
    normal = scaled[:, :free, :free].sum(axis=0)
    slopes = scaled[:, :free, _LEFT] - np.einsum("sij,j->si", scaled[:, :free, :free], start / errors)
    left = float(total[_LEFT, _LEFT]) / count
    noise, excess, change = left, 1.0, np.zeros(free)
    inverse = meat = np.eye(free)
    for _ in range(HELD_FIT_SETTINGS.passes):
        inverse = scipy.linalg.inv(normal / (noise * excess) + np.eye(free))
        change = inverse @ slopes.sum(axis=0) / (noise * excess)
        found = np.append(start / errors + change, -1.0)
        noise = max(float(np.einsum("i,sij,j->", found, scaled, found)) / count, 1e-12)
        scores = slopes - np.einsum("sij,j->si", scaled[:, :free, :free], change)
        part = len(sums) / (len(sums) - HELD_FIT_SETTINGS.taken)
        meat = part * bartlett_covariance(scores - scores.mean(axis=0), HELD_FIT_SETTINGS.lags)
        ratio = np.diag(meat)[_OWN] / (noise * np.diag(normal)[_OWN])
        excess = max(1.0, float(ratio.mean()))
    # Scatter of the scores, and what is known before being off, with the weights of the estimate.
    inverse = scipy.linalg.inv(normal / (noise * excess) + np.eye(free))
    change = inverse @ slopes.sum(axis=0) / (noise * excess)
    covariance = inverse @ (meat / (noise * excess) ** 2 + np.eye(free)) @ inverse
    # The scatter along one column alone comes from a few passages: where it happens to be small, the one
    # pooled over the four stands.
    wider = np.sqrt(np.maximum(1.0, np.diag(inverse) / np.diag(covariance)))
    covariance = covariance * np.outer(wider * errors, wider * errors)
    known = (start + change * errors)[_OWN]
    return HeldFit(known, covariance[_OWN, _OWN], float(np.sqrt(left)), float(np.sqrt(noise)))
