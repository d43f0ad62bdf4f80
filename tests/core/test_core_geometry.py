"""Sun, Earth's turn and orbit against the almanac's own examples, and against orbits known in closed form."""

import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation

from inflight.frames import (
    EARTH_RADIUS,
    GEOMETRY,
    SHADOW_LAYERS,
    add_geometry,
    days_since_j2000,
    from_date,
    geometry_at,
    itrf_to_nec,
    rotate,
    rotate_with_earth,
    sidereal_angle,
    sun_direction,
    sunlit_fraction,
    to_date,
)
from inflight.time import SECOND, to_tt2000

NAN = float("nan")
PERIOD, INCLINATION, RADIUS = 5600.0, 87.3, 6800.0


def at(*texts):
    return days_since_j2000(to_tt2000(np.array(texts, dtype="datetime64[ns]")))


def unit(right_ascension, declination):
    a, d = np.deg2rad([right_ascension, declination])
    return np.array([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)])


def apart(one, other):
    """Return the angle between vectors, deg."""
    return np.rad2deg(np.arccos(np.clip(np.sum(one * other, axis=-1), -1, 1)))


def test_the_sun_stands_where_the_almanac_says():
    # Meeus, Astronomical Algorithms, example 25.a, apparent place; 59 s of TD - UT do not matter.
    assert apart(sun_direction(at("1992-10-13"))[0], unit(198.38083, -7.78507)) < 0.012
    # Equinox and solstice of 2024 as published to the minute.
    assert sun_direction(at("2024-03-20T03:06"))[0] == pytest.approx([1, 0, 0], abs=2e-4)
    assert sun_direction(at("2024-06-20T20:51"))[0] == pytest.approx(unit(90, 23.4385), abs=2e-4)


def test_the_earth_turns_by_sidereal_time():
    # Meeus, examples 12.a and 12.b: mean sidereal time 13h 10m 46.3668s and 8h 34m 57.0896s.
    angle = np.rad2deg(sidereal_angle(at("1987-04-10T00:00:00", "1987-04-10T19:21:00")))
    assert angle == pytest.approx([197.693195, 128.7378734], abs=1e-3)


def test_precession_is_that_of_the_worked_example():
    # Meeus, example 21.b: theta Persei from J2000 (proper motion applied) to 2028 November 13.19.
    days = at("2028-11-13T04:33:36")
    of_date = to_date(unit(41.054063, 49.227750)[None], days)
    assert apart(of_date[0], unit(41.547214, 49.348483)) < 1e-3
    assert from_date(of_date, days)[0] == pytest.approx(unit(41.054063, 49.227750), abs=1e-12)


def test_turning_with_the_earth_and_back_changes_nothing():
    vectors = np.random.default_rng(0).normal(size=(50, 3))
    days = np.linspace(8000, 8003, 50)
    assert rotate_with_earth(rotate_with_earth(vectors, days, 1), days, -1) == pytest.approx(vectors)


def test_shadow_has_the_length_of_the_earth_and_a_soft_edge():
    angle = np.deg2rad(np.linspace(0, 360, 36_001))
    position = RADIUS * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    lit = sunlit_fraction(position, np.broadcast_to([1.0, 0.0, 0.0], position.shape))
    # Of a circular orbit in the Sun's plane the arc 2 asin(R / r) is dark, to the Sun's own radius.
    dark = 2 * np.rad2deg(np.arcsin(EARTH_RADIUS / RADIUS))
    assert 360 * np.mean(lit < 0.5) == pytest.approx(dark, abs=0.02)
    assert 360 * np.mean((lit > 0) & (lit < 1)) == pytest.approx(2 * 2 * 0.2666, abs=0.03)
    assert lit.min() == 0.0
    assert lit.max() == 1.0
    half = (angle > np.pi / 2) & (angle < np.pi)
    assert np.all(np.diff(lit[half]) <= 1e-12), "light fades steadily"


def test_far_away_the_earth_is_a_small_spot_on_the_sun():
    lit = sunlit_fraction(np.array([[-1.5e6 / 0.5, 0.0, 0.0], [1.5e6, 0, 0]]), np.array([[1.0, 0, 0]] * 2))
    radius = np.arcsin(EARTH_RADIUS / 3e6)
    assert lit == pytest.approx([1 - (radius / np.deg2rad(0.2666)) ** 2, 1.0])


def orbit(
    frame="itrf", step=10.0, hours=12.0, node=40.0, inclination=INCLINATION, unit="km", start="2024-05-01"
):
    """Return samples of a circular orbit, its argument of latitude (deg), its positions of date (km)."""
    stamps = to_tt2000(np.datetime64(start, "ns")) + np.arange(0, hours * 3600, step).astype(int) * SECOND
    t = (stamps - stamps[0]) / SECOND
    days = days_since_j2000(stamps)
    argument = 2 * np.pi * t / PERIOD + 1.0
    plane = Rotation.from_euler("ZX", [40.0, inclination], degrees=True)
    inertial = plane.apply(RADIUS * np.stack([np.cos(argument), np.sin(argument), 0 * t], axis=1))
    given = from_date(inertial, days) if frame == "gcrf" else rotate_with_earth(inertial, days, -1)
    factor = {"km": 1.0, "m": 1e3}[unit]
    samples = xr.Dataset(
        {
            "tt2000": ("time", stamps),
            "position": (("time", "axis"), given * factor, {"units": unit, "frame": frame}),
        }
    )
    return samples, np.rad2deg(argument) % 360, inertial


def difference(one, other):
    """Return the difference of two angles, deg, in -180..180."""
    return (one - other + 180) % 360 - 180


@pytest.mark.parametrize("step", [1.0, 10.0, 60.0, 300.0])
@pytest.mark.parametrize(("frame", "unit"), [("itrf", "km"), ("itrf", "m"), ("gcrf", "km")])
def test_phases_are_those_of_the_orbit(frame, unit, step):
    samples, argument, inertial = orbit(frame, step, hours=3.5, unit=unit)
    found = add_geometry(samples)
    assert np.abs(difference(found["orbit_phase"].values, argument)).max() < 0.01
    assert found["latitude"].values == pytest.approx(np.rad2deg(np.arcsin(inertial[:, 2] / RADIUS)), abs=0.01)
    days = days_since_j2000(samples["tt2000"].values)
    height = np.sum(inertial * sun_direction(days), axis=1)
    # The phase from the point nearest the Sun is 0 where the orbit comes nearest to it.
    swing = difference(found["sun_phase"].values[np.argmax(height)], 0.0)
    assert abs(swing) < 360 * step / PERIOD
    assert np.cos(np.deg2rad(found["sun_phase"].values)) == pytest.approx(height / height.max(), abs=0.01)
    assert {name: found[name].attrs["units"] for name in ("latitude", "local_time")} == {
        "latitude": "deg",
        "local_time": "h",
    }


def test_the_phase_grows_over_an_orbit_without_a_step_back():
    phase = add_geometry(orbit(step=1.0, hours=6)[0])["orbit_phase"].values
    steps = np.diff(phase) % 360
    assert steps == pytest.approx(np.full(steps.size, 360 / PERIOD), rel=0.02)


def test_local_time_is_that_of_the_mean_sun():
    samples = xr.Dataset(
        {
            "tt2000": ("time", to_tt2000(np.array(["2024-05-01T12:00", "2024-05-01T06:00"], dtype="M8[ns]"))),
            "position": (
                ("time", "axis"),
                np.array([[7000.0, 0, 0], [0, 7000, 0]]),
                {"units": "km", "frame": "itrf"},
            ),
        }
    )
    assert add_geometry(samples)["local_time"].values == pytest.approx([12.0, 12.0])


def test_gaps_stay_gaps_and_leave_the_rest_as_it_is():
    samples, _, _ = orbit(step=10.0)
    whole = add_geometry(samples)
    holed = samples.copy(deep=True)
    holed["position"][100:130] = NAN
    holed = holed.isel(time=np.r_[0:1000, 1290:4320])
    found = add_geometry(holed)
    lost = np.isnan(holed["position"].values[:, 0])
    for name in ("latitude", "orbit_phase", "sun_phase", "local_time", "sunlit"):
        assert np.array_equal(np.isnan(found[name].values), lost), name
    rows = np.r_[0:1000, 1290:4320]
    off = difference(found["orbit_phase"].values, whole["orbit_phase"].values[rows])
    assert np.nanmax(np.abs(off)) < 0.01
    assert add_geometry(samples.isel(time=slice(0, 1)))["latitude"].size == 1
    nothing = samples.copy(deep=True)
    nothing["position"][:] = NAN
    assert np.isnan(add_geometry(nothing)["orbit_phase"].values).all()


def test_an_orbit_above_the_equator_has_a_phase_too():
    found = add_geometry(orbit(inclination=0.0, hours=3)[0])
    steps = np.diff(found["orbit_phase"].values) % 360
    assert steps == pytest.approx(np.full(steps.size, 3600 / PERIOD), rel=1e-3)


@pytest.mark.parametrize("frame", ["itrf", "gcrf", "nec"])
def test_the_sun_is_seen_in_the_axes_of_the_sensor(frame):
    samples, _, _ = orbit(step=60.0)
    days = days_since_j2000(samples["tt2000"].values)
    position = samples["position"].values
    fixed = rotate_with_earth(sun_direction(days), days, -1)
    target = {
        "itrf": fixed,
        "gcrf": from_date(sun_direction(days), days),
        "nec": itrf_to_nec(fixed, position),
    }
    turns = Rotation.random(days.size, random_state=1)
    mounting = Rotation.random(random_state=2)
    samples["attitude"] = (("time", "quaternion"), turns.as_quat(), {"frame": frame})
    samples["vector"] = (("time", "axis"), position, {"orientation": tuple(mounting.as_quat())})
    found = add_geometry(samples)["sun_direction"].values
    assert np.linalg.norm(found, axis=1) == pytest.approx(np.ones(days.size))
    assert rotate(rotate(found, mounting.as_quat()), turns.as_quat()) == pytest.approx(
        target[frame], abs=1e-9
    )


@pytest.mark.parametrize("change", ["no position", "solar frame", "no attitude", "attitude in no frame"])
def test_without_position_or_attitude_there_is_less(change):
    samples, _, _ = orbit(step=60.0)
    samples["attitude"] = (("time", "quaternion"), np.tile([0.0, 0, 0, 1], (samples.sizes["time"], 1)), {})
    if change == "no position":
        samples = samples.drop_vars("position")
    elif change == "solar frame":
        samples["position"].attrs["frame"] = "gse"
    elif change == "no attitude":
        samples = samples.drop_vars("attitude")
    added = set(add_geometry(samples)) - set(samples)
    expected = set() if change in ("no position", "solar frame") else set(GEOMETRY) - {"sun_direction"}
    assert added == expected


def test_what_is_measured_is_not_replaced():
    samples, _, _ = orbit(step=60.0)
    samples["sunlit"] = ("time", np.full(samples.sizes["time"], 0.25))
    assert np.all(add_geometry(samples)["sunlit"].values == 0.25)


def test_it_agrees_with_the_geometry_the_simulator_makes_on_its_own():
    from inflight.simulate import Grid, Parameters, geometry, sunlight

    start = int(to_tt2000(np.datetime64("2005-03-01", "ns")))
    made = geometry(Grid.covering(start, start + 6 * 3600 * SECOND), Parameters(), 1)
    stamps = np.round(made.grid.seconds * SECOND).astype(np.int64)
    samples = xr.Dataset(
        {
            "tt2000": ("time", stamps),
            "position": (("time", "axis"), made.position, {"units": "km", "frame": "itrf"}),
            "attitude": (
                ("time", "quaternion"),
                Rotation.from_matrix(made.axes.transpose(0, 2, 1)).as_quat(),
                {"frame": "itrf"},
            ),
        }
    )
    found = add_geometry(samples)
    assert apart(found["sun_direction"].values, made.sun).max() < 0.02
    expected = sunlight(made.zenith, float(np.linalg.norm(made.position[0])))
    assert np.abs(found["sunlit"].values - expected).max() < 0.2
    assert np.mean(np.abs(found["sunlit"].values - expected)) < 1e-3


def test_places_at_some_samples_are_those_of_all():
    samples = orbit(step=1.0, hours=3)[0]
    rows = np.array([0, 7, 4000, samples.sizes["time"] - 1])
    whole, some = add_geometry(samples), geometry_at(samples, rows)
    assert set(some) == set(whole) - set(samples)
    for name, told in some.items():
        np.testing.assert_allclose(told.values, whole[name].values[rows], rtol=0, atol=1e-9)


def test_only_what_is_asked_for_is_added():
    samples = orbit(step=10.0, hours=1)[0]
    assert set(add_geometry(samples, ("sunlit",))) - set(samples) == {"sunlit"}


def test_vectors_turn_as_the_library_for_rotations_turns_them():
    random = np.random.default_rng(3)
    field, quaternion = random.standard_normal((50, 3)), random.standard_normal((50, 4))
    quaternion *= 2.0 / np.linalg.norm(quaternion, axis=1, keepdims=True)
    expected = Rotation.from_quat(quaternion).apply(field)
    np.testing.assert_allclose(rotate(field, quaternion), expected, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(
        rotate(field, quaternion[0]), Rotation.from_quat(quaternion[0]).apply(field), rtol=1e-12, atol=1e-14
    )
    assert np.isnan(rotate(field, 0.1 * quaternion)).all()


def test_layers_of_the_shadow_are_where_light_fades_and_where_it_returns():
    samples, _, _ = orbit(step=2.0)
    found = add_geometry(samples)
    entry, leaving, lit = (found[name].values for name in ("shadow_entry", "shadow_exit", "sunlit"))
    days = days_since_j2000(samples["tt2000"].values)
    place, sun = rotate_with_earth(samples["position"].values, days, 1), sun_direction(days)
    narrow, wide = (sunlit_fraction(place, sun, SHADOW_LAYERS[end]) for end in (0, -1))
    assert (entry + leaving).sum(axis=1) == pytest.approx(narrow - wide, abs=1e-12)
    assert np.all(entry >= 0)
    assert np.all(leaving >= 0)
    # Both happen, never at once; light fades before the shadow and returns after it.
    here, there = entry.max(axis=1) > 0.1, leaving.max(axis=1) > 0.1
    assert here.any()
    assert there.any()
    assert not np.any(here & there)
    slope = np.gradient(lit)
    assert slope[here].sum() < 0 < slope[there].sum()
