from .base import (
    AXES,
    Effect,
    Parameter,
    Values,
    did_you_mean,
    direction,
    multiply,
    slope,
    strength,
    with_field,
)
from .conformance import ConformanceSettings, check_effect
from .environment import DayNight, DayNightSeries, of_orders
from .families import NO_CAUSE, channel_unit, channels_of, coefficient_unit, family_of
from .registry import effect_class, known_effects
from .sensors import ANGLES, Affine, ScalarBias, TimeShift, VectorSensor
from .sources import EffectSource
from .spacecraft import BEGINS, CYCLE, SIDES, TOP, light_on, schedule
from .spinning_sensor import SpinningSensor, coupling, gains_of, package_to_spin, sensor_axes

__all__ = [
    "ANGLES",
    "AXES",
    "BEGINS",
    "CYCLE",
    "NO_CAUSE",
    "SIDES",
    "TOP",
    "Affine",
    "ConformanceSettings",
    "DayNight",
    "DayNightSeries",
    "Effect",
    "EffectSource",
    "Parameter",
    "ScalarBias",
    "SpinningSensor",
    "TimeShift",
    "Values",
    "VectorSensor",
    "channel_unit",
    "channels_of",
    "check_effect",
    "coefficient_unit",
    "coupling",
    "did_you_mean",
    "direction",
    "effect_class",
    "family_of",
    "gains_of",
    "known_effects",
    "light_on",
    "multiply",
    "of_orders",
    "package_to_spin",
    "schedule",
    "sensor_axes",
    "slope",
    "strength",
    "with_field",
]
