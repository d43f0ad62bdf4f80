"""A spinning spacecraft, simulated: solar wind, magnetosheath and a dipole seen by a turning sensor.

In: `SpinningSettings`. Out: a day's deliveries and the truth (`simulate_spinning_day`). The ambient field has
the statistics of natural fluctuations (Alfvenic rotations and compressions with a power law) and a dipole;
the sensor's equation (Plaschke et al. 2019, eq. 9) is written here a second time, from field to reading. Open
day.py first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
