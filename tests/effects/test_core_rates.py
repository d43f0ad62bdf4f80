"""Rates of change: exact for straight lines and slow swings, whatever the gaps."""

import numpy as np
import pytest

from inflight.effects import time_derivative
from inflight.time import SECOND


def stamps(count, step=10.0):
    return (step * SECOND * np.arange(count)).astype(np.int64)


def test_a_swing_of_twelve_samples_keeps_its_rate():
    """A plain difference of neighbours makes it 4.5 % too small, which would pass for a larger delay."""
    t, omega = stamps(400) / SECOND, 2 * np.pi / 120.0
    made, true = time_derivative(np.sin(omega * t), stamps(400)), omega * np.cos(omega * t)
    fitted = made[5:-5] @ true[5:-5] / (true[5:-5] @ true[5:-5])
    plain = time_derivative(np.sin(omega * t), stamps(400), order=2)
    assert fitted == pytest.approx(1.0, abs=0.003)
    assert plain[5:-5] @ true[5:-5] / (true[5:-5] @ true[5:-5]) == pytest.approx(0.955, abs=0.003)


@pytest.mark.parametrize("count", [2, 3, 4, 5, 40])
def test_a_straight_line_has_its_slope_everywhere(count):
    values = np.stack([3.0 * np.arange(count), -0.5 * np.arange(count)], axis=1)
    np.testing.assert_allclose(time_derivative(values, stamps(count)), [[0.3, -0.05]] * count, rtol=1e-12)


def test_no_rate_reaches_across_a_gap_or_a_missing_sample():
    t = stamps(40)
    t[20:] += 100 * SECOND
    values = np.arange(40.0)
    values[20:] += 500.0
    values[8] = np.nan
    made = time_derivative(values, t)
    good = np.delete(np.arange(40), 8)
    np.testing.assert_allclose(made[good], 0.1, rtol=1e-9)


def test_uneven_steps_keep_the_plain_form():
    g = np.random.default_rng(1)
    t = np.cumsum(SECOND * g.uniform(8, 12, 50)).astype(np.int64)
    values = np.sin(t / SECOND / 40.0)
    np.testing.assert_array_equal(time_derivative(values, t), time_derivative(values, t, order=2))
