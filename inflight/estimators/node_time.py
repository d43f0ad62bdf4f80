"""Local time of an orbit's ascending node from where samples lie on the orbit."""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats

_DEGREES_AN_HOUR = 15.0


def node_local_time(local_time: Floats, orbit_phase: Floats, latitude: Floats) -> Floats:
    """Return the local time of the ascending node, h; shape of the arguments.

    From the node at an angle u along an orbit inclined by i the longitude has grown by
    ``atan2(cos i sin u, cos u)``: near the poles of a polar orbit by 180 degrees at once. The inclination is
    that which the latitudes show, ``sin(latitude) = sin i sin u``; of a prograde and a retrograde orbit
    of the same latitudes that one is taken whose node wanders less from each place to the next.

    Parameters
    ----------
    local_time : ndarray
        h, where the satellite is; in order of time.
    orbit_phase, latitude : ndarray
        deg; u and the geocentric latitude there.
    """
    u, sine = np.deg2rad(orbit_phase), np.sin(np.deg2rad(latitude))
    known = np.isfinite(u) & np.isfinite(sine)
    power = float(np.sum(np.sin(u[known]) ** 2))
    tilt = min(abs(float(np.sum(sine[known] * np.sin(u[known])))) / power, 1.0) if power > 0 else 1.0
    cosine = float(np.sqrt(1.0 - tilt**2))
    both = [_node(local_time, u, one) for one in (cosine, -cosine)]
    return min(both, key=_wander)


def _node(local_time: Floats, u: Floats, cosine: float) -> Floats:
    away = np.rad2deg(np.arctan2(cosine * np.sin(u), np.cos(u)))
    return np.asarray((local_time - away / _DEGREES_AN_HOUR) % 24.0)


def _wander(hours: Floats) -> float:
    """Return the mean step on the clock's circle from each place to the next, h."""
    known = hours[np.isfinite(hours)]
    steps = (np.diff(known) + 12.0) % 24.0 - 12.0
    return float(np.mean(np.abs(steps))) if steps.size else 0.0
