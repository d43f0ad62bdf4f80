"""What a table of a turning sensor says of its errors together, and of windows and days joined."""

import numpy as np
import pytest
import xarray as xr

from inflight.spin import GROUND, SPIN_RELATED, CalibrationParameters, ExternalValue, join_parameters
from inflight.tasks.pipelines.spin.tables import _axial_offset, _combine_days, _full_covariance
from inflight.time import DAY

PRIOR = np.full(8, 0.1)


def joined(sigma_axial):
    found = CalibrationParameters().changed({"elevation[1]": 4e-3, "elevation[2]": 3e-3})
    sigma = np.full(8, 5e-4)
    spin = (found.spin_related(), sigma, found)
    axial = {"offset[3]": ExternalValue(1.0, sigma_axial, "mirror mode")}
    return found, join_parameters(spin, CalibrationParameters(), {}, axial), np.diag(sigma**2), sigma


def test_an_uncertain_axial_offset_cancels_in_the_spin_plane():
    found, table, covariance, sigma = joined(3.0)
    offsets = _full_covariance(table, covariance, sigma)[-3:, -3:]
    assert np.linalg.eigvalsh(offsets).min() > 0.0
    matrix = found.matrix()
    field = matrix @ offsets @ matrix.T
    # 4 mrad of 3 nT would be 0.012 nT.
    assert np.sqrt(offsets[0, 0]) == pytest.approx(0.012, rel=0.1)
    assert np.allclose(np.sqrt(np.diag(field))[:2], 5e-4, rtol=0.02)


def zero(value, sigma):
    edge = np.arange(len(value) + 1) * 10 * DAY
    return xr.Dataset(
        {
            "value": ("interval", np.array(value)),
            "sigma": ("interval", np.array(sigma)),
            "method": ("interval", ["mirror mode"] * len(value)),
            "start": ("interval", edge[:-1]),
            "end": ("interval", edge[1:]),
        }
    )


def test_a_span_has_the_mean_of_all_windows_that_tell():
    table = zero([1.0, 3.0, 1.2], [0.1, np.inf, 0.1])
    found = _axial_offset(table, 0, 30 * DAY)
    assert found.value == pytest.approx(1.1)
    # They differ by 1.4 of their errors: chi square of two for one of freedom.
    assert found.sigma == pytest.approx(0.1 / np.sqrt(2) * np.sqrt(2.0))
    assert "2 windows" in found.source


def test_a_day_and_a_window_have_that_of_the_window_around_them():
    table = zero([1.0, 3.0, 1.2], [0.1, np.inf, 0.2])
    assert _axial_offset(table, 20 * DAY, 30 * DAY) == ExternalValue(1.2, 0.2, "mirror mode")
    assert _axial_offset(table, 3 * DAY, 4 * DAY) == ExternalValue(1.0, 0.1, "mirror mode")
    assert _axial_offset(table, 13 * DAY, 14 * DAY).source == GROUND
    assert _axial_offset(None, 0, DAY).source == GROUND


def day_of(value, sigma):
    own = np.linalg.inv(np.diag(PRIOR**-2.0) + np.diag(sigma**-2.0))
    held = own @ (value / sigma**2)
    return xr.Dataset(
        {
            "value": (("block", "parameter"), held[None]),
            "sigma": (("block", "parameter"), np.sqrt(np.diag(own))[None]),
            "covariance": (("block", "parameter", "other"), own[None]),
        },
        coords={"parameter": list(SPIN_RELATED)},
    )


def test_days_that_tell_two_combinations_are_judged_by_these():
    sigma = np.full(8, 1e3)
    sigma[:2] = 1e-3
    random = np.random.default_rng(5)
    # They scatter by three times their errors.
    days = [day_of(np.concatenate([3e-3 * random.normal(size=2), np.zeros(6)]), sigma) for _ in range(40)]
    value, covariance, excess = _combine_days(days, np.zeros(8), PRIOR)
    assert excess == pytest.approx(9.0, rel=0.35)
    assert np.allclose(value[2:], 0.0, atol=1e-9)
    assert np.sqrt(covariance[0, 0]) == pytest.approx(3e-3 / np.sqrt(40), rel=0.2)


def test_a_day_has_its_windows_value_to_the_last_digit():
    rng = np.random.default_rng(3)
    for value, sigma in zip(rng.normal(size=200), rng.uniform(0.01, 1.0, size=200), strict=True):
        found = _axial_offset(zero([value], [sigma]), 0, DAY)
        assert (found.value, found.sigma) == (value, sigma)
