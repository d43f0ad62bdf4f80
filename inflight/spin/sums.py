"""Sums over blocks of spins: all that tones, their noise and their derivatives need of the samples."""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.spin.block_sums import LINES, NEIGHBOURS, SERIES, TONES, M, Z, sum_blocks, sum_tones
from inflight.spin.equation import TwelveParameters
from inflight.spin.layout import Bools, Layout
from inflight.time import Int64


def block_sums(
    readings: Floats, phase: Floats, layout: Layout, parameters: TwelveParameters
) -> tuple[Floats, Floats, Floats]:
    """Return the sums of all blocks.

    (block, 6, column) of lines and tones times all columns, (block, 16, 2) of neighbouring frequencies times
    Bz and modulus, and (block, 5): samples, covered phase, least modulus, least and largest size of Bz.
    """
    count = layout.start.size
    inner = np.empty((count, LINES + TONES, LINES + TONES + NEIGHBOURS + len(SERIES)))
    sums = inner, np.empty((count, NEIGHBOURS, 2)), np.empty((count, 5))
    record = np.asarray(readings, dtype=np.float64), np.asarray(phase, dtype=np.float64), layout.good
    sum_blocks(*record, _cut(layout), _correction(parameters), layout.settings.distances, sums)
    return sums


def tone_sums(readings: Floats, phase: Floats, layout: Layout, parameters: TwelveParameters) -> Floats:
    """Return sums of lines and tones times themselves, Bz and modulus; (block, 6, 8)."""
    inner = np.empty((layout.start.size, LINES + TONES, LINES + TONES + 2))
    record = np.asarray(readings, dtype=np.float64), np.asarray(phase, dtype=np.float64), layout.good
    sum_tones(*record, _cut(layout), _correction(parameters), inner)
    return inner


def _cut(layout: Layout) -> tuple[Int64, Int64, float]:
    return layout.start, layout.stop, layout.settings.turn


def _correction(parameters: TwelveParameters) -> tuple[Floats, Floats]:
    return parameters.matrix(), np.array(parameters.offset)


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
