"""Least squares from Gram matrices: one container, one solver, one covariance of each kind.

In go rows of [columns | residual], or their Gram matrices; out come values, covariances and what the data
determine. Knows neither effects nor files. Open `gram_blocks` first: `GramBlocks` is the protocol of the
statistics that everything is made from, `GramArrays` holds them in memory. Then `solver` (solving,
marginalising, priors), `covariance` (HAC, sandwich, jackknife), `clusters` (fits of independent clusters),
`robust` (biweight), and `contrasts`: differences across a step, along and across the field.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
