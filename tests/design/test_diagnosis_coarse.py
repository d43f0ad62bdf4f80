"""From native samples to bins: linear statements survive, spikes do not, effects do."""

import numpy as np
import pytest
import xarray as xr

from inflight.design import bin_channel, bin_edges, bin_means, bridge_gaps, coarsen
from inflight.design.columns import find_spikes
from inflight.effects import field_strength
from inflight.effects.sensors import field_strength_rate
from inflight.model import ResidualRows
from inflight.time import SECOND

START = 700_000_000 * SECOND


def stamps_of(count, step_s=1.0):
    return START + (np.arange(count) * step_s * SECOND).astype(np.int64)


def test_the_grid_covers_the_span_and_no_more_than_a_bin():
    edges = bin_edges(START, START + 95 * SECOND, 10 * SECOND)
    assert (edges[0], edges.size) == (START, 11)
    assert edges[-2] < START + 95 * SECOND <= edges[-1]


def test_means_of_bins_keep_linear_statements():
    """A residual that is a combination of columns is the same combination after binning, gaps or not."""
    g = np.random.default_rng(0)
    columns, values = g.normal(size=(1000, 4)), np.array([1.0, -2.0, 0.5, 3.0])
    good = g.random(1000) > 0.3
    good[200:260] = False
    edges = bin_edges(START, START + 1000 * SECOND, 20 * SECOND)
    stamps = stamps_of(1000)
    binned, count = bin_means(columns, stamps, edges, good)
    residual, _ = bin_means(columns @ values, stamps, edges, good)
    np.testing.assert_allclose(residual, binned @ values, atol=1e-12)
    assert count.sum() == good.sum()
    np.testing.assert_array_equal(np.isnan(residual), count == 0)
    assert (count == 0).sum() == 3


@pytest.mark.parametrize("offset", [0.0, 0.4])
def test_a_bin_of_one_sample_is_that_sample(offset):
    g = np.random.default_rng(2)
    values, good = g.normal(size=(500, 3)), g.random(500) > 0.1
    stamps = stamps_of(500) + int(offset * SECOND)
    # Some bins have no sample at all.
    there = g.random(500) > 0.2
    edges = bin_edges(START, START + 500 * SECOND, SECOND)
    mean, count = bin_means(values[there], stamps[there], edges, good[there])
    held = there & good
    np.testing.assert_array_equal(count, held * 1.0)
    np.testing.assert_array_equal(mean[held], values[held])
    assert np.isnan(mean[~held]).all()


def test_samples_outside_the_bins_are_left_out():
    edges = bin_edges(START, START + 20 * SECOND, 10 * SECOND)
    mean, count = bin_means(np.arange(60.0), stamps_of(60) - 10 * SECOND, edges, np.ones(60, dtype=bool))
    np.testing.assert_array_equal(count, [10, 10])
    np.testing.assert_allclose(mean, [14.5, 24.5])


def test_bins_of_one_sample_leave_out_what_is_outside_them_and_take_every_sample_inside():
    values, good = np.arange(60.0).reshape(20, 3), np.arange(20) != 7
    edges = bin_edges(START, START + 20 * SECOND, SECOND)
    mean, count = bin_means(values, stamps_of(20), edges, good)
    np.testing.assert_array_equal(mean, np.where(good[:, None], values, np.nan))
    np.testing.assert_array_equal(count, good * 1.0)
    mean, count = bin_means(values, stamps_of(20) - 5 * SECOND, edges, good)
    np.testing.assert_array_equal(mean[:15], np.where(good[5:, None], values[5:], np.nan))
    np.testing.assert_array_equal(count, [*(good[5:] * 1.0), *np.zeros(5)])


def quiet(seed=1, count=3000):
    return np.random.default_rng(seed).normal(0, 0.1, (count, 1))


@pytest.mark.parametrize("size", [2.0, -2.0, 500.0])
def test_a_single_wild_sample_is_a_spike(size):
    residual = quiet()
    residual[[700, 2200]] += size
    assert np.flatnonzero(find_spikes(residual)).tolist() == [700, 2200]


def test_two_wild_samples_beside_each_other_are_spikes():
    residual = quiet()
    residual[1500:1502] += 40.0
    assert find_spikes(residual)[1500:1502].all()


@pytest.mark.parametrize("size", [20.0, -0.5])
def test_a_step_is_no_spike(size):
    residual = quiet()
    residual[1234:] += size
    assert not find_spikes(residual).any()


def test_a_slow_effect_of_20_nt_is_no_spike():
    residual = quiet() + 20.0 * np.sin(2 * np.pi * np.arange(3000) / 300)[:, None]
    assert not find_spikes(residual).any()


def test_a_switch_of_20_nt_is_no_spike():
    residual = quiet() + 20.0 * (np.arange(3000) // 50 % 2)[:, None]
    assert not find_spikes(residual).any()


def test_a_lively_hour_is_no_series_of_spikes_but_a_wild_sample_in_it_is():
    residual = quiet()
    residual[1000:1400] *= 12.0
    assert find_spikes(residual).sum() <= 2
    residual[1200] += 60.0
    assert find_spikes(residual)[1200]


def test_missing_samples_are_no_spikes():
    residual = quiet()
    residual[100:130] = np.nan
    residual[500] = 9.0
    assert np.flatnonzero(find_spikes(residual)).tolist() == [500]


def test_a_record_too_short_has_no_spikes():
    assert not find_spikes(np.array([[0.0], [99.0], [0.0]])).any()


def test_a_faster_channel_is_averaged():
    edges = bin_edges(START, START + 600 * SECOND, 60 * SECOND)
    stamps = stamps_of(600)
    values = np.arange(600.0)
    on = bin_channel(values, stamps, edges, SECOND)
    np.testing.assert_allclose(on, 29.5 + 60 * np.arange(10))


def test_a_slower_channel_is_a_straight_line_between_its_readings():
    edges = bin_edges(START, START + 600 * SECOND, 10 * SECOND)
    stamps = stamps_of(11, 60.0)
    on = bin_channel(3.0 * np.arange(11), stamps, edges, 60 * SECOND)
    centre = (edges[:-1] - START) / SECOND + 5.0
    np.testing.assert_allclose(on, 3.0 * centre / 60.0, atol=1e-12)


def test_a_slower_channel_of_three_components_keeps_them():
    edges = bin_edges(START, START + 600 * SECOND, 10 * SECOND)
    values = np.stack([np.arange(11.0), np.ones(11), -np.arange(11.0)], axis=1)
    on = bin_channel(values, stamps_of(11, 60.0), edges, 60 * SECOND)
    assert on.shape == (60, 3)
    np.testing.assert_allclose(on[:, 0], -on[:, 2])
    np.testing.assert_allclose(on[:, 1], 1.0)


def test_a_short_gap_is_bridged_and_a_long_one_is_not():
    edges = bin_edges(START, START + 6000 * SECOND, 60 * SECOND)
    stamps, values = stamps_of(6000), np.arange(6000.0)
    values[600:900] = np.nan
    values[3000:4200] = np.nan
    on = bin_channel(values, stamps, edges, SECOND)
    np.testing.assert_allclose(on[10:15], 29.5 + 60 * np.arange(10, 15))
    assert np.isnan(on[50:70]).all()
    assert np.isfinite(np.delete(on, range(50, 70))).all()


def test_a_slower_channel_is_not_drawn_across_its_gaps():
    stamps, values = stamps_of(60, 60.0), np.arange(60.0)
    values[20:40] = np.nan
    edges = bin_edges(START, START + 3600 * SECOND, 10 * SECOND)
    on = bin_channel(values, stamps, edges, 60 * SECOND)
    inside = (edges[:-1] > stamps[22]) & (edges[:-1] < stamps[37])
    assert np.isnan(on[inside]).all()
    assert np.isfinite(on[edges[:-1] < stamps[19]]).all()


def test_a_channel_that_says_nothing_is_missing_everywhere():
    edges = bin_edges(START, START + 600 * SECOND, 60 * SECOND)
    assert np.isnan(bin_channel(np.full(600, np.nan), stamps_of(600), edges, SECOND)).all()


def test_ends_are_not_bridged():
    values = np.array([np.nan, 1.0, np.nan, 3.0, np.nan])
    np.testing.assert_array_equal(bridge_gaps(values), [np.nan, 1.0, 2.0, 3.0, np.nan])


def coarse(residual, good=None, step=10, field=None):
    count = len(residual)
    field = np.tile([20_000.0, -3_000.0, 40_000.0], (count, 1)) if field is None else field
    samples = xr.Dataset(
        {
            "tt2000": ("time", stamps_of(count)),
            "vector": (("time", "axis"), field),
            "scalar": ("time", np.linalg.norm(field, axis=1)),
        }
    )
    unit = (field / np.linalg.norm(field, axis=1, keepdims=True))[:, None, :]
    good = np.ones(count, dtype=bool) if good is None else good
    rows = ResidualRows(
        residual=residual, directions={"fgm": unit}, fields={"fgm": field}, field=field, good=good, step_s=1.0
    )
    return coarsen(samples, rows, bin_edges(START, START + count * SECOND, step * SECOND), {}, {})


def test_scatter_inside_bins_and_of_their_means_add_up_to_the_whole():
    residual = quiet(5)
    rows, sums = coarse(residual)
    assert sums["count"] == 3000
    assert sums["square"] == pytest.approx(np.sum(residual**2))
    means = 10 * np.sum(rows.residual**2)
    assert sums["inside"] + means == pytest.approx(sums["square"])


def test_the_strength_of_a_bin_in_which_the_spacecraft_slews_is_that_of_its_samples():
    count, step = 3000, 20
    seconds = np.arange(float(count))
    strength = 4e4 + 5e3 * np.sin(seconds / 900.0)
    # A half turn within two bins, as yaw steering makes it where the Sun lies in the orbit's plane.
    angle = 0.5 * np.pi * np.tanh((seconds - 1500.0) / 12.0)
    field = strength[:, None] * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    field[:, 2] = 0.1 * strength
    rows, _ = coarse(quiet(5), step=step, field=field)
    whole = np.linalg.norm(field, axis=1)
    expected = whole.reshape(-1, step).mean(axis=1)
    np.testing.assert_allclose(field_strength(rows.samples), expected, rtol=1e-12)
    rate = field_strength_rate(rows.samples)
    native = np.gradient(whole).reshape(-1, step).mean(axis=1)
    np.testing.assert_allclose(rate[2:-2], native[2:-2], atol=1e-3 * np.abs(native).max())


def test_bins_weigh_what_they_hold_and_empty_ones_nothing():
    good = np.ones(3000, dtype=bool)
    good[100:200] = False
    good[305:310] = False
    good[402:410] = False
    rows, sums = coarse(quiet(6), good)
    assert not rows.weight[10:20].any()
    assert not rows.residual[10:20].any()
    assert rows.weight[30] == 0.5
    assert rows.weight[40] == 0.0, "two of ten samples are too few"
    assert rows.weight[50] == 1.0
    assert sums["count"] == good.sum() - 2


def test_samples_of_a_bin_without_weight_are_not_scatter_within_bins():
    """The residual of a model before its fit is large, and what has no bin must not count with all of it."""
    good = np.ones(3000, dtype=bool)
    good[402:410] = False
    residual = quiet(6)
    usual, far = (coarse(residual + away, good)[1]["inside"] for away in (0.0, 70.0))
    assert far == pytest.approx(usual, rel=1e-6)


@pytest.mark.parametrize(("step", "after"), [(1, 0.0), (10, 4.5)])
def test_bins_are_when_their_samples_are_and_evenly_spaced(step, after):
    rows, _ = coarse(quiet(6), np.arange(3000) % 70 != 3, step)
    stamps = rows.samples["tt2000"].values
    assert stamps[0] == stamps_of(1)[0] + after * SECOND
    assert np.all(np.diff(stamps) == step * SECOND)


def test_spikes_are_counted_and_left_out():
    residual = quiet(7)
    residual[[55, 1000]] += 300.0
    rows, sums = coarse(residual)
    assert sums["spikes"] == 2
    assert np.abs(rows.residual).max() < 1.0
    assert rows.weight[5] == 0.9
