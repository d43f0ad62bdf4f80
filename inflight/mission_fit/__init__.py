"""The fit of a whole mission, and the spacecraft's fields from its parameters and residual.

In go samples and the Gram matrices of days (`inflight.calibration`, `inflight.lsq`); out come trends in
time, one continuous calibration, and the fields of temperature, day and night, currents and torquers with
their uncertainties. Nothing here reads or writes a file. Open `daily_equations` first (what is kept of a
day), then `continuous` (one fit of all days), `trends` and `joint_effects`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
