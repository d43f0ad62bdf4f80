"""Zero levels of a magnetometer from the statistics of natural fluctuations, without an absolute instrument.

In: times and readings, nT, of a record (`Intervals.of`). Out: offsets with covariances (`Estimate`), of each
method in `METHODS` and of all together (`combine_methods`), with the axes that are not determined and why,
and with the test of what methods assume (`check_assumptions`); averages over whole turns (`average_spans`);
and the parts of sensors and spacecraft from a flipper (`separate_flipped`). No file is opened here.

Open methods.py first: the methods and their equations; then combination.py.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
