"""Calibration of a magnetometer on a spinning spacecraft: phase, spin fits, tones, parameters, product.

In: Sun pulses or an angle, and readings, nT, of a triad. Out: the spin phase (phase.py), spin fits and the
angles and zero levels of Farrell et al. 1995 (fits.py, farrell.py), the eight spin-related of the twelve
parameters of Plaschke et al. 2019 with covariances (tones.py, estimate.py), the values in use (update.py),
the level-2 product (product.py), and what the tones of the residual depend on (residual.py). Open equation.py
first, then estimate.py.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
