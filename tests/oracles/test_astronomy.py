"""Frames and the Sun against astropy and sunpy, on random days of fifty years."""

from functools import partial

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import GCRS, ITRS, CartesianRepresentation, PrecessedGeocentric, SkyCoord, get_sun
from astropy.time import Time
from astropy.utils import iers
from sunpy.coordinates import GeocentricSolarEcliptic, GeocentricSolarMagnetospheric

from inflight.frames import days_since_j2000, gse_to_gsm, sidereal_angle, sun_direction, to_date, to_gse
from inflight.time import to_tt2000

COUNT = 40
#: What the almanac's short series and first-order precession leave, deg.
TOLERANCE = 0.02
#: The other library's dipole is that of another epoch of the IGRF, deg.
DIPOLE_TOLERANCE = 0.3


@pytest.fixture(scope="module", autouse=True)
def offline():
    """Use the tables of the Earth's rotation that came with the library."""
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("iers_degraded_accuracy", "ignore"):
        yield


@pytest.fixture(scope="module")
def when() -> np.ndarray:
    rng = np.random.default_rng(7)
    seconds = rng.integers(0, 50 * 365 * 86_400, COUNT)
    return np.datetime64("1974-01-01T00:00:00", "ns") + seconds * np.timedelta64(1_000_000_000, "ns")


@pytest.fixture(scope="module")
def stamps(when) -> np.ndarray:
    return np.array([to_tt2000(one) for one in when], dtype=np.int64)


def vectors_of(frame_coordinates) -> np.ndarray:
    found = frame_coordinates.cartesian.xyz.value.T
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.linalg.norm(one - other, axis=1))


def random_vectors() -> np.ndarray:
    vectors = np.random.default_rng(8).standard_normal((COUNT, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def each_day(turn, vectors: np.ndarray, when: np.ndarray) -> np.ndarray:
    """Turn vectors one by one: precession is taken at the mean of the days that are given together."""
    return np.concatenate([turn(vectors[[one]], when[[one]]) for one in range(len(vectors))])


def far_away(vectors: np.ndarray) -> CartesianRepresentation:
    """Return directions as places so far away that parallax does not count."""
    return CartesianRepresentation(vectors.T * 1e6 * u.AU)


def test_the_sun_is_where_astropy_sees_it(when, stamps):
    times = Time(when)
    seen = get_sun(times).transform_to(PrecessedGeocentric(equinox=times, obstime=times))
    assert apart(sun_direction(days_since_j2000(stamps)), vectors_of(seen)).max() < TOLERANCE


def test_sidereal_time_is_that_of_astropy(when, stamps):
    theirs = Time(when).sidereal_time("mean", "greenwich").to_value(u.rad)
    difference = np.angle(np.exp(1j * (sidereal_angle(days_since_j2000(stamps)) - theirs)))
    # UTC stands for UT1, which is at most 0.9 s of time away.
    assert np.abs(difference).max() < 0.9 * 2 * np.pi / 86_164 + 1e-6


def test_precession_is_that_of_astropy(when, stamps):
    vectors, times = random_vectors(), Time(when)
    there = SkyCoord(far_away(vectors), frame=GCRS(obstime=times))
    theirs = vectors_of(there.transform_to(PrecessedGeocentric(equinox=times, obstime=times)))
    assert apart(each_day(to_date, vectors, days_since_j2000(stamps)), theirs).max() < TOLERANCE


@pytest.mark.parametrize("frame", ["gcrf", "itrf"])
def test_gse_is_that_of_sunpy(when, stamps, frame):
    vectors, times = random_vectors(), Time(when)
    begin = GCRS(obstime=times) if frame == "gcrf" else ITRS(obstime=times)
    there = SkyCoord(far_away(vectors), frame=begin).transform_to(GeocentricSolarEcliptic(obstime=times))
    found = each_day(partial(to_gse, frame=frame), vectors, stamps)
    assert apart(found, vectors_of(there)).max() < TOLERANCE


def test_gsm_is_that_of_sunpy(when, stamps):
    vectors, times = random_vectors(), Time(when)
    begin = SkyCoord(far_away(vectors), frame=GeocentricSolarEcliptic(obstime=times))
    there = begin.transform_to(GeocentricSolarMagnetospheric(obstime=times))
    assert apart(gse_to_gsm(vectors, stamps), vectors_of(there)).max() < DIPOLE_TOLERANCE
