from .ambient import solar_wind
from .day import simulate_spinning_day
from .settings import CRAFT, SpinningParameters, SpinningSettings

__all__ = [
    "CRAFT",
    "SpinningParameters",
    "SpinningSettings",
    "simulate_spinning_day",
    "solar_wind",
]
