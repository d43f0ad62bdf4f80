"""Calibration from the spin: phase, spin fits, and what tones at the spin period tell of a magnetometer."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
