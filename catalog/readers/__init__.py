"""Readers: a delivered file of any supported format becomes one `RawTable`, rows of it become days."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
