"""Families of causes, channels by their kind, and units of coefficients per channel.

A *family* is what a search reports a missing effect by. The kind of a channel in the mission YAML decides
it, never its name. `channels_of_kind` and `options_of_channels` make candidates; `coefficient_unit` gives
the unit of a parameter that is per unit of a channel.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from inflight.effects.base import Effect, Parameter
from inflight.errors import ModelError
from inflight.frames import GEOMETRY
from inflight.samples import parse_channel
from inflight.units import is_same_unit

if TYPE_CHECKING:
    from inflight.instruments import Channel
    from inflight.mission import Mission


#: Every family there is.
FAMILIES = (
    "sensor",
    "temperature",
    "ageing",
    "torquer",
    "solar",
    "battery",
    "camera",
    "current",
    "day_night",
    "sun_angle",
    "remanent",
    "induced",
    "eddy",
    "nonlinearity",
    "clock",
    "bias",
    "offset_step",
    "tone",
    "hysteresis",
    "unknown",
)

#: Family of a channel's kind; all others are currents of some kind.
FAMILY_OF_KIND = {
    "temperature": "temperature",
    "solar_current": "solar",
    "battery_current": "battery",
    "camera_current": "camera",
    "torquer_current": "torquer",
    "sunlight": "day_night",
    "sun_direction": "sun_angle",
    "frequency": "clock",
    "attitude": "unknown",
    "position": "unknown",
}

#: Families of currents that flow on the spacecraft: their field is a source's, not an instrument's.
CURRENT_FAMILIES = ("torquer", "solar", "battery", "camera", "current")

#: Kinds of channels that give place and attitude of the spacecraft, and are no cause themselves.
NO_CAUSE = ("attitude", "position", "sun_pulse", "spin_phase", "spin_axis")

#: The same of what `inflight.frames.add_geometry` works out.
FAMILY_OF_GEOMETRY = {
    "sunlit": "day_night",
    "shadow_entry": "day_night",
    "shadow_exit": "day_night",
    "sun_direction": "sun_angle",
    "sun_phase": "day_night",
    "local_time": "sun_angle",
    "orbit_phase": "unknown",
    "latitude": "unknown",
    "longitude": "unknown",
}


def channels_of(mission: Mission) -> dict[str, Channel]:
    """Return a mission's channels but the fields, by their names in samples.

    A name that several instruments use is written ``instrument.channel``.
    """
    found = list(mission.channel_instruments())
    plain = [name for _, name, _ in found]
    return {
        (name if plain.count(name) == 1 else f"{instrument}.{name}"): channel
        for instrument, name, channel in found
    }


def position_channel(mission: Mission) -> str:
    """Return the channel with the position over the Earth; empty when there is none."""
    for name, channel in channels_of(mission).items():
        if channel.kind == "position" and channel.frame in ("itrf", "gcrf"):
            return name
    return ""


def channels_of_kind(mission: Mission, *kinds: str, width: int = 1) -> list[str]:
    """Return the names of channels of some kinds, or of all that are no geometry when none is given.

    Parameters
    ----------
    width : int
        Number of components; 1 for one number a time.
    """
    return [
        name
        for name, channel in channels_of(mission).items()
        if (channel.kind in kinds if kinds else channel.kind not in NO_CAUSE)
        and max(len(channel.axis_names), 1) == width
    ]


def options_of_channels(names: list[str]) -> list[dict[str, Any]]:
    """Return one set of options a channel."""
    return [{"channel": name} for name in names]


def has_orbit(mission: Mission) -> bool:
    """Return True when the mission delivers positions, from which phases and local time are made."""
    return any(channel.kind == "position" for channel in channels_of(mission).values())


def has_sun_direction(mission: Mission) -> bool:
    """Return True when the Sun's direction in the sensor's axes can be made, or is delivered."""
    kinds = {channel.kind for channel in channels_of(mission).values()}
    return {"position", "attitude"} <= kinds or "sun_direction" in kinds


def family_of(effect: Effect, mission: Mission) -> str:
    """Return the family an effect is reported by.

    An effect made from any channel belongs to the family of its first channel's kind; a play makes
    it a hysteresis. A channel without a kind is a current: nothing is guessed from its name.
    """
    if not effect.family_by_channel or not effect.channels:
        return type(effect).family
    try:
        parts = parse_channel(effect.channels[0]).parts
    except ModelError:
        return type(effect).family
    if any(part.width for part in parts):
        return "hysteresis"
    known = channels_of(mission)
    name = parts[0].channel
    if name not in known:
        return FAMILY_OF_GEOMETRY.get(name, "current")
    return FAMILY_OF_KIND.get(known[name].kind, "current")


def channel_unit(mission: Mission, name: str) -> str | None:
    """Return the unit of a channel, derived or not; None when the mission does not know it."""
    known = GEOMETRY | {name: channel.unit for name, channel in channels_of(mission).items()}
    try:
        parts = [known[part.channel] for part in parse_channel(name).parts]
    except (KeyError, ModelError):
        return None
    # A factor that is a plain number, such as sunlit, leaves the other's unit.
    parts = [unit for unit in parts if not is_same_unit(unit, "1")] or ["1"]
    return parts[0] if len(parts) == 1 else "*".join(f"({unit})" for unit in parts)


def coefficient_unit(parameter: Parameter, mission: Mission, channel: str) -> str:
    """Return the whole unit of a parameter, ``nT/mA`` where its own is nT and the channel's mA.

    A parameter that is per no channel, and one per a channel the mission does not know, keeps its own.
    """
    unit = channel_unit(mission, channel) if parameter.per_channel else None
    if unit is None or is_same_unit(unit, "1"):
        return parameter.unit
    below = "K" if is_same_unit(unit, "degC") else unit
    below = below if re.fullmatch(r"\w+", below) else f"({below})"
    power = f"^{parameter.per_channel}" if parameter.per_channel > 1 else ""
    return f"{parameter.unit}/{below}{power}"
