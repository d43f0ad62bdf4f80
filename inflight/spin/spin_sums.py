"""The compiled loops of the spin fits: every span of samples on its own, plainly or with weights.

Functions are 1, sin, cos and, where five unknowns are asked for, sin and cos of twice the phase. A reading
that is NaN is none.
"""

from __future__ import annotations

import numba
import numpy as np

from inflight.arrays import Floats
from inflight.calibration.robust import BIWEIGHT_WIDTH
from inflight.time import Int64

#: Huber's weights end at this many sigmas (95 % efficient); rounds with them, and then with the biweight.
_HUBER, _ROUNDS = 1.345, 12
_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def fit_plain(
    sine: Floats,
    cosine: Floats,
    field: Floats,
    edges: Int64,
    value: Floats,
    inverse: Floats,
    variance: Floats,
    count: Int64,
    largest: Floats,
    spread: Floats,
) -> None:  # pragma: no cover
    """Fit every span of samples by least squares; readings count from one of the span's own.

    Parameters
    ----------
    sine, cosine : ndarray, shape (time,)
        Of the phase.
    field : ndarray, shape (time, component)
    edges : ndarray of int64, shape (fit + 1,)
        First sample of each span, and the end.
    value, inverse : ndarray, shape (fit, component, unknown), (fit, component, unknown, unknown)
        Filled: the coefficients and the inverse of the normal equations.
    variance, count, largest, spread : ndarray, shape (fit, component)
        Filled: residual variance, readings, largest residual, and the determinant of the normal equations
        as a part of that of evenly spread phases.
    """
    right = np.empty(value.shape[2])
    for f in range(edges.size - 1):
        for k in range(field.shape[1]):
            low, high = edges[f], edges[f + 1]
            gram, now = inverse[f, k], value[f, k]
            first = _first(field[:, k], low, high)
            if right.size == 3:
                many = _sum_three(sine, cosine, field[:, k], low, high, first, gram, right)
                spread[f, k] = _invert_three(gram)
            else:
                many = _sum_five(sine, cosine, field[:, k], low, high, first, gram, right)
                spread[f, k] = _invert(gram, float(many))
            for p in range(right.size):
                now[p] = 0.0
                for q in range(right.size):
                    now[p] += gram[p, q] * right[q]
            now[0] += first
            total, largest[f, k] = _left_over(sine, cosine, field[:, k], low, high, now)
            variance[f, k] = total / max(many - right.size, 1)
            count[f, k] = many


@_compiled
def fit_weighted(
    sine: Floats, cosine: Floats, field: Floats, edges: Int64, places: Int64, scale: Floats, value: Floats
) -> tuple[Floats, Floats, Floats]:  # pragma: no cover
    """Fit some spans again: Huber's weights, which converge from any start, then the biweight.

    Parameters
    ----------
    places : ndarray of int64, shape (place, 2)
        Fit and component.
    scale : ndarray, shape (fit, component)
        Usual residual there.
    value : ndarray, shape (fit, component, unknown)
        Where to start.

    Returns
    -------
    now : ndarray, shape (place, unknown)
    inverse : ndarray, shape (place, unknown, unknown)
    sums : ndarray, shape (place, 4)
        Spread as in `fit_plain`, weighted sum of squares, sum of weights, readings below half their weight.
    """
    size = value.shape[2]
    now = np.empty((places.shape[0], size))
    inverse = np.empty((places.shape[0], size, size))
    sums, right = np.zeros((places.shape[0], 4)), np.empty(size)
    for at in range(places.shape[0]):
        f, k = places[at, 0], places[at, 1]
        now[at] = value[f, k]
        for turn in range(2 * _ROUNDS + 1):
            gram = inverse[at]
            total, kept, out = _sum_weighted(
                sine,
                cosine,
                field[:, k],
                (edges[f], edges[f + 1]),
                (max(scale[f, k], 1e-300), turn >= _ROUNDS),
                now[at],
                gram,
                right,
            )
            sums[at, 0] = _invert(gram, kept)
            sums[at, 1], sums[at, 2], sums[at, 3] = total, kept, out
            if sums[at, 0] == 0.0:
                break
            if turn < 2 * _ROUNDS:
                now[at] += gram @ right
    return now, inverse, sums


@_compiled
def _first(reading: Floats, low: int, high: int) -> float:  # pragma: no cover
    for i in range(low, high):
        if np.isfinite(reading[i]):
            return float(reading[i])
    return 0.0


@_compiled
def _sum_three(
    sine: Floats,
    cosine: Floats,
    reading: Floats,
    low: int,
    high: int,
    first: float,
    gram: Floats,
    right: Floats,
) -> int:  # pragma: no cover
    many, s1, c1, ss, sc = 0, 0.0, 0.0, 0.0, 0.0
    y1, ys, yc = 0.0, 0.0, 0.0
    for i in range(low, high):
        y, s, c = reading[i] - first, sine[i], cosine[i]
        if y == y:  # noqa: PLR0124, several times faster than isfinite
            many += 1
            s1 += s
            c1 += c
            ss += s * s
            sc += s * c
            y1 += y
            ys += y * s
            yc += y * c
    gram[0, 0], gram[0, 1], gram[0, 2] = many, s1, c1
    gram[1, 1], gram[1, 2], gram[2, 2] = ss, sc, many - ss
    right[0], right[1], right[2] = y1, ys, yc
    return many


@_compiled
def _invert_three(gram: Floats) -> float:  # pragma: no cover
    """Invert the upper triangle in place, by cofactors; return the spread."""
    a, b, c = gram[0, 0], gram[0, 1], gram[0, 2]
    d, e, f = gram[1, 1], gram[1, 2], gram[2, 2]
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    whole = a * aa + b * bb + c * cc
    spread = whole / (0.25 * a**3) if a > 0 else 0.0
    if not spread > 1e-12:
        gram[:] = 0.0
        return 0.0
    unit = 1.0 / whole
    gram[0, 0], gram[1, 1], gram[2, 2] = aa * unit, (a * f - c * c) * unit, (a * d - b * b) * unit
    gram[0, 1] = gram[1, 0] = bb * unit
    gram[0, 2] = gram[2, 0] = cc * unit
    gram[1, 2] = gram[2, 1] = (b * c - a * e) * unit
    return spread


@_compiled
def _fill(row: Floats, s: float, c: float) -> None:  # pragma: no cover
    row[0], row[1], row[2] = 1.0, s, c
    if row.size > 3:
        row[3], row[4] = 2.0 * s * c, 1.0 - 2.0 * s * s


@_compiled
def _sum_five(
    sine: Floats,
    cosine: Floats,
    reading: Floats,
    low: int,
    high: int,
    first: float,
    gram: Floats,
    right: Floats,
) -> int:  # pragma: no cover
    row = np.empty(right.size)
    gram[:], right[:], many = 0.0, 0.0, 0
    for i in range(low, high):
        y = reading[i] - first
        if y == y:  # noqa: PLR0124
            many += 1
            _fill(row, sine[i], cosine[i])
            _add(gram, right, row, y, 1.0)
    return many


@_compiled
def _add(gram: Floats, right: Floats, row: Floats, y: float, weight: float) -> None:  # pragma: no cover
    for p in range(row.size):
        right[p] += weight * row[p] * y
        for q in range(row.size):
            gram[p, q] += weight * row[p] * row[q]


@_compiled
def _sum_weighted(
    sine: Floats,
    cosine: Floats,
    reading: Floats,
    span: tuple[int, int],
    rule: tuple[float, bool],
    now: Floats,
    gram: Floats,
    right: Floats,
) -> tuple[float, float, float]:  # pragma: no cover
    """Sum the weighted normal equations of the residuals; `rule` is their unit, and whether biweight."""
    row = np.empty(right.size)
    gram[:], right[:] = 0.0, 0.0
    total, kept, out = 0.0, 0.0, 0.0
    for i in range(span[0], span[1]):
        y = reading[i]
        if y == y:  # noqa: PLR0124
            _fill(row, sine[i], cosine[i])
            left = y - np.dot(row, now)
            pull = abs(left) / rule[0]
            if rule[1]:
                weight = max(1.0 - (pull / BIWEIGHT_WIDTH) ** 2, 0.0) ** 2
            else:
                weight = min(1.0, _HUBER / max(pull, 1e-300))
            out += weight < 0.5
            total += weight * left * left
            kept += weight
            _add(gram, right, row, left, weight)
    return total, kept, out


@_compiled
def _invert(gram: Floats, count: float) -> float:  # pragma: no cover
    """Invert a small positive matrix in place (Gauss-Jordan); return the spread, 0 for no inverse."""
    size = gram.shape[0]
    spread = 1.0
    for p in range(size):
        pivot = gram[p, p]
        spread *= pivot / (count if p == 0 else 0.5 * count)
        if not pivot > 1e-9 * count:
            gram[:] = 0.0
            return 0.0
        for q in range(size):
            gram[p, q] /= pivot
        gram[p, p] = 1.0 / pivot
        for r in range(size):
            if r != p:
                _eliminate(gram, r, p, pivot)
    return spread


@_compiled
def _eliminate(gram: Floats, r: int, p: int, pivot: float) -> None:  # pragma: no cover
    factor = gram[r, p]
    for q in range(gram.shape[0]):
        if q != p:
            gram[r, q] -= factor * gram[p, q]
    gram[r, p] = -factor / pivot


@_compiled
def _left_over(
    sine: Floats, cosine: Floats, reading: Floats, low: int, high: int, value: Floats
) -> tuple[float, float]:  # pragma: no cover
    """Return the sum of the squared residuals and the largest residual."""
    total, far = 0.0, 0.0
    a, b, c, double = value[0], value[1], value[2], value.size > 3
    for i in range(low, high):
        left = reading[i] - a - b * sine[i] - c * cosine[i]
        if double:
            left -= value[3] * 2.0 * sine[i] * cosine[i] + value[4] * (1.0 - 2.0 * sine[i] * sine[i])
        if left == left:  # noqa: PLR0124
            total += left * left
            far = max(far, abs(left))
    return total, far
