"""What the residual follows: the field along each sensor axis as a function of a channel, and chance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dependence import MIN_BLOCKS, bin_edges, jackknife
from inflight.diagnosis.pictures import BINS, FEWEST, Curve, Seen
from inflight.diagnosis.series import Series
from inflight.time import DAY, SECOND, Int64

#: A bin whose field is known worse than this (condition of its equations) is left out.
_CONDITION = 1e4
#: Shifts of a channel that its envelope of chance is taken from, in days.
_SHIFTS = (1.27, 1.61, 2.37, 2.74, 3.43, 3.83)


@dataclass(frozen=True)
class Response:
    """The field along each sensor axis that would make the residual follow a channel.

    Attributes
    ----------
    axes : tuple of str
        ``x``, ``y``, ``z``; ``B`` alone, along the field, where its direction hardly turns.
    branches : dict of str to list of Curve
        ``rising``, ``falling`` (or ``all`` of a channel that hardly turns), by axis, and ``after`` when
        something was found.
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
        return any(
            bool(np.any(np.isfinite(one.mean) & (np.abs(one.mean) - 3.0 * one.sigma > reach)))
            for name, curves in self.branches.items()
            if name != "after"
            for one, reach in [(curves[axis], self._reach(axis))]
        )

    def _reach(self, axis: int) -> float:
        ends = np.concatenate([self.low[axis], self.high[axis]])
        known = ends[np.isfinite(ends)]
        return float(np.abs(known).max()) if known.size else 0.0


def responses(seen: Seen, channels: Sequence[str]) -> list[Response]:
    """Return the response to each channel that varies; those without enough bins are left out."""
    thin = seen.thinned()
    u, axes = _directions(thin)
    return [found for name in channels for found in [_response(thin, u, axes, name)] if found is not None]


def _directions(seen: Seen) -> tuple[Floats, tuple[str, ...]]:
    """Return the direction of each row (sample, row, axis), and what its axes are called."""
    u = np.where(seen.good[:, None, None], seen.series.direction(), 0.0)
    if not seen.is_scalar or np.linalg.cond(np.einsum("tra,trb->ab", u, u)) < _CONDITION:
        return u, ("x", "y", "z")
    return np.ones((len(u), 1, 1)), ("B",)


def _response(seen: Seen, u: Floats, axes: tuple[str, ...], name: str) -> Response | None:
    series = seen.series
    x = series[name]
    if x.ndim != 1:
        return None
    good = seen.good & np.isfinite(x)
    edges = bin_edges(x[good], BINS)
    blocks = np.unique(seen.block[good])
    if edges is None or blocks.size < MIN_BLOCKS:
        return None
    place = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, edges.size - 2)
    before, after = seen.before, seen.after
    rising = _rising(x, series)
    branches = {}
    if rising is None:
        branches["all"] = _fields("all", x, place, before, u, seen.block, [good])[0]
    else:
        both = [good & (rising > 0), good & (rising < 0)]
        found = _fields("rising", x, place, before, u, seen.block, both)
        branches["rising"] = found[0]
        branches["falling"] = [Curve("falling", one.centre, one.mean, one.sigma) for one in found[1]]
    if seen.changed:
        branches["after"] = _fields("after", x, place, after, u, seen.block, [good])[0]
    chance = list(_chance(seen, u, x, edges, good))
    low = [np.min([one[axis].mean for one in chance], axis=0) for axis in range(len(axes))]
    high = [np.max([one[axis].mean for one in chance], axis=0) for axis in range(len(axes))]
    unit = series.features.units[series.features.names.index(name)]
    return Response(name, unit, axes, branches, chance[0][0].centre, low, high)


def _rising(x: Floats, series: Series) -> Floats | None:
    """Return +1 where a channel rises, -1 where it falls, 0 between; None when it turns too seldom."""
    reach = max(1, round(120.0 / series.step_s))
    change = np.zeros_like(x)
    if x.size <= 2 * reach:
        return None
    change[reach:-reach] = x[2 * reach :] - x[: -2 * reach]
    change = np.nan_to_num(change)
    spread = float(np.nanstd(x))
    sign = np.where(np.abs(change) > 0.02 * spread, np.sign(change), 0.0)
    return sign if min((sign > 0).mean(), (sign < 0).mean()) > 0.1 else None


def _chance(
    seen: Seen, u: Floats, x: Floats, edges: Floats, good: npt.NDArray[np.bool_]
) -> Iterator[list[Curve]]:
    """Yield the response to the channel of another time, which the residual cannot follow."""
    series = seen.series
    per_day = DAY / (SECOND * series.step_s)
    for shift in _SHIFTS:
        samples = round(shift * per_day)
        if samples >= 0.6 * x.size:
            samples = round(x.size * (0.2 + 0.6 * (shift % 1.0)))
        moved = np.roll(x, samples)
        place = np.clip(np.searchsorted(edges, moved, side="right") - 1, 0, edges.size - 2)
        inside = good & np.isfinite(moved)
        yield _fields("chance", moved, place, seen.before, u, np.zeros_like(seen.block), [inside])[0]


def _fields(
    label: str,
    x: Floats,
    place: Int64,
    residual: Floats,
    u: Floats,
    block: Int64,
    sides: Sequence[npt.NDArray[np.bool_]],
) -> list[list[Curve]]:
    """Return, a side, the field along each axis in bins, all less one common mean field.

    The residual of a sample is ``u @ f`` of its row; each bin is a least-squares fit of f.
    """
    bins = int(place.max()) + 1
    inside = np.any(sides, axis=0)
    side = np.argmax(sides, axis=0)[inside]
    _, which = np.unique(block[inside], return_inverse=True)
    shape = (int(which.max()) + 1, len(sides) * bins)
    cell = which * shape[1] + side * bins + place[inside]
    y, rows = residual[inside], u[inside]
    axes = u.shape[2]
    gram, right = np.empty((*shape, axes, axes)), np.empty((*shape, axes))

    def summed(values: Floats) -> Floats:
        found = np.bincount(cell, weights=values, minlength=shape[0] * shape[1])
        return np.asarray(found, dtype=np.float64).reshape(shape)

    for i in range(axes):
        right[..., i] = summed(np.einsum("tr,tr->t", rows[:, :, i], y))
        for j in range(i, axes):
            gram[..., i, j] = gram[..., j, i] = summed(np.einsum("tr,tr->t", rows[:, :, i], rows[:, :, j]))
    count = summed(np.ones(len(y))).sum(axis=0)
    centre = np.divide(summed(x[inside]).sum(axis=0), count, out=np.full(shape[1], np.nan), where=count > 0)
    mean, sigma = _solved(gram, right, count)
    return [
        [Curve(label, centre[part], mean[part, axis], sigma[part, axis]) for axis in range(axes)]
        for part in (slice(one * bins, (one + 1) * bins) for one in range(len(sides)))
    ]


def _solved(gram: Floats, right: Floats, count: Floats) -> tuple[Floats, Floats]:
    """Return each cell's field less the common mean, and its jackknife error over blocks; (cell, axis)."""
    whole, total, eye = gram.sum(axis=0), right.sum(axis=0), np.eye(right.shape[-1])
    met = (count >= FEWEST) & (np.linalg.cond(whole + 1e-12 * eye) < _CONDITION)
    if not met.any():
        nothing = np.full(total.shape, np.nan)
        return nothing, nothing
    share = np.where(met, count, 0.0) / count[met].sum()
    ridge = 1e-9 * np.maximum(np.trace(whole, axis1=1, axis2=2), 1e-9)[:, None, None] * eye
    field = np.linalg.solve(whole + ridge, total[..., None])[..., 0]
    field = np.where(met[:, None], field - share @ np.where(met[:, None], field, 0.0), np.nan)
    if len(gram) < 2:
        return field, np.full_like(field, np.nan)
    without = np.linalg.solve(whole - gram + ridge, (total - right)[..., None])[..., 0]
    without = np.where(met[None, :, None], without, 0.0)
    without -= np.einsum("c,bca->ba", share, without)[:, None, :]
    return field, np.where(met[:, None], jackknife(without), np.nan)
