"""Temperatures of the fluxgate's coil and of the electronics from heat balances."""

from __future__ import annotations

import numpy as np

from inflight.simulate.grid import Float
from inflight.simulate.power import relax

#: s: boom housing to space and Sun, coil to housing, electronics to body.
_HOUSING_TIME = 1500.0
_COIL_TIME = 2400.0
_ELECTRONICS_TIME = 5400.0


def temperatures(sun: Float, light: Float, heater: Float, cadence: float) -> tuple[Float, Float]:
    """Return the temperatures of coil and electronics.

    Two nodes in series for the coil (housing, then coil) and one for the electronics, each a
    linear heat balance integrated exactly.

    Parameters
    ----------
    sun : ndarray, shape (time, 3)
        Unit vector to the Sun, spacecraft axes; the housing is a cylinder along x.
    light : ndarray, shape (time,)
        Visible fraction of the Sun.
    heater : ndarray, shape (time,)
        Heater current, A.
    cadence : float
        s; the series has to start several time constants before it is used.

    Returns
    -------
    coil, electronics : ndarray, shape (time,)
        degC.
    """
    across = np.sqrt(np.clip(1.0 - sun[:, 0] ** 2, 0.0, 1.0))
    housing_drive = -9.0 + 28.0 * light * across + 4.0 * light * np.clip(-sun[:, 2], 0.0, None)
    housing = relax(housing_drive, _HOUSING_TIME, cadence, float(housing_drive.mean()))
    coil = relax(housing + 2.0, _COIL_TIME, cadence, float(housing.mean()) + 2.0)
    electronics_drive = 17.0 + 7.0 * light + 4.0 * heater
    electronics = relax(electronics_drive, _ELECTRONICS_TIME, cadence, float(electronics_drive.mean()))
    return coil, electronics
