"""Which effects exist: the library's own, those of installed packages, and a user's own classes.

A package offers effects through the entry point group ``inflight.effects``; in a notebook `register`
makes a class known.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.metadata import entry_points

from inflight.effects.base import Effect
from inflight.effects.scalar_sensor import Heading, Induced, Oscillator, ScalarBias, TimeShift
from inflight.effects.spacecraft import ChannelField, Remanent, Torquer
from inflight.effects.vector_sensor import Affine, Nonlinearity, Temperature, VectorSensor
from inflight.errors import ModelError

_LIBRARY: tuple[type[Effect], ...] = (
    VectorSensor,
    Affine,
    Nonlinearity,
    Temperature,
    TimeShift,
    Oscillator,
    ScalarBias,
    Heading,
    Induced,
    Torquer,
    Remanent,
    ChannelField,
)
_registered: dict[str, type[Effect]] = {}


def register(effect: type[Effect]) -> type[Effect]:
    """Make a user's own effect known by its name; usable as a class decorator."""
    _registered[effect.label()] = effect
    return effect


@lru_cache(maxsize=1)
def _offered() -> dict[str, type[Effect]]:
    return {point.name: point.load() for point in entry_points(group="inflight.effects")}


def known_effects() -> dict[str, type[Effect]]:
    """Return every effect by name; a user's own wins over the library's."""
    return {effect.label(): effect for effect in _LIBRARY} | _offered() | _registered


def effect_class(name: str) -> type[Effect]:
    """Return the class of an effect.

    Raises
    ------
    ModelError
        When no effect has this name.
    """
    known = known_effects()
    if name not in known:
        raise ModelError(f"there is no effect {name!r}", remedy=f"known are {', '.join(sorted(known))}")
    return known[name]
