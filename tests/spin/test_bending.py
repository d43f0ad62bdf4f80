"""Bending of the boom from two magnetometers on it."""

import numpy as np
import pytest
from farrell_cases import READINGS, natural, phase_of, stamps_of

from inflight.errors import CalibrationError, SamplesError
from inflight.spin import SensorAngles, fit_spins, measure_boom_bending, respin

MEAN = [3.0, -2.5, 3.0]


def both(seed, bend, *, spins=600, noise=0.02):
    """Fits of the outer and the inner triad; `bend` is one angle or one a sample."""
    rng = np.random.default_rng(seed)
    phase = phase_of(spins * READINGS)
    field = natural(rng, phase.size, MEAN)
    stamps = stamps_of(phase.size)
    seen = [respin(field, phase + turned) for turned in (bend, 0.0)]
    return [fit_spins(stamps, one + noise * rng.standard_normal(one.shape), phase) for one in seen]


@pytest.mark.parametrize("bend", [0.02, -0.02])
def test_a_bend_of_either_sign_is_found_within_its_sigma(bend):
    pulls = []
    for seed in range(40):
        found = measure_boom_bending(*both(seed, bend))
        pulls.append((found.value[0] - bend) / found.sigma[0])
        assert found.sigma[0] < 5e-4
    assert 0.55 < np.mean(np.abs(pulls) < 1) < 0.81


@pytest.mark.parametrize("bend", [0.02, -0.02])
def test_a_bent_boom_is_a_common_azimuth_of_both_sensors(bend):
    """The reading needs B1 - dph B2 and B2 + dph B1: (32) has the wrong sign, (33) the right one."""
    phase = phase_of(240)
    field = respin(np.tile(MEAN, (240, 1)), phase)
    bent = SensorAngles(azimuth=np.full(2, bend)).disturb(field)
    np.testing.assert_allclose(bent, respin(np.tile(MEAN, (240, 1)), phase + bend), atol=1e-12)
    left = np.abs(bent[:, 0] - bend * bent[:, 1] - field[:, 0]).max()
    printed = np.abs(bent[:, 0] + bend * bent[:, 1] - field[:, 0]).max()
    assert left < 0.05 * printed
    assert np.abs(bent[:, 1] + bend * bent[:, 0] - field[:, 1]).max() < 0.05 * printed


def test_windows_follow_a_boom_that_bends_and_lies_back():
    phase = phase_of(1200 * READINGS)
    bend = 0.01 * np.sin(phase / phase[-1] * 2 * np.pi)
    found = measure_boom_bending(*both(0, bend, spins=1200), window=0.004, mounted=0.005)
    middle = (found.time - stamps_of(1)[0]) / (stamps_of(phase.size)[-1])
    # Within a window the boom moves by up to 0.006.
    np.testing.assert_allclose(found.value, 0.01 * np.sin(2 * np.pi * middle) - 0.005, atol=1.5e-3)
    assert found.fits.sum() == 1200


def test_different_fits_and_too_few_are_refused():
    outer, inner = both(0, 0.0, spins=30)
    with pytest.raises(CalibrationError, match="5 spins have fits of both"):
        measure_boom_bending(outer.select(outer.turn < 15), inner.select(inner.turn >= 10))
    with pytest.raises(CalibrationError, match="take longer windows"):
        measure_boom_bending(outer, inner, window=1e-4)
    phase = phase_of(30 * READINGS)
    double = fit_spins(stamps_of(phase.size), respin(np.tile(MEAN, (phase.size, 1)), phase), phase, spins=2)
    with pytest.raises(SamplesError, match="fits of 1 and of 2 spins"):
        measure_boom_bending(outer, double)
