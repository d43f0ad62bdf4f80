"""Where the tones of a turning sensor's residual come from, in words: the strongest, one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from inflight.spin.residual_tones import (
    ROWS,
    TONES,
    Ints,
    ToneCoordinate,
    ToneDependence,
    Tones,
    taken_off,
    tone_dependence,
)

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
