"""What leaves no tone: the eight move with it, and its errors are in the table and the product."""

import numpy as np
import pytest

from benchmarks.spin_coverage import spin_coverage
from inflight.spin import HELD, PARAMETER_NAMES, SPIN_RELATED, CalibrationParameters, held_slopes

TRUTH = CalibrationParameters(
    1.002, 1.0, 1.0, (4e-3, -3e-3), 5e-3, (8e-3, -9e-3), 0.0, (1.0, -2.0, 3.0)
)  # fmt: skip


def tones(field):
    """The largest variation of Bz and of the spin-plane modulus."""
    return max(np.ptp(field[:, 2]), np.ptp(np.hypot(field[:, 0], field[:, 1])))


@pytest.mark.parametrize(("name", "off"), list(zip(HELD, (1e-3, 1e-3, 4e-3, 5.0), strict=True)))
def test_with_another_value_of_what_leaves_no_tone_the_eight_that_go_with_it_leave_none(name, off):
    phase = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    field = np.column_stack([900.0 * np.cos(phase), -900.0 * np.sin(phase), np.full(24, 1200.0)])
    readings = TRUTH.disturb(field)
    held = {name: TRUTH.values()[PARAMETER_NAMES.index(name)] + off}
    alone = TRUTH.changed(held)
    eight = TRUTH.spin_related() + held_slopes(TRUTH)[:, HELD.index(name)] * off
    together = alone.changed(dict(zip(SPIN_RELATED, eight.tolist(), strict=True)))
    # To first order: what is left is of second order. A turn alone leaves no tone by itself.
    assert tones(together.correct(readings)) < 1e-4
    if name != "rotation":
        assert tones(alone.correct(readings)) > 1e-3


@pytest.mark.slow
def test_truths_lie_within_the_stated_errors_of_table_tones_and_product_as_often_as_they_should():
    found = spin_coverage(seeds=40)
    wrong = [(one.of, one.name, one.within) for one in found if not one.is_right()]
    assert not wrong
