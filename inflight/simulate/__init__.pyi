from .day import simulate_day
from .defects import FILL
from .field import main_field
from .grid import STEP, Grid, Sampling
from .mission import MissionSettings, SimulatedDay
from .orbit import EARTH_RADIUS, geometry, mjd, node_local_time, sunlight
from .parameters import Parameters
from .settings import SimulationSettings, effect_names
from .torquers import mean_current, torquer_currents

__all__ = [
    "EARTH_RADIUS",
    "FILL",
    "STEP",
    "Grid",
    "MissionSettings",
    "Parameters",
    "Sampling",
    "SimulatedDay",
    "SimulationSettings",
    "effect_names",
    "geometry",
    "main_field",
    "mean_current",
    "mjd",
    "node_local_time",
    "simulate_day",
    "sunlight",
    "torquer_currents",
]
