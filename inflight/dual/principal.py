"""Principal directions of the difference of two sensors: one source after the other.

A unit that switches, whatever its current does, moves the difference along one direction. The direction in
which the difference varies most (beyond its noise) is that of the strongest unit when it stands out; what
moves along it is regressed out of the outboard sensor, and the next direction is sought in what is left. The
idea is Constantinescu et al. (2020); here the variances are of weighted contrasts, with the sensors' white
noise taken out, so that slow ambient field and noise choose no direction.
"""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats


def principal_directions(square: Floats, noise: Floats) -> Floats:
    """Return the directions of the difference in the order of their variance over that of the noise.

    Parameters
    ----------
    square : ndarray, shape (3, 3)
        Sum of squares of the difference, its noise taken out.
    noise : ndarray, shape (3, 3)
        Covariance of the difference's noise, nT^2.

    Returns
    -------
    ndarray, shape (3, 3)
        Row r is what the difference is projected on for source r. Projections on different rows are
        uncorrelated in stray field and in noise.
    """
    level = np.trace(noise) / 3.0
    root = np.linalg.cholesky(noise + 1e-6 * max(level, 1e-12) * np.eye(3))
    inverse = np.linalg.inv(root)
    whitened = inverse @ square @ inverse.T
    _, vector = np.linalg.eigh(0.5 * (whitened + whitened.T))
    # Projection of the whitened difference: v^T root^-1 d.
    return np.asarray(vector[:, ::-1].T @ inverse)
