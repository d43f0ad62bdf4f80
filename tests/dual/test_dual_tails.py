"""Noise with heavy tails makes hardly any jump; what is no noise keeps its size."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from inflight.dual import Readings
from inflight.dual.change_points import winsorise
from inflight.dual.segments import segments_of

COUNT = 20_000


def noise_of(kind: str, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    if kind == "Student's, 3":
        return random.standard_t(3, (COUNT, 3))
    if kind == "Student's, 5":
        return random.standard_t(5, (COUNT, 3))
    if kind == "all axes together":
        return random.normal(size=(COUNT, 3)) / np.sqrt(random.chisquare(3, COUNT) / 3.0)[:, None]
    wide = random.normal(size=(COUNT, 3))
    if kind == "one in fifty":
        wide[random.random(COUNT) < 0.02] *= 8.0
    return wide


def jumps(values: np.ndarray) -> np.ndarray:
    stamps = np.arange(COUNT, dtype=np.int64) * 1_000_000_000
    return segments_of(Readings(stamps, values, np.zeros_like(values))).first[1:]


HEAVY = ("Student's, 3", "Student's, 5", "all axes together", "one in fifty")


@pytest.mark.parametrize("kind", HEAVY)
def test_heavy_tails_make_less_than_a_jump_a_record(kind):
    assert sum(jumps(noise_of(kind, seed)).size for seed in range(5_000, 5_010)) < 10


@pytest.mark.parametrize("kind", HEAVY)
def test_a_short_stretch_far_off_is_found_in_them_all_the_same(kind):
    found = 0
    for seed in range(5_100, 5_106):
        values = noise_of(kind, seed)
        values[9_000:9_012, 0] += 8.0
        found += all(np.abs(jumps(values) - edge).min(initial=COUNT) < 3 for edge in (9_000, 9_012))
    assert found >= 5


def test_the_size_of_a_step_stays():
    values = noise_of("Student's, 3", 5_200)
    values[10_000:] += [5.0, 0.0, -20.0]
    clean = winsorise(values)
    step = clean[10_000:].mean(axis=0) - clean[:10_000].mean(axis=0)
    assert np.abs(step - [5.0, 0.0, -20.0]).max() < 0.1
    assert np.abs(clean[:10_000]).max() < 0.5 * np.abs(values[:10_000]).max()


def test_other_noise_is_left_as_it_is():
    values = noise_of("Gaussian", 5_300)
    # A valve that is driven for two samples now and then, and rare spikes.
    for first in range(500, COUNT, 700):
        values[first : first + 2] += 30.0
    values[7::4_000] -= 40.0
    assert_array_equal(winsorise(values), values)
