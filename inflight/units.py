"""Units: one registry for the project, and the conversions of channels to the units the physics uses.

Delivered files spell units in many ways; `parse_unit` and `factor_and_offset` alone interpret them.
`product_factor` converts coefficients per unit of a channel.
"""

from __future__ import annotations

import re
from functools import cache, lru_cache
from math import floor, isfinite, log10, pi
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pint

#: Numbers smaller than this are written with an exponent.
_PLAIN = 1e-4
#: Units that nearly every mission states, known without the registry, which takes a moment to load: what each
#: measures, how large it is, and where its zero lies, both in the unit of size 1 that measures the same.
COMMON_UNITS = {
    "1": ("number", 1.0, 0.0),
    "count": ("number", 1.0, 0.0),
    "rad": ("number", 1.0, 0.0),
    "deg": ("number", pi / 180.0, 0.0),
    "nT": ("field", 1.0, 0.0),
    "s": ("time", 1.0, 0.0),
    "m": ("length", 1.0, 0.0),
    "km": ("length", 1000.0, 0.0),
    "A": ("current", 1.0, 0.0),
    "mA": ("current", 0.001, 0.0),
    "V": ("voltage", 1.0, 0.0),
    "K": ("temperature", 1.0, 0.0),
    "degC": ("temperature", 1.0, 273.15),
}

_STRAY = re.compile(r"[^\w\s.*/^()%°·+-]")

#: Spellings found in delivered files that pint does not know, lower case.
_SPELLINGS = {
    "": "dimensionless",
    "1": "dimensionless",
    "none": "dimensionless",
    "counts": "count",
    "dn": "count",
    "celsius": "degC",
    "deg c": "degC",
    "deg_c": "degC",
    "degrees c": "degC",
    "degree celsius": "degC",
    "degrees celsius": "degC",
    "c": "degC",
    "gamma": "nT",
    "nt": "nT",
    "nanotesla": "nT",
    "degrees": "deg",
}


@cache
def registry() -> pint.UnitRegistry[float]:
    """Return the one registry of the project."""
    import pint

    return pint.UnitRegistry(autoconvert_offset_to_baseunit=True, cache_folder=None)


def require_unit(text: str) -> None:
    """Raise ValueError when a text names no unit."""
    if text not in COMMON_UNITS:
        parse_unit(text)


@lru_cache(maxsize=256)
def parse_unit(text: str) -> pint.Unit:
    """Return the pint unit of a text as found in a file or a YAML.

    Raises
    ------
    ValueError
        When the text names no unit.
    """
    plain = text.strip()
    # pint passes over characters it cannot read.
    if stray := set(_STRAY.findall(plain)):
        raise ValueError(f"{text!r} is no known unit ({' '.join(sorted(stray))} has no meaning in a unit)")
    import pint

    try:
        return registry().Unit(_SPELLINGS.get(plain.lower(), plain))
    except (pint.PintError, AssertionError, ValueError, TypeError) as error:
        raise ValueError(f"{text!r} is no known unit ({error})") from None


def is_same_unit(one: str, other: str) -> bool:
    """Return True when two texts name one unit.

    Raises
    ------
    ValueError
        When a text names no unit.
    """
    if one in COMMON_UNITS and other in COMMON_UNITS:
        return one == other
    return bool(parse_unit(one) == parse_unit(other))


@lru_cache(maxsize=256)
def factor_and_offset(source: str, target: str) -> tuple[float, float]:
    """Return (a, b) with ``target value = a * source value + b``.

    Raises
    ------
    ValueError
        When the units measure different things.
    """
    if source in COMMON_UNITS and target in COMMON_UNITS:
        (measured, size, zero), (wanted, unit, origin) = COMMON_UNITS[source], COMMON_UNITS[target]
        if measured != wanted:
            raise ValueError(f"unit {source!r} cannot become {target!r}")
        return size / unit, (zero - origin) / unit
    start, goal = parse_unit(source), parse_unit(target)
    if start == goal:
        return 1.0, 0.0
    if start.dimensionality != goal.dimensionality:
        raise ValueError(f"unit {source!r} cannot become {target!r}")
    zero = registry().Quantity(0.0, start).to(goal).magnitude
    one = registry().Quantity(1.0, start).to(goal).magnitude
    return float(one - zero), float(zero)


#: A coefficient per degree counts differences: scales with a zero of their own count like kelvins.
_OFFSET_UNIT = re.compile(r"(?<!delta_)\bdegree_(Celsius|Fahrenheit)\b")


@lru_cache(maxsize=256)
def product_factor(stated: str, channel: str, power: int, target: str) -> float:
    """Return the factor that makes ``value [stated] * channel ** power`` a value in `target`.

    Parameters
    ----------
    stated, channel, target : str
        Units, such as ``nT/A``, ``mA`` and ``nT``.
    power : int
        Power of the channel.

    Raises
    ------
    ValueError
        When the product measures something else.
    """
    units = [parse_unit(text) for text in (stated, channel, target)]
    product = units[0].dimensionality * units[1].dimensionality ** power
    if product != units[2].dimensionality:
        times = f"{channel}^{power}" if power > 1 else channel
        raise ValueError(f"{stated} times {times} is not {target}")
    of_stated, of_channel, of_target = (_size(str(unit)) for unit in units)
    return float(of_stated * of_channel**power / of_target)


def _size(unit: str) -> float:
    """Return how many base units one unit is; zeros of temperature scales do not count."""
    plain = _OFFSET_UNIT.sub(r"delta_degree_\1", unit)
    if plain == "dimensionless":  # pint parses it to a unit without a name, which it then does not find
        return 1.0
    return factor_and_offset(plain, str(registry().get_base_units(plain)[1]))[0]


def with_error(value: float, sigma: float) -> str:
    """Return a value and its error to the same digit, two of the error's: ``-0.0450 ± 0.0012``."""
    if not isfinite(value):
        return ""
    if not 0.0 < sigma < float("inf"):
        return f"{value:.5g}"
    place = floor(log10(sigma)) - 1
    if -10 <= place <= 0 and max(abs(value), sigma) >= _PLAIN:
        return f"{value:.{-place}f} ± {sigma:.{-place}f}"
    digits = max(1, floor(log10(max(abs(value), sigma))) - place)
    return f"{value:.{digits}e} ± {sigma:.1e}"
