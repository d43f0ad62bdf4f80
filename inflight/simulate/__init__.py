"""A CHAMP-like mission, simulated: the other side of every recovery test.

It shares no code with the corrections: orbit and main field, sunlight, temperatures and currents
drive dipoles on the spacecraft and sensors whose equations are written here a second time, in the
direction from field to reading. Each module names the source of its equations.
"""

from inflight.simulate.day import simulate_day
from inflight.simulate.mission import SimulatedDay
from inflight.simulate.parameters import Parameters
from inflight.simulate.settings import SimulationSettings, effect_names

__all__ = [
    "Parameters",
    "SimulatedDay",
    "SimulationSettings",
    "effect_names",
    "simulate_day",
]
