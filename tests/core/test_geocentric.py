"""Geocentric solar axes against another library's numbers, and payload axes in them."""

import numpy as np
import pytest

from inflight.errors import MissionError
from inflight.frames import dipole_angle, dipole_axis, gse_to_gsm, payload_to_gse, sun_direction_gse, to_gse
from inflight.time import to_tt2000

VECTOR = np.array([0.6, -0.64, 0.48])
#: What sunpy 7.0 (astropy 8.0) makes of VECTOR in gse, from four frames; its dipole is older than ours.
SUNPY = {
    "1974-03-05T03:20:00": {
        "gcrf": [0.68394, -0.22179, 0.69501],
        "itrf": [-0.92413, 0.14402, 0.35389],
        "gei": [0.6853, -0.21758, 0.69499],
        "gsm": [0.59999, -0.34849, 0.72012],
    },
    "1995-11-20T12:00:00": {
        "gcrf": [0.01489, 0.71893, 0.69492],
        "itrf": [0.4406, -0.73593, 0.51409],
        "gei": [0.01417, 0.7189, 0.69497],
        "gsm": [0.59997, -0.77755, 0.18828],
    },
    "2008-09-01T17:45:00": {
        "gcrf": [-0.70069, 0.16151, 0.69495],
        "itrf": [0.73726, 0.37271, 0.56349],
        "gei": [-0.70035, 0.16289, 0.69496],
        "gsm": [0.59997, -0.76372, 0.23825],
    },
    "2019-06-02T00:30:00": {
        "gcrf": [-0.17891, -0.69639, 0.695],
        "itrf": [-0.45234, 0.64179, 0.61926],
        "gei": [-0.18219, -0.69559, 0.69495],
        "gsm": [0.59998, -0.47277, 0.64538],
    },
}


def stamps_of(*texts):
    return np.array([to_tt2000(np.datetime64(one, "ns")) for one in texts], dtype=np.int64)


@pytest.mark.parametrize("when", list(SUNPY))
@pytest.mark.parametrize("frame", ["gcrf", "itrf", "gei", "gsm"])
def test_gse_is_that_of_another_library_to_a_fiftieth_of_a_degree(when, frame):
    found = to_gse(VECTOR[None], stamps_of(when), frame)[0]
    apart = np.rad2deg(np.linalg.norm(found - SUNPY[when][frame]))
    assert apart < 0.02


def test_gsm_and_back_is_the_same_and_has_the_dipole_in_its_xz_plane_northward():
    rng = np.random.default_rng(1)
    stamps = stamps_of(*(f"2005-{month:02d}-17T{month:02d}:30:00" for month in range(1, 13)))
    vectors = rng.standard_normal((12, 3))
    there = gse_to_gsm(vectors, stamps)
    np.testing.assert_allclose(to_gse(there, stamps, "gsm"), vectors, atol=1e-12)
    np.testing.assert_allclose(there[:, 0], vectors[:, 0], atol=1e-15)
    days = (stamps - stamps_of("2000-01-01T12:00:00")[0]) / 86_400e9
    dipole = gse_to_gsm(to_gse(dipole_axis(days), stamps, "itrf"), stamps)
    np.testing.assert_allclose(dipole[:, 1], 0.0, atol=1e-6)
    assert (dipole[:, 2] > 0.8).all()


def test_the_dipole_is_where_it_was():
    """The boreal pole of the dipole of the IGRF, geocentric."""
    for year, (latitude, longitude) in {2005: (79.74, -71.78), 2020: (80.59, -72.68)}.items():
        axis = dipole_axis(np.array([(year - 2000) * 365.25]))[0]
        assert np.rad2deg(np.arcsin(axis[2])) == pytest.approx(latitude, abs=0.02)
        assert np.rad2deg(np.arctan2(axis[1], axis[0])) == pytest.approx(longitude, abs=0.03)
    assert np.abs(dipole_angle(stamps_of("2005-06-21T00:00:00"))) < np.deg2rad(36)


def test_payload_axes_are_turned_by_spin_axis_and_sun():
    axis = np.array([[0.1, -0.3, 2.0], [0.0, 0.0, -1.0]])
    towards = sun_direction_gse(np.zeros(2, dtype=np.int64))
    sun = payload_to_gse(np.tile([1.0, 0.0, 0.0], (2, 1)), axis, towards)
    up = payload_to_gse(np.tile([0.0, 0.0, 1.0], (2, 1)), axis, towards)
    side = payload_to_gse(np.tile([0.0, 1.0, 0.0], (2, 1)), axis, towards)
    np.testing.assert_allclose(up, axis / np.linalg.norm(axis, axis=1, keepdims=True))
    np.testing.assert_allclose(np.einsum("ta,ta->t", side, towards), 0.0, atol=1e-15)
    assert (np.einsum("ta,ta->t", sun, towards) > 0.95).all()
    np.testing.assert_allclose(np.cross(up, sun), side, atol=1e-15)
    # Upside down, dusk is on the other side.
    np.testing.assert_allclose(side[1], [0.0, -1.0, 0.0], atol=1e-15)


def test_without_an_axis_or_with_one_at_the_sun_nothing_is_said():
    towards = sun_direction_gse(np.zeros(3, dtype=np.int64))
    axis = np.array([[np.nan, 0.0, 1.0], [1.0, 0.02, 0.0], [1.0, 0.2, 0.0]])
    known = np.isfinite(payload_to_gse(np.ones((3, 3)), axis, towards)).all(axis=1)
    assert known.tolist() == [False, False, True]


def test_the_sun_is_seen_from_where_the_spacecraft_is():
    place = np.array([[0.0, 6371.2 * 20, 0.0], [np.nan] * 3])
    towards = sun_direction_gse(stamps_of("2012-01-03T00:00:00", "2012-01-03T00:00:00"), place)
    assert np.rad2deg(np.arctan2(-towards[0, 1], towards[0, 0])) == pytest.approx(0.0496, abs=2e-4)
    np.testing.assert_allclose(towards[1], [1.0, 0.0, 0.0])


def test_another_frame_is_refused():
    with pytest.raises(MissionError, match="'nec'"):
        to_gse(VECTOR[None], stamps_of("2012-01-03T00:00:00"), "nec")
