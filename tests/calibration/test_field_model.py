"""Twelve parameters against a field model: recovered, what they mean, and whether their errors cover."""

import numpy as np
import scipy

from inflight.calibration import comparison_grams, field_variance, fit_twelve, mounting
from inflight.effects import VectorSensor

#: What nobody knows of a sensor before it flew.
PRIOR = np.concatenate([np.eye(3).ravel(), np.zeros(3)]), np.concatenate([np.full(9, 0.1), np.full(3, 1e4)])


def flight(count=3000):
    """The field of a tilted dipole along some polar orbits, and Earth-fixed axes in a nadir frame."""
    orbits = np.linspace(0.0, 15.0, count)
    angle, turned = 2 * np.pi * orbits, 2 * np.pi * orbits / 15.0
    up = np.stack([np.cos(angle) * np.cos(turned), np.cos(angle) * np.sin(turned), np.sin(angle)], axis=1)
    ahead = np.stack(
        [-np.sin(angle) * np.cos(turned), -np.sin(angle) * np.sin(turned), np.cos(angle)], axis=1
    )
    axes = np.stack([ahead, np.cross(-up, ahead), -up], axis=1)
    pole = np.array([np.sin(0.2), 0.0, -np.cos(0.2)])
    earth = 26_000.0 * (3.0 * (up @ pole)[:, None] * up - pole)
    return np.einsum("tab,tb->ta", axes, earth), axes


def reading_of(field, matrix, shift):
    return (field - shift) @ np.linalg.inv(matrix).T


def test_what_a_sensor_is_comes_back_from_the_twelve_parameters():
    upper = np.array(
        [[1.02, np.cos(np.deg2rad(89.7)), np.cos(np.deg2rad(90.2))], [0, 0.97, 0.004], [0, 0, 1.01]]
    )
    rotation = scipy.spatial.transform.Rotation.from_rotvec([0.4, -0.3, 1.2], degrees=True).as_matrix()
    matrix, offset = rotation @ upper, np.array([120.0, -40.0, 300.0])
    field, axes = flight()
    reading = reading_of(field, matrix, -matrix @ offset)
    grams = comparison_grams(reading, field, axes, np.ones(len(field), bool), PRIOR)
    found, _ = mounting(fit_twelve(grams, *PRIOR).value, np.eye(12) * 1e-12)
    expected = [1.02, 0.97, 1.01, 89.7, 90.2, np.rad2deg(np.arccos(0.004)), 0.4, -0.3, 1.2, *offset]
    np.testing.assert_allclose(list(found.values()), expected, rtol=1e-6, atol=1e-5)
    # Scale factors, angles and offsets mean what they mean in the model of a sensor beside a scalar one.
    values = {
        "scale_factor": np.array(expected[:3]),
        "misalignment": np.array(expected[3:6]),
        "offset": offset,
    }
    calibrated = VectorSensor().correct(reading, None, values, None)
    np.testing.assert_allclose(calibrated @ rotation.T, field, atol=1e-6)


def test_disturbed_passes_have_no_weight():
    field, axes = flight()
    reading, aurora = reading_of(field, np.eye(3), np.zeros(3)), np.arange(len(field)) % 40 < 3
    noise = np.random.default_rng(1).normal(size=field.shape)
    seen = field + noise + 400.0 * aurora[:, None]
    good = np.ones(len(field), bool)
    found = fit_twelve(comparison_grams(reading, seen, axes, good, PRIOR), *PRIOR)
    assert np.abs(found.value[9:]).max() < 1.0


def test_errors_cover_a_field_that_the_model_lacks():
    """Slow fields of single passes and one that stays, both unknown: 50 seeds, twelve parameters each."""
    field, axes = flight()
    good, seeds, matrix = np.ones(len(field), bool), 50, np.eye(3) + 0.01
    reading, pulls = reading_of(field, matrix, np.full(3, 50.0)), []
    truth = np.concatenate([matrix.ravel(), np.full(3, 50.0)])
    for seed in range(seeds):
        g = np.random.default_rng(seed)
        slow = scipy.ndimage.gaussian_filter1d(g.normal(size=field.shape), 40.0, axis=0)
        slow *= 8.0 / slow.std()
        steady = axes @ g.normal(scale=20.0, size=3)
        # What is there is the model's field and what the model lacks.
        seen = comparison_grams(reading, field - slow - steady, axes, good, PRIOR)
        found = fit_twelve(seen, *PRIOR, external_nT=20.0)
        pulls.append((found.value - truth) / np.sqrt(np.diag(found.covariance)))
    within = np.mean(np.abs(pulls) < 1.0), np.mean(np.abs(pulls) < 2.0)
    # The twelve of one seed share its fields: some two hundred counts are independent.
    assert 0.6 < within[0] < 0.85
    assert within[1] > 0.9
    # Without the field that stays, errors would be several times too small.
    alone = fit_twelve(seen, *PRIOR)
    assert np.sqrt(np.diag(alone.covariance))[8] < 0.5 * np.sqrt(np.diag(found.covariance))[8]


def test_what_the_data_do_not_tell_stays_with_what_was_known():
    field, axes = flight()
    field[:, 1] = 0.0
    prior = PRIOR[0], np.where(np.arange(12) < 9, 0.01, 100.0)
    found = fit_twelve(comparison_grams(field, field, axes, np.ones(len(field), bool), prior), *prior)
    unknown = [1, 4, 7]  # what the middle component of the reading makes
    assert not found.determined[unknown].any()
    assert found.determined[[0, 2, 6, 8, 9, 10, 11]].all()
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance))[unknown], 0.01, rtol=0.2)


def test_no_usable_sample_is_told_by_nothing_determined():
    field, axes = flight(200)
    found = fit_twelve(comparison_grams(field, field, axes, np.zeros(200, bool), PRIOR), *PRIOR)
    assert found.count == 0
    assert not found.determined.any()


def test_a_delay_moves_the_twelve_and_the_field_by_what_is_stated():
    field, axes = flight()
    seconds, good = 30.0 * np.arange(len(field)), np.ones(len(field), bool)
    rate = np.gradient(field, seconds, axis=0)
    seen, late = (
        fit_twelve(comparison_grams(reading, field, axes, good, PRIOR, rate=rate), *PRIOR, late_s=0.5)
        for reading in (field, field + 0.5 * rate)
    )
    moved = late.value - seen.value
    np.testing.assert_allclose(moved, seen.late, rtol=0.02, atol=0.01 * np.abs(seen.late[:9]).max())
    error = (field + 0.5 * rate) @ late.value[:9].reshape(3, 3).T + late.value[9:] - field
    sigma = np.sqrt(field_variance(field, seen.covariance, 0.0, seen.late, 0.5 * rate))
    # The turn of the field in the axes of a spacecraft is a turn of the axes: most of it is made good.
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.sqrt(np.mean((0.5 * rate) ** 2))
    np.testing.assert_allclose(
        np.sqrt(np.mean(sigma**2, axis=0)), np.sqrt(np.mean(error**2, axis=0)), rtol=0.1
    )
