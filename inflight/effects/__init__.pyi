from .base import (
    AXES,
    Effect,
    Parameter,
    Values,
    field_direction,
    field_strength,
    multiply,
    time_derivative,
    with_field,
)
from .conformance import ConformanceSettings, check_effect
from .environment import MAX_HARMONIC, DayNight, DayNightSeries, order_names
from .families import CURRENT_FAMILIES, NO_CAUSE, channel_unit, channels_of, coefficient_unit, family_of
from .registry import effect_class, known_effects
from .sensors import ANGLES, VECTOR_ROLES, Affine, ScalarBias, TimeShift, VectorSensor
from .spacecraft import (
    PANEL_CYCLE_DAYS,
    PANEL_CYCLE_START_H,
    SIDE_NORMALS,
    TOP_NORMAL,
    panel_illumination,
    panel_weights_at,
)
from .spinning_sensor import SpinningSensor, coupling, gains_of, package_to_spin, sensor_axes
from .user_effects import EffectSource

__all__ = [
    "ANGLES",
    "AXES",
    "CURRENT_FAMILIES",
    "MAX_HARMONIC",
    "NO_CAUSE",
    "PANEL_CYCLE_DAYS",
    "PANEL_CYCLE_START_H",
    "SIDE_NORMALS",
    "TOP_NORMAL",
    "VECTOR_ROLES",
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
    "effect_class",
    "family_of",
    "field_direction",
    "field_strength",
    "gains_of",
    "known_effects",
    "multiply",
    "order_names",
    "package_to_spin",
    "panel_illumination",
    "panel_weights_at",
    "sensor_axes",
    "time_derivative",
    "with_field",
]
