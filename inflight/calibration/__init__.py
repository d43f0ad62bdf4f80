"""Scalar calibration: nine parameters a block from normal equations, with what the data can determine."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
