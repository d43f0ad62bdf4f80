"""Change points of the difference: found in the noise of a sample, never in noise alone."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import lfilter
from switching_cases import power_law

from benchmarks.thresholds import false_alarm_probability, published_jumps
from inflight.dual.change_points import find_jumps, find_spikes
from inflight.errors import SettingsError


def noise_of(kind: str, seed: int, count: int = 20_000) -> np.ndarray:
    random = np.random.default_rng(seed)
    white = random.normal(size=(count, 3))
    if kind == "autoregressive":
        return lfilter([1.0], [1.0, -0.9], white, axis=0)
    if kind == "pink":
        return power_law(random, count, 1.0, slope=1.0)
    if kind == "ambient leak":
        return power_law(random, count, 1.0) + 0.3 * white
    if kind == "random walk":
        return np.cumsum(random.normal(size=(count, 3)), axis=0) * 0.01 + white
    if kind == "coarse":
        return np.round(0.4 * white)
    if kind == "burst":
        white[count // 3 : count // 3 + count // 10] *= 4.0
    if kind == "slow wave":
        return white + 2.0 * np.sin(np.arange(count) / 300.0)[:, None]
    if kind == "tone":
        return white + 2.0 * np.sin(np.arange(count) / 5.0)[:, None]
    return white


KINDS = ("white", "autoregressive", "pink", "ambient leak", "random walk", "coarse", "slow wave", "tone")


@pytest.mark.parametrize("kind", KINDS)
def test_noise_alone_makes_no_jump(kind):
    # 0.01 a record is stated: of ten records two with a jump would be one in two hundred.
    assert sum(find_jumps(noise_of(kind, seed))[0].size > 0 for seed in range(1_000, 1_010)) <= 1


def test_a_burst_of_noise_is_no_row_of_jumps():
    assert sum(find_jumps(noise_of("burst", seed))[0].size for seed in range(2_000, 2_010)) <= 3


def test_a_step_no_larger_than_the_noise_of_a_sample_is_found():
    found = []
    for seed in range(10):
        values = noise_of("white", 3_000 + seed)
        values[9_000:] += [1.0, 0.0, 0.0]
        places, _ = find_jumps(values)
        found.append(places.size == 1 and abs(places[0] - 9_000) < 40)
    assert sum(found) >= 9


def test_a_clear_step_is_placed_to_the_sample():
    values = noise_of("white", 7)
    for place, step in ((3_000, 12.0), (3_030, -7.0), (11_111, 4.0)):
        values[place:, 1] += step
    places, _ = find_jumps(values)
    assert_allclose(places, [3_000, 3_030, 11_111], atol=1)
    assert_array_equal(places[:2], [3_000, 3_030])


def test_drift_is_no_jump():
    values = noise_of("white", 11) + np.linspace(0.0, 60.0, 20_000)[:, None]
    assert not find_jumps(values)[0].size


def test_the_noise_of_steps_follows_the_length():
    _, noise = find_jumps(noise_of("white", 12, 60_000))
    assert_allclose(np.einsum("sii->si", noise.covariance) * noise.length[:, None] / 2.0, 1.0, atol=0.35)


def test_a_spike_stands_out_and_a_step_does_not():
    values = noise_of("white", 13)
    values[500] += 30.0
    values[9_000:] += 30.0
    assert_array_equal(np.flatnonzero(find_spikes(values)), [500])


def test_the_published_thresholds_have_the_false_alarms_of_white_noise():
    assert_allclose(false_alarm_probability(10.3), 1e-4, rtol=0.1)
    assert_allclose(false_alarm_probability(5.9, components="any"), 1e-4, rtol=0.1)
    step = np.abs(np.diff(noise_of("white", 14, 400_000), axis=0)).sum(axis=1)
    assert_allclose(np.mean(step > 7.0), false_alarm_probability(7.0), rtol=0.05)


def test_the_published_thresholds_find_what_exceeds_them():
    values = np.zeros((20, 3))
    values[5:] += [1.0, -1.0, 1.0]
    values[12:, 2] += 2.5
    assert_array_equal(published_jumps(values, sum_threshold=2.9), [5])
    assert_array_equal(published_jumps(values, component_threshold=2.0), [12])
    with pytest.raises(SettingsError, match="threshold"):
        published_jumps(values)
