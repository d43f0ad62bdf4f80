"""A spacecraft with two fluxgates on one boom, simulated: units that switch, solar wind, drifting sensors.

Every unit is a dipole at a place (or, for the published six states, a pair of free vectors): both sensors
see its field at once, the inner one more of it. The numbers are chosen; no spacecraft has them. Open `day.py`
first: it adds up what `ambient`, `switching` and the sensors give.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
