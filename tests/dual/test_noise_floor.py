"""White noise is estimated where tones, jumps and slow changes hide it from second differences."""

import numpy as np
import pytest
from scipy import signal

from inflight.dual.noise import noise_floor, noise_of_bands
from inflight.dual.readings import cells_of, white_covariance

COUNT = 12_000
NOISE = np.array([[1.0, 0.3, 0.0], [0.3, 0.7, -0.1], [0.0, -0.1, 2.0]])
TIME = np.arange(COUNT)[:, None]
DIRECTION = np.array([0.8, -0.5, 0.6])


def white(seed=1):
    return np.random.default_rng(seed).multivariate_normal(np.zeros(3), NOISE, COUNT)


def tones(size=5.0):
    frequencies = (0.41, 0.3, 0.17, 0.1, 0.03)
    return size * sum(np.sin(2 * np.pi * one * TIME + 9 * one) for one in frequencies) * DIRECTION


def steps(size=30.0):
    on = np.searchsorted(np.cumsum(np.random.default_rng(2).exponential(700, 100)), np.arange(COUNT)) % 2
    return size * on[:, None] * DIRECTION


def floor(series):
    outboard = np.random.default_rng(3).normal(size=series.shape)
    return noise_floor(cells_of(outboard, series), series, white_covariance(series))


@pytest.mark.parametrize("more", [0.0, 30.0 * np.sin(TIME / 900.0) * DIRECTION, tones(), steps()])
def test_the_covariance_is_that_of_the_white_noise(more):
    found = floor(white() + more)
    assert np.abs(found - NOISE).max() < 0.25


def test_tones_of_all_octaves_raise_every_scale_but_not_the_bands_between_them():
    series = white() + tones()
    assert np.trace(white_covariance(series)) > 5.0 * np.trace(NOISE)
    assert np.trace(noise_of_bands(series)[0]) == pytest.approx(np.trace(NOISE), rel=0.05)


def test_the_quietest_bands_are_not_quiet_by_chance():
    found = [np.trace(noise_of_bands(white(seed))[0]) for seed in range(20)]
    assert np.mean(found) == pytest.approx(np.trace(NOISE), rel=0.04)


def test_a_short_series_has_no_bands():
    assert noise_of_bands(white()[:1000])[0] is None
    assert np.trace(floor(white()[:300])) == pytest.approx(np.trace(NOISE), rel=0.3)


@pytest.mark.parametrize("filtered", [signal.butter(4, 0.5), signal.butter(4, 0.8), ([0.5, 0.5], [1.0])])
def test_noise_that_a_filter_takes_away_at_high_frequencies_is_still_there_below(filtered):
    assert np.trace(floor(signal.lfilter(*filtered, white(), axis=0))) > 0.5 * np.trace(NOISE)
