"""Units of coefficients: what a number per unit of a channel is worth when the channel comes in another."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import TYPE_CHECKING

from inflight.derived import parse
from inflight.effects.families import channels_of
from inflight.errors import ModelError
from inflight.geometry import GEOMETRY
from inflight.units import REGISTRY, factor_and_offset, parse_unit

if TYPE_CHECKING:
    from inflight.effects.base import Parameter
    from inflight.mission import Mission

#: A coefficient per degree counts differences: scales with a zero of their own count like kelvins.
_OFFSET_UNIT = re.compile(r"(?<!delta_)\bdegree_(Celsius|Fahrenheit)\b")


@lru_cache(maxsize=256)
def product_factor(stated: str, channel: str, power: int, wanted: str) -> float:
    """Return the factor that makes ``value [stated] * channel ** power`` a value in `wanted`.

    Parameters
    ----------
    stated, channel, wanted : str
        Units, such as ``nT/A``, ``mA`` and ``nT``.
    power : int
        Power of the channel.

    Raises
    ------
    ValueError
        When the product measures something else.
    """
    units = [parse_unit(text) for text in (stated, channel, wanted)]
    product = units[0].dimensionality * units[1].dimensionality ** power
    if product != units[2].dimensionality:
        times = f"{channel}^{power}" if power > 1 else channel
        raise ValueError(f"{stated} times {times} is not {wanted}")
    of_stated, of_channel, of_wanted = (_size(str(unit)) for unit in units)
    return float(of_stated * of_channel**power / of_wanted)


def _size(unit: str) -> float:
    """Return how many base units one unit is; zeros of temperature scales do not count."""
    plain = _OFFSET_UNIT.sub(r"delta_degree_\1", unit)
    if plain == "dimensionless":  # pint parses it to a unit without a name, which it then does not find
        return 1.0
    return factor_and_offset(plain, str(REGISTRY.get_base_units(plain)[1]))[0]


def channel_unit(mission: Mission, name: str) -> str | None:
    """Return the unit of a channel, derived or not; None when the mission does not know it."""
    known = GEOMETRY | {name: channel.unit for name, channel in channels_of(mission).items()}
    try:
        parts = [known[part.channel] for part in parse(name).parts]
    except (KeyError, ModelError):
        return None
    # A factor that is a plain number, such as sunlit, leaves the other's unit.
    parts = [unit for unit in parts if parse_unit(unit) != parse_unit("1")] or ["1"]
    return parts[0] if len(parts) == 1 else "*".join(f"({unit})" for unit in parts)


def coefficient_unit(parameter: Parameter, mission: Mission, channel: str) -> str:
    """Return the whole unit of a parameter, ``nT/mA`` where its own is nT and the channel's mA.

    A parameter that is per no channel, and one per a channel the mission does not know, keeps its own.
    """
    unit = channel_unit(mission, channel) if parameter.per_channel else None
    if unit is None or parse_unit(unit) == parse_unit("1"):
        return parameter.unit
    below = "K" if parse_unit(unit) == parse_unit("degC") else unit
    below = below if re.fullmatch(r"\w+", below) else f"({below})"
    power = f"^{parameter.per_channel}" if parameter.per_channel > 1 else ""
    return f"{parameter.unit}/{below}{power}"
