"""A spinning spacecraft, simulated: solar wind, magnetosheath and a dipole seen by a turning sensor.

The ambient field is nature's own statistics (Alfvenic rotations and compressions with a power law) and a
dipole; the sensor's equation is written here a second time, in the direction from field to reading.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
