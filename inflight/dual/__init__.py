"""Two sensors on one boom: the spacecraft's states told from their difference, and its field taken off.

The ambient field is the same at both sensors, so that their difference ``d = B_in - B_out`` is the
spacecraft's field alone (and both sensors' offsets and noise). Delva et al. (Venus Express) recognise
the spacecraft's switching states in it; Ness et al. (1971) scale it to the outboard sensor.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
