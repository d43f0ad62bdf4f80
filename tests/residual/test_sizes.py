"""Sizes of residuals, apart and together."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from inflight.residual import merge_statistics, residual_statistics

finite = st.floats(-1e4, 1e4, allow_nan=False)
values = arrays(np.float64, st.integers(1, 60), elements=finite | st.just(float("nan")))


@given(st.lists(values, min_size=1, max_size=5))
def test_sizes_joined_are_the_size_of_everything_together(parts):
    whole, together = (
        residual_statistics(np.concatenate(parts)),
        merge_statistics([residual_statistics(part) for part in parts]),
    )
    assert together.count == whole.count
    for name in ("mean", "std", "rms", "least", "largest"):
        assert getattr(together, name) == pytest.approx(getattr(whole, name), abs=1e-9, rel=1e-9, nan_ok=True)


def test_the_size_of_nothing_is_not_a_number_and_joins_as_nothing():
    nothing, something = residual_statistics(np.full(5, np.nan)), residual_statistics(np.array([3.0, 4.0]))
    assert nothing.count == 0
    assert np.isnan(nothing.rms)
    assert merge_statistics([nothing, something]) == something
    assert merge_statistics([]).count == 0


def test_the_robust_sigma_is_that_of_normal_noise_and_outliers_do_not_move_it():
    noise = np.random.default_rng(0).normal(5.0, 2.0, 100_000)
    noise[::100] = 1e4
    assert residual_statistics(noise).robust == pytest.approx(2.0, rel=0.03)
    assert residual_statistics(noise).std > 500
