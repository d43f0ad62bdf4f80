"""Which lines of a spectrum stand for themselves: all of them fitted together to the record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from inflight.arrays import Floats
from inflight.lines import CHANCE, Line, told_period
from inflight.spectrum import LEAST_SAMPLES, Power, background_of

#: Lines that are fitted together, and the rows of one step of that.
_RESOLVED, _CHUNK = 40, 20_000
#: Lines this many times a day from one of the orbit's need company: one nearer to it, of this strength.
_FAR, _FAMILY = 2, 0.3


def resolve_lines(
    seconds: Floats, residual: Floats, direction: Floats, lines: Sequence[Line], power: Power
) -> list[Line]:
    """Keep those of the lines that stand for themselves: fields along the axes at their periods.

    A field with a period shows in every series, with sidebands. All lines are fitted to the record
    as ``u_k cos`` and ``u_k sin`` (six columns each); the one that explains most is taken, then the
    one that explains most of what is left, until none is left that chance could not explain.

    Parameters
    ----------
    seconds, residual, direction : ndarray, shape (row,), (row,), (row, 3)
        The record the lines were found in.
    lines : sequence of Line
        Candidates.
    power : Power
        Their spectrum: its background is the noise.

    Returns
    -------
    list of Line
        In the order they were taken; amplitudes along the axes are those of the common fit, that in
        the residual is its rms times the square root of two.
    """
    lines = sorted(lines, key=lambda line: -line.ratio)[:_RESOLVED]
    known = np.isfinite(residual) & np.isfinite(direction).all(axis=1)
    if not lines or known.sum() < LEAST_SAMPLES:
        return []
    # A constant field is no line, but the orbit's would have to stand for it.
    constant = np.column_stack([np.ones(int(known.sum())), direction[known]])
    y = residual[known] - constant @ np.linalg.lstsq(constant, residual[known])[0]
    frequency = np.array([1.0 / line.period_s for line in lines])
    gram, right = _line_equations(seconds[known] - seconds[known][0], y, direction[known], frequency)
    background = background_of(power.density[0])
    at = np.clip(np.round(frequency / power.frequency[0]).astype(np.int64) - 1, 0, background.size - 1)
    # White noise of this variance a row has the background's density.
    noise = background[at] * power.frequency[-1]
    taken = _taken(gram, right, noise)
    found = [_resolved(lines, gram, right, noise, taken, place) for place in range(len(taken))]
    found = [_unless_alone(line, found) for line in found]
    return [_as_multiple(line, found[:place], power) for place, line in enumerate(found)]


def _unless_alone(line: Line, found: Sequence[Line]) -> Line:
    """Take off a name that is due to the Earth's turn where lines nearer to the orbit's own are too weak.

    The field's harmonics make lines of the orbit split by once, twice, ... a day, and the first ones
    are the strong ones: a line at four times a day without them is something else.
    """
    family, side = _turns(line)
    if abs(side) < _FAR:
        return line
    nearer = [one.strength for one in found if _turns(one)[0] == family and abs(_turns(one)[1]) < abs(side)]
    return line if max(nearer, default=0.0) > _FAMILY * line.strength else replace(line, label="")


def _turns(line: Line) -> tuple[str, int]:
    """Return which of the orbit's lines a line is beside, and by how many times a day."""
    parts = line.label.split(" ")
    if len(parts) != 3 or not parts[2].endswith("/day"):
        return line.label, 0
    return parts[0], int(parts[1] + parts[2].removesuffix("/day"))


def _as_multiple(line: Line, stronger: Sequence[Line], power: Power) -> Line:
    """Say of a line that it is a multiple of a stronger new one, as the parts of a square wave are."""
    if line.is_known:
        return line
    for base in stronger:
        ratio = base.period_s / line.period_s
        times = round(ratio)
        if (
            base.is_new
            and 2 <= times <= 12
            and abs(ratio - times) <= 1.5 * float(power.frequency[0]) * base.period_s
        ):
            return replace(line, follows=f"multiple: ({told_period(base.period_s)})/{times}")
    return line


def _line_equations(
    seconds: Floats, residual: Floats, direction: Floats, frequency: Floats
) -> tuple[Floats, Floats]:
    """Return the products of all lines' columns with each other and with the residual."""
    width = 6 * frequency.size
    gram, right = np.zeros((width, width)), np.zeros(width)
    for start in range(0, seconds.size, _CHUNK):
        rows = slice(start, start + _CHUNK)
        angle = 2.0 * np.pi * seconds[rows, None] * frequency
        waves = np.stack([np.cos(angle), np.sin(angle)], axis=2)
        columns = (waves[:, :, None, :] * direction[rows, None, :, None]).reshape(len(angle), width)
        gram += columns.T @ columns
        right += columns.T @ residual[rows]
    return gram, right


def _taken(gram: Floats, right: Floats, noise: Floats) -> list[int]:
    """Return the lines that are taken one after the other."""
    count = noise.size
    limit = float(stats.chi2.isf(CHANCE / count, 6))
    own = [gram[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(count)]
    taken: list[int] = []
    while len(taken) < count:
        columns = [6 * i + j for i in taken for j in range(6)]
        left = right - gram[:, columns] @ _solved(gram[np.ix_(columns, columns)], right[columns])
        gain = np.array(
            [
                -1.0 if i in taken else left[6 * i : 6 * i + 6] @ _solved(own[i], left[6 * i : 6 * i + 6])
                for i in range(count)
            ]
        )
        # The noise counts where a line could be chance; among the others the largest is taken.
        gain[gain < limit * noise] = -1.0
        if gain.max() <= 0:
            break
        taken.append(int(np.argmax(gain)))
    return taken


def _solved(gram: Floats, right: Floats) -> Floats:
    ridge = 1e-9 * np.trace(gram) / max(len(gram), 1)
    return np.asarray(np.linalg.solve(gram + ridge * np.eye(len(gram)), right))


def _resolved(
    lines: Sequence[Line], gram: Floats, right: Floats, noise: Floats, taken: list[int], place: int
) -> Line:
    """Return one taken line with the amplitudes of the common fit."""
    columns = [6 * i + j for i in taken for j in range(6)]
    whole = gram[np.ix_(columns, columns)]
    mine = slice(6 * place, 6 * place + 6)
    value = _solved(whole, right[columns])[mine]
    spread = np.sqrt(noise[taken[place]] * np.diag(np.linalg.pinv(whole, hermitian=True))[mine])
    along, sigma = np.hypot(value[0::2], value[1::2]), np.hypot(spread[0::2], spread[1::2]) / np.sqrt(2.0)
    own = whole[mine, mine]
    rows = float(np.trace(own))  # The six columns' squares sum to the number of rows.
    seen = np.sqrt(2.0 * max(float(value @ own @ value), 0.0) / rows)
    line = lines[taken[place]]
    amplitude = np.append(seen, along)
    deviation = np.append(np.sqrt(2.0 * noise[taken[place]] / rows), sigma)
    return replace(line, follows="", amplitude=amplitude, sigma=deviation)
