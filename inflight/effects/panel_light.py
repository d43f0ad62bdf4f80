"""Which solar panels are lit: by the local time of the orbit, or by the Sun's direction."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats

#: Days in which the local time falls by 24 h, and the hour at which the thesis' schedule begins.
CYCLE, BEGINS = 260.5, 9.0
#: Outward normals in spacecraft axes: two sides that lean by 45 degrees, and the top.
SIDES = ((0.0, -(0.5**0.5), -(0.5**0.5)), (0.0, 0.5**0.5, -(0.5**0.5)))
TOP = (0.0, 0.0, -1.0)


def node_local_time(local_time: Floats, orbit_phase: Floats, inclination: float = 90.0) -> Floats:
    """Return the local time of the ascending node from that of a place on the orbit; (epoch,) h.

    Right ascension runs ``atan2(cos i sin u, cos u)`` ahead of the node's at argument of latitude u.

    Parameters
    ----------
    local_time, orbit_phase : ndarray, shape (epoch,)
        h, and degrees from the ascending node.
    inclination : float
        deg; with 90 the two halves of the orbit differ by 12 h.
    """
    phase, tilt = np.radians(orbit_phase), np.radians(inclination)
    ahead = np.degrees(np.arctan2(np.cos(tilt) * np.sin(phase), np.cos(phase)))
    return np.asarray((local_time - ahead / 15.0) % 24.0)


def schedule(local_time: Floats) -> Floats:
    """Return the weights of first and second panel by the node's local time; (epoch, 2), of sum 1.

    Parameters
    ----------
    local_time : ndarray, shape (epoch,)
        h, of the ascending node. It falls: a cycle begins at 9 h and its quarters, 65.125 of 260.5
        days, end at 3, 21, 15 and 9 h.
    """
    return scheduled(((BEGINS - np.asarray(local_time)) % 24.0) / 24.0)


def scheduled(turn: Floats) -> Floats:
    """Return the weights of first and second panel by the turns since a cycle began; (time, 2), of sum 1."""
    part = np.asarray(turn) % 1.0
    angle = 0.5 * np.pi * (np.clip(4 * part - 1, 0.0, 1.0) - np.clip(4 * part - 3, 0.0, 1.0))
    light = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    return np.asarray(light / light.sum(axis=1, keepdims=True))


def light_on(sun: Floats, normals: npt.ArrayLike, areas: npt.ArrayLike | None = None) -> Floats:
    """Return the share of each panel in the light; (time, panel), of sum 1, 0 where none is lit.

    Parameters
    ----------
    sun : ndarray, shape (time, 3)
        Unit vector to the Sun, axes of the normals.
    normals : array_like, shape (panel, 3)
    areas : array_like, shape (panel,), optional
        Currents at normal incidence relative to each other; equal when absent.
    """
    rows = np.asarray(normals, dtype=np.float64)
    size = np.ones(len(rows)) if areas is None else np.asarray(areas, dtype=np.float64)
    light = np.clip(sun @ rows.T, 0.0, None) * size
    total = light.sum(axis=1, keepdims=True)
    return np.asarray(np.divide(light, total, out=np.zeros_like(light), where=total > 0))
