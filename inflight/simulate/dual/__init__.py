"""A spacecraft with two fluxgates on one boom, simulated: units that switch, solar wind, drifting sensors.

Every unit is a dipole at a place (or, for the published six states, a pair of free vectors): both sensors
see its field at once, the inner one more of it. The numbers are chosen; no spacecraft has them.
"""

from inflight.simulate.dual.day import simulate_dual_day
from inflight.simulate.dual.settings import DualParameters, DualSettings

__all__ = ["DualParameters", "DualSettings", "simulate_dual_day"]
