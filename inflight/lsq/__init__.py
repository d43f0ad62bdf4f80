"""Least squares from Gram matrices: the one container, the one solver and the one of each covariance.

In go rows of [columns | residual], or their Gram matrices; out come values, covariances and what the data
determine. Knows nothing of sensors, effects or files. Open `gram_blocks` first (the statistics that
everything is made from), then `solver` (solving, marginalising, priors), `covariance` (HAC, sandwich,
jackknife), `clusters` (fits of independent clusters), `robust` and `contrasts`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
