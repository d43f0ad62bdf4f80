"""Local time of the ascending node, from places all around an orbit."""

import numpy as np
import pytest

from inflight.mission_fit import node_local_time


@pytest.mark.parametrize("inclination", [87.3, 97.5, 60.0])
@pytest.mark.parametrize("node", [0.3, 9.5, 23.8])
def test_places_around_the_orbit_tell_one_node(inclination, node):
    u = np.linspace(0.0, 359.0, 360)
    tilt, angle = np.deg2rad(inclination), np.deg2rad(u)
    latitude = np.rad2deg(np.arcsin(np.sin(tilt) * np.sin(angle)))
    east = np.rad2deg(np.arctan2(np.cos(tilt) * np.sin(angle), np.cos(angle)))
    found = node_local_time((node + east / 15.0) % 24.0, u, latitude)
    apart = (found - node + 12.0) % 24.0 - 12.0
    assert np.abs(apart).max() < 1e-6
