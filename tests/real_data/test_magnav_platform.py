"""The aircraft: published coefficients through our chain, and an estimator that does no harm held out."""

import numpy as np
import pytest
import scipy.io

from benchmarks.tolles_lawson import GROUPS, judge, load, published_halves, real_data, retained, windows

FOLDER = real_data() / "magnav-tl"
pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"the folder of real measurements is absent: {FOLDER}"),
]


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    return load(tmp_path_factory.mktemp("magnav"))


def test_the_effect_has_the_published_columns(record):
    held = scipy.io.loadmat(FOLDER / "test_data_TL.mat")["TL_data"][0, 0]
    np.testing.assert_allclose(
        record.columns @ record.published, held["A_a"] @ held["TL_a_1"][:, 0], atol=1e-9
    )


def test_the_published_coefficients_leave_the_published_residual(record):
    (first, second), coefficient = published_halves(FOLDER)
    assert first.remaining(coefficient) == pytest.approx(0.0556, abs=1e-4)
    assert second.remaining(coefficient) == pytest.approx(0.0263, abs=1e-4)
    ours = record.halves()
    assert [half.remaining(record.published) for half in ours] == pytest.approx([0.0556, 0.0263], abs=2e-3)


def test_the_published_coefficients_are_a_fit_to_both_halves_and_no_held_out_mark():
    (first, second), coefficient = published_halves(FOLDER)
    columns = np.vstack([first.columns, second.columns])
    total = np.concatenate([first.total, second.total])
    again = np.linalg.solve(columns.T @ columns + 1e-3 * np.eye(18), columns.T @ total)
    np.testing.assert_allclose(again, coefficient, atol=1e-9)


@pytest.mark.parametrize("arrays", ["own", "published"])
@pytest.mark.parametrize("fitted", [0, 1])
def test_the_half_not_fitted_is_far_better_than_untouched(record, arrays, fitted, record_property):
    if arrays == "own":
        halves, coefficient = record.halves(), record.published
    else:
        halves, coefficient = published_halves(FOLDER)
    score = judge(halves[fitted], halves[1 - fitted], coefficient, record.rows.step_s, record.band)
    record_property("left_nT", score.remaining)
    assert score.remaining["ridge, one error"] < 0.65 * score.remaining["untouched"]
    assert score.remaining["ridge, one error"] < score.remaining["least squares"]


def test_wherever_the_fitted_window_lies_the_rest_is_not_made_worse(record):
    found = windows(record)
    assert len(found) == 11
    assert all(after < before for before, after in found)


def test_eddy_currents_are_told_apart_and_permanent_from_induced_are_not(record):
    for half in record.halves():
        kept = retained(half.columns, GROUPS)
        assert kept["permanent"].max() < 0.01
        assert kept["induced"].max() < 0.05
        assert kept["eddy"].min() > 0.3
