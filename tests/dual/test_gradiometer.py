"""The gradiometer finds its matrix beside the ambient field, and says how well."""

import numpy as np
import pytest

from inflight.dual import FORMS, Body, Readings
from inflight.dual.geometry import dipole_matrix
from inflight.dual.gradiometer import (
    correction_by_gradiometer,
    fit_forms,
    fit_gradiometer,
    principal_directions,
    wiener_shrink,
)
from inflight.errors import CalibrationError, SettingsError
from inflight.time import SECOND

COUNT = 6000
POSITIONS = np.array([[1.0, 0.0, 0.0], [1.5, 0.0, 0.0]])
BODY = Body(POSITIONS, np.zeros(3), np.full(3, 0.3))
PLACE = np.array([0.1, -0.15, 0.05])


def switching(random, count=COUNT):
    return (np.searchsorted(np.cumsum(random.exponential(120, 200)), np.arange(count)) % 2).astype(float)


def readings_of(seed, matrix, leak=None, noise=0.02, restless=0.02):
    """Three units that switch, with one matrix from difference to outboard sensor."""
    random = np.random.default_rng(seed)
    ambient = np.cumsum(random.normal(0, restless, (COUNT, 3)), axis=0) + np.array([20.0, -5.0, 3.0])
    units = random.normal(0, 2.0, (3, 3))
    difference = np.stack([switching(random) for _ in range(3)], axis=1) @ units
    stray = difference @ matrix.T
    outboard = ambient + stray + random.normal(0, noise, (COUNT, 3))
    inboard = ambient + stray + difference + random.normal(0, noise, (COUNT, 3))
    if leak is not None:
        inboard += ambient @ leak.T
    return Readings(np.arange(COUNT) * SECOND, inboard, outboard), ambient, stray


def test_ratio_of_a_dipole_on_the_boom_is_the_cube_of_the_distances():
    k = (2.0 / 3.0) ** 3
    pulls = []
    for seed in range(8):
        readings, _, _ = readings_of(seed, k / (1 - k) * np.eye(3))
        found = fit_gradiometer(readings, "ratio").facts
        pulls.append((found["ratio"] - k) / found["sigma"])
    assert np.sqrt(np.mean(np.square(pulls))) < 2.0
    assert np.abs(pulls).max() < 4.0


def test_full_matrix_is_found_within_its_sigmas():
    matrix = np.array([[0.5, 0.1, -0.05], [0.0, 0.3, 0.1], [-0.1, 0.05, 0.8]])
    pulls = []
    for seed in range(10, 18):
        found = fit_gradiometer(readings_of(seed, matrix)[0], "matrix")
        pulls.append((found.matrix - matrix).ravel() / np.sqrt(np.diag(found.covariance)))
    assert np.sqrt(np.mean(np.square(pulls))) < 1.5


def test_place_of_one_dipole_is_found():
    readings, _, _ = readings_of(3, dipole_matrix(POSITIONS, PLACE))
    found = fit_gradiometer(readings, "dipole", BODY)
    assert np.abs(found.value - PLACE).max() < 5.0 * np.sqrt(np.diag(found.value_covariance)).max()
    assert np.abs(found.matrix - dipole_matrix(POSITIONS, PLACE)).max() < 0.05


def test_dipole_matrix_on_the_axis_is_the_ratio_of_ness():
    k = (1.0 / 1.5) ** 3
    assert dipole_matrix(POSITIONS, np.zeros(3)) == pytest.approx(k / (1 - k) * np.eye(3), abs=1e-12)


def test_ambient_field_that_leaks_into_the_difference_is_not_taken_for_stray_field():
    leak = np.array([[0.004, 0.01, 0.0], [-0.01, -0.003, 0.005], [0.0, -0.005, 0.002]])
    errors = []
    for seed in range(20, 24):
        readings, _, stray = readings_of(seed, 0.4 * np.eye(3), leak, restless=0.3)
        found = fit_gradiometer(readings, "matrix")
        sigma = np.sqrt(np.diag(found.mixing.leak_covariance)).reshape(3, 3)
        assert np.sqrt(np.mean(((found.leak - leak) / sigma) ** 2)) < 2.0
        blind = fit_gradiometer(readings, "matrix", leak_sigma=0.0)
        both = [correction_by_gradiometer(one, readings).field - stray for one in (found, blind)]
        errors.append([one.std(axis=0).mean() for one in both])
    seeing, blind_error = np.mean(errors, axis=0)
    assert seeing < 0.75 * blind_error


def test_every_form_lowers_the_error():
    readings, ambient, _ = readings_of(5, dipole_matrix(POSITIONS, PLACE))
    raw = (readings.outboard - ambient).std(axis=0).mean()
    for one in fit_forms(readings, FORMS, BODY).values():
        left = correction_by_gradiometer(one, readings).corrected(readings.outboard) - ambient
        assert left.std(axis=0).mean() < 0.5 * raw, one.form


def test_missing_readings_have_no_correction_and_the_rest_has():
    readings, _, _ = readings_of(6, 0.4 * np.eye(3))
    readings.inboard[100:150] = np.nan
    found = correction_by_gradiometer(fit_gradiometer(readings, "axes"), readings)
    assert np.array_equal(found.known, readings.good)
    assert np.isfinite(found.covariance[readings.good]).all()


def test_what_cannot_be_fitted_is_said():
    readings, _, _ = readings_of(7, 0.4 * np.eye(3))
    with pytest.raises(SettingsError, match="choose from"):
        fit_gradiometer(readings, "sphere")
    with pytest.raises(SettingsError, match="positions"):
        fit_gradiometer(readings, "dipole")
    with pytest.raises(CalibrationError, match="100 samples"):
        fit_gradiometer(readings.select(slice(0, 100)))


def test_white_noise_alone_is_not_kept():
    noise = np.random.default_rng(8).normal(0, 0.1, (20_000, 3))
    kept, _ = wiener_shrink(noise, 0.01 * np.eye(3))
    assert kept.std() < 0.3 * noise.std()


def test_a_step_keeps_its_edge_when_noise_is_taken_out():
    step = np.zeros((4000, 3))
    step[2000:] = 5.0
    noisy = step + np.random.default_rng(9).normal(0, 0.1, step.shape)
    kept, variance = wiener_shrink(noisy, 0.01 * np.eye(3))
    away = np.abs(np.arange(4000) - 2000) > 500
    assert np.abs(kept - step)[1990:2010].max() < 0.6
    assert (kept - step)[away].std() < 0.05
    assert variance[2000] > variance[100]


def test_first_principal_direction_is_that_of_the_strongest_unit():
    unit = np.array([1.0, -2.0, 0.5])
    directions = principal_directions(9.0 * np.outer(unit, unit) + 0.1 * np.eye(3), 0.01 * np.eye(3))
    assert abs(directions[0] @ unit) == pytest.approx(
        np.linalg.norm(directions[0]) * np.linalg.norm(unit), rel=1e-3
    )
    assert directions @ (0.01 * np.eye(3)) @ directions.T == pytest.approx(np.eye(3), rel=1e-3, abs=1e-6)


def test_a_leak_that_parts_of_a_record_disagree_on_is_less_sure():
    random = np.random.default_rng(12)
    count = 6000
    ambient = 5.0 * np.cumsum(random.normal(0.0, 0.02, (count, 3)), axis=0)
    noise = random.normal(0.0, 0.02, (2, count, 3))
    sure, unsure = (
        fit_gradiometer(
            Readings(
                np.arange(count) * SECOND,
                ambient * (1.0 + leak[:, None]) + noise[0],
                ambient + noise[1],
            )
        ).mixing
        for leak in (np.full(count, 0.004), np.where(np.arange(count) < count // 2, 0.008, 0.0))
    )
    off = np.diag(sure.leak) - 0.004
    assert np.all(np.abs(off) < 4.0 * np.sqrt(np.diag(sure.leak_covariance)[[0, 4, 8]]))
    assert np.trace(unsure.leak_covariance) > 4.0 * np.trace(sure.leak_covariance)


def test_units_of_other_scales_at_other_places_are_in_the_sigma():
    random = np.random.default_rng(14)
    count, directions = 12_000, np.array([[0.8, 0.5, -0.3], [-0.2, 0.7, 0.7]])
    time = np.arange(count)
    quick = np.sin(2.0 * np.pi * time / 7.0)
    slow = (np.searchsorted(np.cumsum(random.exponential(300.0, 200)), time) % 2).astype(float)
    difference = quick[:, None] * directions[0] + slow[:, None] * directions[1]
    matrices = 0.2 * np.eye(3), 0.5 * np.eye(3)
    stray = quick[:, None] * (matrices[0] @ directions[0]) + slow[:, None] * (matrices[1] @ directions[1])
    ambient = np.cumsum(random.normal(0.0, 0.02, (count, 3)), axis=0)
    noise = random.normal(0.0, 0.01, (2, count, 3))
    readings = Readings(time * SECOND, ambient + stray + difference + noise[0], ambient + stray + noise[1])
    for form in ("ratio", "matrix"):
        found = correction_by_gradiometer(fit_gradiometer(readings, form), readings)
        error = found.field - stray
        error -= error.mean(axis=0)
        assert np.sqrt(np.mean(error**2) / np.mean(found.sigma**2)) < 2.0, form
