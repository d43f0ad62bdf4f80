"""What leaves no tone: the eight move with it, and its errors are in the table and the product."""

import numpy as np
import pytest

from benchmarks.spin_coverage import _MISSIONS, spin_coverage
from inflight.errors import MissionError
from inflight.mission import Mission
from inflight.model import Model
from inflight.spin import (
    HELD,
    PARAMETER_NAMES,
    SPIN_RELATED,
    CalibrationParameters,
    fit_held,
    held_slopes,
    respin,
    sums_near_earth,
)
from inflight.tasks.pipelines.spin.pipeline import _require_a_parameter_to_tell
from inflight.time import SECOND

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


def test_a_known_field_tells_what_leaves_no_tone_beside_a_field_it_lacks_and_a_turned_axis():
    hours = np.arange(0.0, 6.0, 0.01)
    turning = np.column_stack([np.cos(hours), np.sin(1.7 * hours), np.cos(0.6 * hours)])
    model = turning * (1000.0 + 4000.0 * np.sin(2.0 * hours[:, None]) ** 2)
    noise = np.random.default_rng(1).normal(size=model.shape)
    true = model + np.cross([1e-3, -2e-3, 0.0], model) + [3.0, -5.0, 4.0] + noise
    off = np.array([8e-4, -6e-4, 3e-3, 0.0])
    held = dict(zip(HELD, TRUTH.values()[[PARAMETER_NAMES.index(one) for one in HELD]] - off, strict=True))
    eight = TRUTH.spin_related() - held_slopes(TRUTH) @ off
    ground = TRUTH.changed(held | dict(zip(SPIN_RELATED, eight.tolist(), strict=True)))
    phase = 2.0 * np.pi * hours * 1200.0
    despun = respin(ground.correct(TRUTH.disturb(respin(true, phase))), -phase)
    stamps = np.rint(hours * 3600.0 * SECOND).astype(np.int64)
    known = np.array([1e-3, 1e-3, 4e-3, 10.0])
    found = fit_held(sums_near_earth(despun, model, stamps, ground), np.zeros(4), known, 10.0)
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(found.value - off) < 3.0 * sigma)
    assert np.all(sigma[:3] < 1e-4)
    # A uniform field along the axis looks like an offset: the offset stays as it was known.
    assert 6.0 < sigma[3] < 10.0
    assert found.after < 1.1 < found.before
    assert fit_held(np.zeros((40, 11, 11)), np.zeros(4), known, 10.0) is None


def test_a_field_model_that_may_tell_nothing_is_refused():
    mission = Mission.parse((_MISSIONS / "themis.yaml").read_text(encoding="utf-8"))
    text = (_MISSIONS / "models/themis-preflight.yaml").read_text(encoding="utf-8")
    _require_a_parameter_to_tell(Model.parse(text, mission))
    fixed = text.replace("unit: nT, value: [0.0, 0.0, 0.0]", "unit: nT, free: false, value: [0.0, 0.0, 0.0]")
    with pytest.raises(MissionError, match="holds all of them"):
        _require_a_parameter_to_tell(Model.parse(fixed, mission))


@pytest.mark.slow
def test_truths_lie_within_the_stated_errors_of_table_tones_and_product_as_often_as_they_should():
    found = spin_coverage(seeds=40)
    wrong = [(one.of, one.name, one.within) for one in found if not one.is_right()]
    assert not wrong
