"""Trends are recovered from equations and tables, without jumps, and no kind is forced."""

import numpy as np
import pytest
from estimator_cases import (
    LB,
    NINE,
    PRIOR_SIGMA,
    REST,
    SCALES,
    day_equations,
    joined,
    nine_at,
    table_of,
    wandering,
)

from inflight.calibration import table_boundary_steps, trend_jumps
from inflight.effects import VectorSensor
from inflight.errors import CalibrationError
from inflight.mission_fit import fit_origin, fit_trends, make_trend
from inflight.mission_fit.trend_selection import compare_trends
from inflight.mission_fit.trends import equations_of_table
from inflight.model.time_dependence import parse_timed
from inflight.time import from_mjd2000, mjd2000

SPREAD = np.full(1, 0.005)


def log_table(days, seed=0, growth=2.9e-4, noise=2e-6, origin=150.0):
    error = np.random.default_rng(seed).normal(size=days.size)
    value = 1.0 + growth * np.log(days + 0.5 - origin) + noise * error
    return equations_of_table(table_of(days, value[:, None], noise, ["l"]))


def log_at(equations, mjd=150.0):
    return make_trend("log", equations.middle, int(from_mjd2000(mjd)))


@pytest.fixture(scope="module")
def mission():
    """Equations of 80 days over eight years, with gaps, one day of a clock fault and noise of 0.1 nT."""
    days = np.unique(np.round(np.geomspace(50, 3000, 90))) + 150
    generator = np.random.default_rng(4)
    return joined(
        [day_equations(day, nine_at(day + 0.5), generator, shift=0.05 if i == 40 else 0.0)
         for i, day in enumerate(days)]
    )  # fmt: skip


def test_the_law_of_ageing_is_recovered_from_the_sum_of_all_days_equations(mission):
    fit = fit_trends(mission, dict.fromkeys(SCALES, log_at(mission)), PRIOR_SIGMA)
    truth = np.concatenate([np.stack([nine_at(151.0)[:3], LB], axis=1).ravel(), REST])
    assert np.all(np.abs(fit.value - truth) < 4 * fit.sigma)
    assert fit.sigma[1] < 2e-7
    assert fit.determined.all()
    assert fit.columns[:2] == ("vector_sensor.scale_factor[x]", "vector_sensor.scale_factor[x]*b")
    assert fit.weight[40] < 0.2, "the day of the clock fault must lose its say"
    assert np.delete(fit.weight, 40).min() > 0.5


def test_values_in_time_and_their_sigmas_cover_the_truth_everywhere(mission):
    fit = fit_trends(mission, dict.fromkeys(SCALES, log_at(mission)), PRIOR_SIGMA)
    times = from_mjd2000(np.array([220.0, 800.0, 3100.0]))
    value, sigma = fit.at(times)
    truth = np.array([nine_at(day) for day in mjd2000(times)])
    assert np.all(np.abs(value - truth) < 4 * sigma)


def test_a_falling_trend_is_recovered_too():
    equations = log_table(np.arange(200.0, 900.0), growth=-1.5e-4)
    fit = fit_trends(equations, {"l": log_at(equations)}, SPREAD)
    assert np.all(np.abs(fit.value - [1.0, -1.5e-4]) < 4 * fit.sigma)


@pytest.mark.parametrize("memory", [0.01, 3.0])
def test_one_sigma_of_a_trend_covers_two_thirds_of_seeds_also_when_days_are_correlated(memory):
    inside = []
    days, names = np.arange(300.0, 700.0), [f"l{index}" for index in range(6)]
    truth = 1.0 + 2.9e-4 * np.log(days + 0.5 - 150.0)
    for seed in range(40):
        generator = np.random.default_rng(seed)
        error = [wandering(days.size, memory, generator) for _ in names]
        value = truth[:, None] + 2e-6 * np.stack(error, axis=1)
        equations = equations_of_table(table_of(days, value, 2e-6, names))
        fit = fit_trends(equations, dict.fromkeys(names, log_at(equations)), np.full(6, 0.005))
        inside += list(np.abs(fit.value.reshape(6, 2) - [1.0, 2.9e-4]).ravel() < fit.sigma)
    assert 0.60 <= np.mean(inside) <= 0.76


def test_outlying_and_missing_intervals_do_not_move_a_trend():
    days = np.arange(300.0, 700.0)
    value = 1.0 + 2.9e-4 * np.log(days + 0.5 - 150.0) + 2e-6 * np.random.default_rng(1).normal(size=400)
    value[50:54] += 3e-4
    value[100:160] = np.nan
    equations = equations_of_table(table_of(days, value[:, None], 2e-6, ["l"]))
    fit = fit_trends(equations, {"l": log_at(equations)}, SPREAD)
    assert len(equations) == 340
    assert np.all(fit.weight[50:54] == 0)
    assert abs(fit.value[1] - 2.9e-4) < 4 * fit.sigma[1]


def test_a_table_weighs_components_by_their_covariance():
    """A parameter seen only in sum with another takes its part of the sum from the other's own days."""
    days = np.arange(300.0, 340.0)
    generator = np.random.default_rng(3)
    covariance = np.array([[1.0, -0.99], [-0.99, 1.0]])
    noise = generator.multivariate_normal([0, 0], covariance, size=40)
    table = table_of(days, np.array([5.0, 7.0]) + noise, 1.0, ["a", "b"])
    table["covariance"] = (("interval", "parameter", "other"), np.broadcast_to(covariance, (40, 2, 2)))
    fit = fit_trends(equations_of_table(table), {}, np.full(2, 100.0))
    assert fit.covariance[0, 1] < -0.9 * fit.covariance[0, 0]
    both = np.array([1.0, 1.0])
    assert np.sqrt(both @ fit.covariance @ both) < 0.2 * fit.sigma[0]
    assert fit.rms == pytest.approx(1.0, abs=0.2)


def test_the_origin_is_found_early_in_a_mission_and_its_interval_covers_it():
    inside, within = [], []
    for seed in range(60):
        equations = log_table(np.arange(196.0, 700.0, 3), seed)
        origin = fit_origin(equations, {"l": log_at(equations, 100.0)}, SPREAD).origin
        assert origin.determined
        inside.append(abs(origin.mjd - 150.0) < origin.sigma)
        within.append(origin.low < 150.0 < origin.high)
    assert np.mean(within) >= 0.88
    # 60 seeds: 0.68 +- 0.06.
    assert 0.56 <= np.mean(inside) <= 0.80


def test_an_origin_that_a_straight_line_does_without_is_said_not_to_be_determined():
    equations = log_table(np.arange(2000.0, 2100.0))
    fit = fit_origin(equations, {"l": log_at(equations)}, SPREAD)
    assert not fit.origin.determined
    assert fit.origin.low == -np.inf
    assert "NOT DETERMINED" in fit.origin.summary()
    assert float(mjd2000(fit.trends["l"].t0)) == pytest.approx(150.0)


def test_held_out_days_choose_the_law_the_mission_follows():
    days = np.arange(200.0, 2200.0, 4)
    found = compare_trends(log_table(days), ["l"], SPREAD, t0=int(from_mjd2000(150.0)))
    assert found.chosen == "log"
    assert found.rivals[0].rms == pytest.approx(1.0, abs=0.05)
    assert not any(one.tied for one in found.rivals[1:])
    assert "log does best" in found.summary()


@pytest.mark.parametrize("bend", [4e-11, -4e-11])
def test_the_logarithm_is_never_forced_where_a_parabola_is_true(bend):
    days = np.arange(200.0, 2200.0, 4)
    noise = 2e-6 * np.random.default_rng(2).normal(size=days.size)
    value = 1.0 + 1e-7 * days + bend * (days - 1200.0) ** 2 + noise
    equations = equations_of_table(table_of(days, value[:, None], 2e-6, ["l"]))
    found = compare_trends(equations, ["l"], SPREAD, t0=int(from_mjd2000(150.0)))
    assert found.chosen == "parabola"
    behind = {one.kind: one for one in found.rivals}["log"]
    assert behind.behind > 2 * behind.sigma_behind > 0


def test_ties_are_said_and_the_simplest_kind_is_taken():
    noise = np.random.default_rng(7).normal(size=(300, 1))
    equations = equations_of_table(table_of(np.arange(2000.0, 2300.0), noise, 1.0, ["offset"]))
    found = compare_trends(equations, ["offset"], np.full(1, 100.0), t0=int(from_mjd2000(150.0)))
    assert found.chosen == "constant"
    assert "tied" in found.summary()
    assert set(found.table()["kind"].values) == {"constant", "linear", "parabola", "log", "spline"}


def test_ageing_alone_makes_the_published_steps_of_fifteen_days_and_a_trend_makes_none():
    """0.62 nT at MJD 500 and 0.08 at 3000 in 50 000 nT (Yin 2010, figure 3.4)."""
    edges = np.arange(200.0, 3200.0, 15.0)
    table = table_of(edges, np.array([nine_at(day + 7.5) for day in edges]), 1e-9, NINE, width=15.0)
    jumps = table_boundary_steps(table)
    at = mjd2000(jumps.at)
    for day, size in ((500.0, 0.62), (3000.0, 0.08)):
        # The step at a boundary is the ageing from the middle of one interval to the next.
        assert np.interp(day + 7.5, at, jumps.mean) == pytest.approx(size, abs=0.006)
    equations = equations_of_table(table)
    fit = fit_trends(equations, dict.fromkeys(SCALES, log_at(equations)), PRIOR_SIGMA)
    smooth = trend_jumps(lambda times: fit.at(times)[0], jumps.at)
    assert np.abs(smooth.rms).max() < 1e-7


def test_an_offset_steps_by_direction_and_not_on_average():
    value = np.array([nine_at(500.0), nine_at(500.0) + np.array([0] * 8 + [0.3])])
    jumps = table_boundary_steps(table_of(np.array([0.0, 15.0]), value, 1e-9, NINE, width=15.0))
    assert abs(jumps.mean[0]) < 1e-4
    assert jumps.rms[0] == pytest.approx(0.3 * nine_at(500.0)[2] / np.sqrt(3), rel=5e-4)


@pytest.mark.parametrize("kind", ["constant", "linear", "parabola", "log", "spline"])
def test_a_fitted_trend_becomes_an_entry_of_a_model_that_gives_the_same_values(mission, kind):
    times = mission.middle
    trend = make_trend(kind, times, int(from_mjd2000(150.0)) if kind == "log" else None)
    fit = fit_trends(mission, dict.fromkeys(SCALES, trend), PRIOR_SIGMA)
    parameter = VectorSensor.parameters()["scale_factor"]
    timed = fit.to_timed_value("vector_sensor.scale_factor", parameter)
    again = parse_timed("vector_sensor.scale_factor", parameter, timed.as_yaml())
    assert again.time == kind
    assert not again.free
    values = np.broadcast_to(again.at(times), (len(mission), 3))
    np.testing.assert_allclose(values, fit.at(times)[0][:, :3], rtol=1e-12)


def test_too_few_days_and_unknown_names_are_refused_in_words():
    equations = log_table(np.array([300.0, 301.0]))
    with pytest.raises(CalibrationError, match="2 blocks do not tell the 3 coefficients"):
        fit_trends(equations, {"l": make_trend("parabola", equations.middle)}, SPREAD)
    with pytest.raises(CalibrationError, match="no parameter 'm'"):
        fit_trends(equations, {"m": log_at(equations)}, SPREAD)
    with pytest.raises(CalibrationError, match="origin before its first time"):
        make_trend("log", equations.middle, int(from_mjd2000(400.0)))
    with pytest.raises(CalibrationError, match="no 8 folds"):
        compare_trends(equations, ["l"], SPREAD)


def test_an_early_mission_has_its_own_day_numbers():
    assert mjd2000(from_mjd2000(np.array([150.0, 2517.0])))[1] == 2517.0
    assert str(np.datetime64("2000-01-01") + np.timedelta64(150, "D")) == "2000-05-30"
