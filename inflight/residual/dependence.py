"""Residual against any coordinate, ranked.

How a residual depends on a coordinate: means in bins, their branches, the sensor axis behind them.

Uncertainties are jackknives over blocks of time: samples of a block are not independent, blocks are.

Where a model fails, in words: the strongest structures of its residual, one after the other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.lsq import jackknife

#: Bins of a dependence, and the fewest blocks its uncertainty is taken from.
BINS = 24

MIN_BLOCKS = 6

#: A bin that fewer blocks meet has no uncertainty between blocks.
LONELY = 3

#: What stands out: so many standard deviations.
CLEAR = 5.0


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
        return self.opening > CLEAR * self.sigma_opening


@dataclass(frozen=True)
class Dependence:
    """Mean residual in bins of a coordinate, with its uncertainty between blocks.

    Attributes
    ----------
    centre, mean, sigma : ndarray, shape (bin,)
        Mean coordinate of each bin; mean residual less the overall mean, and its standard deviation
        from a jackknife over blocks (nT). NaN where fewer than `LONELY` blocks meet.
    amplitude : float
        Rms of the means, weighted by their counts, less what noise makes of it, nT.
    sigma_amplitude : float
        Its standard deviation from the same jackknife, nT.
    loop : Loop, optional
        The branches, where it was said when the coordinate rises.
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
        return self.amplitude > CLEAR * self.sigma_amplitude


@dataclass(frozen=True)
class _Binned:
    """Sums of a residual in cells of (block, bin)."""

    count: Floats
    total: Floats

    @classmethod
    def of(cls, y: Floats, which: npt.NDArray[np.int64], index: npt.NDArray[np.int64], shape: Any) -> _Binned:
        cell = which * shape[1] + index
        size = shape[0] * shape[1]
        count = np.bincount(cell, minlength=size).reshape(shape).astype(np.float64)
        return cls(count, np.bincount(cell, weights=y, minlength=size).reshape(shape))

    @property
    def met(self) -> npt.NDArray[np.bool_]:
        """Bins that enough blocks meet; (bin,)."""
        return np.asarray((self.count > 0).sum(axis=0) >= LONELY)

    @property
    def mean(self) -> Floats:
        """Means of the bins; (bin,), NaN where too few blocks meet."""
        each = self.count.sum(axis=0)
        return np.where(self.met, self.total.sum(axis=0) / np.maximum(each, 1.0), np.nan)

    @property
    def without(self) -> Floats:
        """The means without one of the blocks; (block, bin)."""
        count = self.count.sum(axis=0) - self.count
        total = self.total.sum(axis=0) - self.total
        return np.where(self.met & (count > 0), total / np.maximum(count, 1.0), np.nan)


def _rms(mean: Floats, without: Floats, share: Floats) -> tuple[float, float]:
    """Return the weighted rms of bins less what their noise makes of it, and its standard deviation."""
    noise = jackknife(without)
    amplitude = np.sqrt(max(float(share @ (mean**2 - noise**2)), 0.0))
    each = np.sqrt(np.maximum((without**2) @ share, 0.0))
    return float(amplitude), max(float(jackknife(each)), 1e-9)


def dependence(
    name: str,
    unit: str,
    coordinate: Floats,
    residual: Floats,
    block: npt.NDArray[np.int64],
    rising: Floats | None = None,
    bins: int = BINS,
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
        None when the coordinate does not vary, or there are fewer than `MIN_BLOCKS` blocks.
    """
    good = np.isfinite(coordinate) & np.isfinite(residual)
    x, y = coordinate[good], residual[good]
    blocks, which = np.unique(block[good], return_inverse=True)
    edges = bin_edges(x, bins)
    if blocks.size < MIN_BLOCKS or edges is None:
        return None
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, edges.size - 2)
    shape = (blocks.size, edges.size - 1)
    y = y - y.mean()
    cells = _Binned.of(y, which, index, shape)
    met = cells.met
    if met.sum() < 2:
        return None
    share = np.where(met, cells.count.sum(axis=0), 0.0)
    share /= share.sum()
    amplitude, sigma_amplitude = _rms(np.nan_to_num(cells.mean), np.nan_to_num(cells.without), share)
    sigma = np.where(met, jackknife(np.nan_to_num(cells.without)), np.nan)
    centre = np.bincount(index, weights=x, minlength=shape[1]) / np.bincount(index, minlength=shape[1])
    loop = _loop(y, which, index, shape, rising[good]) if rising is not None else None
    return Dependence(name, unit, centre, cells.mean, sigma, amplitude, sigma_amplitude, loop)


def bin_edges(values: Floats, bins: int) -> Floats | None:
    """Return edges of bins of about equal counts; None when the values do not vary."""
    if values.size == 0:
        return None
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, bins + 1)))
    if edges.size == 2 and np.unique(values).size == 2:
        # Two states, such as on and off: one bin each.
        edges = np.array([edges[0], 0.5 * (edges[0] + edges[1]), edges[1]])
    return edges if edges.size >= 3 else None


def _loop(y: Floats, which: Any, index: Any, shape: tuple[int, int], rising: Floats) -> Loop | None:
    """Return the branches of a coordinate that rises and falls within blocks."""
    parts = []
    for sign in (1.0, -1.0):
        rows = rising * sign > 0
        parts.append(_Binned.of(y[rows], which[rows], index[rows], shape))
    both = parts[0].met & parts[1].met
    if both.sum() < 2:
        return None
    branches = [
        Branch(part.mean, np.where(part.met, jackknife(np.nan_to_num(part.without)), np.nan))
        for part in parts
    ]
    share = np.where(both, np.minimum(parts[0].count.sum(axis=0), parts[1].count.sum(axis=0)), 0.0)
    share /= share.sum()
    apart = np.nan_to_num(parts[0].mean - parts[1].mean)
    without = np.nan_to_num(parts[0].without - parts[1].without)
    opening, sigma = _rms(apart, without, share)
    return Loop(branches[0], branches[1], opening, sigma)


@dataclass(frozen=True)
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
        pulls = self.amplitude / self.sigma_amplitude
        best = int(np.argmax(np.where(pulls > 3.0, self.amplitude, 0.0)))
        return "xyz"[best] if pulls[best] > 3.0 else ""


def axis_response(
    name: str,
    unit: str,
    coordinate: Floats,
    residual: Floats,
    direction: Floats,
    block: npt.NDArray[np.int64],
    bins: int = 8,
) -> AxisResponse | None:
    """Fit in each bin of a coordinate the field (three components) that the residual is the projection of.

    Parameters
    ----------
    name, unit : str
        Of the coordinate.
    coordinate, residual : ndarray, shape (sample,)
        Residual |B| - F in nT: a field f at the vector sensor makes ``direction @ f`` of it.
    direction : ndarray, shape (sample, 3)
        Unit vector of the field in the axes wanted.
    block : ndarray of int, shape (sample,)
        Blocks of the jackknife.
    bins : int
        Bins of about equal counts; with a single one the constant field is told, which with more
        is taken off.

    Returns
    -------
    AxisResponse or None
        None where `dependence` has none, or a bin does not tell three components.
    """
    good = np.isfinite(coordinate) & np.isfinite(residual) & np.isfinite(direction).all(axis=1)
    x, y, u = coordinate[good], residual[good], direction[good]
    blocks, which = np.unique(block[good], return_inverse=True)
    edges = bin_edges(x, bins) if bins > 1 else np.array([-np.inf, np.inf])
    if blocks.size < MIN_BLOCKS or edges is None:
        return None
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, edges.size - 2)
    shape = (blocks.size, edges.size - 1)
    cells = _Binned.of(np.ones_like(y), which, index, shape)
    gram, right = np.empty((*shape, 3, 3)), np.empty((*shape, 3))
    for i in range(3):
        right[..., i] = _Binned.of(u[:, i] * (y - y.mean()), which, index, shape).total
        for j in range(i, 3):
            gram[..., i, j] = gram[..., j, i] = _Binned.of(u[:, i] * u[:, j], which, index, shape).total
    whole = gram.sum(axis=0)
    if not cells.met.all() or np.linalg.cond(whole).max() > 1e4:
        return None
    share = cells.count.sum(axis=0) / cells.count.sum()
    centred = _centred if bins > 1 else _as_it_is
    field_ = centred(np.linalg.solve(whole, right.sum(axis=0)[..., None])[..., 0], share)
    ridge = 1e-9 * np.trace(whole, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    left = whole - gram + ridge
    without = centred(np.linalg.solve(left, (right.sum(axis=0) - right)[..., None])[..., 0], share)
    found = [_rms(field_[:, axis], without[..., axis], share) for axis in range(3)]
    centre = np.bincount(index, weights=x, minlength=shape[1]) / np.bincount(index, minlength=shape[1])
    amplitude, sigma = np.array(found).T
    return AxisResponse(name, unit, centre, field_, jackknife(without), amplitude, sigma)


def _centred(field: Floats, share: Floats) -> Floats:
    """Return a field (..., bin, axis) less its weighted mean over the bins."""
    return np.asarray(field - np.einsum("b,...ba->...a", share, field)[..., None, :])


def _as_it_is(field: Floats, share: Floats) -> Floats:
    return field


def strongest(found: Sequence[Dependence], count: int = 3) -> list[Dependence]:
    """Return the dependences that stand out by five sigma, largest first."""
    return sorted((one for one in found if one.is_clear), key=lambda one: -one.amplitude)[:count]


#: Structures told, and the part of the residual's own rms below which one is not worth a sentence.
COUNT, _LEAST_PART = 3, 0.01

#: What a structure in a coordinate could come from, by the coordinate's kind.
_MEANING = {
    "time": "something changed in time: an ageing scale factor, or a step at an event",
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
class Failure:
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
        """What a physicist would say of it."""
        opening = "The residual" if self.rank == 0 else "Beyond that, the residual"
        meaning = _MEANING.get(self.kind, _OTHERWISE)
        return (
            f"{opening} follows {self.coordinate} with {self.amplitude:.3f} +- {self.sigma:.3f} nT rms"
            f"{self._extremes()}{self._along()}{self._loop()}; it could be {meaning}."
        )

    def _extremes(self) -> str:
        found = self.dependence
        low, high = int(np.nanargmin(found.mean)), int(np.nanargmax(found.mean))
        unit = f" {found.unit}" if found.unit not in ("", "1") else ""
        told = [
            f"{found.mean[at]:+.3f} +- {found.sigma[at]:.3f} nT near {found.centre[at]:.4g}{unit}"
            for at in (low, high)
        ]
        return f" ({told[0]}, {told[1]})"

    def _along(self) -> str:
        if not self.axis or self.response is None:
            return ", along no axis more than another"
        index = "xyz".index(self.axis)
        amplitude, sigma = self.response.amplitude[index], self.response.sigma_amplitude[index]
        return f", as a field along {self.axis} of {amplitude:.3f} +- {sigma:.3f} nT would make it"

    def _loop(self) -> str:
        loop = self.dependence.loop
        if loop is None or not loop.is_open:
            return ""
        return (
            f"; rising and falling differ by {loop.opening:.3f} +- {loop.sigma_opening:.3f} nT "
            "(hysteresis, or a slow response)"
        )


def measure(
    coordinates: Iterable[Coordinate], residual: Floats, block: npt.NDArray[np.int64]
) -> list[Dependence]:
    """Return how the residual (sample,) depends on each coordinate that varies, in their order."""
    found = (
        dependence(one.name, one.unit, one.values, residual, block, one.rising, _bins(one, block))
        for one in coordinates
    )
    return [one for one in found if one is not None]


def _bins(one: Coordinate, block: npt.NDArray[np.int64]) -> int:
    """Return the bins of a coordinate: in time, each takes several blocks."""
    return int(np.clip(np.unique(block).size // 4, 2, 24)) if one.kind == "time" else 24


def find_failures(
    coordinates: Mapping[str, Coordinate],
    found: list[Dependence],
    residual: Floats,
    direction: Floats,
    block: npt.NDArray[np.int64],
) -> list[Failure]:
    """Return the strongest structures, each measured after the stronger ones were taken off.

    Coordinates move together: what one structure leaves in twenty coordinates is told once.

    Parameters
    ----------
    coordinates : mapping of str to Coordinate
        By name.
    found : list of Dependence
        Of the whole residual, as `measure` returns them.
    residual : ndarray, shape (sample,)
        nT.
    direction : ndarray, shape (sample, 3)
        Unit vector of the field, axes of the vector sensor.
    block : ndarray of int, shape (sample,)
        Blocks of the jackknife.
    """
    failures: list[Failure] = []
    left, told = residual, found
    least = _LEAST_PART * float(np.nanstd(residual)) if np.isfinite(residual).any() else 0.0
    while len(failures) < COUNT:
        clear = [one for one in told if one.is_clear and one.amplitude > least]
        if not clear:
            break
        best = max(clear, key=lambda one: one.amplitude)
        one = coordinates[best.coordinate]
        # What follows the field itself is a constant field, or no field at all.
        parts = 1 if one.kind.startswith("field_") else 8
        response = axis_response(one.name, one.unit, one.values, left, direction, block, parts)
        failures.append(Failure(best, response, one.kind, len(failures)))
        left = left - _fitted(best, one, left, response, direction, block)
        told = measure((coordinates[each.coordinate] for each in found), left, block)
    return failures


def _fitted(
    best: Dependence,
    one: Coordinate,
    residual: Floats,
    response: AxisResponse | None,
    direction: Floats,
    block: npt.NDArray[np.int64],
) -> Floats:
    """Return what a structure makes of the residual: its field along the axes, and its mean curve beyond."""
    fitted = np.zeros_like(residual)
    if response is not None and response.axis:
        curves = [np.interp(one.values, response.centre, response.field[:, axis]) for axis in range(3)]
        fitted = np.nan_to_num(np.einsum("at,ta->t", np.array(curves), direction))
        beyond = dependence(one.name, one.unit, one.values, residual - fitted, block, bins=_bins(one, block))
        best = beyond or best
    met = np.isfinite(best.mean)
    return np.asarray(fitted + np.nan_to_num(np.interp(one.values, best.centre[met], best.mean[met])))
