"""Sensors and spacecraft told apart by a flipper."""

import numpy as np
import pytest

from inflight.errors import CalibrationError
from inflight.zero_level import separate_flipped


@pytest.mark.parametrize(
    ("along_z", "along_x", "parts"),
    [((-0.3, 2.5), (0.7, 2.1), (-2.1, -0.7, 2.8, 0.4)), ((1.8, 2.0), (1.3, 1.0), (0.05, -0.25, 1.25, 2.05))],
)
def test_both_published_examples(along_z, along_x, parts):
    np.testing.assert_allclose(separate_flipped(along_z, along_x, np.eye(4)).value, parts, atol=1e-12)


def test_without_offsets_of_the_sensors_all_is_the_spacecrafts():
    found = separate_flipped((0.4, 0.4), (1.5, 1.5), np.eye(4))
    np.testing.assert_allclose(found.value, [0, 0, 1.5, 0.4], atol=1e-12)


def test_errors_are_those_of_many_draws():
    generator = np.random.default_rng(3)
    factor = generator.normal(size=(4, 4))
    covariance = factor @ factor.T
    draws = generator.multivariate_normal(np.zeros(4), covariance, size=20_000)
    values = np.array([separate_flipped((a, b), (c, d), covariance).value for a, b, c, d in draws])
    np.testing.assert_allclose(
        np.cov(values.T), separate_flipped((0, 0), (0, 0), covariance).covariance, rtol=0.1, atol=0.1
    )


def test_three_corrections_leave_a_part_open_and_sensor_2_is_never_told():
    with pytest.raises(CalibrationError, match="3 of the corrections"):
        separate_flipped((0.1, np.nan), (0.2, 0.3), np.eye(4))
    found = separate_flipped((0.1, 0.1), (0.2, 0.3), 0.01 * np.eye(4))
    assert "sensor 2" in found.summary()
    assert not found.significant("sensor_1")
