from .day import simulate_dual_day
from .settings import DualParameters, DualSettings
from .switching import six_states

__all__ = [
    "DualParameters",
    "DualSettings",
    "simulate_dual_day",
    "six_states",
]
