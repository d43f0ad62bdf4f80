"""Currents of the power system: three solar panels, a battery, loads, heaters, the boom's star camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from inflight.simulate.grid import Float
from inflight.simulate.parameters import Parameters
from inflight.simulate.randomness import drift

#: Normals of the panels in spacecraft axes: two sides leaning 45 degrees, and the top.
PANEL_NORMALS = np.array(
    [[0.0, -np.sqrt(0.5), -np.sqrt(0.5)], [0.0, np.sqrt(0.5), -np.sqrt(0.5)], [0.0, 0.0, -1.0]]
)
#: Boresights of the camera heads: the Sun crosses them near local times 03, 09, 15 and 21.
_BORESIGHTS = PANEL_NORMALS[:2]
_BAFFLE = 0.05


@dataclass(frozen=True)
class Currents:
    """Currents at regular times, A: `panels` (time, 3), the others (time,)."""

    panels: Float
    battery: Float
    camera: Float
    heater: Float
    load: Float

    @property
    def solar(self) -> Float:
        """Current of the whole array, A."""
        return np.asarray(self.panels.sum(axis=1))


def currents(
    seconds: Float, sun: Float, light: Float, *, parameters: Parameters, seed: int, cadence: float
) -> Currents:
    """Return the currents of the power system.

    The battery takes what the array gives beyond the load until it is full; then the array falls
    to the load within some seconds. The charge missing is the running maximum of the charge
    balance minus the balance, so the state forgets the start at the first full battery.

    Parameters
    ----------
    seconds : ndarray, shape (time,)
        TT2000, s, regular.
    sun : ndarray, shape (time, 3)
        Unit vector to the Sun, spacecraft axes.
    light : ndarray, shape (time,)
        Visible fraction of the Sun.
    parameters, seed : Parameters, int
        The spacecraft, and the seed of its small load changes.
    cadence : float
        s.
    """
    heater = parameters.heater_current * switched(seconds, parameters.heater_period, parameters.heater_duty)
    # How much the Sun shines into a camera head, 0 to 1.
    glare = np.exp((sun @ _BORESIGHTS.T - 1.0) / _BAFFLE).max(axis=1)
    camera = parameters.camera_current + parameters.camera_sunlit_current * glare * light
    load = parameters.load + heater + camera
    load += drift(seconds[::30], seed, "load", (0.08,), periods=(1200.0, 9000.0)).repeat(30, axis=0)[
        : load.size, 0
    ]
    generated = np.clip(sun @ PANEL_NORMALS.T, 0.0, None) * light[:, None] * parameters.panel_peaks
    available = generated.sum(axis=1)
    balance = np.cumsum(available - load)
    full = balance >= np.maximum.accumulate(balance)
    demand = np.where(full, np.minimum(1.0, load / np.maximum(available, 1e-9)), 1.0)
    share = relax(demand, parameters.regulation_time, cadence, demand[0])
    panels = generated * share[:, None]
    return Currents(panels, panels.sum(axis=1) - load, camera, heater, load)


def switched(seconds: Float, period: float, duty: float) -> Float:
    """Return 1 while a periodic switch is on and 0 while it is off."""
    return np.asarray((seconds / period) % 1.0 < duty, dtype=np.float64)


def relax(drive: Float, time_constant: float, cadence: float, start: float) -> Float:
    """Return the exact solution of ``dy/dt = (drive - y) / time_constant`` for a stepwise drive."""
    keep = float(np.exp(-cadence / time_constant))
    return np.asarray(scipy.signal.lfilter([1.0 - keep], [1.0, -keep], drive, zi=[keep * start])[0])
