"""What a residual follows: fits in bins of any coordinate, errors between blocks, chance, and words.

Takes a residual of one row (`dependence`, `axis_response`), of several rows seen through the direction of the
field (`field_response`), or spin tones (`inflight.spin.residual`), and any coordinate: time, geometry, the
field, a channel. All of them rest on one fit, `BinnedFit`: in each bin of the coordinate the least-squares
solution b of ``y = A b``, where A is one (a mean), the field's direction (a field along each axis) or a
channel's own tone.

Uncertainties are jackknives over blocks of time (Efron, 1982): samples of a block are not independent,
blocks are. An amplitude is the rms over bins less what noise makes of it. A structure counts when it stands
out by five sigma and exceeds *chance*: what the same coordinate of another part of the record explains of
the residual without the structure. The structures of a residual are taken one after the other, the largest
first (`select_successively`): coordinates move together, and what one structure leaves in twenty of them is
reported once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.lsq import jackknife

Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Residual = TypeVar("Residual")
Structure = TypeVar("Structure")


@dataclass(frozen=True, kw_only=True)
class DependenceSettings:
    """How dependences are measured and when they count.

    Attributes
    ----------
    bins, field_bins, curve_bins : int
        Bins of a mean residual, of a field along each axis, and of a figure's curves. Assumed.
    block_bins : int
        Blocks that a bin of time takes: in time a block lies in one bin.
    min_blocks : int
        Fewest blocks an uncertainty is taken from. Assumed.
    lonely : int
        Fewest blocks of a bin: with fewer it has no uncertainty between blocks.
    fewest : int
        Fewest samples of a bin of a figure's curves. Assumed.
    clear : float
        Standard deviations from which a structure stands out: a stated level of significance.
    axis_clear : float
        The same for the axis along which a field would make it.
    condition : float
        Largest condition of the equations of a bin's field: beyond, its axes cannot be separated. Assumed.
    count : int
        Structures that are reported at most.
    least_part : float
        Part of the residual's own rms below which a structure is not worth a sentence. Assumed.
    shifts : tuple of float
        Shifts of a coordinate, in parts of the record, that chance is taken from. Assumed: no two are
        multiples of one period.
    moving : float
        A coordinate rises or falls where it changes by more than this part of its standard deviation.
        Assumed.
    window_preference : float
        A structure that repeats in each window of a table is told as that where it is so many times smaller
        than one in time at most. Assumed.
    turning : float
        A coordinate has two branches when each holds more than this part of the samples. Assumed.
    """

    bins: int = 24
    field_bins: int = 8
    curve_bins: int = 12
    block_bins: int = 4
    min_blocks: int = 6
    lonely: int = 3
    fewest: int = 12
    clear: float = 5.0
    axis_clear: float = 3.0
    condition: float = 1e4
    count: int = 3
    least_part: float = 0.01
    shifts: tuple[float, ...] = (0.362, 0.422, 0.458, 0.566, 0.644, 0.698)
    moving: float = 0.02
    window_preference: float = 1.25
    turning: float = 0.1


DEPENDENCE_SETTINGS = DependenceSettings()


@dataclass(frozen=True)
class BinnedFit:
    """Least-squares fits of ``values = columns @ coefficients`` in bins, by block.

    Attributes
    ----------
    count : ndarray, shape (block, bin)
        Samples.
    gram : ndarray, shape (block, bin, column, column)
        Sums of products of the columns, by the samples' weights; complex columns are conjugated on the left.
    right : ndarray, shape (block, bin, column, series)
        Sums of products of the columns with the values.
    """

    count: Floats
    gram: Any
    right: Any

    @classmethod
    def of(
        cls, columns: Any, values: Any, block: Ints, index: Ints, bins: int, weight: Floats | None = None
    ) -> BinnedFit:
        """Sum the equations of samples.

        Parameters
        ----------
        columns : ndarray, shape (sample, row, column)
            Real or complex.
        values : ndarray, shape (sample, row, series)
        block, index : ndarray of int, shape (sample,)
            Block, counted from zero, and bin of each sample.
        bins : int
        weight : ndarray, shape (sample,), optional
        """
        shape = (int(block.max()) + 1 if block.size else 0, bins)
        cell, size = block * bins + index, shape[0] * shape[1]

        def summed(one: Any) -> Any:
            if weight is not None:
                one = weight * one
            if np.iscomplexobj(one):
                return summed_parts(one.real) + 1j * summed_parts(one.imag)
            return summed_parts(one)

        def summed_parts(one: Floats) -> Floats:
            return np.asarray(np.bincount(cell, weights=one, minlength=size), dtype=np.float64).reshape(shape)

        width, series = columns.shape[2], values.shape[2]
        gram = np.empty((*shape, width, width), dtype=columns.dtype)
        right = np.empty((*shape, width, series), dtype=np.result_type(columns, values))
        for i in range(width):
            left = np.conj(columns[:, :, i])
            for j in range(series):
                right[..., i, j] = summed(np.einsum("tr,tr->t", left, values[:, :, j]))
            for j in range(i, width):
                gram[..., i, j] = summed(np.einsum("tr,tr->t", left, columns[:, :, j]))
                gram[..., j, i] = np.conj(gram[..., i, j])
        count = np.bincount(cell, minlength=size).reshape(shape).astype(np.float64)
        return cls(count, gram, right)

    @property
    def size(self) -> Floats:
        """Trace of the Gram matrices; (block, bin). Of unit columns the number of samples."""
        return np.asarray(np.trace(self.gram, axis1=2, axis2=3).real)

    def met(self, fewest_blocks: int = DEPENDENCE_SETTINGS.lonely, fewest: int = 1) -> Bools:
        """Return the bins that enough blocks and samples meet and whose equations can be solved; (bin,)."""
        size = self.size
        enough = (size > 0).sum(axis=0) >= min(fewest_blocks, len(size))
        enough &= self.count.sum(axis=0) >= fewest
        if self.gram.shape[2] > 1:
            eye = np.eye(self.gram.shape[2])
            enough &= np.linalg.cond(self.gram.sum(axis=0) + 1e-12 * eye) < DEPENDENCE_SETTINGS.condition
        return np.asarray(enough)

    @property
    def value(self) -> Any:
        """Coefficients of all blocks; (bin, column, series). Zero where there is nothing."""
        return _solved(self.gram.sum(axis=0), self.right.sum(axis=0))

    @property
    def without(self) -> Any:
        """Coefficients without one of the blocks; (block, bin, column, series)."""
        return _solved(self.gram.sum(axis=0) - self.gram, self.right.sum(axis=0) - self.right)

    def share(self, met: Bools) -> Floats:
        """Return the part of the samples that each of some bins holds; (bin,)."""
        count = np.where(met, self.count.sum(axis=0), 0.0)
        return np.asarray(count / max(count.sum(), 1e-300))


def _solved(gram: Any, right: Any) -> Any:
    """Return the solutions of (..., column, column) and (..., column, series); zero where all is zero."""
    if gram.shape[-1] == 1:
        size = gram[..., 0, 0].real[..., None, None]
        # A sum without its only block is zero but for rounding.
        empty = size <= 1e-12 * size.max(initial=0.0)
        return np.where(empty, 0.0, right) / np.where(empty, 1.0, size)
    trace = np.trace(gram, axis1=-2, axis2=-1).real
    ridge = 1e-9 * np.maximum(trace, 1e-9)[..., None, None] * np.eye(gram.shape[-1])
    return np.linalg.solve(gram + ridge, right)


def excess_rms(mean: Floats, without: Floats, share: Floats) -> tuple[float, float]:
    """Return the weighted rms of bins less what their noise makes of it, and its standard deviation.

    Parameters
    ----------
    mean, without : ndarray, shape (bin,), (block, bin)
    share : ndarray, shape (bin,)
        Weights that sum to one.
    """
    noise = jackknife(without)
    amplitude = np.sqrt(max(float(share @ (mean**2 - noise**2)), 0.0))
    each = np.sqrt(np.maximum((without**2) @ share, 0.0))
    return float(amplitude), max(float(jackknife(each)), 1e-9)


def bin_edges(values: Floats, bins: int) -> Floats | None:
    """Return edges of bins of about equal counts; None when the values do not vary."""
    if values.size == 0:
        return None
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, bins + 1)))
    if edges.size == 2 and np.unique(values).size == 2:
        # Two states, such as on and off: one bin each.
        edges = np.array([edges[0], 0.5 * (edges[0] + edges[1]), edges[1]])
    return edges if edges.size >= 3 else None


def bin_indices(values: Floats, edges: Floats) -> Ints:
    """Return the bin of each value; those beyond the ends are in the first and last."""
    place = np.searchsorted(edges, values, side="right") - 1
    return np.asarray(np.clip(place, 0, edges.size - 2), dtype=np.int64)


def bin_count(kind: str, block: Ints, bins: int = DEPENDENCE_SETTINGS.bins) -> int:
    """Return the bins of a coordinate of a kind: in time, each takes several blocks."""
    if kind != "time":
        return bins
    return int(np.clip(np.unique(block).size // DEPENDENCE_SETTINGS.block_bins, 2, bins))


def rising_or_falling(values: Floats, reach: int) -> Floats:
    """Return +1 where a channel (sample,) rises over `reach` samples on either side, -1 where it falls.

    Zero where it hardly moves.
    """
    change = np.zeros_like(values)
    if values.size > 2 * reach:
        change[reach:-reach] = values[2 * reach :] - values[: -2 * reach]
    change = np.nan_to_num(change)
    spread = float(np.nanstd(values)) if np.isfinite(values).any() else 0.0
    return np.where(np.abs(change) > DEPENDENCE_SETTINGS.moving * spread, np.sign(change), 0.0)


def placebo_shifts_of(values: Any) -> Iterator[Any]:
    """Yield a coordinate (sample,) as it was in other parts of the record: a placebo."""
    for part in DEPENDENCE_SETTINGS.shifts:
        yield np.roll(values, round(part * len(values)))


@dataclass(frozen=True)
class Branch:
    """Mean residual in bins of a coordinate, and its standard deviation between blocks; (bin,) nT."""

    mean: Floats
    sigma: Floats


@dataclass(frozen=True)
class Loop:
    """Mean residual while a coordinate rises and while it falls, and how far the two stand apart.

    `opening` is the rms of their difference, nT, less what noise makes of it; `sigma_opening` its
    standard deviation between blocks.
    """

    rising: Branch
    falling: Branch
    opening: float
    sigma_opening: float

    @property
    def is_open(self) -> bool:
        """True when the branches differ by five sigma."""
        return self.opening > DEPENDENCE_SETTINGS.clear * self.sigma_opening


@dataclass(frozen=True, kw_only=True)
class Dependence:
    """Mean residual in bins of a coordinate, with its uncertainty between blocks.

    Attributes
    ----------
    centre, mean, sigma : ndarray, shape (bin,)
        Mean coordinate of each bin; mean residual less the overall mean, and its standard deviation
        from a jackknife over blocks (nT). NaN where too few blocks meet.
    amplitude : float
        Rms of the means, weighted by their counts, less what noise makes of it, nT.
    sigma_amplitude : float
        Its standard deviation from the same jackknife, nT.
    loop : Loop, optional
        The branches, where it is known when the coordinate rises.
    """

    coordinate: str
    unit: str
    centre: Floats
    mean: Floats
    sigma: Floats
    amplitude: float
    sigma_amplitude: float
    loop: Loop | None = None

    @property
    def is_clear(self) -> bool:
        """True when the amplitude stands out by five sigma."""
        return self.amplitude > DEPENDENCE_SETTINGS.clear * self.sigma_amplitude


def dependence(
    name: str,
    unit: str,
    coordinate: Floats,
    residual: Floats,
    block: Ints,
    rising: Floats | None = None,
    bins: int = DEPENDENCE_SETTINGS.bins,
) -> Dependence | None:
    """Measure how a residual depends on a coordinate.

    Parameters
    ----------
    name, unit : str
        Of the coordinate.
    coordinate, residual : ndarray, shape (sample,)
        NaN are left out; residual in nT.
    block : ndarray of int, shape (sample,)
        Block of each sample; blocks are taken as independent, samples are not.
    rising : ndarray, shape (sample,), optional
        Positive where the coordinate rises, negative where it falls: gives the two branches.
    bins : int
        Bins of about equal counts.

    Returns
    -------
    Dependence or None
        None when the coordinate does not vary, or there are too few blocks
        (`DependenceSettings.min_blocks`).
    """
    cut = _Cut.of(coordinate, residual, block, bins)
    return None if cut is None else _measure_in_bins(name, unit, cut, residual, rising)


@dataclass(frozen=True)
class _Cut:
    """The samples of a coordinate cut into bins and blocks: the same for every residual of these samples.

    Attributes
    ----------
    good : ndarray of bool, shape (sample,)
        Where coordinate and residual are known.
    index, block : ndarray of int, shape (good sample,)
        Bin, and block counted from zero.
    centre : ndarray, shape (bin,)
        Mean of the coordinate.
    """

    good: Bools
    index: Ints
    block: Ints
    centre: Floats

    @classmethod
    def of(cls, coordinate: Floats, residual: Floats, block: Ints, bins: int) -> _Cut | None:
        """Return None when the coordinate does not vary, or there are too few blocks."""
        good = np.isfinite(coordinate) & np.isfinite(residual)
        x = coordinate[good]
        blocks, which = np.unique(block[good], return_inverse=True)
        edges = bin_edges(x, bins)
        if blocks.size < DEPENDENCE_SETTINGS.min_blocks or edges is None:
            return None
        index, count = bin_indices(x, edges), edges.size - 1
        centre = np.bincount(index, weights=x, minlength=count) / np.bincount(index, minlength=count)
        return cls(good, index, which, centre)


def _measure_in_bins(
    name: str, unit: str, cut: _Cut, residual: Floats, rising: Floats | None
) -> Dependence | None:
    """Return `dependence` of samples that are cut into bins; None when too few bins are met."""
    y, count = residual[cut.good], cut.centre.size
    y = y - y.mean()
    cells = _means(y, cut.block, cut.index, count)
    met, mean, without = _branch(cells)
    if met.sum() < 2:
        return None
    amplitude, sigma_amplitude = excess_rms(np.nan_to_num(mean), without, cells.share(met))
    loop = None
    if rising is not None:
        sides, blocks = [rising[cut.good] * sign > 0 for sign in (1.0, -1.0)], len(cells.count)
        loop = _loop([_means(y[side], cut.block[side], cut.index[side], count, blocks) for side in sides])
    return Dependence(
        coordinate=name,
        unit=unit,
        centre=cut.centre,
        mean=mean,
        sigma=np.where(met, jackknife(without), np.nan),
        amplitude=amplitude,
        sigma_amplitude=sigma_amplitude,
        loop=loop,
    )


def _means(y: Floats, block: Ints, index: Ints, bins: int, blocks: int = 0) -> BinnedFit:
    """Return the fit of a constant in each bin; of so many blocks at least."""
    found = BinnedFit.of(np.ones((y.size, 1, 1)), y[:, None, None], block, index, bins)
    lacking = max(blocks - len(found.count), 0)
    if not lacking:
        return found
    more = [np.concatenate([one, np.zeros((lacking, *one.shape[1:]))]) for one in vars(found).values()]
    return BinnedFit(*more)


def _branch(cells: BinnedFit) -> tuple[Bools, Floats, Floats]:
    """Return which bins are met, their means (NaN elsewhere), and the means without a block (0 elsewhere)."""
    met = cells.met()
    return met, np.where(met, cells.value[:, 0, 0], np.nan), np.where(met, cells.without[:, :, 0, 0], 0.0)


def _loop(sides: Sequence[BinnedFit]) -> Loop | None:
    """Return the branches of a coordinate that rises and falls within blocks."""
    (met, rising, first), (met_falling, falling, second) = (_branch(side) for side in sides)
    both = met & met_falling
    if both.sum() < 2:
        return None
    branches = [
        Branch(mean, np.where(there, jackknife(without), np.nan))
        for there, mean, without in ((met, rising, first), (met_falling, falling, second))
    ]
    share = np.where(both, np.minimum(*(side.count.sum(axis=0) for side in sides)), 0.0)
    apart = np.nan_to_num(rising - falling)
    opening, sigma = excess_rms(apart, first - second, share / share.sum())
    return Loop(branches[0], branches[1], opening, sigma)


@dataclass(frozen=True, kw_only=True)
class AxisResponse:
    """What a field along each sensor axis would have to be to make a residual follow a coordinate.

    Attributes
    ----------
    centre : ndarray, shape (bin,)
        Mean coordinate of each bin.
    field, sigma : ndarray, shape (bin, axis)
        Field less its mean over the bins, nT, and its standard deviation between blocks.
    amplitude, sigma_amplitude : ndarray, shape (axis,)
        Rms over the bins less what noise makes of it, and its standard deviation, nT.
    """

    coordinate: str
    unit: str
    centre: Floats
    field: Floats
    sigma: Floats
    amplitude: Floats
    sigma_amplitude: Floats

    @property
    def axis(self) -> str:
        """The axis that stands out: x, y or z; empty when none does by three sigma."""
        ratio = self.amplitude / self.sigma_amplitude
        best = int(np.argmax(np.where(ratio > DEPENDENCE_SETTINGS.axis_clear, self.amplitude, 0.0)))
        return "xyz"[best] if ratio[best] > DEPENDENCE_SETTINGS.axis_clear else ""


def axis_response(
    name: str,
    unit: str,
    coordinate: Floats,
    residual: Floats,
    direction: Floats,
    block: Ints,
    bins: int = DEPENDENCE_SETTINGS.field_bins,
) -> AxisResponse | None:
    """Fit in each bin of a coordinate the field (three components) that the residual is the projection of.

    Parameters
    ----------
    name, unit : str
        Of the coordinate.
    coordinate, residual : ndarray, shape (sample,)
        Residual |B| - F in nT: a field f at the vector sensor makes ``direction @ f`` of it.
    direction : ndarray, shape (sample, 3)
        Unit vector of the field in the sensor's axes.
    block : ndarray of int, shape (sample,)
        Blocks of the jackknife.
    bins : int
        Bins of about equal counts; a single one gives the constant field, which with more is taken off.

    Returns
    -------
    AxisResponse or None
        None where `dependence` has none, or a bin does not determine three components.
    """
    good = np.isfinite(coordinate) & np.isfinite(residual) & np.isfinite(direction).all(axis=1)
    x, y, u = coordinate[good], residual[good], direction[good]
    blocks, which = np.unique(block[good], return_inverse=True)
    edges = bin_edges(x, bins) if bins > 1 else np.array([-np.inf, np.inf])
    if blocks.size < DEPENDENCE_SETTINGS.min_blocks or edges is None:
        return None
    index, count = bin_indices(x, edges), edges.size - 1
    cells = BinnedFit.of(u[:, None, :], (y - y.mean())[:, None, None], which, index, count)
    met = cells.met()
    if not met.all():
        return None
    share = cells.share(met)
    field, without = cells.value[..., 0], cells.without[..., 0]
    if bins > 1:
        field, without = subtract_mean(field, share), subtract_mean(without, share)
    amplitude, sigma = np.array(
        [excess_rms(field[:, axis], without[..., axis], share) for axis in range(3)]
    ).T
    return AxisResponse(
        coordinate=name,
        unit=unit,
        centre=np.bincount(index, weights=x, minlength=count) / np.bincount(index, minlength=count),
        field=field,
        sigma=jackknife(without),
        amplitude=amplitude,
        sigma_amplitude=sigma,
    )


def subtract_mean(field: Floats, share: Floats) -> Floats:
    """Return a field (..., bin, axis) less its mean over the bins, weighted by `share` (bin,)."""
    return np.asarray(field - np.einsum("b,...ba->...a", share, field)[..., None, :])


@dataclass(frozen=True)
class Curve:
    """Means in bins of a coordinate; (bin,), `sigma` between blocks, NaN where there is none."""

    label: str
    centre: Floats
    mean: Floats
    sigma: Floats


def curve_of(
    label: str,
    x: Floats,
    y: Floats,
    block: Ints,
    edges: Floats,
    used: Bools,
    settings: Any = DEPENDENCE_SETTINGS,
) -> Curve:
    """Return the mean residual in bins between given edges.

    Parameters
    ----------
    label : str
        Of the curve.
    x, y : ndarray, shape (sample,)
        Coordinate, and residual in nT; NaN are left out.
    block : ndarray of int, shape (sample,)
    edges : ndarray, shape (bin + 1,)
    used : ndarray of bool, shape (sample,)
        Samples of the curve.
    """
    good = used & np.isfinite(x) & np.isfinite(y)
    _, which = np.unique(block[good], return_inverse=True)
    cells = _means(y[good], which, bin_indices(x[good], edges), edges.size - 1, 1)
    met = cells.met(settings.lonely, settings.fewest)
    sigma = jackknife(cells.without[:, :, 0, 0]) if len(cells.count) > 1 else np.full(met.size, np.nan)
    centre = 0.5 * (edges[1:] + edges[:-1])
    return Curve(label, centre, np.where(met, cells.value[:, 0, 0], np.nan), np.where(met, sigma, np.nan))


@dataclass(frozen=True, kw_only=True)
class FieldResponse:
    """The field along each sensor axis that would make the residual follow a channel.

    Attributes
    ----------
    channel, unit : str
    axes : tuple of str
        ``x``, ``y``, ``z``; ``B`` alone, along the field, where its direction hardly turns.
    branches : dict of str to list of Curve
        ``rising``, ``falling`` (or ``all`` of a channel that hardly turns), by axis, and ``after`` when
        something was found.
    centre : ndarray, shape (bin,)
        Of the envelope.
    low, high : list of ndarray, shape (bin,)
        Envelope, by axis, of what the channel at other times explains: what chance does.
    """

    channel: str
    unit: str
    axes: tuple[str, ...]
    branches: dict[str, list[Curve]]
    centre: Floats
    low: list[Floats]
    high: list[Floats]

    def stands_out(self, axis: int) -> bool:
        """Return True when some bin lies beyond chance by three sigma."""
        ends = np.concatenate([self.low[axis], self.high[axis]])
        known = ends[np.isfinite(ends)]
        reach = float(np.abs(known).max()) if known.size else 0.0
        return any(
            bool(np.any(np.isfinite(one.mean) & (np.abs(one.mean) - 3.0 * one.sigma > reach)))
            for name, curves in self.branches.items()
            if name != "after"
            for one in [curves[axis]]
        )


def field_axes(direction: Floats, is_scalar: bool) -> tuple[Floats, tuple[str, ...]]:
    """Return the columns of a field (sample, row, axis), and what their axes are called.

    Where the direction of a scalar comparison hardly turns, the axes cannot be separated: the field along it
    is fitted alone.
    """
    if not is_scalar:
        return direction, ("x", "y", "z")
    if np.linalg.cond(np.einsum("tra,trb->ab", direction, direction)) < DEPENDENCE_SETTINGS.condition:
        return direction, ("x", "y", "z")
    return np.ones((len(direction), 1, 1)), ("B",)


def field_response(
    coordinate: tuple[str, str, Floats],
    residuals: Mapping[str, Floats],
    columns: tuple[Floats, tuple[str, ...]],
    block: Ints,
    used: Bools,
    reach: int,
) -> FieldResponse | None:
    """Return the response of a residual of any rows to a channel: branches, the rest, and chance.

    Parameters
    ----------
    coordinate : tuple of (str, str, ndarray)
        Name, unit and values (sample,).
    residuals : mapping of str to ndarray, shape (sample, row)
        ``before``, and ``after`` when something was found; nT.
    columns : tuple of (ndarray, tuple of str)
        As `field_axes` returns them.
    block : ndarray of int, shape (sample,)
    used : ndarray of bool, shape (sample,)
        Samples with a residual.
    reach : int
        Samples on either side over which the channel rises or falls.

    Returns
    -------
    FieldResponse or None
        None when the channel does not vary, or there are too few blocks.
    """
    name, unit, x = coordinate
    u, axes = columns
    good = used & np.isfinite(x)
    edges = bin_edges(x[good], DEPENDENCE_SETTINGS.curve_bins)
    if edges is None or np.unique(block[good]).size < DEPENDENCE_SETTINGS.min_blocks:
        return None
    before, index, count = residuals["before"], bin_indices(x, edges), edges.size - 1
    sign = rising_or_falling(x, reach) if x.size > 2 * reach else np.zeros_like(x)
    branches: dict[str, list[Curve]] = {}
    if min((sign > 0).mean(), (sign < 0).mean()) > DEPENDENCE_SETTINGS.turning:
        sides = {"rising": good & (sign > 0), "falling": good & (sign < 0)}
    else:
        sides = {"all": good}
    branches |= _field_curves(x, index, count, before, u, block, sides)
    if "after" in residuals:
        branches |= _field_curves(x, index, count, residuals["after"], u, block, {"after": good})
    whole = _field_curves(x, index, count, before, u, block, {"all": good})["all"]
    rest = before - np.einsum("tra,at->tr", u, [np.nan_to_num(one.mean)[index] for one in whole])
    chance = []
    for moved in placebo_shifts_of(x):
        inside = {"chance": used & np.isfinite(moved)}
        one_block = np.zeros_like(block)
        chance.append(
            _field_curves(moved, bin_indices(moved, edges), count, rest, u, one_block, inside)["chance"]
        )
    return FieldResponse(
        channel=name,
        unit=unit,
        axes=axes,
        branches=branches,
        centre=chance[0][0].centre,
        low=[np.min([one[axis].mean for one in chance], axis=0) for axis in range(len(axes))],
        high=[np.max([one[axis].mean for one in chance], axis=0) for axis in range(len(axes))],
    )


def _field_curves(
    x: Floats, index: Ints, bins: int, residual: Floats, u: Floats, block: Ints, sides: Mapping[str, Bools]
) -> dict[str, list[Curve]]:
    """Return, of each side, the field along each axis in bins, all less one common mean field."""
    inside = np.any(list(sides.values()), axis=0)
    side = np.argmax(list(sides.values()), axis=0)[inside]
    _, which = np.unique(block[inside], return_inverse=True)
    place, cells = side * bins + index[inside], len(sides) * bins
    fit = BinnedFit.of(u[inside], residual[inside][:, :, None], which, place, cells)
    met = fit.met(1, DEPENDENCE_SETTINGS.fewest)
    share, total = fit.share(met), fit.count.sum(axis=0)
    sums = np.bincount(place, weights=x[inside], minlength=cells)
    centre = np.divide(sums, total, out=np.full(cells, np.nan), where=total > 0)
    field = subtract_mean(np.where(met[:, None], fit.value[..., 0], 0.0), share)
    sigma = np.full_like(field, np.nan)
    if len(fit.count) > 1:
        sigma = jackknife(subtract_mean(np.where(met[:, None], fit.without[..., 0], 0.0), share))
    field, sigma = (np.where(met[:, None], one, np.nan) for one in (field, sigma))
    parts = {name: slice(at * bins, (at + 1) * bins) for at, name in enumerate(sides)}
    return {
        name: [Curve(name, centre[part], field[part, axis], sigma[part, axis]) for axis in range(u.shape[2])]
        for name, part in parts.items()
    }


def select_successively(
    residual: Residual,
    measure: Callable[[Residual], list[Structure]],
    *,
    size: Callable[[Structure], float],
    is_clear: Callable[[Structure], bool],
    remove: Callable[[Residual, Structure], Residual],
    chance: Callable[[Residual, Structure], float],
    least: float,
    count: int,
) -> Iterator[tuple[Structure, Residual, list[Structure], Residual, list[Structure]]]:
    """Yield the structures of a residual, each measured after the stronger ones were taken off.

    Parameters
    ----------
    residual : any
        What `measure` measures.
    measure : callable
        Returns the dependences of a residual on every coordinate.
    size, is_clear : callable
        Amplitude of a dependence, nT, and whether it stands out between blocks.
    remove : callable
        Returns the residual without a structure.
    chance : callable
        Returns the amplitude that the structure's coordinate at other times explains of such a rest, nT.
    least : float
        Least amplitude, nT.
    count : int
        Structures at most.

    Yields
    ------
    tuple
        The structure, the residual and the dependences it was found in, the rest, and the rest's own
        dependences.
    """
    found = measure(residual)
    for _ in range(count):
        clear = [one for one in found if is_clear(one) and size(one) > least]
        for best in sorted(clear, key=lambda one: -size(one)):
            rest = remove(residual, best)
            if size(best) > chance(rest, best):
                break
        else:
            return
        remaining = measure(rest)
        yield best, residual, clear, rest, remaining
        residual, found = rest, remaining


#: What a structure in a coordinate could come from, by the coordinate's kind.
_MEANING = {
    "time": "something changed in time: an ageing scale factor, or a step at an event",
    "window": "parameters that move within the windows they are fitted in: 'inflight reprocess --table "
    "continuous' follows them",
    "time_of_day": "something with a daily course: a temperature, or the sensor's surroundings",
    "orbit_phase": "something fixed to the orbit: the field's own strength and direction, or a time lag",
    "sun_phase": "something that light and shadow drive: temperatures, solar array, battery",
    "local_time": "something that the season of the orbit drives: full Sun, eclipses, temperatures",
    "latitude": "something that follows the field along the orbit: a time lag between the instruments, "
    "a scale factor",
    "longitude": "something fixed to the Earth: a field-dependent error, or the positions",
    "sunlit": "light and shadow: two levels of a stray field or of an offset",
    "sun_angle": "a field that depends on where the Sun stands: solar panels, sunlit surfaces, a thermal "
    "gradient",
    "field_direction": "an offset along this axis, or an angle between axes",
    "field_component": "a scale factor or a non-linearity of this axis, or an angle to it",
    "field_strength": "a scale factor of either instrument, a bias of the reference, or a non-linearity",
    "temperature": "a scale factor, an angle or an offset that follows this temperature",
    "solar_current": "a stray field of the solar array's current",
    "battery_current": "a stray field of the battery's current",
    "camera_current": "a stray field of the camera's current",
    "torquer_current": "a stray field of the torquers",
    "current": "a stray field of this current",
    "heater": "a stray field of the heater, or what it warms",
    "voltage": "a stray field of the loads behind this voltage",
    "frequency": "the clock of the reference instrument: a scale factor or a time lag",
    "sun_direction": "a field that depends on where the Sun stands",
    "sunlight": "light and shadow: two levels of a stray field or of an offset",
}

_OTHERWISE = "whatever this channel measures, or something that moves with it"


@dataclass(frozen=True)
class Coordinate:
    """What a residual may follow: its values (sample,), unit, and kind (of a channel, or a geometry's)."""

    name: str
    unit: str
    kind: str
    values: Floats
    rising: Floats | None = None


@dataclass(frozen=True)
class RankedDependence:
    """One structure of the residual, less the stronger ones before it."""

    dependence: Dependence
    response: AxisResponse | None
    kind: str
    rank: int

    @property
    def coordinate(self) -> str:
        """What the residual follows."""
        return self.dependence.coordinate

    @property
    def amplitude(self) -> float:
        """Rms of the structure, nT."""
        return self.dependence.amplitude

    @property
    def sigma(self) -> float:
        """Standard deviation of the amplitude between blocks, nT."""
        return self.dependence.sigma_amplitude

    @property
    def axis(self) -> str:
        """Sensor axis along which a field would make it: x, y, z, or empty when none stands out."""
        return self.response.axis if self.response else ""

    @property
    def sentence(self) -> str:
        """The structure as a sentence: what, how large, along which axis, and what could make it."""
        found, loop = self.dependence, self.dependence.loop
        unit = f" {found.unit}" if found.unit not in ("", "1") else ""
        ends = [
            f"{found.mean[at]:+.3f} +- {found.sigma[at]:.3f} nT near {found.centre[at]:.4g}{unit}"
            for at in (int(np.nanargmin(found.mean)), int(np.nanargmax(found.mean)))
        ]
        along, branches = ", along no axis more than another", ""
        if self.axis and self.response is not None:
            index = "xyz".index(self.axis)
            amplitude, sigma = self.response.amplitude[index], self.response.sigma_amplitude[index]
            along = f", as a field along {self.axis} of {amplitude:.3f} +- {sigma:.3f} nT would make it"
        if loop is not None and loop.is_open:
            branches = (
                f"; rising and falling differ by {loop.opening:.3f} +- {loop.sigma_opening:.3f} nT "
                "(hysteresis, or a slow response)"
            )
        return (
            f"{'The residual' if self.rank == 0 else 'Beyond that, the residual'} follows {self.coordinate} "
            f"with {self.amplitude:.3f} +- {self.sigma:.3f} nT rms ({ends[0]}, {ends[1]}){along}{branches}; "
            f"it could be {_MEANING.get(self.kind, _OTHERWISE)}."
        )


def measure_dependences(coordinates: Iterable[Coordinate], residual: Floats, block: Ints) -> list[Dependence]:
    """Return how the residual (sample,) depends on each coordinate that varies, in their order."""
    found = (_dependence_on(one, residual, block) for one in coordinates)
    return [one for one in found if one is not None]


def _dependence_on(one: Coordinate, residual: Floats, block: Ints, rising: bool = True) -> Dependence | None:
    branches = one.rising if rising else None
    return dependence(one.name, one.unit, one.values, residual, block, branches, bin_count(one.kind, block))


def rank_dependences(
    coordinates: Mapping[str, Coordinate],
    found: list[Dependence],
    residual: Floats,
    direction: Floats,
    block: Ints,
) -> list[RankedDependence]:
    """Return the strongest structures of a residual of one row, each after the stronger ones were taken off.

    Parameters
    ----------
    coordinates : mapping of str to Coordinate
        By name.
    found : list of Dependence
        Of the whole residual, as `measure_dependences` returns them.
    residual : ndarray, shape (sample,)
        nT.
    direction : ndarray, shape (sample, 3)
        Unit vector of the field, axes of the vector sensor.
    block : ndarray of int, shape (sample,)
        Blocks of the jackknife.
    """
    # Time in the window of a table is no course of its own: see `as_window`.
    varying = [coordinates[one.coordinate] for one in found if coordinates[one.coordinate].kind != "window"]
    found = [one for one in found if coordinates[one.coordinate].kind != "window"]

    @cache
    def cut(name: str) -> _Cut | None:
        # What is taken off leaves the samples as they are: they are cut once.
        one = coordinates[name]
        return _Cut.of(one.values, residual, block, bin_count(one.kind, block))

    def measured(rest: Floats) -> list[Dependence]:
        if rest is residual:
            return found
        cuts = ((one, cut(one.name)) for one in varying)
        each = (
            _measure_in_bins(one.name, one.unit, bins, rest, one.rising)
            for one, bins in cuts
            if bins is not None
        )
        return [one for one in each if one is not None]

    def response(of: Floats, best: Dependence) -> AxisResponse | None:
        one = coordinates[best.coordinate]
        # What follows the field itself is a constant field, or no field at all.
        bins = 1 if one.kind.startswith("field_") else DEPENDENCE_SETTINGS.field_bins
        return axis_response(one.name, one.unit, one.values, of, direction, block, bins)

    def removed(of: Floats, best: Dependence) -> Floats:
        """Return the residual without a structure: its field along the axes, and its mean curve beyond."""
        one, along = coordinates[best.coordinate], response(of, best)
        fitted = np.zeros_like(of)
        if along is not None and along.axis:
            curves = [np.interp(one.values, along.centre, along.field[:, axis]) for axis in range(3)]
            fitted = np.nan_to_num(np.einsum("at,ta->t", np.array(curves), direction))
            best = _dependence_on(one, of - fitted, block, rising=False) or best
        met = np.isfinite(best.mean)
        curve = np.nan_to_num(np.interp(one.values, best.centre[met], best.mean[met]))
        return np.asarray(of - (fitted + curve))

    def chance(rest: Floats, best: Dependence) -> float:
        one = coordinates[best.coordinate]
        moved = (Coordinate(one.name, one.unit, one.kind, values) for values in placebo_shifts_of(one.values))
        return max((each.amplitude for each in measure_dependences(moved, rest, block)), default=0.0)

    def as_window(of: Floats, best: Dependence) -> Dependence:
        """Return a course in time as one that repeats in every window of a table, where it does."""
        window = next((one for one in coordinates.values() if one.kind == "window"), None)
        if window is None or coordinates[best.coordinate].kind != "time":
            return best
        repeated = _dependence_on(window, of, block)
        enough = repeated and DEPENDENCE_SETTINGS.window_preference * repeated.amplitude >= best.amplitude
        return repeated if repeated is not None and enough else best

    least = (
        DEPENDENCE_SETTINGS.least_part * float(np.nanstd(residual)) if np.isfinite(residual).any() else 0.0
    )
    structures = select_successively(
        residual,
        measured,
        size=lambda one: one.amplitude,
        is_clear=lambda one: one.is_clear,
        remove=removed,
        chance=chance,
        least=least,
        count=DEPENDENCE_SETTINGS.count,
    )
    told = [(as_window(of, best), of) for best, of, _, _, _ in structures]
    return [
        RankedDependence(best, response(of, best), coordinates[best.coordinate].kind, rank)
        for rank, (best, of) in enumerate(told)
    ]
