"""Synthetic turns keep what stands still in the body and lose what changes outside."""

import numpy as np
import pytest
import xarray as xr

from inflight.errors import SamplesError
from inflight.samples import Folding, fold_series, fold_spins
from inflight.samples.spin_folding import fourier_sums
from inflight.time import SECOND, day_bounds

DAY = np.datetime64("2012-03-02")
SPAN = day_bounds(DAY)
PERIOD = 3.0137


def turning(body=(0.0, 0.0, 0.0), outside=None, cadence=0.25, keep=None):
    """Readings of a perfect sensor that turns, with a field that stands still in the body."""
    stamps = SPAN[0] + np.arange(0, 86_400 * SECOND, round(cadence * SECOND), dtype=np.int64)
    seconds = (stamps - SPAN[0]) / SECOND
    phase = 2.0 * np.pi * seconds / PERIOD + 0.3 * np.sin(seconds / 9e3)
    field = outside(seconds) if outside else np.tile([30.0, -20.0, 45.0], (stamps.size, 1))
    c, s = np.cos(phase), np.sin(phase)
    x, y, z = field.T
    reading = np.column_stack([c * x + s * y, c * y - s * x, z])
    reading = reading + (body(phase) if callable(body) else np.asarray(body))
    samples = xr.Dataset(
        {
            "vector": (("time", "axis"), reading, {"units": "nT"}),
            "spin_phase": ("time", phase),
            "flag": ("time", np.zeros(stamps.size, dtype=np.uint32)),
            "tt2000": ("time", stamps),
            "current": ("time", np.cos(phase + 0.4) + 5.0),
        }
    )
    return samples if keep is None else samples.isel(time=keep(stamps.size))


def changing(seconds):
    """A field of thousands of nT that turns and grows by parts in minutes, as at perigee."""
    size = 4000.0 * (1.5 + np.sin(seconds / 1500.0))
    return np.column_stack([size * np.cos(seconds / 2000.0), size * np.sin(seconds / 2700.0), 0.4 * size])


def tone_of(samples, value):
    return np.nanmax(np.abs(samples - value), axis=0)


def test_a_body_field_comes_through_unchanged():
    folded = fold_spins(turning((3.0, -4.0, 1.5)), Folding.of_period(round(PERIOD * SECOND)), SPAN)
    plain = fold_spins(turning(), Folding.of_period(round(PERIOD * SECOND)), SPAN)
    assert tone_of(folded["vector"].values - plain["vector"].values, [3.0, -4.0, 1.5]).max() < 1e-9
    assert folded.sizes["time"] == 288 * 12


def test_harmonics_of_the_body_come_through_up_to_the_fourth():
    def shape(phase):
        return np.column_stack([np.cos(4 * phase), np.sin(3 * phase), np.cos(2 * phase)])

    folding = Folding.of_period(round(PERIOD * SECOND))
    folded = fold_spins(turning(shape), folding, SPAN)
    plain = fold_spins(turning(), folding, SPAN)
    expected = np.tile(shape(folding.phases), (288, 1))
    off = np.abs(folded["vector"].values - plain["vector"].values - expected)
    # A turn's own fit stops at the second: what is above leaks a little into the means of turns.
    assert np.nanmax(off) < 2e-3
    assert np.nanmedian(off) < 1e-4


def test_a_field_that_changes_outside_leaves_no_tone():
    folding = Folding.of_period(round(PERIOD * SECOND))
    folded = fold_spins(turning(outside=changing), folding, SPAN)
    steady = folding.steady(
        folded["vector"].values,
        folded["spin_phase"].values,
        folded["tt2000"].values,
        np.isfinite(folded["vector"].values).all(axis=1),
    )
    assert np.nanmax(np.abs(folded["vector"].values - steady)) < 2e-3


def test_gaps_and_one_missing_reading_do_no_harm():
    generator = np.random.default_rng(3)

    def some(count):
        kept = generator.random(count) > 0.2
        kept[count // 3 : count // 3 + 5000] = False
        return np.flatnonzero(kept)

    samples = turning((3.0, -4.0, 1.5), outside=changing, keep=some)
    samples["vector"][777, 1] = np.nan
    folding = Folding.of_period(round(PERIOD * SECOND))
    folded = fold_spins(samples, folding, SPAN)
    lost = np.isnan(folded["vector"].values).any(axis=1)
    assert 12 * 3 <= lost.sum() <= 12 * 7
    assert np.all(folded["weight"].values[lost] == 0)
    assert np.all(folded["flag"].values[lost] != 0)
    whole = fold_spins(turning((0.0, 0.0, 0.0), outside=changing), folding, SPAN)
    off = folded["vector"].values - whole["vector"].values
    # Intervals with a gap have another mean of the field outside: their tones are compared.
    per = off[~lost].reshape(-1, 12, 3)
    left = np.median(np.abs(per[:, :, 2] - per[:, :, 2].mean(axis=1, keepdims=True)))
    # A fifth of the samples lost at random in a field of 10 000 nT that changes by 3 nT/s: a millionth.
    assert left < 1e-6 * 10_000


def test_a_channel_that_goes_with_the_spin_is_folded_with_it():
    samples = turning()
    folding = Folding.of_period(round(PERIOD * SECOND))
    folded = fold_spins(samples, folding, SPAN)
    expected = np.tile(np.cos(folding.phases + 0.4) + 5.0, 288)
    np.testing.assert_allclose(folded["current"].values, expected, atol=1e-9)
    alone = fold_series(
        samples["current"].values, samples["tt2000"].values, samples["spin_phase"].values, folding, SPAN
    )
    np.testing.assert_allclose(alone, expected, atol=1e-9)


def test_noise_tells_what_nature_leaves():
    generator = np.random.default_rng(1)
    samples = turning()
    samples["vector"] = samples["vector"] + 0.5 * generator.standard_normal(samples["vector"].shape)
    folding = Folding.of_period(round(PERIOD * SECOND))
    folded = fold_spins(samples, folding, SPAN)
    both = np.column_stack(
        [
            folded["vector"].values[:, 2],
            np.hypot(folded["vector"].values[:, 0], folded["vector"].values[:, 1]),
        ]
    )
    good = np.isfinite(both).all(axis=1)
    rows = folding.keep(both, folded["tt2000"].values, good)
    # White noise has as much in the higher harmonics as in the first; nature's falls.
    assert 0.6 < np.median(folded["noise"].values) / np.sqrt(np.mean(rows**2)) < 1.1


def test_intervals_divide_a_day_and_samples_stand_evenly():
    for period in (1.0, 2.5871, 3.0137, 4.0, 20.0):
        folding = Folding.of_period(round(period * SECOND))
        assert 86_400 * SECOND % folding.interval_ns == 0
        assert folding.interval_ns % folding.sectors == 0
        assert 0.5 < folding.interval_ns / SECOND / (100 * period) < 2.0


def test_without_a_phase_nothing_is_folded():
    with pytest.raises(SamplesError, match="phase"):
        fold_spins(turning().drop_vars("spin_phase"), Folding.of_period(3 * SECOND), SPAN)


def test_sums_are_least_squares_and_missing_where_samples_do_not_tell_them():
    """An unbroken turn, half of one, samples that lie together, and too few."""
    around = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    phases = [around, around[:9], 1.0 + 1e-5 * np.arange(6), around[:4]]
    group = np.repeat(np.arange(4), [len(one) for one in phases])
    phase = np.concatenate(phases)
    values = np.random.default_rng(1).normal(size=(phase.size, 2)) + 0j
    sums = fourier_sums(values, phase, group, 4, 2, np.ones(phase.size, dtype=bool))
    found = sums.coefficients
    waves = np.exp(1j * phase[:, None] * np.arange(-2, 3))
    for one in range(2):
        part = group == one
        known = np.linalg.lstsq(waves[part], values[part])[0]
        assert np.allclose(found[one], known, rtol=1e-9, atol=1e-9)
        assert np.allclose(sums.at(phase[part])[one], waves[part] @ known)
        assert np.allclose(sums.along(phase, group)[part], waves[part] @ known)
    assert np.isnan(found[2:]).all()
