"""Stated errors hold in a nature that estimators were not made in: parcels, holes, shocks, trains, gaps."""

import numpy as np
import pytest
from nature import solar_wind
from weather import sheath, wind

from inflight.zero_level import Intervals, OffsetSearch, combine_methods, davis_smith
from inflight.zero_level.combination import weighted_mean
from inflight.zero_level.estimate import Estimate, covariance_of


def pulls(nature, seeds, length):
    found = []
    for seed in seeds:
        offset = np.random.default_rng([seed, 79]).normal(size=3)
        times, field = nature(seed)
        estimate = combine_methods(Intervals.of(times, field + offset, length)).estimate
        if estimate.determined.all():
            found.append((estimate.solution - offset) / estimate.sigma)
    # Of a sheath other offsets in the cube are as likely in some records.
    assert len(found) > 0.7 * len(seeds)
    return np.abs(found)


@pytest.mark.parametrize(("nature", "length", "seeds"), [(wind, 1800.0, 20), (sheath, 300.0, 16)])
def test_sigmas_cover_in_another_nature(nature, length, seeds, record_property):
    size = pulls(nature, range(5000, 5000 + seeds), length)
    record_property("covered", (float(np.mean(size < 1)), float(np.mean(size < 2))))
    # Two thirds and 95 % within what chance makes of some fifty errors, three of each record alike.
    assert 0.55 <= np.mean(size < 1.0) <= 0.90
    assert np.mean(size < 2.0) >= 0.87


def test_few_intervals_with_wide_tails_state_the_error_that_they_make():
    """Means of some numbers of Student's t: with the plain sum of squares 1 sigma is too small by a fifth."""
    generator = np.random.default_rng(1)
    draws = generator.standard_t(3, size=(4000, 14, 3)) / 14.0
    chi2 = [one.sum(axis=0) ** 2 / np.diag(covariance_of(one)) for one in draws]
    plain = [one.sum(axis=0) ** 2 / np.sum(one**2, axis=0) for one in draws]
    assert np.mean(np.array(chi2) < 1.0) == pytest.approx(0.70, abs=0.06)
    assert np.mean(chi2) < np.mean(plain)


def estimate_of(name, influence):
    count = len(influence)
    stamps = np.arange(count)
    return Estimate(
        method=name, solution=influence.sum(axis=0), covariance=covariance_of(influence),
        determined=np.full(3, True), influence=influence, used=np.full(count, True),
        start=stamps, end=stamps + 1, systematic=np.zeros((3, 3)),
    )  # fmt: skip


def test_weights_that_are_estimated_cost_what_the_mean_states():
    """Two methods of equal worth whose covariances are known from twenty intervals each."""
    generator = np.random.default_rng(2)
    chi2 = []
    for _ in range(1500):
        pair = [estimate_of(str(k), generator.normal(size=(20, 3)) / 20.0) for k in range(2)]
        mean = weighted_mean(pair, OffsetSearch())
        chi2.append(mean.solution**2 / np.diag(mean.covariance))
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.25)


def test_an_amplitude_that_wanders_for_hours_is_no_doubt_of_the_offset():
    """All intervals turn; that some turn ten times as much says nothing against any."""
    generator = np.random.default_rng(3)
    times, field = solar_wind(generator, hours=40.0, spread=0.3, compressed=0.02)
    mean = field.mean(axis=0)
    calm = np.where((np.arange(times.size) // 1500) % 2 == 0, 0.3, 1.0)[:, None]
    turned = mean + calm * (field - mean)
    turned *= np.linalg.norm(field, axis=1, keepdims=True) / np.linalg.norm(turned, axis=1, keepdims=True)
    found = davis_smith(Intervals.of(times, turned + np.array([0.7, -1.1, 0.4]), 1800.0))
    assert found.determined.all()
    assert np.all(np.abs(found.solution - [0.7, -1.1, 0.4]) < 4 * found.sigma)
