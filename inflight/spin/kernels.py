"""Compiled loops of the tones and of the spin fits.

Takes: readings, phase, and the blocks or spans they are cut into. Makes: sums of products over blocks of
spins (`sum_blocks`, `sum_tones`), from which `inflight.spin.tones` has tones, their noise and their
derivatives (Plaschke et al. 2019, section 5.3), and the least-squares fits of every span (`fit_plain`,
`fit_weighted`) of eq. (22) of Farrell et al. (1995). One pass over the samples each.

Sine and cosine (`sine_cosine`): compiled loops call a library for them one by one. Taylor's series of a
quarter of the angle, doubled twice, is good to a few units of the last place and makes several at once: ten
times faster.

Samples of the tones go through buffers that stay in the cache, a row a column of the sums; samples that are
not good are skipped. The functions of a spin fit are 1, sin, cos and, with five unknowns, sin and cos of
twice the phase; a reading that is NaN is none.
"""

from __future__ import annotations

import numba
import numpy as np

from inflight.arrays import Floats
from inflight.lsq import BIWEIGHT_WIDTH
from inflight.spin.intervals import BLOCK_SETTINGS, Bools
from inflight.time import Int64

#: 2 pi in parts: whole turns times the first are exact, and the last is what the double nearest to it lacks.
_TURN = 2.0 * np.pi

_HIGH = float(np.float32(_TURN))

_LOW, _REST = _TURN - _HIGH, 2.4492935982947064e-16

_PER_TURN = 1.0 / _TURN


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def sine_cosine(angle: float) -> tuple[float, float]:  # pragma: no cover
    """Return sine and cosine of an angle of less than some 1e8 turns, rad; the error is below 3e-15."""
    turns = np.floor(angle * _PER_TURN + 0.5)
    part = 0.25 * (((angle - turns * _HIGH) - turns * _LOW) - turns * _REST)
    q = part * part
    high = 1.0 / 362880.0 - q * (1.0 / 39916800.0 - q * (1.0 / 6227020800.0 - q / 1307674368000.0))
    sine = part * (1.0 - q * (1.0 / 6.0 - q * (1.0 / 120.0 - q * (1.0 / 5040.0 - q * high))))
    high = 1.0 / 3628800.0 - q * (1.0 / 479001600.0 - q * (1.0 / 87178291200.0 - q / 20922789888000.0))
    cosine = 1.0 - q * (0.5 - q * (1.0 / 24.0 - q * (1.0 / 720.0 - q * (1.0 / 40320.0 - q * high))))
    sine, cosine = 2.0 * sine * cosine, 1.0 - 2.0 * sine * sine
    return 2.0 * sine * cosine, 1.0 - 2.0 * sine * sine


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def fill_sine_cosine(angle: Floats, sine: Floats, cosine: Floats) -> None:  # pragma: no cover
    """Fill in sine and cosine; all of shape (time,)."""
    for i in range(angle.size):
        sine[i], cosine[i] = sine_cosine(angle[i])


#: Lines of a block, and tones: cos and sin at the spin and at twice the spin.
LINES, TONES = 2, 4

#: Columns of the neighbouring frequencies: of two tones at two distances below and above, cos and sin.
NEIGHBOURS = 16

#: Columns of sums: the field, its spin-plane modulus m, u = Bx/m, v = By/m and their products with the field.
SERIES = ("x", "y", "z", "m", "u", "v", "xu", "xv", "zu", "zv")

Z, M, U, V = (SERIES.index(name) for name in ("z", "m", "u", "v"))

#: Samples in the buffers at once: some tens of kB, so that they stay in the cache. Assumed.
_PIECE = 128

#: Columns of `sum_blocks` and of `sum_tones`.
_NEIGHBOURS_AT, _FIELD_AT = LINES + TONES, LINES + TONES + NEIGHBOURS

_COLUMNS = _FIELD_AT + len(SERIES)

_FEW = LINES + TONES + 2

#: Compiled loops know numbers, not records.
_WIDEST_STEP = BLOCK_SETTINGS.widest_step

_compiled_fast = numba.njit(
    cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz", "arcp"}
)


@_compiled_fast
def sum_blocks(
    readings: Floats,
    phase: Floats,
    good: Bools,
    blocks: tuple[Int64, Int64, float],
    correction: tuple[Floats, Floats],
    distances: tuple[float, float],
    sums: tuple[Floats, Floats, Floats],
) -> None:  # pragma: no cover
    """Sum the products of the columns of every block.

    Parameters
    ----------
    readings : ndarray, shape (time, 3)
    phase : ndarray, shape (time,)
        rad.
    good : ndarray of bool, shape (time,)
    blocks : two ndarrays of int64, shape (block,), and a float
        First sample and end of each block, and the phase of a block.
    correction : ndarrays of shape (3, 3) and (3,)
        Coupling matrix and offset.
    distances : two floats
        Of the neighbours from the tones, in spin frequencies.
    sums : ndarrays of shape (block, 6, 6 + 16 + series), (block, 16, 2) and (block, 5)
        Filled: lines and tones times all columns; neighbours times Bz and modulus; samples, covered phase,
        least modulus, least and largest size of Bz. The line is the phase from the middle of the block,
        1 at its end.
    """
    inner, neighbours, levels = sums
    columns, angle = np.empty((_COLUMNS, _PIECE)), np.empty(_PIECE)
    turned = np.empty((2, _PIECE))
    columns[0] = 1.0
    inner[:], neighbours[:] = 0.0, 0.0
    for b in range(blocks[0].size):
        levels[b, 0], levels[b, 1], levels[b, 2], levels[b, 3], levels[b, 4] = 0.0, 0.0, np.inf, np.inf, 0.0
        at, stop = blocks[0][b], blocks[1][b]
        middle = phase[at] + 0.5 * blocks[2] if at < stop else 0.0
        last = np.nan
        while at < stop:
            field = columns[_FIELD_AT:]
            at, many = _load(readings, phase, good, at, stop, correction, angle, field)
            last = _covered_phase(angle, many, last, levels[b])
            _fill_tones(angle, many, middle, 2.0 / blocks[2], columns)
            _fill_modulus(field, field[M], many)
            _fill_series(field, many, levels[b])
            for place in range(2):
                _fill_turned(angle, many, distances[place], turned)
                for tone in range(2):
                    row = _NEIGHBOURS_AT + 8 * tone + 4 * place
                    _fill_neighbours(turned, many, columns[2 + 2 * tone :], columns[row:])
            _add_products(columns, many, inner[b])
            for row in range(NEIGHBOURS):
                _add_two(columns[_NEIGHBOURS_AT + row], field[Z], field[M], many, neighbours[b, row])
    _mirror(inner)


@_compiled_fast
def sum_tones(
    readings: Floats,
    phase: Floats,
    good: Bools,
    blocks: tuple[Int64, Int64, float],
    correction: tuple[Floats, Floats],
    inner: Floats,
) -> None:  # pragma: no cover
    """Fill in lines and tones times themselves, Bz and modulus, (block, 6, 8); see `sum_blocks`."""
    columns, angle = np.empty((_FEW, _PIECE)), np.empty(_PIECE)
    field = np.empty((3, _PIECE))
    columns[0] = 1.0
    inner[:] = 0.0
    for b in range(blocks[0].size):
        at, stop = blocks[0][b], blocks[1][b]
        middle = phase[at] + 0.5 * blocks[2] if at < stop else 0.0
        while at < stop:
            at, many = _load(readings, phase, good, at, stop, correction, angle, field)
            _fill_tones(angle, many, middle, 2.0 / blocks[2], columns)
            _fill_modulus(field, columns[_FEW - 1], many)
            for i in range(many):
                columns[_FEW - 2, i] = field[2, i]
            _add_products(columns, many, inner[b])
    _mirror(inner)


@_compiled_fast
def _load(
    readings: Floats,
    phase: Floats,
    good: Bools,
    at: int,
    stop: int,
    correction: tuple[Floats, Floats],
    angle: Floats,
    field: Floats,
) -> tuple[int, int]:  # pragma: no cover
    """Copy good samples into the buffers, the readings corrected; return the next sample, and how many."""
    many = 0
    while at < stop and many < angle.size:
        if good[at]:
            angle[many] = phase[at]
            for axis in range(3):
                field[axis, many] = readings[at, axis] - correction[1][axis]
            many += 1
        at += 1
    _rotate(correction[0], field[0], field[1], field[2], many)
    return at, many


@_compiled_fast
def _rotate(matrix: Floats, x: Floats, y: Floats, z: Floats, many: int) -> None:  # pragma: no cover
    """Multiply the vectors of a buffer by the coupling matrix, in place."""
    xx, xy, xz = matrix[0]
    yx, yy, yz = matrix[1]
    zx, zy, zz = matrix[2]
    for i in range(many):
        a, b, c = x[i], y[i], z[i]
        x[i] = xx * a + xy * b + xz * c
        y[i] = yx * a + yy * b + yz * c
        z[i] = zx * a + zy * b + zz * c


@_compiled_fast
def _covered_phase(angle: Floats, many: int, last: float, levels: Floats) -> float:  # pragma: no cover
    """Count samples and the phase between those that are near each other; return the last phase."""
    levels[0] += many
    covered = 0.0
    for i in range(many):
        step = angle[i] - last
        # A step from NaN, before the first sample, is not covered.
        covered += step if step <= _WIDEST_STEP else 0.0
        last = angle[i]
    levels[1] += covered
    return last


@_compiled_fast
def _fill_tones(
    angle: Floats, many: int, middle: float, scale: float, columns: Floats
) -> None:  # pragma: no cover
    line, cosine, sine = columns[1], columns[2], columns[3]
    for i in range(many):
        sine[i], cosine[i] = sine_cosine(angle[i])
    double, other = columns[4], columns[5]
    for i in range(many):
        double[i] = cosine[i] * cosine[i] - sine[i] * sine[i]
        other[i] = 2.0 * cosine[i] * sine[i]
        line[i] = (angle[i] - middle) * scale


@_compiled_fast
def _fill_turned(angle: Floats, many: int, distance: float, turned: Floats) -> None:  # pragma: no cover
    """Fill in cos and sin of the part of the phase by which the neighbours differ from the tones."""
    cosine, sine = turned[0], turned[1]
    for i in range(many):
        sine[i], cosine[i] = sine_cosine(distance * angle[i])


@_compiled_fast
def _fill_neighbours(turned: Floats, many: int, tone: Floats, rows: Floats) -> None:  # pragma: no cover
    """Fill in cos and sin below and above a tone, four rows."""
    c, s, near, far = tone[0], tone[1], turned[0], turned[1]
    below, below_sine, above, above_sine = rows[0], rows[1], rows[2], rows[3]
    for i in range(many):
        cc, ss, sc, cs = c[i] * near[i], s[i] * far[i], s[i] * near[i], c[i] * far[i]
        below[i], below_sine[i] = cc + ss, sc - cs
        above[i], above_sine[i] = cc - ss, sc + cs


@_compiled_fast
def _fill_modulus(field: Floats, modulus: Floats, many: int) -> None:  # pragma: no cover
    x, y = field[0], field[1]
    for i in range(many):
        modulus[i] = np.sqrt(x[i] * x[i] + y[i] * y[i])


@_compiled_fast
def _fill_series(series: Floats, many: int, levels: Floats) -> None:  # pragma: no cover
    """Fill in the rest of `SERIES`, and what is least and largest."""
    x, y, z, m, u, v = series[0], series[1], series[2], series[3], series[4], series[5]
    for i in range(many):
        inverse = 1.0 / max(m[i], 1e-12)
        u[i], v[i] = x[i] * inverse, y[i] * inverse
    xu, xv, zu, zv = series[6], series[7], series[8], series[9]
    for i in range(many):
        xu[i], xv[i], zu[i], zv[i] = x[i] * u[i], x[i] * v[i], z[i] * u[i], z[i] * v[i]
    least, low, high = levels[2], levels[3], levels[4]
    for i in range(many):
        least, low, high = min(least, m[i]), min(low, abs(z[i])), max(high, abs(z[i]))
    levels[2], levels[3], levels[4] = least, low, high


@_compiled_fast
def _add_products(columns: Floats, many: int, inner: Floats) -> None:  # pragma: no cover
    """Add the products of lines and tones with all columns but the first."""
    inner[0, 0] += many
    one, two, three, four, five = columns[1], columns[2], columns[3], columns[4], columns[5]
    for at in range(1, columns.shape[0]):
        column = columns[at]
        a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(many):
            value = column[i]
            a += value
            b += value * one[i]
            c += value * two[i]
            d += value * three[i]
            e += value * four[i]
            f += value * five[i]
        inner[0, at] += a
        inner[1, at] += b
        inner[2, at] += c
        inner[3, at] += d
        inner[4, at] += e
        inner[5, at] += f


@_compiled_fast
def _add_two(row: Floats, one: Floats, two: Floats, many: int, out: Floats) -> None:  # pragma: no cover
    a, b = 0.0, 0.0
    for i in range(many):
        a += row[i] * one[i]
        b += row[i] * two[i]
    out[0] += a
    out[1] += b


@_compiled_fast
def _mirror(inner: Floats) -> None:  # pragma: no cover
    """Fill in the products with the column of ones, which are those of its row."""
    for b in range(inner.shape[0]):
        for row in range(1, LINES + TONES):
            inner[b, row, 0] = inner[b, 0, row]


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
            first = _first_reading(field[:, k], low, high)
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
            total, largest[f, k] = _residual_sums(sine, cosine, field[:, k], low, high, now)
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
        # Number by number: numba takes seconds to compile the assignment of a row.
        for p in range(size):
            now[at, p] = value[f, k, p]
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
                step = gram @ right
                for p in range(size):
                    now[at, p] += step[p]
    return now, inverse, sums


@_compiled
def _first_reading(reading: Floats, low: int, high: int) -> float:  # pragma: no cover
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
def _fill_row(row: Floats, s: float, c: float) -> None:  # pragma: no cover
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
            _fill_row(row, sine[i], cosine[i])
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
            _fill_row(row, sine[i], cosine[i])
            residual = y - np.dot(row, now)
            scaled = abs(residual) / rule[0]
            if rule[1]:
                weight = max(1.0 - (scaled / BIWEIGHT_WIDTH) ** 2, 0.0) ** 2
            else:
                weight = min(1.0, _HUBER / max(scaled, 1e-300))
            out += weight < 0.5
            total += weight * residual * residual
            kept += weight
            _add(gram, right, row, residual, weight)
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
def _residual_sums(
    sine: Floats, cosine: Floats, reading: Floats, low: int, high: int, value: Floats
) -> tuple[float, float]:  # pragma: no cover
    """Return the sum of the squared residuals and the largest residual."""
    total, far = 0.0, 0.0
    a, b, c, double = value[0], value[1], value[2], value.size > 3
    for i in range(low, high):
        residual = reading[i] - a - b * sine[i] - c * cosine[i]
        if double:
            residual -= value[3] * 2.0 * sine[i] * cosine[i] + value[4] * (1.0 - 2.0 * sine[i] * sine[i])
        if residual == residual:  # noqa: PLR0124
            total += residual * residual
            far = max(far, abs(residual))
    return total, far
