"""Readings of two sensors on one time base, and covariances of what they hold.

Takes stamps and the readings of both sensors in spacecraft axes; makes their difference, the white noise of
it, and second moments in cells of time and scale.

A *contrast* is the mean over a block of samples less that over as many before it, times the root of half
their number (Haar's wavelet): white noise has the same variance on every scale, a constant gives zero. A
*cell* is a run of neighbouring contrasts of one scale; its covariance shows how large the ambient field and
the spacecraft's field were there and then.

The difference is equation 3 of the Venus Express paper (Delva et al.). Robust covariances follow
Gnanadesikan and Kettenring (1972).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.errors import SamplesError
from inflight.lsq import MAD_TO_SIGMA
from inflight.time import SECOND, Int64, usual_step


@dataclass(frozen=True, kw_only=True)
class WhiteNoiseSettings:
    """Numbers of the white noise of a series, by second differences and robust covariances.

    Attributes
    ----------
    most_samples : int
        Samples that the noise is estimated from at most. Assumed, for speed.
    stretch : int
        Samples of each of the evenly spread stretches that a longer record is reduced to. Assumed.
    quartile_to_sigma : float
        Standard deviation of a Gaussian over the upper quartile of its absolute values. Derived: one over
        the Gaussian quantile of 0.875.
    trim_distance : float
        Squared distance (whitened, three axes) up to which values count in a trimmed covariance. Level of
        significance of 1 %: chi-square with three degrees of freedom.
    trim_variance : float
        Part of the variance of Gaussian values that lies within `trim_distance`. Derived:
        ``P(chi2_5 < 11.345) / 0.99``.
    least_eigenvalue : float
        Smallest eigenvalue of a robust covariance over its largest. Assumed: medians of pairs of axes need
        not make a positive matrix.
    """

    most_samples: int = 200_000
    stretch: int = 2_000
    quartile_to_sigma: float = 0.86930
    trim_distance: float = 11.345
    trim_variance: float = 0.9647
    least_eigenvalue: float = 1e-3


@dataclass(frozen=True, kw_only=True)
class DefectSettings:
    """Numbers that show that an axis stands still.

    Attributes
    ----------
    power_ratio : float
        Power of the changes along the quietest direction over that along the liveliest, below which a sensor
        measures nothing along the former. Assumed: rounding of double precision, far below any noise.
    fewest_samples : int
        Samples that show it. Assumed.
    """

    power_ratio: float = 1e-10
    fewest_samples: int = 16


@dataclass(frozen=True, kw_only=True)
class CellSettings:
    """Numbers of the cells of time and scale.

    Attributes
    ----------
    longest : int
        The longest blocks are this part of the record: one sixteenth. Assumed; see `python -m
        tests.dual_cases` for what the whole method makes of it.
    contrasts : int
        Neighbouring contrasts of one cell. Assumed: a variance to about a third, in short runs of time.
    """

    longest: int = 16
    contrasts: int = 31


WHITE_NOISE_SETTINGS = WhiteNoiseSettings()
DEFECT_SETTINGS = DefectSettings()
CELL_SETTINGS = CellSettings()


@dataclass(frozen=True)
class Readings:
    """Readings of an inboard and an outboard sensor at the same moments; spacecraft axes.

    Attributes
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000, strictly increasing; gaps stay gaps.
    inboard, outboard : ndarray, shape (time, axis)
        nT; NaN where a reading is missing.

    Raises
    ------
    SamplesError
        When the shapes do not agree or the stamps do not increase.
    """

    stamps: Int64
    inboard: Floats
    outboard: Floats

    def __post_init__(self) -> None:
        count = self.stamps.size
        for name, field in (("inboard", self.inboard), ("outboard", self.outboard)):
            if field.shape != (count, 3):
                raise SamplesError(
                    f"{name} readings of shape {field.shape} for {count} stamps, expected ({count}, 3)",
                    remedy="put both sensors on one time base, in spacecraft axes",
                )
        if count > 1 and not bool(np.all(self.stamps[1:] > self.stamps[:-1])):
            raise SamplesError("the stamps do not increase", remedy="sort the samples and drop double ones")

    def __len__(self) -> int:
        return int(self.stamps.size)

    @cached_property
    def difference(self) -> Floats:
        """``d = B_in - B_out`` (Venus Express paper, equation 3); (time, axis), nT."""
        return np.asarray(self.inboard - self.outboard)

    @cached_property
    def good(self) -> npt.NDArray[np.bool_]:
        """Where both sensors have all three components; (time,)."""
        d = self.difference
        return np.asarray(np.isfinite(d[:, 0]) & np.isfinite(d[:, 1]) & np.isfinite(d[:, 2]))

    @cached_property
    def step(self) -> int:
        """Usual distance of neighbouring stamps, ns."""
        return usual_step(self.stamps, SECOND)

    def samples_in(self, seconds: float) -> int:
        """Return how many samples there are in a time, at least one."""
        return max(round(seconds * SECOND / self.step), 1)

    @cached_property
    def noise(self) -> Floats:
        """Covariance of the white noise of the difference; (axis, axis), nT^2."""
        return white_covariance(self.difference[self.good])

    @cached_property
    def defect(self) -> str:
        """Why these cannot be readings of two working sensors; empty where they can.

        Noise alone changes all axes of a working sensor, in whatever axes it is given.
        """
        if np.count_nonzero(self.good) < DEFECT_SETTINGS.fewest_samples:
            return ""
        power = []
        for field in (self.inboard, self.outboard, self.difference):
            change = np.diff(field[self.good], axis=0)
            power.append(np.linalg.eigvalsh(change.T @ change))
        for name, own in zip(("inboard", "outboard"), power, strict=False):
            if own[0] <= DEFECT_SETTINGS.power_ratio * own[-1]:
                return f"the {name} sensor reads one value along an axis"
        same = power[2] <= DEFECT_SETTINGS.power_ratio**2 * power[1][-1]
        if same.all():
            return "the difference of both sensors never changes"
        return "the difference of both sensors never changes along an axis" if same.any() else ""

    def select(self, rows: slice | npt.NDArray[np.bool_]) -> Readings:
        """Return some of the readings, in their order."""
        return Readings(self.stamps[rows], self.inboard[rows], self.outboard[rows])


def white_covariance(values: Floats) -> Floats:
    """Return the covariance of the white noise of a series, whatever its steps and slow part; nT^2.

    Parameters
    ----------
    values : ndarray, shape (time, axis)
        Finite.

    Returns
    -------
    ndarray, shape (axis, axis)
        The `robust_covariance` of second differences ``v[t-1] - 2 v[t] + v[t+1]``, whose variance is six
        times that of white noise. Zero for fewer than three samples.
    """
    if len(values) < 3:
        return np.zeros((values.shape[1], values.shape[1]))
    if len(values) <= WHITE_NOISE_SETTINGS.most_samples:
        return robust_covariance(np.asarray(values[:-2] - 2.0 * values[1:-1] + values[2:])) / 6.0
    # Of a long record, stretches spread over it.
    stretch = WHITE_NOISE_SETTINGS.stretch
    starts = np.linspace(0, len(values) - stretch, WHITE_NOISE_SETTINGS.most_samples // stretch).astype(
        np.int64
    )
    parts = np.stack([values[first : first + stretch] for first in starts])
    second = np.asarray(parts[:, :-2] - 2.0 * parts[:, 1:-1] + parts[:, 2:]).reshape(-1, values.shape[1])
    return robust_covariance(second) / 6.0


def robust_covariance(values: Floats) -> Floats:
    """Return the covariance about zero of values (time, axis) by medians; (axis, axis).

    By the squared scale of each axis and, for pairs of axes, of sum and difference (Gnanadesikan and
    Kettenring 1972).
    """
    width = values.shape[1]
    covariance = np.zeros((width, width))
    variance = np.array([_robust_variance(one) for one in values.T])
    unit = values / np.sqrt(np.where(variance > 0, variance, 1.0))
    for i in range(width):
        covariance[i, i] = variance[i]
        for j in range(i):
            wide = _robust_variance(unit[:, i] + unit[:, j])
            narrow = _robust_variance(unit[:, i] - unit[:, j])
            share = (wide - narrow) / (wide + narrow) if wide + narrow > 0 else 0.0
            covariance[i, j] = covariance[j, i] = share * np.sqrt(variance[i] * variance[j])
    # Medians of pairs need not fit together: the nearest matrix without small eigenvalues.
    value, vector = np.linalg.eigh(covariance)
    floor = WHITE_NOISE_SETTINGS.least_eigenvalue * value.max()
    return np.asarray((vector * np.clip(value, floor, None)) @ vector.T)


def _robust_variance(values: Floats) -> float:
    """Return the variance about zero by median and upper quartile of the absolute values, the larger.

    Values most of which are zero have no such median: their mean square is taken.
    """
    size = np.abs(values)
    half, quartile = size.size // 2, (3 * size.size) // 4
    ranked = np.partition(size, (half, quartile))
    # Of readings coarser than their noise the median alone may be zero, or one step too small.
    scale = max(
        MAD_TO_SIGMA * float(ranked[half]), WHITE_NOISE_SETTINGS.quartile_to_sigma * float(ranked[quartile])
    )
    return scale**2 if scale > 0 else float(np.mean(values**2))


def trimmed_covariance(values: Floats) -> Floats:
    """Return the covariance about zero of values (time, axis) without the farthest; (axis, axis).

    Those within the 99 % ellipsoid of the `robust_covariance` are taken, and what Gaussian values lose by
    that is put back: nearly as precise as the plain covariance, which medians are not.
    """
    first = robust_covariance(values)
    if not first.max() > 0:
        return first
    weight = np.linalg.inv(first + 1e-12 * np.trace(first) * np.eye(len(first)))
    near = values[np.einsum("ti,ij,tj->t", values, weight, values) < WHITE_NOISE_SETTINGS.trim_distance]
    return np.asarray(near.T @ near / max(len(near), 1) / WHITE_NOISE_SETTINGS.trim_variance)


@dataclass(frozen=True)
class Cells:
    """Covariances of series, such as [outboard, difference], in cells of time and scale.

    Attributes
    ----------
    covariance : ndarray, shape (cell, column, column)
        Mean products of contrasts, nT^2; three columns a series.
    count : ndarray, shape (cell,)
        Contrasts that do not overlap, or as many as the overlapping ones are worth.
    scale : ndarray of int64, shape (cell,)
        Samples of a block: 1, 2, 4 and so on.
    row : ndarray of int64, shape (cell,)
        Sample in the middle of the cell.
    """

    covariance: Floats
    count: Floats
    scale: npt.NDArray[np.int64]
    row: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return int(self.count.size)

    def blocks(self, number: int) -> npt.NDArray[np.int64]:
        """Return in which of so many blocks of time each cell is, from 0; (cell,)."""
        return np.asarray(self.row * number // (int(self.row.max(initial=0)) + 1), dtype=np.int64)

    def select(self, use: npt.NDArray[np.bool_]) -> Cells:
        """Return some of the cells."""
        return Cells(self.covariance[use], self.count[use], self.scale[use], self.row[use])


def cells_of(*series: Floats, longest: int = CELL_SETTINGS.longest) -> Cells:
    """Return the cells of series of samples without gaps.

    Parameters
    ----------
    *series : ndarray, shape (time, axis)
        nT, finite. Samples on both sides of a gap count as neighbours: the cell then shows a larger change of
        the ambient field.
    longest : int
        The longest blocks are this part of the record.
    """
    sums = running_sums(np.concatenate(series, axis=1))
    count, columns = len(series[0]), sums.shape[1]
    parts = []
    for block in scales_of(count, longest):
        values, middle, share = contrasts(sums, block)
        first, number = _runs_of(len(values))
        # All runs but the last, which takes the rest, are of one length.
        runs = values[: first[-1]].reshape(first.size - 1, CELL_SETTINGS.contrasts, columns)
        rest = values[first[-1] :]
        products = np.concatenate([np.swapaxes(runs, 1, 2) @ runs, (rest.T @ rest)[None]])
        covariance = products / number[:, None, None]
        rows = np.asarray(middle[first + number // 2], dtype=np.int64)
        worth = np.asarray(share * number, dtype=np.float64)
        parts.append(Cells(covariance, worth, np.full(first.size, block, dtype=np.int64), rows))
    if not parts:
        none = np.zeros(0, dtype=np.int64)
        return Cells(np.zeros((0, columns, columns)), np.zeros(0), none, none)
    return concatenate_cells(parts)


def _runs_of(contrasts: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the first of the contrasts of each cell, and their number."""
    first = np.arange(0, max(contrasts - CELL_SETTINGS.contrasts // 2, 1), CELL_SETTINGS.contrasts)
    return first, np.diff(np.append(first, contrasts))


def joined_contrasts(stretches: Sequence[Floats], block: int, weights: Sequence[Floats]) -> Floats:
    """Return contrasts of stretches, one after the other in time, by the roots of weights; (contrast, axis).

    Between two stretches are zeros for the contrasts that would reach from one into the next.

    Parameters
    ----------
    stretches : sequence of ndarray, shape (time, axis)
    block : int
        Samples of a block, as of `contrasts`.
    weights : sequence of ndarray, shape (cell, axis)
        Of all contrasts of each cell together, as `cells_of` makes cells of that scale; none of a stretch
        that is too short for one.
    """
    parts = []
    for series, weight in zip(stretches, weights, strict=True):
        if len(weight):
            values, _, share = contrasts(running_sums(series), block)
            _, number = _runs_of(len(values))
            parts.append(values * np.sqrt(np.repeat(weight / number[:, None], number, axis=0)))
            parts.append(np.zeros((round(1.0 / share) - 1, series.shape[1])))
    return np.concatenate(parts)


def scales_of(count: int, longest: int = CELL_SETTINGS.longest) -> list[int]:
    """Return the lengths of blocks in a record of `count` samples: powers of two up to that part of it.

    Half the record is always among them where they go so far: else half of it could be slower than all.
    """
    most = min(max(count // longest, 1), count // 2)
    powers = [1 << power for power in range(most.bit_length())]
    return [*powers, most] if longest == 2 and powers and most > powers[-1] else powers


def concatenate_cells(parts: Sequence[Cells]) -> Cells:
    """Return the cells of several stretches together; their rows are those in the stretch."""
    return Cells(
        np.concatenate([one.covariance for one in parts]),
        np.concatenate([one.count for one in parts]),
        np.concatenate([one.scale for one in parts]),
        np.concatenate([one.row for one in parts]),
    )


def running_sums(series: Floats) -> Floats:
    """Return the sums of the first samples of a series (time, column), less its mean; (time + 1, column)."""
    zero = np.zeros((1, series.shape[1]))
    if not len(series):
        return zero
    # Sums of many large numbers would lose the noise; contrasts do not depend on the mean.
    return np.concatenate([zero, np.cumsum(series - series.mean(axis=0), axis=0)])


def contrasts(sums: Floats, block: int) -> tuple[Floats, npt.NDArray[np.int64], float]:
    """Return contrasts of a series over blocks of samples, from its `running_sums`.

    Returns
    -------
    values : ndarray, shape (contrast, column)
    middle : ndarray of int64, shape (contrast,)
        First sample of the later block.
    share : float
        What one contrast is worth of one that does not overlap.
    """
    stride = max(block // 2, 1)
    middle = np.arange(block, len(sums) - block, stride)
    later, early = sums[2 * block :: stride], sums[: len(sums) - 2 * block : stride]
    values = (later - 2.0 * sums[block : len(sums) - block : stride] + early) / np.sqrt(2.0 * block)
    return values, middle.astype(np.int64), stride / (2.0 * block)
