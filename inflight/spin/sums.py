"""Sums over blocks of spins: all that tones, their noise and their derivatives need of the samples."""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.spin.equation import TwelveParameters
from inflight.spin.layout import WIDEST_STEP, Bools, Layout

#: Columns of sums: the field, its spin-plane modulus m, u = Bx/m, v = By/m and their products with the field.
SERIES = ("x", "y", "z", "m", "u", "v", "xu", "xv", "zu", "zv")
Z, M, U, V = (SERIES.index(name) for name in ("z", "m", "u", "v"))
#: Lines of a block, tones (cos, sin at the spin and twice), and columns beside each tone.
LINES, TONES = 2, 4
#: Blocks worked on at once: their columns stay in the cache.
_CHUNK = 16


def chunks(layout: Layout) -> list[slice]:
    """Return the blocks worked on at once."""
    return [slice(low, low + _CHUNK) for low in range(0, layout.start.size, _CHUNK)]


def gathered(
    readings: Floats, phase: Floats, layout: Layout, parameters: TwelveParameters, part: slice
) -> tuple[Floats, Floats, Bools]:
    """Return angle (block, sample), field (block, sample, 3) and which samples are of use; 0 where not."""
    start, stop = layout.start[part], layout.stop[part]
    length = max(int((stop - start).max()), 1)
    whole = slice(int(start[0]), int(stop[-1]))
    even = bool(np.all(stop - start == length)) and bool(layout.good[whole].all())
    if even:
        own = np.ones((start.size, length), dtype=np.bool_)
        angle = phase[whole].reshape(own.shape)
        taken = readings[whole]
    else:
        index = start[:, None] + np.arange(length)
        inside = index < stop[:, None]
        np.minimum(index, phase.size - 1, out=index)
        own = layout.good[index] & inside
        angle = np.where(own, phase[index], 0.0)
        taken = np.where(own[..., None], readings[index], 0.0).reshape(-1, 3)
    field = parameters.correct(taken).reshape(*own.shape, 3)
    if not even:
        field[~own] = 0.0
    return angle, field, own


def tone_sums(angle: Floats, field: Floats, own: Bools) -> Floats:
    """Return sums of lines and tones times themselves, Bz and modulus; (block, 6, 8)."""
    columns = np.empty((len(angle), LINES + TONES + 2, angle.shape[1]))
    _fill_tones(columns, angle, own.astype(np.float64))
    columns[:, -2] = field[..., 2]
    np.hypot(field[..., 0], field[..., 1], out=columns[:, -1])
    return np.asarray(columns[:, : LINES + TONES] @ columns.transpose(0, 2, 1))


def block_sums(angle: Floats, field: Floats, own: Bools, layout: Layout) -> tuple[Floats, Floats, Floats]:
    """Return sums of some blocks.

    (block, 6, column) of lines and tones times all columns, (block, 16, 2) of neighbouring frequencies times
    Bz and modulus, and (block, 5): samples, covered phase, least modulus, least and largest size of Bz.
    """
    columns = np.empty((len(angle), LINES + TONES + 16 + len(SERIES), angle.shape[1]))
    _fill_tones(columns, angle, own.astype(np.float64))
    _fill_neighbours(columns, angle, layout.settings.distances)
    series = columns[:, -len(SERIES) :]
    _fill_series(series, field)
    inner = columns[:, : LINES + TONES] @ columns.transpose(0, 2, 1)
    both = np.ascontiguousarray(series[:, [Z, M]]).transpose(0, 2, 1)
    beside = columns[:, LINES + TONES : -len(SERIES)] @ both
    return inner, beside, _levels(angle, own, series)


def _fill_tones(columns: Floats, angle: Floats, weight: Floats) -> None:
    """Fill in line and tones; all are 0 where the weight is."""
    count = np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
    middle = (angle * weight).sum(axis=1, keepdims=True) / count
    columns[:, 0] = weight
    columns[:, 1] = (angle - middle) * weight
    size = np.abs(columns[:, 1]).max(axis=1, keepdims=True)
    columns[:, 1] /= np.where(size > 0.0, size, 1.0)
    cos, sin = np.cos(angle), np.sin(angle)
    cos *= weight
    sin *= weight
    columns[:, 2], columns[:, 3] = cos, sin
    np.subtract(cos * cos, sin * sin, out=columns[:, 4])
    np.multiply(2.0 * cos, sin, out=columns[:, 5])


def _fill_neighbours(columns: Floats, angle: Floats, neighbours: tuple[float, float]) -> None:
    """Fill in the frequencies beside the tones that are already there."""
    for place, distance in enumerate(neighbours):
        near, far = np.cos(distance * angle), np.sin(distance * angle)
        for tone in range(2):
            c, s = columns[:, 2 + 2 * tone], columns[:, 3 + 2 * tone]
            at = LINES + TONES + 8 * tone + 4 * place
            cc, ss, sc, cs = c * near, s * far, s * near, c * far
            np.add(cc, ss, out=columns[:, at])  # below the tone
            np.subtract(sc, cs, out=columns[:, at + 1])
            np.subtract(cc, ss, out=columns[:, at + 2])  # above it
            np.add(sc, cs, out=columns[:, at + 3])


def _fill_series(series: Floats, field: Floats) -> None:
    """Fill in the columns of `SERIES`; all are 0 where the field is."""
    for axis in range(3):
        series[:, axis] = field[..., axis]
    x, y, z = series[:, 0], series[:, 1], series[:, 2]
    np.sqrt(x * x + y * y, out=series[:, M])
    inverse = 1.0 / np.maximum(series[:, M], 1e-12)
    np.multiply(x, inverse, out=series[:, U])
    np.multiply(y, inverse, out=series[:, V])
    u, v = series[:, U], series[:, V]
    for at, (one, two) in enumerate(((x, u), (x, v), (z, u), (z, v)), start=V + 1):
        np.multiply(one, two, out=series[:, at])


def _levels(angle: Floats, own: Bools, series: Floats) -> Floats:
    """Return samples, covered phase, least modulus, least and largest size of Bz; (block, 5)."""
    step = np.diff(angle, axis=1)
    covers = own[:, 1:] & own[:, :-1] & (step <= WIDEST_STEP)
    axial = np.abs(series[:, Z])
    far = np.where(own, 0.0, np.inf)
    return np.stack(
        [
            own.sum(axis=1).astype(np.float64),
            np.where(covers, step, 0.0).sum(axis=1),
            (series[:, M] + far).min(axis=1),
            (axial + far).min(axis=1),
            axial.max(axis=1),
        ],
        axis=1,
    )


def _slopes(inner: Floats, known: Bools) -> Floats:
    """Return the lines (block, 2, column) through all columns of the blocks."""
    gram = np.where(known[:, None, None], inner[:, :LINES, :LINES], np.eye(LINES))
    return np.asarray(np.linalg.solve(gram, inner[:, :LINES]))


def without_lines(inner: Floats, known: Bools) -> Floats:
    """Return the sums (block, 4, column) of tones times what a line in each block leaves of the columns."""
    crossed = inner[:, :LINES, LINES : LINES + TONES].transpose(0, 2, 1)
    tones = inner[:, LINES:] - crossed @ _slopes(inner, known)
    return np.where(known[:, None, None], tones, 0.0)[:, :, LINES:]


def beside_without_lines(inner: Floats, beside: Floats, known: Bools) -> Floats:
    """Return the sums (block, 16, 2) of neighbours times what a line leaves of Bz and modulus."""
    both = _slopes(inner, known)[:, :, [Z - len(SERIES), M - len(SERIES)]]
    near = slice(LINES + TONES, -len(SERIES))
    rest = beside - inner[:, :LINES, near].transpose(0, 2, 1) @ both
    return np.where(known[:, None, None], rest, 0.0)
