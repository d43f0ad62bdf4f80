"""What an effect is, in the words of a physicist: one sentence with its numbers in units one would choose.

Takes a `FoundEffect` or its plain parts; makes text (`what_it_is`, `numbers_text`). The words for kinds of
effects stand in one table; a user's own effect is called by its family.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from math import floor, isfinite, log10
from typing import Protocol

#: What an effect is, by its name in a model; ``{channels}`` are what it follows.
_KINDS = {
    "channel_field": "a field that follows {channels}",
    "channel_power": "a field that follows the square of {channels}",
    "channel_rate": "a field that follows the rate of change of {channels}",
    "channel_matrix": "fields of the currents {channels}",
    "function_of_channel": "a field that is some function of {channels}",
    "function_of_two": "a field that is some function of {channels} together",
    "formula_field": "a field that follows a formula of {channels}",
    "hysteresis": "a field that follows {channels} with play (hysteresis)",
    "channel_scale": "scale factors that follow {channels}",
    "channel_angle": "angles between the axes that follow {channels}",
    "channel_turn": "a sensor or an attitude that turns with {channels}",
    "channel_bias": "a bias of the scalar sensor that follows {channels}",
    "channel_clock": "a clock error that follows {channels}",
    "temperature": "scale factors that follow the temperature {channels}",
    "adc_temperature": "scale factors and offsets that follow the converter's temperature {channels}",
    "torquer": "fields of the magneto-torquers' currents {channels}",
    "solar_array": "fields of the solar panels' currents",
    "scale_drift": "scale factors that drift (ageing)",
    "offset_drift": "offsets that drift",
    "angle_drift": "angles between the axes that drift",
    "bias_drift": "a bias of the scalar sensor that drifts",
    "clock_drift": "a clock that drifts",
    "scale_step": "scale factors that step",
    "offset_step": "offsets that step",
    "angle_step": "angles between the axes that step",
    "bias_step": "a bias of the scalar sensor that steps",
    "clock_step": "a clock that steps",
    "scale_episode": "scale factors that change for a while",
    "offset_episode": "offsets that change for a while",
    "angle_episode": "angles between the axes that change for a while",
    "bias_episode": "a bias of the scalar sensor for a while",
    "clock_episode": "a clock error for a while",
    "remanent_moment": "the field of the body's magnetic moment, as the torquers cancel it",
    "day_night": "a field that is there in sunlight only",
    "day_night_series": "a field that goes with sunlight along the orbit",
    "sun_periodic": "a field that repeats with the Sun's phase along the orbit",
    "orbit_periodic": "a field that repeats with every orbit",
    "local_time_periodic": "a field that depends on local time",
    "sun_direction_field": "a field that depends on the Sun's direction in the spacecraft",
    "tone": "a field of one fixed period",
    "eddy": "eddy currents: a field that follows the rate of change of the field",
    "induced": "a field induced in soft magnetic material",
    "soft_iron": "a field induced in soft magnetic material",
    "tolles_lawson": "permanent, induced and eddy-current fields (Tolles and Lawson)",
    "cross_talk": "cross-talk between the axes",
    "nonlinearity": "a non-linear sensor",
    "response_curve": "a response of the sensor that is no straight line",
    "time_shift": "a clock that is off",
    "vector_clock": "late readings (or early positions, or eddy currents alike on every axis)",
    "scalar_bias": "a constant error of the scalar sensor",
    "scalar_response": "an averaging of the scalar sensor that is not known",
    "oscillator": "a reference oscillator that is off",
    "heading": "a field of the scalar sensor itself",
    "heading_anisotropy": "a reading of the scalar sensor that depends on the field's direction in it",
    "remanent": "a permanent field of the spacecraft",
    "affine": "scale factors, angles and offsets that change",
}

#: Units that coefficients are told in instead, smaller ones first: (unit, factor, below which size).
_UNITS: dict[str, tuple[tuple[str, float, float], ...]] = {
    "nT": (("pT", 1e3, 0.1),),
    "1": (("ppm", 1e6, 0.01),),
    "1/d": (("ppm/d", 1e6, 0.01),),
    "1/K": (("ppm/K", 1e6, 0.01),),
    "1/K^2": (("ppm/K^2", 1e6, 0.01),),
    "deg": (("arcsec", 3600.0, 0.1),),
    "deg/d": (("arcsec/d", 3600.0, 0.1),),
    "s": (("ms", 1e3, 0.5),),
}

#: Why another parameter is told after a change of the model, for a person (`Revision.moved`).
WHY_MOVED = {
    "cross-talk made": "less well known now",
    "cross-talk removed": "better known now",
    "moved": "",
}

#: Numbers that are listed; those of more, by size.
_LISTED = 3


class _Number(Protocol):
    """A coefficient: `inflight.diagnosis.result.Coefficient`."""

    @property
    def name(self) -> str: ...

    @property
    def value(self) -> float: ...

    @property
    def sigma(self) -> float: ...

    @property
    def unit(self) -> str: ...

    @property
    def stands_out(self) -> bool: ...


def what_it_is(name: str, channels: Sequence[str], family: str) -> str:
    """Return what an effect is, ``a field that follows heater_current``, by the name a search gives it."""
    label = re.split(r"[(@]", name, maxsplit=1)[0]
    inner = name.partition("(")[2].rpartition(")")[0]
    text = f"the product of {' and '.join(channels)}" if "*" in inner else " and ".join(channels)
    if label in _KINDS and (text or "{channels}" not in _KINDS[label]):
        return _KINDS[label].format(channels=text)
    kind = family.replace("_", " ")
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind} effect" + (f" that follows {text}" if text else "")


def numbers_text(numbers: Sequence[_Number]) -> str:
    """Return the coefficients that stand out, ``+0.341 +- 0.002 nT/A on x``; empty when none does."""
    clear = [one for one in numbers if one.stands_out]
    if len(clear) > _LISTED:
        clear = sorted(clear, key=lambda one: -abs(one.value / one.sigma))[:_LISTED]
        clear = [one for one in numbers if one in clear]
    return ", ".join(_number_text(one, len(numbers)) for one in clear)


def _number_text(number: _Number, count: int) -> str:
    part = number.name.rsplit("[", maxsplit=1)[-1].rstrip("]") if "[" in number.name else ""
    text = quantity(number.value, number.sigma, number.unit)
    return (
        f"{text} on {part}" if part in ("x", "y", "z") else f"{text} ({part})" if part and count > 1 else text
    )


def fall_text(before: float, after: float) -> str:
    """Return two sizes with an arrow between them, to three digits; the same size only once."""
    first, last = f"{before:.3g}", f"{after:.3g}"
    return first if first == last else f"{first} -> {last}"


def quantity(value: float, sigma: float, unit: str) -> str:
    """Return a value with its error to two digits of the error, in a unit that suits its size.

    ``1.8e-07 1/d`` becomes ``+0.18 ppm/d``, ``-0.00068 nT/mA`` becomes ``-0.68 nT/A``.
    """
    unit, factor = _suited(unit, abs(value))
    value, sigma = value * factor, sigma * factor
    if not 0.0 < sigma < float("inf"):
        return f"{value:+.3g} {unit}".strip()
    places = 1 - floor(log10(sigma))
    if -2 <= places <= 6:
        digits = max(places, 0)
        return f"{value:+.{digits}f} +- {sigma:.{digits}f} {unit}".strip()
    shown = max(floor(log10(max(abs(value), sigma))) + places, 1)
    return f"{value:+.{shown}e} +- {sigma:.1e} {unit}".strip()


def _suited(unit: str, size: float) -> tuple[str, float]:
    """Return the unit to tell a size in, and the factor to it."""
    per_milli = re.search(r"/m(A|V|W)(\^2)?$", unit)
    if per_milli and isfinite(size) and size < 0.1:
        power = 2 if per_milli[2] else 1
        return f"{unit[: per_milli.start()]}/{per_milli[1]}{per_milli[2] or ''}", 1e3**power
    for other, factor, below in _UNITS.get(unit, ()):
        if 0.0 < size < below:
            return other, factor
    return ("" if unit == "1" else unit), 1.0
