"""Scalar calibration: nine parameters a block, tables of them, and the calibrated field.

In go aligned samples of a vector and a scalar sensor and a model (`inflight.model`); out come normal
equations of blocks, calibration tables with what the data determine, and level-2 fields. Open `scalar`
first (the fit of one block), then `normal_equations` (sums of blocks), `table` and `product`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
