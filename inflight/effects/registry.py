"""Which effects exist: the library's own, those of installed packages, and a user's own classes.

A package adds effects through the entry point group ``inflight.effects``; a mission names files with its
own (`inflight.effects.user_effects`); in a notebook `register` makes a class known.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from importlib.metadata import entry_points

from inflight.effects import channels, environment, events, sensors, spacecraft, wander
from inflight.effects.base import Effect
from inflight.effects.sensors import (
    Affine,
    Heading,
    Nonlinearity,
    Oscillator,
    ResponseCurve,
    ScalarBias,
    ScalarResponse,
    Temperature,
    TimeShift,
    VectorSensor,
)
from inflight.effects.spinning_sensor import SpinningSensor
from inflight.effects.user_effects import EffectSource, own_effects
from inflight.errors import ModelError, did_you_mean

_LIBRARY: tuple[type[Effect], ...] = (
    VectorSensor,
    SpinningSensor,
    Affine,
    Nonlinearity,
    ResponseCurve,
    Temperature,
    sensors.ChannelScale,
    sensors.ChannelAngle,
    sensors.AdcTemperature,
    channels.CrossTalk,
    ScalarResponse,
    TimeShift,
    Oscillator,
    ScalarBias,
    sensors.ChannelBias,
    sensors.ChannelClock,
    Heading,
    sensors.HeadingAnisotropy,
    channels.Induced,
    channels.SoftIron,
    channels.Eddy,
    channels.VectorClock,
    channels.ChannelTurn,
    channels.TollesLawson,
    spacecraft.Torquer,
    spacecraft.Remanent,
    spacecraft.RemanentMoment,
    spacecraft.SolarArray,
    channels.ChannelField,
    channels.ChannelPower,
    channels.ChannelMatrix,
    channels.ChannelRate,
    channels.Hysteresis,
    channels.FunctionOfChannel,
    channels.FunctionOfTwo,
    channels.FormulaField,
    environment.DayNight,
    environment.SunDirectionField,
    environment.OrbitPeriodic,
    environment.SunPeriodic,
    environment.DayNightSeries,
    environment.LocalTimePeriodic,
    environment.Tone,
    events.OffsetStep,
    events.OffsetEpisode,
    events.ScaleStep,
    events.ScaleEpisode,
    events.AngleStep,
    events.AngleEpisode,
    events.BiasStep,
    events.ClockStep,
    events.ClockEpisode,
    wander.Wander,
)

_registered: dict[str, type[Effect]] = {}


def register(effect: type[Effect]) -> type[Effect]:
    """Make a user's own effect known by its name; usable as a class decorator."""
    _registered[effect.label()] = effect
    return effect


@lru_cache(maxsize=1)
def _from_library() -> dict[str, type[Effect]]:
    return {effect.label(): effect for effect in _LIBRARY}


@lru_cache(maxsize=1)
def _from_packages() -> dict[str, type[Effect]]:
    return {point.name: point.load() for point in entry_points(group="inflight.effects")}


def known_effects(own: Iterable[EffectSource] = ()) -> dict[str, type[Effect]]:
    """Return every effect by name; a mission's own win over registered ones, those over the library's.

    Parameters
    ----------
    own : iterable of EffectSource
        Files the mission names: their effects are known to this call alone.

    Raises
    ------
    ModelError
        When one of the files is wrong.
    """
    return _from_library() | _from_packages() | _registered | own_effects(own)


def effect_class(name: str, own: Iterable[EffectSource] = ()) -> type[Effect]:
    """Return the class of an effect.

    Raises
    ------
    ModelError
        When no effect has this name.
    """
    known = known_effects(own)
    if name not in known:
        raise ModelError(
            f"there is no effect {name!r}{did_you_mean(name, known)}",
            remedy=f"known are {', '.join(sorted(known))}",
        )
    return known[name]
