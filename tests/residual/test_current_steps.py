"""Fast changes of a current found from the current alone."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.excursions import find_excursions
from inflight.errors import SamplesError
from inflight.residual import find_steps
from inflight.simulate import SimulationSettings, simulate_day
from inflight.time import SECOND

ORBIT = 5560.0


def series(cadence, moments, sizes, *, noise=0.0, resolution=0.0, settle=5.0, hours=6.0, seed=0):
    """A current that follows the orbit, with exponential steps at the moments."""
    seconds = np.arange(0.0, hours * 3600.0, cadence)
    current = 6.0 + 2.0 * np.sin(2 * np.pi * seconds / ORBIT)
    for moment, size in zip(moments, sizes, strict=True):
        since = np.clip(seconds - moment, 0.0, None)
        current = current + size * -np.expm1(-since / settle)
    current = current + noise * np.random.default_rng(seed).standard_normal(seconds.size)
    if resolution:
        current = np.rint(current / resolution) * resolution
    return (seconds * SECOND).astype(np.int64), current


@pytest.mark.parametrize("cadence", [1, 10])
@pytest.mark.parametrize(("noise", "resolution"), [(0.0, 0.0), (0.0, 0.005), (0.02, 0.005), (0.05, 0.0)])
def test_drops_and_rises_are_found_with_size_time_and_duration(cadence, noise, resolution):
    moments, sizes = [3003.0, 9004.0, 15007.0], [-4.0, 3.0, -2.0]
    found = find_steps(*series(cadence, moments, sizes, noise=noise, resolution=resolution))
    assert found.size == pytest.approx(sizes, abs=0.05 + 5 * noise / np.sqrt(60 / cadence))
    assert list(found.direction) == [-1, 1, -1]
    # Half of an exponential has passed after 0.7 time constants.
    assert found.time / SECOND == pytest.approx(np.array(moments) + 3.5, abs=0.6 * cadence + 0.5)
    assert (found.start / SECOND <= np.array(moments) + cadence).all()
    assert (found.duration <= 45.0).all()
    assert (np.abs(found.size) > 8 * found.sigma).all()


@pytest.mark.parametrize("cadence", [1, 10])
def test_noise_alone_and_the_orbit_alone_make_no_step(cadence):
    for seed in range(5):
        assert not len(find_steps(*series(cadence, [], [], noise=0.05, seed=seed, hours=24)))
    assert not len(find_steps(*series(cadence, [], [], resolution=0.005, hours=24)))


def test_a_kink_and_a_slow_change_are_no_steps():
    seconds = np.arange(0.0, 7200.0, 10.0)
    stamps = (seconds * SECOND).astype(np.int64)
    kink = np.where(seconds < 3600, 0.0, 0.026 * (seconds - 3600))
    slow = 4.0 * np.clip((seconds - 3600) / 300, 0.0, 1.0)
    for current in (kink, slow):
        assert not len(find_steps(stamps, np.rint(current / 0.005) * 0.005))


def test_spikes_gaps_and_missing_readings_do_not_hide_or_make_steps():
    stamps, current = series(10, [5003.0], [-4.0], noise=0.01)
    current[[100, 900, 1500]] += 5.0
    current[495:498] = np.nan
    kept = np.r_[0:300, 360 : stamps.size]
    found = find_steps(stamps[kept], current[kept])
    assert found.size == pytest.approx([-4.0], abs=0.05)


def test_a_step_inside_a_long_gap_is_not_claimed():
    stamps, current = series(10, [5003.0], [-4.0], noise=0.01)
    kept = (stamps < 4900 * SECOND) | (stamps > 5200 * SECOND)
    assert not len(find_steps(stamps[kept], current[kept]))


def test_a_switch_of_two_levels_is_no_resolution():
    seconds = np.arange(0.0, 86400.0, 10.0)
    heater = np.where((seconds / 2820.0) % 1.0 < 0.45, 0.35, 0.0)
    found = find_steps((seconds * SECOND).astype(np.int64), heater)
    switched = np.count_nonzero(np.diff(heater))
    assert len(found) >= switched - 1
    assert np.abs(found.size) == pytest.approx(0.35)


@settings(max_examples=25, deadline=None)
@given(scale=st.floats(1e-3, 1e3), sign=st.sampled_from([-1, 1]))
def test_units_and_sign_of_a_current_do_not_matter(scale, sign):
    stamps, current = series(10, [3003.0, 9004.0], [-4.0, 3.0], noise=0.02)
    plain, scaled = find_steps(stamps, current), find_steps(stamps, sign * scale * current)
    assert np.array_equal(plain.time, scaled.time)
    assert scaled.size == pytest.approx(sign * scale * plain.size)


def test_the_size_of_a_step_is_known_to_its_sigma():
    pulls = []
    for seed in range(120):
        stamps, current = series(10, [9003.0], [-3.0], noise=0.05, hours=5, seed=seed)
        found = find_steps(stamps, current)
        slow = 2.0 * np.sin(2 * np.pi * (found.time / SECOND) / ORBIT) + 6.0
        assert found.before == pytest.approx(slow, abs=0.3)
        pulls.append((found.size[0] + 3.0) / found.sigma[0])
    assert 0.60 < np.mean(np.abs(pulls) < 1) < 0.80
    assert abs(np.mean(pulls)) < 0.35


def test_the_battery_s_end_of_charge_is_found_in_a_simulated_day():
    day = simulate_day(SimulationSettings(defects=()), "2007-04-30").instruments["hk"]
    found = find_steps(day["Epoch"].values, day["I_SOL"].values / 1e3, smallest=2.5)
    # One end of charge an orbit, at most sixteen orbits a day.
    assert 13 <= len(found) <= 17
    assert (found.direction == -1).all()
    assert (found.duration <= 40).all()


def test_a_dazzled_camera_is_an_excursion_once_an_orbit():
    day = simulate_day(SimulationSettings(defects=()), "2007-04-30").instruments["hk"]
    found = find_excursions(day["Epoch"].values, day["I_CAM"].values / 1e3, longest=2400)
    assert 13 <= len(found) <= 17
    assert found.size == pytest.approx(0.4, abs=0.05)


def test_the_table_says_value_sigma_and_units():
    table = find_steps(*series(10, [3003.0], [-4.0], noise=0.02), unit="A").table()
    assert dict(table.sizes) == {"step": 1}
    assert table["value"].attrs["units"] == table["sigma"].attrs["units"] == "A"


def test_too_few_readings_and_disorder_are_refused():
    stamps, current = series(10, [], [])
    with pytest.raises(SamplesError, match="5 readings"):
        find_steps(stamps[:5], current[:5])
    with pytest.raises(SamplesError, match="do not rise"):
        find_steps(stamps[::-1], current)
    with pytest.raises(SamplesError, match="shape"):
        find_steps(stamps, np.column_stack([current, current]))
