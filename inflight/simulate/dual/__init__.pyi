from .day import simulate_dual_day
from .settings import DualParameters, DualSettings

__all__ = [
    "DualParameters",
    "DualSettings",
    "simulate_dual_day",
]
