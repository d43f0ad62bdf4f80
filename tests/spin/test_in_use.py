"""Values in use over many intervals: what moves them, what does not, and whether stated errors hold."""

import numpy as np
import pytest

from inflight.spin import SPIN_RELATED, CalibrationParameters, SpinParametersInUse, ValueInUse

AT = {name: index for index, name in enumerate(SPIN_RELATED)}
SIGMA = np.array([0.01 if name.startswith("offset") else 2e-5 for name in SPIN_RELATED])
ALL = np.ones(8, dtype=bool)


def covariance(correlation=0.97):
    """Offset and elevation of a sensor share a tone: their errors go together."""
    found = np.eye(8)
    for sensor in "12":
        one, other = AT[f"offset[{sensor}]"], AT[f"elevation[{sensor}]"]
        found[one, other] = found[other, one] = correlation
    return found * np.outer(SIGMA, SIGMA)


def begun():
    ground = CalibrationParameters()
    return SpinParametersInUse.from_ground(ground, dict(zip(SPIN_RELATED, 300.0 * SIGMA, strict=True)))


def flown(truths, generator, quality=None):
    """Return the steps of intervals with these true values (interval, 8)."""
    used, steps = begun(), []
    spread = covariance()
    for day, truth in enumerate(truths):
        size = quality(generator) if quality else 1.0
        seen = generator.multivariate_normal(truth, spread * size**2)
        steps.append(used.update(seen, spread * size**2, ALL, float(day)))
        used = steps[-1].used
    return steps


def constant(days, generator):
    return np.tile(100.0 * SIGMA * generator.normal(size=8), (days, 1))


def verdicts(steps):
    return np.array([[one.verdict for one in step.decisions] for step in steps])


def test_the_first_value_of_the_flight_is_taken():
    generator = np.random.default_rng(1)
    first = flown(constant(1, generator), generator)[0]
    assert set(verdicts([first]).ravel()) == {"update"}
    assert "first value" in first.decisions[0].reason


def test_what_only_noise_moves_is_left_alone():
    updates = looks = 0
    for seed in range(40, 52):
        generator = np.random.default_rng(seed)
        found = verdicts(flown(constant(30, generator), generator))[1:]
        updates, looks = updates + int((found == "update").sum()), looks + found.size
    # Three sigma of both errors: 0.3 % of single decisions, a little more of pairs.
    assert updates < 0.01 * looks


def test_a_step_of_one_parameter_is_taken_when_it_comes_and_leaves_the_others():
    generator = np.random.default_rng(7)
    truths = constant(12, generator)
    at = AT["spin_axis[x]"]
    truths[6:, at] += 10.0 * SIGMA[at]
    found = verdicts(flown(truths, generator))
    assert found[6, at] == "update"
    assert (np.delete(found[1:], at, axis=1) != "update").all()
    assert (found[7:, at] != "update").all()


@pytest.mark.parametrize("varied", [False, True], ids=["alike", "varied"])
@pytest.mark.parametrize("drift", [0.0, 0.1, 0.5, 2.0])
def test_stated_errors_hold_whether_values_drift_or_stay(drift, varied):
    """Drift in sigmas an interval; of intervals alike, or of very different quality."""
    pulls = []
    for seed in range(200, 215):
        generator = np.random.default_rng(seed)
        truths = constant(25, generator) + drift * SIGMA * np.arange(25)[:, None]
        steps = flown(truths, generator, (lambda one: np.exp(one.normal())) if varied else None)
        error = np.array([np.sqrt(np.diag(step.covariance)) for step in steps])
        pulls.append((np.array([step.used.value for step in steps]) - truths) / error)
    # Gaussian errors leave 4.6 %.
    assert np.mean(np.abs(pulls) > 2.0) < 0.08
    # Until intervals have shown a drift, a value known very well is believed too long.
    assert np.mean(np.abs(pulls) > 4.0) < 0.03


def test_a_real_drift_is_followed():
    generator = np.random.default_rng(9)
    truths = constant(30, generator) + 0.6 * SIGMA * np.arange(30)[:, None]
    steps = flown(truths, generator)
    behind = np.abs(np.array([step.used.value for step in steps]) - truths) / SIGMA
    assert behind.max() < 8.0
    assert ((verdicts(steps)[1:] == "update").sum(axis=0) >= 2).all()


def test_offset_and_elevation_are_replaced_together_and_leave_no_tone_behind():
    """A shift that neither alone shows, but their sum does: the tone ``O - Ba dth`` would come back."""
    offset, elevation = AT["offset[1]"], AT["elevation[1]"]
    generator = np.random.default_rng(3)
    used = flown(constant(3, generator), generator)[-1].used
    seen = used.value.copy()
    # Against the common error: of each alone one and a half sigma.
    seen[offset] += 1.5 * SIGMA[offset]
    seen[elevation] -= 1.5 * SIGMA[elevation]
    step = used.update(seen, covariance(), ALL, 3.0)
    found = dict(zip(SPIN_RELATED, step.decisions, strict=True))
    assert found["offset[1]"].verdict == found["elevation[1]"].verdict == "update"
    assert "together" in found["offset[1]"].reason
    assert found["offset[2]"].verdict != "update"
    assert step.used.value[[offset, elevation]] == pytest.approx(seen[[offset, elevation]], rel=1e-9)


def test_what_an_interval_does_not_tell_is_kept_and_the_rest_goes_with_it():
    """In a steady field only the sum of offset and elevation is told; the elevation of before decides."""
    generator = np.random.default_rng(4)
    truth = constant(1, generator)[0]
    used = flown(np.tile(truth, (2, 1)), generator)[-1].used
    axial, offset, elevation = 500.0, AT["offset[1]"], AT["elevation[1]"]
    # Ground's elevation, hardly known, beside an offset that fits it and no other.
    wide = np.diag(SIGMA**2)
    wide[elevation, elevation] = (300.0 * SIGMA[elevation]) ** 2
    wide[offset, offset] = (axial * 300.0 * SIGMA[elevation]) ** 2 + SIGMA[offset] ** 2
    wide[offset, elevation] = wide[elevation, offset] = -axial * wide[elevation, elevation]
    seen = truth.copy()
    seen[elevation] = 0.0
    seen[offset] = truth[offset] + axial * truth[elevation]
    told = ALL.copy()
    told[elevation] = False
    step = used.update(seen, wide, told, 2.0)
    assert dict(zip(SPIN_RELATED, step.decisions, strict=True))["elevation[1]"].verdict == "keep"
    assert step.estimate[offset] == pytest.approx(truth[offset], abs=5.0 * SIGMA[offset])


def test_an_interval_that_tells_nothing_leaves_everything():
    generator = np.random.default_rng(5)
    used = flown(constant(3, generator), generator)[-1].used
    step = used.update(np.zeros(8), np.diag((300.0 * SIGMA) ** 2), ~ALL, 40.0)
    assert np.array_equal(step.used.value, used.value)
    assert {one.verdict for one in step.decisions} == {"keep"}
    assert (np.diag(step.covariance) >= np.diag(used.covariance)).all()


def test_one_value_by_itself_follows_the_same_rules():
    made, used, sigma = ValueInUse("offset[3]", 0.0, 10.0).update(1.7, 0.2)
    assert (made.verdict, used.value, sigma) == ("update", 1.7, 0.2)
    made, kept, sigma = used.update(1.9, 0.2)
    assert (made.verdict, kept.value) == ("keep", 1.7)
    assert 0.2 <= sigma < 0.35
    assert kept.update(float("nan"), float("inf"))[1] == used
    made, moved, _ = kept.update(3.0, 0.2)
    assert (made.verdict, moved.value) == ("update", 3.0)
