"""The product keeps both readings and the correction apart, and never hides what is not known."""

import numpy as np
import pytest

from inflight.dual import Correction, Readings, dual_level2, no_correction
from inflight.dual.product import outboard_noise
from inflight.flags import Flag
from inflight.time import SECOND

COUNT = 500


def readings():
    random = np.random.default_rng(4)
    inboard, outboard = 5.0 + 0.1 * random.normal(size=(2, COUNT, 3))
    return Readings(np.arange(COUNT, dtype=np.int64) * SECOND, inboard + 3.0, outboard)


def states_correction(**changes):
    field = np.full((COUNT, 3), 1.5)
    field[-50:] = np.nan
    state = np.where(np.arange(COUNT) < COUNT - 50, 2, -1)
    spread = np.broadcast_to(0.04 * np.eye(3), (COUNT, 3, 3)).copy()
    spread[-50:] = np.nan
    return Correction(
        field=field,
        covariance=spread,
        state=state,
        probability=np.full(COUNT, 0.99),
        flag=np.zeros(COUNT, dtype=np.uint32),
        method="states",
        **changes,
    )


def made(correction):
    return dual_level2(readings(), correction, np.zeros(COUNT, dtype=np.uint32), "main")


def test_field_is_reading_less_correction_and_its_error_holds_noise_and_correction():
    product = made(states_correction())
    known = product.isel(time=slice(0, COUNT - 50))
    assert np.allclose(known["field_spacecraft"], known["outboard"] - known["correction"])
    # 0.1 nT of noise and 0.2 nT of the correction.
    assert np.allclose(known["uncertainty"], np.hypot(0.1, 0.2), rtol=0.1)
    assert product.attrs["constant_known"] == "no"


@pytest.mark.parametrize(("ambient", "within"), [(0.2, 0.15), (5.0, 0.45)])
def test_ambient_field_that_changes_from_sample_to_sample_is_no_noise(ambient, within):
    random, count = np.random.default_rng(8), 5000
    field = ambient * random.normal(size=(count, 3))
    inboard, outboard = (field + noise * random.normal(size=field.shape) for noise in (0.3, 0.1))
    found = outboard_noise(Readings(np.arange(count, dtype=np.int64) * SECOND, inboard, outboard))
    # Where the ambient field hides which sensor is the noisier one, each has half of the difference's noise.
    assert np.allclose(np.sqrt(found), 0.1 if ambient < 1.0 else np.sqrt(0.05), rtol=within)


@pytest.mark.parametrize("count", [1, 2, 3, 30])
def test_a_few_samples_have_a_noise(count):
    few = readings().select(slice(0, count))
    assert (outboard_noise(few) >= 0.0).all()


def test_what_is_not_known_is_flagged_and_has_no_error():
    product = made(states_correction())
    rest = product.isel(time=slice(COUNT - 50, None))
    assert np.all(rest["flag"].values & np.uint32(Flag.UNKNOWN_STATE))
    assert np.isnan(rest["uncertainty"]).all()
    assert np.array_equal(rest["field_spacecraft"], rest["outboard"])


def test_a_withheld_correction_is_kept_and_changes_nothing():
    product = made(states_correction().withheld("it does not help"))
    assert np.array_equal(product["field_spacecraft"], product["outboard"])
    assert np.isfinite(product["correction"].values[:100]).all()
    assert np.isnan(product["uncertainty"]).all()
    assert (product.attrs["applied"], product.attrs["reason"]) == ("no", "it does not help")
    assert product["correction"].attrs["applied"] == "no"


def test_without_a_correction_the_reading_is_the_field():
    product = made(no_correction(COUNT, "one state alone"))
    assert np.array_equal(product["field_spacecraft"], product["outboard"])
    assert product.attrs["method"] == "none"
