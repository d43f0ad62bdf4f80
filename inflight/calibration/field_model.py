"""Twelve parameters of a vector sensor against a model of the Earth's field: ``B = M E + b``.

A platform magnetometer has no absolute instrument beside it; near the Earth a model of the main field in the
sensor's nominal axes takes its place (Olsen, Albini, Bouffard, Parrinello and Toffner-Clausen 2020, for
CryoSat-2). Nine numbers of M are three scale factors, three angles between the axes and three angles of the
sensor's mounting (`euler_angles`); b is the offset with its sign changed.

In go readings and the model's field; `comparison_grams` makes sums of an orbit each, which `fit_twelve`
solves for any span. What the model lacks is no white noise: ionosphere and crust change from one pass to the
next and count by their scatter between blocks, and a field that stays, as that of the ring current, counts as
a uniform one of a stated size along each Earth-fixed axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats, finite_rows
from inflight.effects import Affine
from inflight.errors import ModelError
from inflight.flags import UNUSABLE
from inflight.lsq import BIWEIGHT_WIDTH, bartlett_covariance, sandwich
from inflight.model import correct_plain

if TYPE_CHECKING:
    import xarray as xr

    from inflight.model import Model, ModelEffect


@dataclass(frozen=True, kw_only=True)
class FieldModelSettings:
    """Numbers of the fit.

    Attributes
    ----------
    blocks : int
        Blocks of a day between which the residual's correlation is measured: an hour and a half, about a low
        orbit (assumed).
    lags : int
        Neighbouring blocks that may be correlated (assumed).
    matrix_sigma, shift_sigma : float
        What is known before the fit where the model's YAML states nothing: of an entry of M, and nT
        (assumed: wider than any sensor that works).
    passes : int
        Of the robust weights; they settle in three (measured).
    """

    blocks: int = 16
    lags: int = 2
    matrix_sigma: float = 0.1
    shift_sigma: float = 1e4
    passes: int = 4


FIELD_MODEL_SETTINGS = FieldModelSettings()

#: Columns of the sums: reading (in 10 uT), one, the model's field, three uniform fields of 1 nT, and how fast
#: the model's field changes, nT/s.
_READING, _ONE, _FIELD, _UNIFORM, _RATE = slice(0, 3), 3, slice(4, 7), slice(7, 16), slice(16, 19)
_WIDTH = 19

#: The reading's unit in the sums, nT: with it all columns of a fit are of one size.
_UNIT = 1e4

#: Least variance of a residual, nT^2: readings have a resolution.
_LEAST_NOISE = 1e-6

#: Median of a chi square of three degrees of freedom over its mean.
_MEDIAN_OF_THREE = 2.366 / 3.0


@dataclass(frozen=True)
class TwelveFit:
    """The twelve parameters of a span.

    Attributes
    ----------
    value : ndarray, shape (12,)
        M row by row, then b, nT.
    covariance : ndarray, shape (12, 12)
    determined : ndarray of bool, shape (12,)
        Whether the data say more of a parameter than was known before.
    before, after : float
        Rms of a component at the prior's values and at the fit, nT, robustly weighted.
    count : float
        Sum of the weights.
    late : ndarray, shape (12,)
        By how much one sigma of the sensor's delay moves the parameters; it is in the covariance.
    """

    value: Floats
    covariance: Floats
    determined: npt.NDArray[np.bool_]
    before: float
    after: float
    count: float
    late: Floats


def own_equation(model: Model) -> ModelEffect:
    """Return the model's matrix and shift of the vector sensor.

    Raises
    ------
    ModelError
        When the model has none, or more than one.
    """
    found = [
        entry for entry in model.effects if isinstance(entry.effect, Affine) and entry.sensor.role == "vector"
    ]
    if len(found) != 1:
        raise ModelError(
            f"model '{model.name}' has {len(found)} effects 'affine' of the vector sensor; a comparison with "
            "a field model needs one",
            remedy="add one to the model YAML, or leave the pre-flight model out",
        )
    return found[0]


def prior_of_twelve(model: Model, tt2000: int) -> tuple[Floats, Floats]:
    """Return values and prior sigmas of the twelve parameters; sigma 0 for what the model holds fixed."""
    entry = own_equation(model)
    values, sigmas = [], []
    wide = {"matrix": FIELD_MODEL_SETTINGS.matrix_sigma, "shift": FIELD_MODEL_SETTINGS.shift_sigma}
    for name, usual in wide.items():
        timed = entry.parameters[name]
        values.append(timed.at(tt2000))
        stated = timed.sigma[:, 0]
        known = np.where(np.isfinite(stated), stated, usual)
        sigmas.append(known if timed.free and timed.time == "block" else np.zeros_like(known))
    return np.concatenate(values), np.concatenate(sigmas)


def readings_of(model: Model, samples: xr.Dataset) -> tuple[Floats, Floats, npt.NDArray[np.bool_]]:
    """Return what enters the sensor's equation, the model's field beside it, and which samples are usable.

    Parameters
    ----------
    samples : xarray.Dataset
        With `vector` and `reference` (time, axis), nT, spacecraft axes, as
        `inflight.tasks.archive.load_samples` makes them.

    Returns
    -------
    reading, reference : ndarray, shape (time, 3)
        nT, the sensor's nominal axes.
    good : ndarray of bool, shape (time,)
    """
    own = own_equation(model)
    effects = tuple(entry for entry in model.effects if entry is not own)
    reading = np.asarray(correct_plain(effects, samples)["field"].values, dtype=np.float64)
    reference = own.sensor.rotation.inv().apply(np.nan_to_num(samples["reference"].values, nan=0.0))
    known = finite_rows(np.asarray(samples["reference"].values))
    good = (samples["flag"].values & np.uint32(UNUSABLE)) == 0
    return reading, reference, np.asarray(good & finite_rows(reading) & known)


def comparison_grams(
    reading: Floats,
    reference: Floats,
    uniform: Floats,
    good: npt.NDArray[np.bool_],
    prior: tuple[Floats, Floats],
    blocks: int = FIELD_MODEL_SETTINGS.blocks,
    rate: Floats | None = None,
) -> Floats:
    """Return the sums of consecutive blocks of a record that a fit is made of.

    Parameters
    ----------
    reading, reference : ndarray, shape (time, 3)
        nT.
    uniform : ndarray, shape (time, 3, 3)
        Of Earth-fixed unit vectors (last axis), the components in the sensor's axes.
    good : ndarray of bool, shape (time,)
    prior : tuple of ndarray, shape (12,)
        Values and sigmas that the robust weights (biweight, over all three components) begin with.
    blocks : int
        Equal parts of the record.
    rate : ndarray, shape (time, 3), optional
        How fast the model's field changes, nT/s: what a delay's error needs.

    Returns
    -------
    ndarray, shape (block, 19, 19)
        Weighted; blocks without a good sample are zero.
    """
    rows = np.flatnonzero(good)
    columns = np.zeros((rows.size, _WIDTH))
    columns[:, _READING] = reading[rows] / _UNIT
    columns[:, _ONE] = 1.0
    columns[:, _FIELD] = reference[rows]
    columns[:, _UNIFORM] = uniform[rows].reshape(rows.size, 9)
    if rate is not None:
        columns[:, _RATE] = rate[rows]
    block = rows * blocks // max(good.size, 1)
    weight = np.ones(rows.size)
    for _ in range(FIELD_MODEL_SETTINGS.passes if rows.size > 12 else 0):
        found = fit_twelve((columns.T @ (weight[:, None] * columns))[None], *prior)
        matrix, shift = found.value[:9].reshape(3, 3), found.value[9:]
        left = reading[rows] @ matrix.T + shift - reference[rows]
        square = np.mean(left**2, axis=1)
        width = BIWEIGHT_WIDTH**2 * max(float(np.median(square)) / _MEDIAN_OF_THREE, 1e-12)
        weight = np.clip(1.0 - square / width, 0.0, None) ** 2
    out = np.zeros((blocks, _WIDTH, _WIDTH))
    for at in np.unique(block):
        own = block == at
        out[at] = columns[own].T @ (weight[own, None] * columns[own])
    return out


def fit_twelve(
    grams: Floats, value: Floats, sigma: Floats, external_nT: float = 0.0, late_s: float = 0.0
) -> TwelveFit:
    """Solve the sums of blocks for the twelve parameters.

    Parameters
    ----------
    grams : ndarray, shape (block, 19, 19)
        As `comparison_grams` returns them, in order of time.
    value, sigma : ndarray, shape (12,)
        What is known before; 0 keeps a parameter where it is.
    external_nT : float
        Standard deviation of a field that the model lacks and that stays, along each Earth-fixed axis.
    late_s : float
        One sigma of the sensor's delay, s.
    """
    grams = grams[grams[:, _ONE, _ONE] > 0]
    total = grams.sum(axis=0)
    count = float(total[_ONE, _ONE])
    scale = np.concatenate([np.full(9, 1.0 / _UNIT), np.ones(3)])
    start, known = value / scale, sigma / scale
    free = known > 0
    # Rows of M and its shift are three fits of one design: four columns each.
    normal, slope = _twelve(total)
    if not count:
        nothing = np.zeros(12, dtype=bool)
        return TwelveFit(value, np.diag(sigma**2), nothing, np.nan, np.nan, 0.0, np.zeros(12))
    change, wide = np.zeros(12), _residual_square(total, start) / (3.0 * count)
    information = np.diag(np.where(free, 1.0 / np.maximum(known, 1e-300) ** 2, 0.0))[np.ix_(free, free)]
    gradient = slope - normal @ start
    noise = max(wide, _LEAST_NOISE)
    inverse = np.zeros((0, 0))
    # The prior's weight depends on the noise, which the fit tells: the second pass has it.
    for _ in range(2):
        matrix = normal[np.ix_(free, free)] / noise + information
        unit = 1.0 / np.sqrt(np.diag(matrix))
        inverse = scipy.linalg.inv(unit[:, None] * matrix * unit) * unit[:, None] * unit
        change[free] = inverse @ (gradient[free] / noise)
        noise = max(_residual_square(total, start + change) / (3.0 * count), _LEAST_NOISE)
    solution = start + change
    bread = inverse / noise
    scores = np.stack([(_twelve(one)[1] - _twelve(one)[0] @ solution)[free] for one in grams])
    scores = scores - scores.mean(axis=0)
    few = len(grams) < 6
    meat = noise * normal[np.ix_(free, free)]
    if not few:
        # Four parameters of each component take part of the scatter away.
        part = len(grams) / (len(grams) - 4.0)
        meat = part * bartlett_covariance(scores, FIELD_MODEL_SETTINGS.lags)
    # What the data do not tell has the prior's error, and none is smaller than that of white noise.
    covariance = sandwich(bread, meat, inverse)
    added = [([_UNIFORM.start + 3 * row + axis for row in range(3)], external_nT) for axis in range(3)]
    # A reading that is late by t holds t dB/dt too much.
    moved = np.zeros(len(bread))
    for columns, size in [*added, ([*range(_RATE.start, _RATE.stop)], -late_s)]:
        pull = np.concatenate([*(total[:3, one] for one in columns), total[_ONE, columns]])
        moved = bread @ pull[free] * size
        covariance = covariance + np.outer(moved, moved)
    late = np.zeros(12)
    late[free] = moved
    whole = np.zeros((12, 12))
    whole[np.ix_(free, free)] = covariance
    whole = whole * scale[:, None] * scale[None, :]
    determined = free & (np.sqrt(np.diag(whole)) < 0.5 * np.where(free, sigma, 1.0))
    before, after = (np.sqrt(_residual_square(total, at) / (3.0 * count)) for at in (start, solution))
    return TwelveFit(solution * scale, whole, determined, float(before), float(after), count, late * scale)


def _twelve(gram: Floats) -> tuple[Floats, Floats]:
    """Return normal matrix (12, 12) and right side (12,) of M row by row and b, in the sums' units."""
    normal, slope = np.zeros((12, 12)), np.zeros(12)
    four = gram[:4, :4]
    for row in range(3):
        own = np.append(3 * row + np.arange(3), 9 + row)
        normal[np.ix_(own, own)] = four
        slope[own] = gram[:4, 4 + row]
    return normal, slope


def _residual_square(gram: Floats, solution: Floats) -> float:
    """Return the weighted sum of squares of all three components' residuals, nT^2."""
    total = 0.0
    for row in range(3):
        change = np.concatenate([solution[3 * row : 3 * row + 3], [solution[9 + row], -1.0]])
        places = [0, 1, 2, _ONE, 4 + row]
        total += float(change @ gram[np.ix_(places, places)] @ change)
    return max(total, 0.0)


def field_variance(
    reading: Floats, covariance: Floats, noise_nT: float, late: Floats, moved: Floats
) -> Floats:
    """Return the variance of the calibrated field; (time, axis) nT^2, the sensor's nominal axes.

    Parameters
    ----------
    late : ndarray, shape (12,)
        As `TwelveFit.late`: the parameters make good part of what a late reading is off by.
    moved : ndarray, shape (time, axis)
        What one sigma of the delay does to the field itself, nT.
    """
    out = np.empty_like(reading)
    slope = np.column_stack([reading, np.ones(len(reading))])
    for row in range(3):
        own = np.append(3 * row + np.arange(3), 9 + row)
        alone = covariance[np.ix_(own, own)] - np.outer(late[own], late[own])
        out[:, row] = np.einsum("ti,ij,tj->t", slope, alone, slope, optimize=True)
        out[:, row] += (moved[:, row] + slope @ late[own]) ** 2
    return np.asarray(np.maximum(out, 0.0) + noise_nT**2)


def mounting(value: Floats, covariance: Floats) -> tuple[dict[str, float], dict[str, float]]:
    """Return what twelve parameters mean: by name, values and one sigma.

    ``M = R K``: K upper triangular, its diagonal the scale factors and the others cosines of the angles
    between the axes, as of `inflight.effects.VectorSensor`; R a rotation from the sensor's orthogonal axes
    to its nominal ones, as a rotation vector, so that no order of angles matters. Offsets are ``-M^-1 b``, of
    the reading.

    Parameters
    ----------
    value : ndarray, shape (12,)
    covariance : ndarray, shape (12, 12)
    """

    def meaning(twelve: Floats) -> Floats:
        rotation, upper = scipy.linalg.qr(twelve[:9].reshape(3, 3))
        sign = np.sign(np.diag(upper))
        rotation, upper = rotation * sign, sign[:, None] * upper
        angles = scipy.spatial.transform.Rotation.from_matrix(rotation).as_rotvec(degrees=True)
        between = np.rad2deg(np.arccos(np.clip(upper[(0, 0, 1), (1, 2, 2)], -1.0, 1.0)))
        offset = -np.linalg.solve(twelve[:9].reshape(3, 3), twelve[9:])
        return np.concatenate([np.diag(upper), between, angles, offset])

    at = meaning(value)
    step = np.where(np.diag(covariance) > 0, 0.1 * np.sqrt(np.maximum(np.diag(covariance), 0.0)), 0.0)
    slope = np.zeros((12, 12))
    for place in np.flatnonzero(step):
        moved = np.zeros(12)
        moved[place] = step[place]
        slope[:, place] = (meaning(value + moved) - meaning(value - moved)) / (2.0 * step[place])
    sigma = np.sqrt(np.maximum(np.diag(slope @ covariance @ slope.T), 0.0))
    return dict(zip(MOUNTING, at.tolist(), strict=True)), dict(zip(MOUNTING, sigma.tolist(), strict=True))


#: Names of what twelve parameters mean, and their units.
MOUNTING = {
    **{f"scale factor {axis}": "1" for axis in "xyz"},
    **{f"angle between {pair}": "deg" for pair in ("x and y", "x and z", "y and z")},
    **{f"mounting about {axis}": "deg" for axis in "xyz"},
    **{f"offset {axis}": "nT" for axis in "xyz"},
}
