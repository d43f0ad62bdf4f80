"""A correction is applied where held-out readings show that it helps, and nowhere else."""

from functools import partial

import numpy as np
from plain_correction import plain

from inflight.dual import Candidates, Readings, choose_correction
from inflight.time import SECOND

COUNT = 8000


def field_correction(readings, field):
    """A correction that knows its field for every stamp."""
    return plain(field[readings.stamps // SECOND])


def world(seed):
    random = np.random.default_rng(seed)
    ambient = np.cumsum(random.normal(0, 0.03, (COUNT, 3)), axis=0)
    steps = (np.searchsorted(np.cumsum(random.exponential(150, 300)), np.arange(COUNT)) % 2).astype(float)
    stray = steps[:, None] * [0.4, -0.3, 0.2]
    outboard = ambient + stray + random.normal(0, 0.02, (COUNT, 3))
    inboard = outboard + 1.5 * stray + random.normal(0, 0.02, (COUNT, 3))
    return Readings(np.arange(COUNT) * SECOND, inboard, outboard), ambient, stray, random


def decide_all(readings, body=None):
    candidates = Candidates(readings, body)
    return choose_correction(readings, candidates.fit, candidates.priors)


def decided(readings, **fields):
    return choose_correction(
        readings,
        lambda _: {name: partial(field_correction, field=field) for name, field in fields.items()},
        Candidates(readings).priors,
    )


def test_the_stray_field_itself_has_the_slope_one_and_is_applied():
    readings, _, stray, _ = world(1)
    found = decided(readings, truth=stray)
    score = found.scores["truth"]
    assert abs(score.slope - 1.0) < 4.0 * score.sigma
    assert found.chosen == "truth"
    assert found.correction.applied
    assert "help" in found.correction.reason


def test_a_field_of_the_wrong_sign_is_told_to_do_harm():
    readings, _, stray, _ = world(2)
    found = decided(readings, wrong=-stray)
    assert found.chosen == "none"
    assert not found.correction.applied
    assert "it would do harm" in found.correction.reason
    assert np.array_equal(found.correction.corrected(readings.outboard), readings.outboard)


def test_three_times_too_much_is_left_alone():
    readings, _, stray, _ = world(3)
    assert decided(readings, much=3.0 * stray).chosen == "none"


def test_ambient_field_in_disguise_is_left_alone():
    readings, ambient, _, _ = world(4)
    found = decided(readings, leak=0.02 * ambient)
    assert found.chosen == "none"
    # Where the leak is known the readings refute it; where it is not, a leak is what they are like.
    assert any(told in found.correction.reason for told in ("ambient field", "it would do harm"))


def test_noise_is_left_alone_and_the_better_of_two_is_chosen():
    readings, _, stray, random = world(5)
    assert decided(readings, noise=random.normal(0, 0.05, stray.shape)).chosen == "none"
    assert decided(readings, whole=stray, part=stray * [1.0, 1.0, 0.0]).chosen == "whole"


def test_two_quiet_sensors_are_left_alone():
    random = np.random.default_rng(6)
    ambient = np.cumsum(random.normal(0, 0.05, (COUNT, 3)), axis=0)
    both = [ambient + random.normal(0, 0.02, ambient.shape) for _ in range(2)]
    readings = Readings(np.arange(COUNT) * SECOND, *both)
    found = decide_all(readings)
    after = found.correction.corrected(readings.outboard) - ambient
    assert after.std() <= 1.02 * (readings.outboard - ambient).std()


def test_too_few_readings_have_a_reason():
    readings, _, _, _ = world(7)
    short = readings.select(slice(0, 200))
    found = decide_all(short)
    assert found.chosen == "none"
    assert found.correction.reason
