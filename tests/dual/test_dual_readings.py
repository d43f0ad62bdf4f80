"""The pair of readings: what its noise is, whatever else is in it, and what a correction leaves alone."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from inflight.dual import Correction, Readings, no_correction
from inflight.dual.readings import white_covariance
from inflight.errors import SamplesError
from inflight.time import SECOND


def readings(difference: np.ndarray, ambient: np.ndarray | float = 0.0) -> Readings:
    stamps = np.arange(len(difference), dtype=np.int64) * SECOND
    outboard = np.broadcast_to(ambient, difference.shape).copy()
    return Readings(stamps, outboard + difference, outboard)


@pytest.mark.parametrize("seed", range(3))
def test_steps_and_drift_do_not_raise_the_noise(seed):
    random = np.random.default_rng(seed)
    true = np.array([[0.04, 0.012, 0.0], [0.012, 0.09, -0.02], [0.0, -0.02, 0.16]])
    noise = random.multivariate_normal(np.zeros(3), true, 60_000)
    steps = 5.0 * random.integers(0, 4, 60).repeat(1000)[:, None]
    drift = np.linspace(0.0, 3.0, 60_000)[:, None]
    found = white_covariance(noise + steps + drift)
    assert_allclose(found, true, atol=0.03 * np.sqrt(np.outer(np.diag(true), np.diag(true))).max())


def test_the_noise_of_a_long_record_is_that_of_its_parts():
    noise = np.random.default_rng(5).normal(0.0, [0.1, 0.2, 0.3], (500_000, 3))
    assert_allclose(np.sqrt(np.diag(white_covariance(noise))), [0.1, 0.2, 0.3], rtol=0.02)


def test_readings_that_seldom_change_still_have_noise():
    coarse = np.round(np.random.default_rng(1).normal(0.0, 0.2, (20_000, 3)))
    assert (np.diag(white_covariance(coarse)) > 0).all()


def test_the_ambient_field_is_not_in_the_difference():
    pair = readings(np.ones((50, 3)), np.linspace(0, 100, 50)[:, None])
    assert_allclose(pair.difference, 1.0)


def test_stamps_must_increase():
    with pytest.raises(SamplesError, match="do not increase"):
        Readings(np.array([0, 2, 2], dtype=np.int64), np.zeros((3, 3)), np.zeros((3, 3)))


def test_both_sensors_must_share_the_time_base():
    with pytest.raises(SamplesError, match="inboard"):
        Readings(np.arange(3, dtype=np.int64), np.zeros((4, 3)), np.zeros((3, 3)))


def test_what_is_not_known_and_what_is_not_applied_leaves_the_reading():
    field = np.array([[1.0, 2.0, 3.0], [np.nan] * 3])
    nothing = no_correction(2, "no training")
    found = Correction(
        field=field,
        covariance=nothing.covariance,
        state=nothing.state,
        probability=nothing.probability,
        flag=nothing.flag,
        method="states",
    )
    outboard = np.full((2, 3), 10.0)
    assert_allclose(found.corrected(outboard), [[9.0, 8.0, 7.0], [10.0] * 3])
    assert_allclose(found.withheld("does not help").corrected(outboard), outboard)
    assert_allclose(nothing.corrected(outboard), outboard)
