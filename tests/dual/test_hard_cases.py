"""Two sensors in trouble: what the held-out decision assumes fails, and it makes nothing worse."""

from dataclasses import replace

import numpy as np
import pytest

from inflight.dual import Body
from inflight.dual.geometry import matrices_near_inboard
from inflight.dual.gradiometer import fit_forms
from inflight.dual.noise import SLOW_NOISE_SETTINGS, draw_slow_noise
from inflight.dual.readings import contrasts, running_sums
from tests.dual.hard_cases import WORSE, body, case, inside, make, outcome, units

#: Not among them, since two sensors cannot tell: an offset that jumps like a unit, one that follows the day
#: farther than sensors wander, sensors whose axes are exchanged.
TROUBLE = ["gain", "crosstalk", "half a sample late", "storm", "turning", "walking offsets", "ten minutes"]


@pytest.mark.parametrize("name", ["dead inboard", "slow inboard", "dead outboard"])
def test_a_broken_sensor_makes_nothing_worse(name):
    assert max(outcome(make(name, seed)).ratio for seed in (200, 5)) < WORSE


@pytest.mark.parametrize("axis", [[1.0, 0.0, 0.0], [0.6, 0.0, -0.8]])
@pytest.mark.parametrize("stuck", ["inboard", "outboard"])
def test_a_sensor_that_stands_still_along_an_axis_is_refused(stuck, axis):
    made = make("ordinary", 410)
    seen = np.eye(3) - np.outer(axis, axis)
    found = outcome(replace(made, **{stuck: getattr(made, stuck) @ seen + 7.0}))
    assert not found.applied
    assert f"the {stuck} sensor reads one value along an axis" in found.decision.correction.reason
    assert not make("coarse", 410).readings.defect


def test_two_sensors_that_read_the_same_are_left_alone():
    made = make("ordinary", 410)
    found = outcome(replace(made, inboard=made.outboard + 1.0))
    assert not found.applied
    assert "never changes" in found.decision.correction.reason


@pytest.mark.slow
@pytest.mark.parametrize("name", TROUBLE)
def test_trouble_makes_no_case_worse(name):
    assert max(outcome(make(name, seed)).ratio for seed in (300, 301)) < WORSE


@pytest.mark.parametrize("seed", [1027, 1062, 1082])
def test_moments_that_the_field_commands_are_not_taken_for_more_than_geometry_says(seed):
    # Their one oscillation, the ambient field's own, has a slope that all parts of the record agree on.
    assert outcome(make("torquers follow the field", seed)).ratio < WORSE


def test_six_units_are_farther_from_one_matrix_than_the_regression_shows_and_the_sigma_knows():
    pulls = []
    for seed in range(6):
        random = np.random.default_rng([11, seed])
        parts = [units(random, 4000, 1.0, inside) for _ in range(3)]
        made = case(random, (sum(one[0] for one in parts), sum(one[1] for one in parts)))
        fitted = fit_forms(made.readings, ("matrix",), body())["matrix"]
        sources = sum(one[0] for one in parts) - made.stray
        error = sources @ fitted.matrix.T - made.stray
        stated = np.einsum("ikil,tk,tl->t", fitted.covariance.reshape(3, 3, 3, 3), sources, sources)
        pulls.append(np.sum(error.var(axis=0)) / np.mean(stated))
    assert np.mean(pulls) < 2.0


def test_around_the_body_more_is_possible_than_in_it_and_less_than_on_any_boom():
    small = Body(body().positions, np.zeros(3), np.full(3, 0.05))
    assert matrices_near_inboard(small).std(axis=0).min() > small.matrices.std(axis=0).max()


def test_sensors_wander_as_flicker_noise_along_a_line_and_as_a_walk():
    count = 4096
    own = draw_slow_noise(count, 200)
    assert own.flicker.std() == pytest.approx(SLOW_NOISE_SETTINGS.flicker, rel=0.01)
    octaves = [
        np.mean(contrasts(running_sums(own.flicker), block)[0] ** 2) / block for block in (4, 16, 64, 256)
    ]
    # One over frequency: the means over neighbouring blocks differ alike on all scales.
    assert max(octaves) < 1.3 * min(octaves)
    assert own.line.std() == pytest.approx(1.0, rel=1e-3)
    assert (own.walk[-1] - own.walk[0]).std() == pytest.approx(1.0, abs=0.2)
    short = np.mean(contrasts(running_sums(own.walk), 8)[0] ** 2)
    # Means over neighbouring blocks of a walk with steps of variance v differ by 2/3 v block.
    assert short == pytest.approx(2.0 / 3.0 / count * 8 * 4.0, rel=0.1)
