"""The compiled loops of the tones: field, tones and their products over blocks of spins, in one pass.

Samples go through buffers that stay in the cache, a row a column of the sums; those of no use are left
behind.
"""

from __future__ import annotations

import numba
import numpy as np

from inflight.arrays import Floats
from inflight.spin.layout import WIDEST_STEP, Bools
from inflight.spin.sine import sine_cosine
from inflight.time import Int64

#: Lines of a block, and tones: cos and sin at the spin and at twice the spin.
LINES, TONES = 2, 4
#: Frequencies beside the tones: of two tones at two distances below and above, cos and sin.
NEIGHBOURS = 16
#: Columns of sums: the field, its spin-plane modulus m, u = Bx/m, v = By/m and their products with the field.
SERIES = ("x", "y", "z", "m", "u", "v", "xu", "xv", "zu", "zv")
Z, M, U, V = (SERIES.index(name) for name in ("z", "m", "u", "v"))
#: Samples in the buffers at once.
_PIECE = 128
#: Columns of `sum_blocks` and of `sum_tones`.
_BESIDE, _FIELD = LINES + TONES, LINES + TONES + NEIGHBOURS
_COLUMNS = _FIELD + len(SERIES)
_FEW = LINES + TONES + 2

_compiled = numba.njit(
    cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz", "arcp"}
)


@_compiled
def sum_blocks(
    readings: Floats,
    phase: Floats,
    good: Bools,
    cut: tuple[Int64, Int64, float],
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
    cut : two ndarrays of int64, shape (block,), and a float
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
    inner, beside, levels = sums
    columns, angle = np.empty((_COLUMNS, _PIECE)), np.empty(_PIECE)
    turned = np.empty((2, _PIECE))
    columns[0] = 1.0
    inner[:], beside[:] = 0.0, 0.0
    for b in range(cut[0].size):
        levels[b, 0], levels[b, 1], levels[b, 2], levels[b, 3], levels[b, 4] = 0.0, 0.0, np.inf, np.inf, 0.0
        at, stop = cut[0][b], cut[1][b]
        middle = phase[at] + 0.5 * cut[2] if at < stop else 0.0
        last = np.nan
        while at < stop:
            field = columns[_FIELD:]
            at, many = _take(readings, phase, good, at, stop, correction, angle, field)
            last = _cover(angle, many, last, levels[b])
            _fill_tones(angle, many, middle, 2.0 / cut[2], columns)
            _fill_modulus(field, field[M], many)
            _fill_series(field, many, levels[b])
            for place in range(2):
                _fill_turned(angle, many, distances[place], turned)
                for tone in range(2):
                    row = _BESIDE + 8 * tone + 4 * place
                    _fill_neighbours(turned, many, columns[2 + 2 * tone :], columns[row:])
            _add(columns, many, inner[b])
            for row in range(NEIGHBOURS):
                _add_two(columns[_BESIDE + row], field[Z], field[M], many, beside[b, row])
    _mirror(inner)


@_compiled
def sum_tones(
    readings: Floats,
    phase: Floats,
    good: Bools,
    cut: tuple[Int64, Int64, float],
    correction: tuple[Floats, Floats],
    inner: Floats,
) -> None:  # pragma: no cover
    """Fill in lines and tones times themselves, Bz and modulus, (block, 6, 8); see `sum_blocks`."""
    columns, angle = np.empty((_FEW, _PIECE)), np.empty(_PIECE)
    field = np.empty((3, _PIECE))
    columns[0] = 1.0
    inner[:] = 0.0
    for b in range(cut[0].size):
        at, stop = cut[0][b], cut[1][b]
        middle = phase[at] + 0.5 * cut[2] if at < stop else 0.0
        while at < stop:
            at, many = _take(readings, phase, good, at, stop, correction, angle, field)
            _fill_tones(angle, many, middle, 2.0 / cut[2], columns)
            _fill_modulus(field, columns[_FEW - 1], many)
            columns[_FEW - 2] = field[2]
            _add(columns, many, inner[b])
    _mirror(inner)


@_compiled
def _take(
    readings: Floats,
    phase: Floats,
    good: Bools,
    at: int,
    stop: int,
    correction: tuple[Floats, Floats],
    angle: Floats,
    field: Floats,
) -> tuple[int, int]:  # pragma: no cover
    """Copy samples of use into the buffers, the readings corrected; return the next sample, and how many."""
    many = 0
    while at < stop and many < angle.size:
        if good[at]:
            angle[many] = phase[at]
            for axis in range(3):
                field[axis, many] = readings[at, axis] - correction[1][axis]
            many += 1
        at += 1
    _turn(correction[0], field[0], field[1], field[2], many)
    return at, many


@_compiled
def _turn(matrix: Floats, x: Floats, y: Floats, z: Floats, many: int) -> None:  # pragma: no cover
    xx, xy, xz = matrix[0]
    yx, yy, yz = matrix[1]
    zx, zy, zz = matrix[2]
    for i in range(many):
        a, b, c = x[i], y[i], z[i]
        x[i] = xx * a + xy * b + xz * c
        y[i] = yx * a + yy * b + yz * c
        z[i] = zx * a + zy * b + zz * c


@_compiled
def _cover(angle: Floats, many: int, last: float, levels: Floats) -> float:  # pragma: no cover
    """Count samples and the phase between those that are near each other; return the last phase."""
    levels[0] += many
    covered = 0.0
    for i in range(many):
        step = angle[i] - last
        # A step from NaN, before the first sample, is not covered.
        covered += step if step <= WIDEST_STEP else 0.0
        last = angle[i]
    levels[1] += covered
    return last


@_compiled
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


@_compiled
def _fill_turned(angle: Floats, many: int, distance: float, turned: Floats) -> None:  # pragma: no cover
    """Fill in cos and sin of the part of the phase by which neighbours differ from tones."""
    cosine, sine = turned[0], turned[1]
    for i in range(many):
        sine[i], cosine[i] = sine_cosine(distance * angle[i])


@_compiled
def _fill_neighbours(turned: Floats, many: int, tone: Floats, rows: Floats) -> None:  # pragma: no cover
    """Fill in cos and sin below and above a tone, four rows."""
    c, s, near, far = tone[0], tone[1], turned[0], turned[1]
    below, below_sine, above, above_sine = rows[0], rows[1], rows[2], rows[3]
    for i in range(many):
        cc, ss, sc, cs = c[i] * near[i], s[i] * far[i], s[i] * near[i], c[i] * far[i]
        below[i], below_sine[i] = cc + ss, sc - cs
        above[i], above_sine[i] = cc - ss, sc + cs


@_compiled
def _fill_modulus(field: Floats, modulus: Floats, many: int) -> None:  # pragma: no cover
    x, y = field[0], field[1]
    for i in range(many):
        modulus[i] = np.sqrt(x[i] * x[i] + y[i] * y[i])


@_compiled
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


@_compiled
def _add(columns: Floats, many: int, inner: Floats) -> None:  # pragma: no cover
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


@_compiled
def _add_two(row: Floats, one: Floats, two: Floats, many: int, out: Floats) -> None:  # pragma: no cover
    a, b = 0.0, 0.0
    for i in range(many):
        a += row[i] * one[i]
        b += row[i] * two[i]
    out[0] += a
    out[1] += b


@_compiled
def _mirror(inner: Floats) -> None:  # pragma: no cover
    """Fill in the products with the column of ones, which are those of its row."""
    for b in range(inner.shape[0]):
        for row in range(1, LINES + TONES):
            inner[b, row, 0] = inner[b, 0, row]
