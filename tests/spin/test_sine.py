"""Sines of the compiled loops are those of the library."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from inflight.spin.kernels import fill_sine_cosine


@settings(deadline=None)  # the first call compiles
@given(st.floats(-1e8, 1e8))
def test_sine_and_cosine_are_the_librarys(first):
    angle = first + np.linspace(-4.0, 4.0, 101)
    sine, cosine = np.empty(angle.size), np.empty(angle.size)
    fill_sine_cosine(angle, sine, cosine)
    assert np.abs(sine - np.sin(angle)).max() < 3e-15
    assert np.abs(cosine - np.cos(angle)).max() < 3e-15


def test_an_angle_that_is_not_known_has_none():
    sine, cosine = np.empty(1), np.empty(1)
    fill_sine_cosine(np.array([np.nan]), sine, cosine)
    assert np.isnan(sine[0])
    assert np.isnan(cosine[0])
