"""A spinning spacecraft, simulated: solar wind, magnetosheath and a dipole seen by a turning sensor.

The ambient field is nature's own statistics (Alfvenic rotations and compressions with a power law) and a
dipole; the sensor's equation is written here a second time, in the direction from field to reading.
"""

from inflight.simulate.spinning.day import simulate_spinning_day
from inflight.simulate.spinning.settings import CRAFT, SpinningParameters, SpinningSettings

__all__ = ["CRAFT", "SpinningParameters", "SpinningSettings", "simulate_spinning_day"]
