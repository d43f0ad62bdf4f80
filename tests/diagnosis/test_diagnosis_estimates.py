"""Values of what a search takes, their errors, and what the calibration takes over."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from diagnosis_cases import NOISE_NT, POLAR, STEP_S, case_of, dipole, flight_of, read, spun
from scipy.signal import lfilter

from inflight.design import design_matrix
from inflight.diagnosis import Search
from inflight.diagnosis.stepwise import (
    Estimate,
    calibration_shifts,
    detectable_amplitude,
    estimate,
    form_disagreement,
)

TRUTH = np.array([0.5, -0.4, -0.8])
SEEDS, EVERY, DAYS = 200, 3, 40


def slow(generator, count, shape, memory_s=1800.0):
    phi = np.exp(-STEP_S / memory_s)
    return lfilter([np.sqrt(1 - phi**2)], [1.0, -phi], generator.normal(size=(count, shape)), axis=0)


@lru_cache(maxsize=1)
def hidden():
    """A heater's field in 200 noises that are slow inside blocks: the case, and a search of all."""
    flight = flight_of(POLAR, DAYS)
    g = np.random.default_rng(11)
    count = flight.tt2000.size
    noise = g.normal(0, NOISE_NT, (count, SEEDS)) + 0.1 * slow(g, count, SEEDS)
    field = flight["heater_current"][:, None] * TRUTH
    noise += flight.along(field)[:, None]
    case = case_of(
        flight, [read(flight)], noise, every=EVERY, channels=("heater_current", "boom_temperature")
    )
    search = case.search()
    # The same search, of all residuals.
    every = Search.begin(
        case.raw,
        case.white,
        search.library,
        search.intervals,
        search.shared.days,
        time_variable=search.time_variable,
    )
    return case, every


def option_of(search, name):
    return next(one for one in search.options if one.name == name)


def estimates_of(search, name):
    option = option_of(search, name)
    out = []
    for residual in range(1, SEEDS + 1):
        out.append(estimate(replace(search, residual=residual, accepted=(option,)), option))
    return out


@lru_cache(maxsize=1)
def found():
    return estimates_of(hidden()[1], "channel_field(heater_current)")


def test_coefficients_of_either_sign_are_recovered():
    values = np.array([one.value for one in found()])
    sigma = np.array([one.sigma for one in found()])
    mean, error = values.mean(axis=0), values.std(axis=0) / np.sqrt(SEEDS)
    assert np.all(np.abs(mean - TRUTH) < 4 * error + 0.002)
    assert np.all(np.abs(values - TRUTH) < 6 * sigma)


def test_one_sigma_holds_for_two_thirds_of_the_noises():
    inside = np.array([np.abs(one.value - TRUTH) < one.sigma for one in found()])
    assert 0.60 <= inside.mean() <= 0.76
    assert np.all((inside.mean(axis=0) > 0.55) & (inside.mean(axis=0) < 0.80))


def test_covariances_belong_to_the_errors():
    for one in found()[:5]:
        np.testing.assert_allclose(np.sqrt(np.diag(one.covariance)), one.sigma, rtol=1e-12)
        assert np.all(np.linalg.eigvalsh(one.covariance) > 0)


def test_raw_and_within_day_values_of_the_right_effect_agree():
    search = hidden()[1]
    option = option_of(search, "channel_field(heater_current)")
    told = []
    for residual in range(1, 60):
        told.append(form_disagreement(replace(search, residual=residual, accepted=(option,)), option))
    assert np.median(told) < 2.0


def test_what_is_detectable_is_three_times_the_error():
    search = hidden()[1]
    option = option_of(search, "channel_field(heater_current)")
    other = replace(search, residual=1)
    np.testing.assert_allclose(detectable_amplitude(other, option), 3 * found()[0].sigma, rtol=1e-9)


def columns_of(case, keys):
    terms = {term.key: term for term in case.library.all_terms}
    base = case.library.base if keys == "base" else [terms[key] for key in keys]
    return design_matrix(base, case.rows)[::EVERY, 0]


def test_the_retained_part_is_that_of_a_regression_of_the_rows():
    case, search = hidden()
    option = option_of(search, "channel_field(heater_current)")
    one = found()[0]
    scale = search.raw.scale[search.raw.index(option.columns)]
    nine, own = columns_of(case, "base"), columns_of(case, option.terms)
    contribution = own @ (one.value / scale)
    # Of its own: about a constant channel, which is a constant field and so an offset of the calibration.
    constant = -case.rows.directions["fgm"][::EVERY, 0]
    mean = [c @ k / (k @ k) for c, k in zip(own.T, constant.T, strict=True)]
    whole = (own - constant * np.array(mean)) @ (one.value / scale)
    rows = np.repeat(np.arange(len(search.raw)), len(own) // len(search.raw))
    left = contribution.copy()
    for group in search.intervals:
        inside = np.isin(rows, group)
        left[inside] -= nine[inside] @ np.linalg.lstsq(nine[inside], contribution[inside], rcond=None)[0]
    assert one.retained == pytest.approx((left @ left) / (whole @ whole), rel=0.02)
    assert one.rms == pytest.approx(np.sqrt(np.mean(left**2)), rel=0.01)
    assert one.retained > 0.9


def mimicked(name, size):
    """Return shifts of the nine parameters, physical units, and which part of the effect is retained."""
    search = replace(hidden()[1], accepted=(), rounds=())
    option = option_of(search, name)
    form = search.forms["raw"]
    (own,), (left,) = search.raw.index(option.columns), form.index(option.columns)
    retained = form.total[left, left] / search.raw.total[own, own]
    return dict(calibration_shifts(search, option, np.array([size]))), float(retained)


def fitted_shift(case, change):
    """Return by how much the nine parameters move to meet a change of the residual; physical units."""
    nine = columns_of(case, "base")
    scale = np.array([one for term in case.library.base for one in term.scale])
    return np.linalg.lstsq(nine, -change[::EVERY], rcond=None)[0] * scale


def test_an_ignored_lag_of_12_ms_passes_for_an_angle_of_some_arc_seconds():
    case, _ = hidden()
    shifts, kept = mimicked("time_shift", 0.012)
    angle = shifts["vector_sensor.misalignment[xz]"] * 3600.0
    assert 2.0 < abs(angle) < 7.0
    assert abs(angle) > 3 * abs(shifts["vector_sensor.misalignment[xy]"] * 3600.0)
    assert kept < 0.5
    # The same of a scalar sensor that really reads early: F(t - 12 ms), by the orbit itself.
    seconds = STEP_S * (np.arange(case.flight.tt2000.size) + 0.5)

    def strength(at):
        position = spun(case.flight.orbit.at(at)[0], np.pi + 2 * np.pi * at / 86_400.0)
        return np.linalg.norm(dipole(position), axis=1)

    early = strength(seconds - 0.012) - strength(seconds)
    real = dict(zip(shifts, fitted_shift(case, -early), strict=True))
    assert real["vector_sensor.misalignment[xz]"] * 3600.0 == pytest.approx(angle, rel=0.02)


def test_an_ignored_bias_of_400_pt_passes_for_scale_factors():
    case, _ = hidden()
    shifts, kept = mimicked("scalar_bias", 0.4)
    ppm = 1e6 * np.array([shifts[f"vector_sensor.scale_factor[{axis}]"] for axis in "xyz"])
    assert np.all(np.abs(ppm) > 3.0)
    assert np.all(np.abs(ppm) < 40.0)
    assert kept < 0.02
    real = fitted_shift(case, np.full(case.flight.tt2000.size, -0.4))
    np.testing.assert_allclose(list(shifts.values()), real, rtol=1e-5)


def test_sigmas_of_an_estimate_reach_as_far_as_another_of_the_same_data():
    one = Estimate(
        columns=("a", "b"),
        value=np.array([1.0, 2.0]),
        sigma=np.array([0.1, 0.5]),
        covariance=np.diag([0.01, 0.25]),
        retained=0.9,
        rms=0.1,
    )
    other = replace(one, value=np.array([1.4, 2.2]))
    told = one.covering(other)
    np.testing.assert_allclose(told.value, one.value)
    np.testing.assert_allclose(told.sigma, [0.4, 0.5])
    np.testing.assert_allclose(np.sqrt(np.diag(told.covariance)), told.sigma)
