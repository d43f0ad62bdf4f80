from .ambient import solar_wind
from .day import simulate_spinning_day
from .settings import SPACECRAFT_PRESETS, SpinningParameters, SpinningSettings

__all__ = [
    "SPACECRAFT_PRESETS",
    "SpinningParameters",
    "SpinningSettings",
    "simulate_spinning_day",
    "solar_wind",
]
