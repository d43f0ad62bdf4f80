"""A CHAMP-like mission, simulated: the other side of every recovery test.

It shares no code with the corrections: orbit and main field, sunlight, temperatures and currents
drive dipoles on the spacecraft and sensors whose equations are written here a second time, in the
direction from field to reading. Each module names the source of its equations.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
