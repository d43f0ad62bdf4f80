"""What is distributed is a term of its own, of a stated size, and slow."""

import numpy as np
import pytest
from scipy import signal

from inflight.calibration import distribute_residual
from inflight.errors import SamplesError

COUNT = 21_600
SECONDS = np.arange(COUNT)
STAMPS = SECONDS * 10**9
FIELD = np.stack(
    [20_000 * np.cos(SECONDS / 900), 0 * SECONDS + 3000.0, 40_000 * np.sin(SECONDS / 900)], axis=1
)
STRENGTH = np.linalg.norm(FIELD, axis=1)


def wave(period, phase=0.0):
    return np.sin(2 * np.pi * SECONDS / period + phase)


def test_the_strength_changes_by_exactly_what_was_distributed():
    residual = 0.4 * wave(5580) + 0.1 * np.random.default_rng(0).normal(size=COUNT)
    found = distribute_residual(FIELD, residual, STAMPS)
    corrected = FIELD - found.correction
    assert np.abs(np.linalg.norm(corrected, axis=1) - (STRENGTH - found.slow)).max() < 1e-9
    np.testing.assert_allclose(np.cross(corrected, FIELD), 0.0, atol=1e-4)
    np.testing.assert_allclose(found.remaining, residual - found.slow)


@pytest.mark.parametrize("period", [1000.0, 300.0, 160.0, 100.0, 80.0, 60.0, 40.0])
def test_a_wave_leaves_what_the_response_says_without_a_shift_in_time(period):
    found = distribute_residual(FIELD, wave(period), STAMPS)
    inner = ~found.edge
    share = 1.0 / (1.0 + (np.sin(np.pi / period) / np.sin(np.pi / 80.0)) ** 6)
    np.testing.assert_allclose(found.slow[inner], share * wave(period)[inner], atol=2e-3)


def test_no_power_is_left_below_the_edge_of_the_band():
    """From white noise of 0.1 nT and an orbital wave of 0.5 nT: measured rms left in two bands."""
    residual = 0.5 * wave(5580) + 0.1 * np.random.default_rng(1).normal(size=COUNT)
    found = distribute_residual(FIELD, residual, STAMPS)
    frequency, density = signal.periodogram(found.remaining, window="hann")
    slow, edge = (
        np.sqrt(density[(frequency >= 1 / long) & (frequency <= 1 / short)].sum() * frequency[1])
        for long, short in ((5000, 200), (40, 2))
    )
    white = 0.1 * np.sqrt(2 * (1 / 200 - 1 / 5000))
    assert slow < 0.01 * white
    assert edge == pytest.approx(0.1 * np.sqrt(2 * (1 / 2 - 1 / 40)), rel=0.05)


def test_the_size_is_never_hidden():
    found = distribute_residual(FIELD, 0.4 * wave(5580), STAMPS)
    assert found.rms == pytest.approx(0.4 / np.sqrt(2), rel=0.02)
    assert "0.28" in found.summary()
    table = found.table()
    assert float(table["value"].sel(parameter="rms_distributed")) == pytest.approx(found.rms)
    assert set(table["units"].values) == {"nT", "1"}


def test_the_noise_that_passes_is_told_inside_and_at_ends():
    pulls, ends = [], []
    for seed in range(12):
        generator = np.random.default_rng(seed)
        noise = 0.1 * generator.normal(size=3600)
        found = distribute_residual(FIELD[:3600], 0.3 * wave(5580)[:3600] + noise, STAMPS[:3600])
        pull = (found.slow - 0.3 * wave(5580)[:3600]) / found.sigma
        pulls += list(pull[200:-200:40])
        ends += [pull[0], pull[-1], pull[5], pull[-6]]
    assert 0.60 <= np.mean(np.abs(pulls) < 1) <= 0.76
    assert 0.7 < np.std(ends) < 1.4


def test_gaps_are_respected_and_short_stretches_are_left_alone_and_said():
    residual = 0.2 + 0.05 * wave(300)
    residual[5000:5030] = np.nan
    residual[8000:9000] = np.nan
    residual[9100:12_000] = np.nan
    found = distribute_residual(FIELD, residual, STAMPS)
    assert found.valid[5000:5030].all(), "30 s are bridged"
    assert not found.valid[8000:12_000].any(), "100 s between long gaps have no slow part"
    assert np.all(found.correction[8000:12_000] == 0)
    assert found.edge[7999]
    assert found.edge[12_000]
    assert not found.edge[6500]
    np.testing.assert_allclose(found.slow[12_000:12_020], residual[12_000:12_020], atol=2e-3)


def test_a_fast_record_has_the_same_slow_part():
    fast = np.arange(10 * 3600) / 10.0
    residual = 0.3 * np.sin(2 * np.pi * fast / 500)
    field = np.tile(FIELD[0], (fast.size, 1))
    found = distribute_residual(field, residual, (fast * 1e9).astype(np.int64))
    inner = ~found.edge
    np.testing.assert_allclose(found.slow[inner], residual[inner], atol=2e-4)


def test_bad_samples_do_not_enter_the_slow_part():
    residual = 0.2 * wave(5580)
    residual[4000] = 500.0
    good = np.ones(COUNT, dtype=bool)
    good[4000] = False
    found = distribute_residual(FIELD, residual, STAMPS, good)
    assert abs(found.slow[4000] - 0.2 * wave(5580)[4000]) < 1e-3
    assert found.remaining[4000] == pytest.approx(500.0, abs=1)


def test_a_cadence_too_slow_for_the_filter_is_refused():
    stamps = np.arange(100) * 60 * 10**9
    with pytest.raises(SamplesError, match="every 60 s have no low-pass at 80 s"):
        distribute_residual(FIELD[:100], np.zeros(100), stamps)
    with pytest.raises(SamplesError, match="do not rise"):
        distribute_residual(FIELD[:3], np.zeros(3), np.array([0, 2, 1]) * 10**9)
