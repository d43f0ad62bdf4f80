"""A sensor on a spinning spacecraft, calibrated by the spin itself.

In go the samples of one vector sensor and the phase of the spin; out come twelve parameters in tables, each
with its origin, and the despun field. `pipeline.py` is the file to open first; `day.py` estimates the eight
parameters of a day, `tables.py` combines days and finds the offset along the spin axis, `product.py` makes
the field, `compare.py` measures the remaining spin tones, `report.py` shows the tables.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
