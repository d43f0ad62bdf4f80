"""Zero levels of a magnetometer from nature's own statistics: Alfvenic rotations, compressions, flippers.

No file is opened here; every method takes `Intervals` and returns an `Estimate`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
