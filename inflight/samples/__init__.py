"""Samples: channels of one span on one time base, an `xarray.Dataset`.

In go channels of any cadence with their stamps (`align`), and names of derived channels; out come
samples as effects and residuals read them. Open `alignment` first; `derived` makes slow responses, plays and
products of channels, `spin_folding` folds many turns of a spinning spacecraft into one.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
