"""A CHAMP-like mission, simulated: what the recovery tests are made from.

In go settings (`SimulationSettings`) and a day; out come the deliveries of each instrument and their truth
(`simulate_day`). It shares no code with the corrections: orbit and main field, sunlight, temperatures and
currents drive dipoles on the spacecraft and sensors whose equations are written here a second time, in the
direction from field to reading. Open `day.py` first; each module names the source of its equations. The
folders `dual` and `spinning` simulate two sensors on a boom and a spinning spacecraft.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
