"""A vector sensor against a model of the Earth's field: platform magnetometers, and others near the Earth.

`pipeline.py` is all of it; the fit is that of `inflight.calibration.field_model`, the field along the orbit
that of `inflight.main_field`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
