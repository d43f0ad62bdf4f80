"""The prior by geometry counts where held-out readings are uncertain, and gives way where they are not."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from plain_correction import plain
from scipy import signal

from inflight.dual import WHOLE, AppliedPart, Body, Candidates, Readings, choose_correction
from inflight.dual.correction import slow_part
from inflight.dual.geometry import dipole_matrix, matrices_of_any_boom, matrix_prior
from inflight.dual.gradiometer import fit_forms, fit_gradiometer
from inflight.dual.held_out import (
    HELD_OUT_SETTINGS,
    SlopeObservation,
    SlopePrior,
    best_part,
    held_out_slopes,
)
from inflight.dual.mixing import SecondMoments
from inflight.time import SECOND

COUNT = 6000
BODY = Body(np.array([[1.0, 0.0, 0.0], [1.8, 0.0, 0.0]]), np.zeros(3), np.full(3, 0.3))
PLACE = np.array([0.1, -0.15, 0.05])


def coloured(random, size):
    return size * np.cumsum(random.normal(0.0, 1.0, (COUNT, 3)), axis=0)


def boom(seed, difference, restless, noise=0.01):
    """Readings of one unit at PLACE that makes a difference (time, axis), and the true field."""
    random = np.random.default_rng(seed)
    ambient = coloured(random, restless) + np.array([20.0, -5.0, 3.0])
    outboard = ambient + difference @ dipole_matrix(BODY.positions, PLACE).T
    inboard = outboard + difference
    inboard, outboard = (one + random.normal(0.0, noise, (COUNT, 3)) for one in (inboard, outboard))
    return Readings(np.arange(COUNT) * SECOND, inboard, outboard), ambient


def switching(seed, size=0.4):
    random = np.random.default_rng([seed, 1])
    on = np.searchsorted(np.cumsum(random.exponential(200, 200)), np.arange(COUNT)) % 2
    return size * on[:, None] * np.array([0.6, -0.5, 0.6])


def decided(readings, body=None):
    candidates = Candidates(readings, body)
    return choose_correction(readings, candidates.fit, candidates.priors)


def error(field, ambient):
    return np.sqrt(np.var(field - ambient, axis=0).mean())


def test_matrices_of_a_body_hold_that_of_a_unit_in_it():
    mean, covariance = matrix_prior(BODY.matrices)
    away = dipole_matrix(BODY.positions, PLACE).ravel() - mean
    assert away @ np.linalg.solve(covariance, away) < 20.0
    assert np.linalg.norm(away) > 0.05


@pytest.mark.parametrize("ratio", [0.05, 0.3, 0.7])
def test_any_boom_holds_every_ratio_of_a_unit_nearer_to_the_inboard_sensor(ratio):
    along = np.trace(matrices_of_any_boom(), axis1=1, axis2=2) / 3.0
    assert along.min() < ratio / (1.0 - ratio) < along.max()
    assert (along > 0).all()


def test_where_the_ambient_field_hides_everything_the_matrix_is_that_of_the_body():
    readings, _ = boom(1, switching(1), restless=0.5)
    found = fit_gradiometer(readings, "matrix", BODY)
    mean, _ = matrix_prior(BODY.matrices)
    assert found.matrix == pytest.approx(mean.reshape(3, 3), abs=0.1)


def test_noise_of_the_difference_does_not_shrink_the_matrix():
    stray, noise = np.diag([3e4, 1e4, 2e4]), 1e4 * np.eye(3)
    truth = dipole_matrix(BODY.positions, PLACE)
    blocks = 24
    told = SecondMoments(
        np.tile((stray + noise) / blocks, (blocks, 3, 1, 1)),
        np.tile(truth @ stray / blocks, (blocks, 1, 1)),
        np.tile(noise / blocks, (blocks, 3, 1, 1)),
        np.zeros((3, 3, 3)),
    )
    wide = np.zeros(9), 9.0 * np.eye(9)
    found, covariance = told.solve(np.eye(9).reshape(9, 3, 3), wide)
    assert found.reshape(3, 3) == pytest.approx(truth, abs=0.01)
    # Plain regression is wrong by more than three of the stated errors.
    plain = (truth @ stray @ np.linalg.inv(stray + noise)).ravel()
    assert np.abs((plain - found) / np.sqrt(np.diag(covariance))).max() > 3.0


def test_geometry_corrects_what_readings_alone_cannot_tell():
    alone, told = [], []
    for seed in range(4):
        readings, ambient = boom(seed, switching(seed), restless=0.1)
        raw = error(readings.outboard, ambient)
        for found, out in ((decided(readings), alone), (decided(readings, BODY), told)):
            out.append(error(found.correction.corrected(readings.outboard), ambient) / raw)
    assert max(told) < 1.0
    assert np.mean(told) < 0.9 * np.mean(alone)


def test_an_inboard_sensor_that_only_makes_noise_is_refused():
    random = np.random.default_rng(5)
    ambient = coloured(random, 0.1)
    inboard, outboard = random.normal(0.0, 0.02, (COUNT, 3)), ambient + random.normal(0.0, 0.02, (COUNT, 3))
    for body in (None, BODY):
        found = decided(Readings(np.arange(COUNT) * SECOND, inboard, outboard), body)
        assert found.chosen == "none"
        assert "matrix (held-out slope" in found.correction.reason


def test_one_sensors_axis_in_both_readings_is_refused():
    readings, _ = boom(14, switching(14), restless=0.1)
    inboard = np.column_stack([readings.outboard[:, 0], readings.inboard[:, 1:]])
    found = decided(Readings(readings.stamps, inboard, readings.outboard), BODY)
    assert found.correction.reason == "the difference of both sensors never changes along an axis"


def test_filtered_noise_of_sensors_without_a_stray_field_is_refused():
    random = np.random.default_rng(15)
    ambient = coloured(random, 0.01)
    filtered = signal.lfilter(*signal.butter(4, 0.5), random.normal(size=(2, COUNT, 3)), axis=1)
    inboard, outboard = ambient + np.array([0.07, 0.05])[:, None, None] * filtered
    assert decided(Readings(np.arange(COUNT) * SECOND, inboard, outboard), BODY).chosen == "none"


def test_a_drift_of_the_size_that_sensors_have_is_left_alone_and_a_large_one_is_not():
    rise = np.linspace(-1.0, 1.0, COUNT)[:, None] * [0.5, -0.3, 0.4]
    small, ambient = boom(7, 0.05 * rise, restless=0.05)
    raw = error(small.outboard, ambient)
    assert error(decided(small, BODY).correction.corrected(small.outboard), ambient) < 1.02 * raw
    large, ambient = boom(7, 20.0 * rise, restless=0.05)
    after = error(decided(large, BODY).correction.corrected(large.outboard), ambient)
    assert after < 0.4 * error(large.outboard, ambient)


def test_what_is_slow_is_left_alone_and_what_is_quick_is_taken_off():
    tone = np.sin(np.arange(COUNT) / 40.0)[:, None] * [0.6, -0.5, 0.6]
    readings, ambient = boom(12, tone, restless=0.002, noise=0.02)
    # The outboard sensor drifts: what the difference holds of it is no stray field.
    drifting = readings.outboard + 0.2 * np.linspace(-1.0, 1.0, COUNT)[:, None] * [1.0, -1.0, 1.0]
    found = decided(Readings(readings.stamps, readings.inboard, drifting), BODY)
    assert 0.0 < found.scores[found.chosen].part.seconds < COUNT
    assert "within" in found.correction.reason
    after = found.correction.corrected(drifting)
    assert error(after, ambient) < 0.9 * error(drifting, ambient)
    quick = [one - ambient - slow_part(one - ambient, 500) for one in (drifting, after)]
    assert quick[1].std() < 0.5 * quick[0].std()


def test_what_states_prove_is_as_much_as_drift_does_not_come_into_their_means():
    rise = np.linspace(-0.2, 0.2, COUNT)[:, None] * np.ones(3)
    lost = []
    # One state after the other, and to and fro.
    for state in (np.arange(COUNT) * 4 // COUNT, np.arange(COUNT) // 50 % 2):
        field = 0.1 * state[:, None] * np.ones(3)
        readings, _ = boom(13, rise + field, restless=0.001)
        made = plain(field, state, method="states")
        prior = Candidates(readings, BODY).priors[0].slope_prior(made)
        lost.append(np.std(prior.slope[-1]) / np.mean(prior.slope[0]))
    assert lost[0] > 3.0 * lost[1]


def test_units_outside_of_the_body_that_is_told_refute_it():
    wrong = replace(BODY, centre=np.array([-8.0, 0.0, 0.0]))
    readings, ambient = boom(8, switching(8, 5.0), restless=0.001)
    found = decided(readings, wrong)
    assert {one.units for one in found.scores.values()} == {"units nearer to the inboard sensor"}
    assert error(found.correction.corrected(readings.outboard), ambient) < 0.3 * error(
        readings.outboard, ambient
    )


def test_less_is_taken_off_where_the_whole_might_do_harm():
    draws = np.random.default_rng(9).normal(0.75, 0.15, 4000)
    posterior = SlopePrior(scale=np.array([1]), power=np.array([2.0]), slope=draws[None]).posterior(
        SlopeObservation.none()
    )
    chances = [posterior.risk(AppliedPart(share)) for share in (1.0, 0.7, 0.5)]
    assert chances[0] > chances[1] > chances[2]
    # 2 share <c s> - share^2 <c^2>
    likely = posterior.benefit(AppliedPart(0.7))
    assert likely == pytest.approx(2.0 * 0.7 * (2 * draws.mean() - 0.7))
    assert likely > posterior.benefit() - 0.1


def test_slow_scales_that_may_do_harm_are_left_alone():
    random = np.random.default_rng(10)
    # On the slow scale most of the correction may be something else.
    slopes = np.stack([random.normal(1.0, 0.1, 4000), random.normal(0.5, 0.6, 4000)])
    kept = {100.0: (np.array([1.0, 0.05]), np.array([1.0, 0.005]))}
    posterior = SlopePrior(
        scale=np.array([1, 1024]), power=np.array([1.0, 2.0]), slope=slopes, filtered=kept
    ).posterior(SlopeObservation.none())
    assert best_part(posterior, constant_known=False).seconds == 100.0
    whole, quick = (posterior.risk(part) for part in (WHOLE, AppliedPart(1.0, 100.0)))
    assert quick < HELD_OUT_SETTINGS.most_risk < whole
    assert best_part(posterior, constant_known=True) == WHOLE


def test_readings_move_the_expected_slope_to_what_they_say():
    draws = np.random.default_rng(10).uniform(0.2, 2.0, 4000)
    prior = SlopePrior(scale=np.array([1, 2]), power=np.ones(2), slope=np.stack([draws, draws]))
    seen = SlopeObservation(
        np.array([1, 2]), np.ones(2), np.full(2, 0.01), np.zeros((2, 3, 3)), np.zeros((2, 2))
    )
    assert prior.posterior(seen).weights @ draws == pytest.approx(1.0, abs=0.05)
    assert not prior.posterior(seen).rejected
    assert prior.posterior(replace(seen, slope=np.array([9.0, 9.0]))).rejected


def test_readings_that_an_error_of_the_leak_explains_tell_less():
    random = np.random.default_rng(11)
    draws = random.uniform(0.2, 2.0, 40_000)
    leak = np.zeros((draws.size, 3, 3))
    leak[:, 0, 0] = random.normal(0.0, 0.01, draws.size)
    # Where ambient field is strong a small leak makes a slope.
    ambient = np.zeros((2, 3, 3))
    ambient[:, 0, 0] = 100.0
    seen = SlopeObservation(np.array([1, 2]), np.full(2, 1.8), np.full(2, 0.01), ambient, np.zeros((2, 2)))
    plain = SlopePrior(scale=seen.scale, power=np.ones(2), slope=np.stack([draws, draws]))
    known = plain.posterior(seen).weights @ draws
    told = replace(plain, leak=leak).posterior(seen).weights @ draws
    assert known == pytest.approx(1.8, abs=0.05)
    assert told == pytest.approx(draws.mean(), abs=0.4)
    assert told < known - 0.2


def test_slopes_of_few_oscillations_tell_less_than_their_cells_agree_on():
    random = np.random.default_rng(14)
    wave = np.sin(2 * np.pi * np.arange(COUNT) / 900.0)
    ambient = 5.0 * np.column_stack([wave, np.roll(wave, 100), np.roll(wave, 200)])
    told = {}
    for name, field in {"wave": np.roll(ambient, 60, axis=0), "units": 5.0 * switching(14)}.items():
        readings = Readings(
            np.arange(COUNT) * SECOND,
            ambient + 2.0 * field + random.normal(0.0, 0.01, (COUNT, 3)),
            ambient + field + random.normal(0.0, 0.01, (COUNT, 3)),
        )
        edges = np.linspace(0, COUNT, 5).astype(int)
        folds = [slice(first, last) for first, last in itertools.pairwise(edges.tolist())]
        held = [(fold, plain(0.5 * field[fold], np.full((COUNT // 4, 3), 0.01))) for fold in folds]
        slope, sigma, seen = held_out_slopes(readings, held)
        told[name] = slope, sigma, np.sqrt(np.diag(seen.coherent).max())
    # Of a wave, the ambient field's own with it: as far off as it is, which cells do not show.
    assert abs(told["wave"][0] - 2.0) > 5 * told["wave"][1]
    assert abs(told["wave"][0] - 2.0) < 2 * told["wave"][2]
    assert told["units"][2] < 0.4 < told["wave"][2]


def test_a_coherent_error_leaves_the_slope_to_the_prior():
    draws = np.random.default_rng(15).uniform(0.2, 2.0, 40_000)
    prior = SlopePrior(scale=np.array([1, 2]), power=np.ones(2), slope=np.stack([draws, draws]))
    seen = SlopeObservation(
        np.array([1, 2]), np.full(2, 1.8), np.full(2, 0.01), np.zeros((2, 3, 3)), np.zeros((2, 2))
    )
    known, open_ = (
        prior.posterior(replace(seen, coherent=np.full((2, 2), size**2))).weights @ draws
        for size in (0.0, 3.0)
    )
    assert known == pytest.approx(1.8, abs=0.05)
    assert open_ == pytest.approx(draws.mean(), abs=0.2)


def test_what_was_taken_for_noise_may_be_stray_field():
    draws = np.random.default_rng(12).uniform(0.2, 1.2, 40_000)
    seen = SlopeObservation(
        np.array([1, 2]), np.full(2, 3.0), np.full(2, 0.01), np.zeros((2, 3, 3)), np.zeros((2, 2))
    )
    clear = SlopePrior(scale=seen.scale, power=np.ones(2), slope=np.stack([draws, draws]))
    assert clear.posterior(seen).rejected
    # A correction that lost four fifths to the noise is three times too small.
    noisy = replace(clear, signal_share=np.full(2, 0.2)).posterior(seen)
    assert not noisy.rejected
    assert noisy.weights @ draws == pytest.approx(1.1, abs=0.1)


def test_nothing_is_sure_by_a_single_draw():
    draws = np.random.default_rng(13).normal(1.0, 0.1, 4000)
    prior = SlopePrior(scale=np.array([1, 2]), power=np.ones(2), slope=np.stack([draws, draws]))
    usual, odd = (
        SlopeObservation(
            np.array([1, 2]), np.full(2, slope), np.full(2, 1e-4), np.zeros((2, 3, 3)), np.zeros((2, 2))
        )
        for slope in (1.0, 2.0)
    )
    assert prior.posterior(usual).risk() < 0.001
    assert not prior.posterior(odd).rejected
    assert prior.posterior(odd).risk() > 0.001


def test_every_form_starts_from_geometry():
    readings, _ = boom(11, switching(11), restless=0.5)
    mean, _ = matrix_prior(BODY.matrices)
    for one in fit_forms(readings, ("ratio", "axes", "dipole", "principal", "matrix"), BODY).values():
        if one.form != "principal":
            assert np.trace(one.matrix) == pytest.approx(np.trace(mean.reshape(3, 3)), rel=0.3), one.form


def test_what_is_left_alone_is_no_error_of_the_part_that_is_taken_off():
    slopes = np.ones((2, 100))
    # Of the slow scale a tenth is left in the part; its slope on that is one, as of the whole.
    kept = {100.0: (np.array([1.0, 0.1]), np.array([1.0, 0.01]))}
    posterior = SlopePrior(
        scale=np.array([1, 1024]), power=np.array([1.0, 200.0]), slope=slopes, filtered=kept
    ).posterior(SlopeObservation.none())
    assert posterior.slope_error(AppliedPart(1.0, 100.0)) == pytest.approx(0.0)
    assert posterior.slope_error(AppliedPart(0.5, 100.0)) == pytest.approx(0.5)
