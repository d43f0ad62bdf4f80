"""Switchings that no channel follows, told from those that one does."""

import numpy as np
import pytest

from inflight.diagnosis import Stretches
from inflight.dual import attribute_jumps
from inflight.residual import piecewise_mean

STEP = 10 * 10**9
HEATER, LAMP, NOBODY = np.array([6.0, -9.0, 4.0]), np.array([-2.0, 1.0, 3.0]), np.array([0.4, 3.0, -5.0])


def part_on(random, count, times):
    """Return 0 or 1 for each row, switched at random rows far from each other, and these."""
    rows = np.sort(random.choice(np.arange(1, count // 40), times, replace=False)) * 40
    return (np.searchsorted(rows, np.arange(count), side="right") % 2).astype(float), rows


@pytest.fixture(params=[1, 2, 3])
def scene(request):
    """Two units with a current, one without, each switching by itself and one switching together."""
    random = np.random.default_rng(request.param)
    count = 8000
    heater, at_heater = part_on(random, count, 20)
    lamp, _ = part_on(random, count, 14)
    nobody, at_nobody = part_on(random, count, 11)
    # Once the unknown unit switches together with the heater.
    both = at_heater[5]
    nobody[both:] = 1.0 - nobody[both:]
    at_nobody = np.sort(np.append(at_nobody, both))
    field = heater[:, None] * HEATER + lamp[:, None] * LAMP + nobody[:, None] * NOBODY
    field += 0.04 * random.standard_normal(field.shape) + 1e-5 * np.arange(count)[:, None]
    channels = {
        "heater_current": 800.0 * heater + 3.0 * random.standard_normal(count),
        "lamp_current": 90.0 * lamp + 1.0 * random.standard_normal(count),
        "temperature": 20.0 + np.sin(np.arange(count) / 500.0) + 0.01 * random.standard_normal(count),
    }
    return STEP * np.arange(count), field, channels, at_nobody


def test_only_what_no_channel_follows_is_unexplained_even_beside_one_that_does(scene):
    stamps, field, channels, at_nobody = scene
    found = attribute_jumps(stamps, field, channels, dict.fromkeys(channels, 1))
    assert found is not None
    middle = (found.last + (found.first - found.last) // 2)[~found.follows] / STEP
    assert middle.size == np.unique(at_nobody).size
    assert np.abs(middle[:, None] - at_nobody[None, :]).min(axis=1).max() <= 2.0
    assert np.count_nonzero(found.follows) > 20


def test_the_unit_without_a_channel_has_its_step_within_the_stated_error(scene):
    stamps, field, channels, _ = scene
    found = attribute_jumps(stamps, field, channels, dict.fromkeys(channels, 1))
    step, sigma, count = found.units[0]
    assert count >= 10
    assert np.all(np.abs(step * np.sign(step @ NOBODY) - NOBODY) < 5.0 * sigma)


def test_a_difference_that_never_jumps_has_no_switching():
    random = np.random.default_rng(7)
    assert attribute_jumps(STEP * np.arange(3000), random.standard_normal((3000, 3)), {}, {}) is None


def test_stretches_take_levels_out_and_leave_no_rounding_of_a_constant():
    stamps = STEP * np.arange(30)
    level = np.where(np.arange(30) < 12, 3.1, -7.7)
    lost = ((11 * STEP, 12 * STEP),)
    kept = Stretches((0, 12 * STEP), lost).keep(level[:, None], stamps, np.ones(30, dtype=bool))
    assert np.isnan(kept[11:13]).all()
    assert np.all(np.delete(kept[:, 0], [11, 12]) == 0.0)


def test_a_switched_current_loses_its_noise_and_a_temperature_keeps_its_wander():
    random = np.random.default_rng(11)
    clean = 300.0 * (np.arange(4000) // 500 % 2)
    out = piecewise_mean(clean + 2.0 * random.standard_normal(4000))
    assert np.abs(out - clean).max() < 0.5
    warm = 20.0 + np.sin(np.arange(4000) / 300.0) + 0.02 * random.standard_normal(4000)
    assert np.array_equal(piecewise_mean(warm), warm)


def test_a_missing_reading_stays_missing():
    values = np.where(np.arange(200) < 100, 1.0, 50.0) + 0.1 * np.random.default_rng(3).standard_normal(200)
    values[[20, 120]] = np.nan
    assert np.array_equal(np.isnan(piecewise_mean(values)), np.isnan(values))
