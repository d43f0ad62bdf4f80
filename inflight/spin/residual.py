"""Tones left and what they follow.

What of a residual still goes with the spin, and what it follows: tones of synthetic turns.

The rows of a spin comparison (`inflight.model.rows`) of one interval are one turn. Its harmonics are the
tones: of the field along the spin axis, and of the modulus of the field across it (Plaschke et al. 2019,
eqs. 21 to 26). A tone is a complex amplitude ``A``, its part of the row ``Re(A exp(-i h phase))``, the rms of
that ``|A|/sqrt 2``.
Uncertainties are jackknives over blocks of time.

Where the tones of a turning sensor's residual come from, in words: the strongest, one after the other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.lsq import jackknife
from inflight.residual import CLEAR, LONELY, MIN_BLOCKS, bin_edges
from inflight.samples import ORDER, Complex

Ints = npt.NDArray[np.int64]

#: The rows, and what their tones are called.
ROWS = ("along the spin axis", "of the modulus across it")

#: Tones in the order of `Tones.value`: (row, harmonic).
TONES = tuple((row, harmonic) for row in range(len(ROWS)) for harmonic in range(1, ORDER + 1))

#: Bins of a coordinate: intervals are few.
_BINS = 12


@dataclass(frozen=True)
class Tones:
    """Tones of a residual, one row an interval.

    Attributes
    ----------
    value : ndarray of complex, shape (interval, 8)
        nT, in the order of `TONES`; NaN where an interval has no turn.
    weight : ndarray, shape (interval,)
        Falls with nature's noise.
    noise : ndarray, shape (interval,)
        Rms that nature gives the rows: by how tones change from one turn to the next, that is by the power at
        the neighbouring frequencies; nT.
    """

    value: Complex
    weight: Floats
    noise: Floats

    @property
    def size(self) -> Floats:
        """Rms of each tone over intervals by their weights, nT; (8,)."""
        weight, total = self._usable()
        return np.asarray(np.sqrt(weight @ np.abs(np.nan_to_num(self.value)) ** 2 / (2.0 * total)))

    @property
    def floor(self) -> float:
        """Rms of the rows that nature alone makes, by the same weights, nT."""
        weight, total = self._usable()
        return float(np.sqrt(weight @ np.nan_to_num(self.noise) ** 2 / total))

    def _usable(self) -> tuple[Floats, float]:
        weight = np.where(np.isfinite(self.value).all(axis=1) & np.isfinite(self.noise), self.weight, 0.0)
        return weight, max(float(weight.sum()), 1e-300)


def tones_of(rows: Floats, sectors: int) -> Complex:
    """Return the tones of rows (time, 2) of synthetic turns of so many samples; (interval, 8), nT."""
    whole = rows[: len(rows) // sectors * sectors].reshape(-1, sectors, rows.shape[1])
    # The first sample stands half a sector after phase zero.
    phase = (np.arange(sectors) + 0.5) * 2.0 * np.pi / sectors
    wheel = np.exp(1j * phase[:, None] * np.arange(1, ORDER + 1))
    # As a cosine and a sine: Re(A exp(-i h phase)).
    found = np.einsum("isr,sh->irh", whole, wheel) * 2.0 / sectors
    return np.asarray(found.reshape(len(whole), -1))


@dataclass(frozen=True)
class ToneCoordinate:
    """What tones may follow.

    Attributes
    ----------
    values : ndarray, shape (interval,)
        In `unit`.
    wheel : ndarray of complex, shape (interval,), optional
        A channel's own tone: residual tones in step with it are looked for, in proportion to it.
    """

    name: str
    unit: str
    kind: str
    values: Floats
    wheel: Complex | None = None


@dataclass(frozen=True)
class ToneDependence:
    """Tones in bins of a coordinate, with uncertainties between blocks.

    Attributes
    ----------
    centre : ndarray, shape (bin,)
    mean : ndarray of complex, shape (bin, 8)
        Mean tone less the mean of all, nT; of a channel's own tone, per unit of it.
    sigma : ndarray, shape (bin, 8)
        Of real and imaginary part together.
    amplitude, sigma_amplitude : ndarray, shape (8,)
        Rms of what follows the coordinate in the rows, less what noise makes of it, nT.
    """

    coordinate: ToneCoordinate
    centre: Floats
    mean: Complex
    sigma: Floats
    amplitude: Floats
    sigma_amplitude: Floats

    @property
    def clear(self) -> npt.NDArray[np.bool_]:
        """Tones that stand out by five sigma; (8,)."""
        return np.asarray(self.amplitude > CLEAR * self.sigma_amplitude)

    @property
    def strongest(self) -> int:
        """The tone that follows it most, a clear one if there is one."""
        return int(np.argmax(np.where(self.clear, self.amplitude + self.amplitude.max(), self.amplitude)))


@dataclass(frozen=True)
class _Binned:
    """Intervals of a coordinate by bin, with the factor that the tone is a multiple of."""

    used: npt.NDArray[np.bool_]
    index: Ints
    factor: Complex
    bins: int

    @classmethod
    def of(cls, one: ToneCoordinate, usable: npt.NDArray[np.bool_], block: Ints) -> _Binned | None:
        """Return the bins of a coordinate; None when it does not vary."""
        known = usable & np.isfinite(one.values)
        if one.wheel is not None:
            known &= np.isfinite(one.wheel)
            if not known.any() or np.abs(one.wheel[known]).max() == 0.0:
                return None
            return cls(known, np.zeros(known.sum(), dtype=np.int64), one.wheel[known], 1)
        if one.kind == "spin_phase":
            count = int(known.sum())
            return cls(known, np.zeros(count, dtype=np.int64), np.ones(count, dtype=np.complex128), 1)
        # In time, each bin takes several blocks.
        bins = int(np.clip(np.unique(block[known]).size // 4, 2, _BINS)) if one.kind == "time" else _BINS
        edges = bin_edges(one.values[known], bins)
        if edges is None:
            return None
        index = np.clip(np.searchsorted(edges, one.values[known], side="right") - 1, 0, edges.size - 2)
        return cls(known, index.astype(np.int64), np.ones(index.size, dtype=np.complex128), edges.size - 1)


def tone_dependence(tones: Tones, one: ToneCoordinate, block: Ints) -> ToneDependence | None:
    """Measure how tones depend on a coordinate.

    Parameters
    ----------
    tones : Tones
    one : ToneCoordinate
    block : ndarray of int, shape (interval,)
        Blocks are taken as independent, intervals are not.

    Returns
    -------
    ToneDependence or None
        None when the coordinate does not vary, or too few blocks meet.
    """
    usable = np.isfinite(tones.value).all(axis=1) & (tones.weight > 0.0)
    cut = _Binned.of(one, usable, block)
    if cut is None:
        return None
    blocks, which = np.unique(block[cut.used], return_inverse=True)
    if blocks.size < MIN_BLOCKS:
        return None
    weight, value = tones.weight[cut.used], tones.value[cut.used]
    if cut.bins > 1:
        value = value - weight @ value / weight.sum()
    cell = which * cut.bins + cut.index
    shape = (blocks.size, cut.bins)
    size = np.bincount(cell, weight * np.abs(cut.factor) ** 2, shape[0] * shape[1]).reshape(shape)
    turned = weight[:, None] * np.conj(cut.factor)[:, None] * value
    total = np.stack([_summed(column, cell, shape) for column in turned.T], axis=2)
    met = (size > 0.0).sum(axis=0) >= LONELY
    if not met.any() or (cut.bins > 1 and met.sum() < 2):
        return None
    mean, without = (
        _ratio(total.sum(axis=0), size.sum(axis=0)),
        _ratio(total.sum(axis=0) - total, size.sum(axis=0) - size),
    )
    share = np.where(met, size.sum(axis=0), 0.0) / weight.sum()
    sigma = np.hypot(jackknife(without.real), jackknife(without.imag))
    amplitude = np.sqrt(np.maximum(share @ (np.abs(mean) ** 2 - sigma**2), 0.0) / 2.0)
    each = np.sqrt(np.einsum("p,bpt->bt", share, np.abs(without) ** 2) / 2.0)
    spread = np.maximum(jackknife(each), 1e-9)
    with np.errstate(invalid="ignore"):
        centre = np.bincount(cut.index, one.values[cut.used], cut.bins) / np.bincount(
            cut.index, minlength=cut.bins
        )
    hidden = np.where(met, 1.0, np.nan)[:, None]
    return ToneDependence(one, centre, mean * hidden, sigma * hidden, amplitude, spread)


def _summed(values: Complex, cell: Ints, shape: tuple[int, int]) -> Complex:
    parts = [np.bincount(cell, part, shape[0] * shape[1]) for part in (values.real, values.imag)]
    return np.asarray(parts[0] + 1j * parts[1]).reshape(shape)


def _ratio(total: Complex, size: Floats) -> Complex:
    return np.asarray(np.where(size > 0.0, 1.0, 0.0)[..., None] * total / np.maximum(size, 1e-300)[..., None])


def taken_off(tones: Tones, found: ToneDependence) -> Tones:
    """Return tones less what follows a coordinate clearly."""
    one, mean = found.coordinate, np.where(found.clear, np.nan_to_num(found.mean), 0.0)
    if one.wheel is not None:
        fitted = np.nan_to_num(one.wheel)[:, None] * mean[0]
    elif one.kind == "spin_phase":
        fitted = np.broadcast_to(mean[0], tones.value.shape)
    else:
        # The mean of all is no part of what follows a coordinate.
        met = np.isfinite(found.mean).all(axis=1) & np.isfinite(found.centre)
        at = np.where(np.isfinite(one.values), one.values, np.nan)
        columns = [np.interp(at, found.centre[met], mean[met, tone]) for tone in range(mean.shape[1])]
        fitted = np.nan_to_num(np.stack(columns, axis=1))
    return Tones(tones.value - fitted, tones.weight, tones.noise)


#: Structures told, and the part of the tones' own rms below which one is not worth a sentence.
_COUNT, _LEAST_PART = 4, 0.05

#: Explaining so much of what the best one does, a rival may as well be behind it.
_RIVAL = 0.8


@dataclass(frozen=True)
class ToneFailure:
    """One structure of the tones, less the stronger ones before it.

    Attributes
    ----------
    dependence : ToneDependence
    tone : int
        The strongest that follows.
    rivals : tuple of str
        Coordinates that explain as much of that tone, and nothing beyond this one.
    """

    dependence: ToneDependence
    tone: int
    rivals: tuple[str, ...]
    rank: int

    @property
    def coordinate(self) -> str:
        """What the residual follows."""
        return self.dependence.coordinate.name

    @property
    def amplitude(self) -> float:
        """Rms of the structure in the row of its tone, nT."""
        return float(self.dependence.amplitude[self.tone])

    @property
    def sigma(self) -> float:
        """Standard deviation of the amplitude between blocks, nT."""
        return float(self.dependence.sigma_amplitude[self.tone])

    @property
    def sentence(self) -> str:
        """What a physicist would say of it."""
        opening = "The residual" if self.rank == 0 else "Beyond that, the residual"
        row, harmonic = TONES[self.tone]
        told = f"{opening} {ROWS[row]}, {_times(harmonic)}, {self._follows()}{self._ends()}; it could be "
        rivals = ", ".join(self.rivals)
        also = f". These data cannot tell it from: {rivals}" if rivals else ""
        return f"{told}{meaning(self.dependence.coordinate, row, harmonic)}{also}."

    def _follows(self) -> str:
        size = f"{self.amplitude:.4f} +- {self.sigma:.4f} nT rms"
        one = self.dependence.coordinate
        if one.kind == "spin_phase":
            return f"has a steady tone of {size}"
        return (
            f"goes in step with {one.name}, {size}"
            if one.wheel is not None
            else f"follows {one.name} with {size}"
        )

    def _ends(self) -> str:
        found = self.dependence
        if len(found.centre) < 2:
            return ""
        size, sigma = np.abs(found.mean[:, self.tone]), found.sigma[:, self.tone]
        met = np.flatnonzero(np.isfinite(size))
        first, last = met[np.argmin(found.centre[met])], met[np.argmax(found.centre[met])]
        # Both ends, as vectors: how far the tone moves from one to the other.
        moved = abs(found.mean[last, self.tone] - found.mean[first, self.tone])
        unit = f" {found.coordinate.unit}" if found.coordinate.unit not in ("", "1") else ""
        error = float(np.hypot(sigma[first], sigma[last]))
        return (
            f" (its amplitude changes by {moved:.4f} +- {error:.4f} nT from {found.centre[first]:.4g} to "
            f"{found.centre[last]:.4g}{unit})"
        )


def _times(harmonic: int) -> str:
    return {1: "at the spin", 2: "at twice the spin"}.get(harmonic, f"at {harmonic} times the spin")


#: What a tone belongs to, by row and harmonic.
_OF = {
    (0, 1): "the direction of the spin axis",
    (1, 1): "the offset of a spin-plane sensor, or its elevation",
    (1, 2): "the gain ratio or the azimuth of the spin-plane sensors",
    (1, 3): "a non-linearity of a spin-plane sensor",
}

#: What a tone of the modulus or along the axis that grows with the field says.
_OF_FIELD = {
    ("field_along", 1, 1): "the elevation of a spin-plane sensor",
    ("field_across", 0, 1): "the direction of the spin axis",
    ("field_across", 1, 1): "a quadratic non-linearity of a spin-plane sensor",
    ("field_across", 1, 2): "the gain ratio or the azimuth of the spin-plane sensors",
    ("field_across", 1, 3): "a non-linearity of a spin-plane sensor",
}

_OF_KIND = {
    "temperature": "following this temperature",
    "flag": "changing with this state, as in light and shadow",
    "sunlit": "changing between light and shadow",
    "sun_phase": "driven by light and shadow",
    "orbit_phase": "changing along the orbit",
    "time": "changing in time: a drift, or a step as at a manoeuvre",
    "time_of_day": "changing with the day",
}

_CURRENTS = ("solar_current", "battery_current", "camera_current", "torquer_current", "current", "voltage")


def meaning(one: ToneCoordinate, row: int, harmonic: int) -> str:
    """Return what could make a tone follow a coordinate."""
    if (one.kind, row, harmonic) in _OF_FIELD:
        return _OF_FIELD[one.kind, row, harmonic]
    if one.wheel is not None or one.kind in _CURRENTS:
        return f"a stray field of what {one.name.rsplit(' at ', 1)[0]} drives"
    of = _OF.get((row, harmonic), "a field of the spacecraft that goes with the spin")
    if one.kind == "spin_phase":
        return f"{of}, or a field of the spacecraft that always goes with the spin alike"
    return f"{of}, {_OF_KIND.get(one.kind, 'or a stray field, that goes with it')}"


def find_tone_failures(
    tones: Tones, coordinates: Mapping[str, ToneCoordinate], block: Ints
) -> tuple[list[ToneFailure], list[ToneDependence]]:
    """Return the strongest structures one after the other, and how the whole tones depend on everything.

    Parameters
    ----------
    tones : Tones
        After calibration.
    coordinates : mapping of str to ToneCoordinate
        By name.
    block : ndarray of int, shape (interval,)
        Blocks of the jackknife.
    """
    whole = told = _measured(tones, coordinates.values(), block)
    least = _LEAST_PART * float(np.sqrt(np.sum(tones.size**2)))
    failures: list[ToneFailure] = []
    left = tones
    while len(failures) < _COUNT:
        clear = [one for one in told if one.clear.any() and one.amplitude[one.strongest] > least]
        if not clear:
            break
        best = max(clear, key=lambda one: one.amplitude[one.strongest])
        left = taken_off(left, best)
        after = _measured(left, coordinates.values(), block)
        failures.append(ToneFailure(best, best.strongest, _rivals(best, clear, after), len(failures)))
        told = after
    return failures, whole


def _measured(tones: Tones, coordinates: Iterable[ToneCoordinate], block: Ints) -> list[ToneDependence]:
    found = (tone_dependence(tones, one, block) for one in coordinates)
    return [one for one in found if one is not None]


def _rivals(
    best: ToneDependence, clear: Sequence[ToneDependence], after: Sequence[ToneDependence]
) -> tuple[str, ...]:
    tone = best.strongest
    left = {one.coordinate.name: bool(one.clear[tone]) for one in after}
    return tuple(
        one.coordinate.name
        for one in clear
        if one is not best
        and one.clear[tone]
        and one.amplitude[tone] > _RIVAL * best.amplitude[tone]
        and not left.get(one.coordinate.name, False)
    )
