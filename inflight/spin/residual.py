"""Spin tones of a residual, and what they follow.

Takes the rows of a spin comparison (`inflight.model.rows`) and coordinates; makes tones, their dependences,
and sentences about the strongest, one after the other. The dependences, their errors between blocks and the
test against chance are those of `inflight.residual.dependence`.

The rows of one interval are one turn. Its harmonics are the tones: of the field along the spin axis, and of
the modulus of the field across it (Plaschke et al. 2019, eqs. 21 to 26). A tone is a complex amplitude ``A``,
its part of the row ``Re(A exp(-i h phase))``, the rms of that ``|A|/sqrt 2``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.lsq import jackknife
from inflight.residual import (
    DEPENDENCE_SETTINGS,
    BinnedFit,
    bin_count,
    bin_edges,
    bin_indices,
    placebo_shifts_of,
    select_successively,
)
from inflight.samples import FOLD_ORDER, FOLDING_SETTINGS, Complex

Ints = npt.NDArray[np.int64]

#: The rows, and what their tones are called.
ROW_NAMES = ("along the spin axis", "of the modulus across it")

#: Tones in the order of `Tones.value`: (row, harmonic).
TONES = tuple((row, harmonic) for row in range(len(ROW_NAMES)) for harmonic in range(1, FOLD_ORDER + 1))


@dataclass(frozen=True, kw_only=True)
class ToneSettings:
    """How dependences of tones are measured and reported; see also `inflight.residual.DependenceSettings`.

    Attributes
    ----------
    bins : int
        Bins of a coordinate: intervals are few. Assumed.
    count : int
        Structures that are reported at most.
    least_part : float
        Part of the tones' own rms below which a structure is not worth a sentence. Assumed.
    rival : float
        Explaining this part of what the best coordinate does, a rival may as well be the cause. Assumed.
    around : int
        Intervals whose tones are taken together where it is asked what of them nature leaves. Assumed: half
        an hour, within which a unit of the spacecraft or an offset changes little.
    chance : float
        Tones of nature alone are taken for an error with this probability. Level of significance.
    """

    bins: int = 12
    count: int = 4
    least_part: float = 0.05
    rival: float = 0.8
    around: int = 3
    chance: float = 1e-3


TONE_SETTINGS = ToneSettings()


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
    def rms(self) -> float:
        """Rms of the two rows by these weights, nT."""
        return float(np.sqrt(np.sum(self.size**2) / len(ROW_NAMES)))

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
    # The first sample is half a sector after phase zero.
    phase = (np.arange(sectors) + 0.5) * 2.0 * np.pi / sectors
    waves = np.exp(1j * phase[:, None] * np.arange(1, FOLD_ORDER + 1))
    # As a cosine and a sine: Re(A exp(-i h phase)).
    found = np.einsum("isr,sh->irh", whole, waves) * 2.0 / sectors
    return np.asarray(found.reshape(len(whole), -1))


def tones_of_turns(rows: Floats, weight: Floats, noise: Floats, sectors: int) -> Tones:
    """Return the tones of synthetic turns of so many samples, as any summary of a residual takes them.

    Parameters
    ----------
    rows : ndarray, shape (time, 2)
        nT.
    weight, noise : ndarray, shape (time,)
        Of the folded samples; a turn has the weight of its worst sample: one with a bad sample has no
        harmonics.
    """
    value = tones_of(rows, sectors)
    turns = slice(0, len(value) * sectors)
    return Tones(value, weight[turns].reshape(-1, sectors).min(axis=1), noise[turns][::sectors])


def error_by_tones(left: Tones) -> Floats:
    """Return the error of a product that shows as tones beyond nature's noise; (interval, 3), nT rms.

    An offset that is off by a shows in the modulus as a tone of amplitude a (Plaschke et al. 2019, eq. 21), a
    gain as one at twice the spin, a spin axis along z. Its phase is that of the field, so that both axes
    across the spin axis have the same. An offset along z leaves no tone; what moves the other two lies in any
    direction, and moves it as much as one of them.

    Nature's tones of n intervals have 2 n degrees of freedom, one complex tone being most of a steep
    spectrum; those of `Tones.noise` are 2 n for each group of turns (F test).
    A wave at just the spin frequency that keeps its phase for half an hour is not told from an offset.

    Parameters
    ----------
    left : Tones
        Of a product.

    Returns
    -------
    ndarray
        In axes that turn; zero where nature explains the tones or nothing is known.
    """
    known = np.isfinite(left.value).all(axis=1) & (left.noise > 0.0)
    power = np.where(known[:, None], 0.5 * np.abs(left.value) ** 2, 0.0)
    nature = np.where(known, left.noise**2, 0.0)
    summed = np.column_stack([power, nature, known])
    kernel = np.ones(TONE_SETTINGS.around)
    summed = np.stack([np.convolve(one, kernel, mode="same") for one in summed.T], axis=1)
    count = np.maximum(summed[:, -1], 1.0)
    tones = (summed[:, :-2] / count[:, None]).reshape(len(known), len(ROW_NAMES), FOLD_ORDER)
    expected = np.maximum(summed[:, -2] / count, 1e-300)
    ratio = tones.sum(axis=(1, 2)) / len(ROW_NAMES) / expected
    limit = scipy.stats.f.isf(TONE_SETTINGS.chance, 2.0 * count, 2.0 * FOLDING_SETTINGS.groups * count)
    part = np.where(ratio > limit, 1.0 - 1.0 / np.maximum(ratio, 1.0), 0.0)
    along, across = (part[:, None] * tones[..., :2].sum(axis=2)).T
    along = along + part * tones[:, 1, 0]
    return np.asarray(np.sqrt(np.stack([across, across, along], axis=1)))


@dataclass(frozen=True)
class ToneCoordinate:
    """What tones may follow.

    Attributes
    ----------
    values : ndarray, shape (interval,)
        In `unit`.
    channel_tone : ndarray of complex, shape (interval,), optional
        A channel's own tone: residual tones in step with it are looked for, in proportion to it.
    """

    name: str
    unit: str
    kind: str
    values: Floats
    channel_tone: Complex | None = None


@dataclass(frozen=True, kw_only=True)
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
        return np.asarray(self.amplitude > DEPENDENCE_SETTINGS.clear * self.sigma_amplitude)

    @property
    def strongest(self) -> int:
        """The tone that follows it most, a clear one if there is one."""
        return int(np.argmax(np.where(self.clear, self.amplitude + self.amplitude.max(), self.amplitude)))


def tone_dependence(tones: Tones, one: ToneCoordinate, block: Ints) -> ToneDependence | None:
    """Measure how tones depend on a coordinate: the fit of `inflight.residual.BinnedFit`.

    In each bin a mean tone; of a channel's own tone one factor for all; of the spin's phase the mean of all.

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
    used = np.isfinite(tones.value).all(axis=1) & (tones.weight > 0.0) & np.isfinite(one.values)
    if one.channel_tone is not None:
        used &= np.isfinite(one.channel_tone)
    blocks, which = np.unique(block[used], return_inverse=True)
    index = _bins(one, used, block)
    if index is None or blocks.size < DEPENDENCE_SETTINGS.min_blocks:
        return None
    weight, value, bins = tones.weight[used], tones.value[used], int(index.max()) + 1
    if bins > 1:
        value = value - weight @ value / weight.sum()
    factor = np.ones(index.size, dtype=np.complex128) if one.channel_tone is None else one.channel_tone[used]
    fit = BinnedFit.of(factor[:, None, None], value[:, None, :], which, index, bins, weight)
    met = fit.met()
    if met.sum() < min(2, bins):
        return None
    mean, without = fit.value[:, 0], fit.without[:, :, 0]
    share = np.where(met, fit.size.sum(axis=0), 0.0) / weight.sum()
    sigma = np.hypot(jackknife(without.real), jackknife(without.imag))
    amplitude = np.sqrt(np.maximum(share @ (np.abs(mean) ** 2 - sigma**2), 0.0) / 2.0)
    each = np.sqrt(np.einsum("p,bpt->bt", share, np.abs(without) ** 2) / 2.0)
    hidden = np.where(met, 1.0, np.nan)[:, None]
    with np.errstate(invalid="ignore"):
        centre = np.bincount(index, one.values[used], bins) / np.bincount(index, minlength=bins)
    return ToneDependence(
        coordinate=one,
        centre=centre,
        mean=mean * hidden,
        sigma=sigma * hidden,
        amplitude=amplitude,
        sigma_amplitude=np.maximum(jackknife(each), 1e-9),
    )


def _bins(one: ToneCoordinate, used: npt.NDArray[np.bool_], block: Ints) -> Ints | None:
    """Return the bin of each used interval; None when the coordinate does not vary."""
    if one.channel_tone is not None:
        turns = used.any() and np.abs(one.channel_tone[used]).max() > 0.0
        return np.zeros(int(used.sum()), dtype=np.int64) if turns else None
    if one.kind == "spin_phase":
        return np.zeros(int(used.sum()), dtype=np.int64) if used.any() else None
    edges = bin_edges(one.values[used], bin_count(one.kind, block[used], TONE_SETTINGS.bins))
    return None if edges is None else bin_indices(one.values[used], edges)


def without_structure(tones: Tones, found: ToneDependence) -> Tones:
    """Return tones less what follows a coordinate clearly."""
    one, mean = found.coordinate, np.where(found.clear, np.nan_to_num(found.mean), 0.0)
    if one.channel_tone is not None:
        fitted = np.nan_to_num(one.channel_tone)[:, None] * mean[0]
    elif one.kind == "spin_phase":
        fitted = np.broadcast_to(mean[0], tones.value.shape)
    else:
        # The mean of all is no part of what follows a coordinate.
        met = np.isfinite(found.mean).all(axis=1) & np.isfinite(found.centre)
        at = np.where(np.isfinite(one.values), one.values, np.nan)
        columns = [np.interp(at, found.centre[met], mean[met, tone]) for tone in range(mean.shape[1])]
        fitted = np.nan_to_num(np.stack(columns, axis=1))
    return Tones(tones.value - fitted, tones.weight, tones.noise)


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
        """The structure as a sentence: which tone, what it follows, how large, and what could make it."""
        opening = "The residual" if self.rank == 0 else "Beyond that, the residual"
        row, harmonic = TONES[self.tone]
        frequency = {1: "at the spin", 2: "at twice the spin"}.get(harmonic, f"at {harmonic} times the spin")
        coordinate = self.dependence.coordinate
        size = f"{self.amplitude:.4f} +- {self.sigma:.4f} nT rms"
        if coordinate.kind == "spin_phase":
            follows = f"has a steady tone of {size}"
        elif coordinate.channel_tone is not None:
            follows = f"goes in step with {coordinate.name}, {size}"
        else:
            follows = f"follows {coordinate.name} with {size}"
        structure = f"{opening} {ROW_NAMES[row]}, {frequency}, {follows}{self._ends()}; it could be "
        rivals = ", ".join(self.rivals)
        also = f". These data cannot tell it from: {rivals}" if rivals else ""
        return f"{structure}{meaning(coordinate, row, harmonic)}{also}."

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


#: What a tone belongs to, by row and harmonic.
_OF = {
    (0, 1): "the direction of the spin axis",
    (1, 1): "the offset of a spin-plane sensor, or its elevation",
    (1, 2): "the gain ratio or the azimuth of the spin-plane sensors",
    (1, 3): "a non-linearity of a spin-plane sensor",
}

#: What makes a tone of the modulus or along the axis that grows with the field.
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
    if one.channel_tone is not None or one.kind in _CURRENTS:
        return f"a stray field of what {one.name.rsplit(' at ', 1)[0]} drives"
    of = _OF.get((row, harmonic), "a field of the spacecraft that goes with the spin")
    if one.kind == "spin_phase":
        return f"{of}, or a field of the spacecraft that always goes with the spin alike"
    return f"{of}, {_OF_KIND.get(one.kind, 'or a stray field, that goes with it')}"


def rank_tone_dependences(
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

    def measured(of: Tones) -> list[ToneDependence]:
        found = (tone_dependence(of, one, block) for one in coordinates.values())
        return [one for one in found if one is not None]

    def chance(rest: Tones, best: ToneDependence) -> float:
        found = [tone_dependence(rest, one, block) for one in _at_other_times(best.coordinate)]
        return max((float(one.amplitude[best.strongest]) for one in found if one is not None), default=0.0)

    structures = select_successively(
        tones,
        measured,
        size=lambda one: float(one.amplitude[one.strongest]),
        is_clear=lambda one: bool(one.clear.any()),
        remove=without_structure,
        chance=chance,
        least=TONE_SETTINGS.least_part * float(np.sqrt(np.sum(tones.size**2))),
        count=TONE_SETTINGS.count,
    )
    failures = [
        ToneFailure(best, best.strongest, _rivals(best, clear, after), rank)
        for rank, (best, _, clear, _, after) in enumerate(structures)
    ]
    return failures, measured(tones)


def _at_other_times(one: ToneCoordinate) -> Iterator[ToneCoordinate]:
    """Yield a coordinate as it was in other parts of the record; none of the spin's own phase."""
    if one.kind == "spin_phase":
        return
    channel_tones = placebo_shifts_of(one.channel_tone) if one.channel_tone is not None else repeat(None)
    for values, tone in zip(placebo_shifts_of(one.values), channel_tones, strict=False):
        yield replace(one, values=values, channel_tone=tone)


def _rivals(
    best: ToneDependence, clear: Sequence[ToneDependence], after: Sequence[ToneDependence]
) -> tuple[str, ...]:
    """Return the coordinates that explain as much of the tone, and nothing beyond the best one."""
    tone = best.strongest
    remains = {one.coordinate.name: bool(one.clear[tone]) for one in after}
    return tuple(
        one.coordinate.name
        for one in clear
        if one is not best
        and one.clear[tone]
        and one.amplitude[tone] > TONE_SETTINGS.rival * best.amplitude[tone]
        and not remains.get(one.coordinate.name, False)
    )
