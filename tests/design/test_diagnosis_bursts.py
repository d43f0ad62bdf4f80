"""Bursts of wild readings are found from end to end; what is a signal, however lively, is none."""

import numpy as np
import pytest
import xarray as xr

from inflight.design import OutlierReport, bin_edges, coarsen
from inflight.design.columns import find_bursts, is_signal
from inflight.model import ResidualRows
from inflight.time import SECOND

START = 700_000_000 * SECOND
COUNT, STEP_S, NOISE = 4000, 20.0, 0.06
BURST = slice(2000, 2040)


def stamps_of(count=COUNT, step_s=STEP_S):
    return START + (np.arange(count) * step_s * SECOND).astype(np.int64)


def quiet(seed=1, count=COUNT):
    return np.random.default_rng(seed).normal(0, NOISE, (count, 1))


def wild(size=30.0, seed=2, at=BURST):
    return np.random.default_rng(seed).normal(0, size, (at.stop - at.start, 1))


def found_in(residual, usable=None, stamps=None):
    usable = np.ones(len(residual), dtype=bool) if usable is None else usable
    return find_bursts(residual, stamps_of(len(residual)) if stamps is None else stamps, usable)


def rows_of(residual, ripple=0.0, at=BURST, seed=3):
    """Rows of an orbit's field, whose own ripple in a burst both instruments see."""
    phase = 2 * np.pi * STEP_S * np.arange(len(residual)) / 5600.0
    field = np.stack([2e4 * np.cos(phase), np.full(len(phase), 3e3), 4e4 * np.sin(phase)], axis=1)
    size = np.linalg.norm(field, axis=1, keepdims=True)
    live = np.zeros((len(residual), 1))
    live[at] = np.random.default_rng(seed).normal(0, ripple, (at.stop - at.start, 1))
    own = np.random.default_rng(seed + 1).normal(0, NOISE, (len(residual), 1))
    # The reference reads the field and its own noise; the residual is the vector's length less that.
    wanted = size + live + own + residual
    field = field * wanted / size
    unit = (field / np.linalg.norm(field, axis=1, keepdims=True))[:, None, :]
    good = np.ones(len(residual), dtype=bool)
    return ResidualRows(
        residual=residual,
        directions={"fgm": unit},
        fields={"fgm": field, "ovm": field},
        field=field,
        good=good,
        step_s=STEP_S,
    )


def said_signal(residual, rows, channels=None, cadence=1):
    stamps = stamps_of(len(residual))
    edges = bin_edges(START, int(stamps[-1]) + 1, int(cadence * STEP_S * SECOND))
    every = found_in(residual)
    return [is_signal(one, every, rows, stamps, channels or {}, edges) for one in every]


@pytest.mark.parametrize("size", [2.0, 30.0, 3000.0])
@pytest.mark.parametrize("length", [8, 40, 300])
def test_a_burst_is_found_from_end_to_end(size, length):
    at = slice(2000, 2000 + length)
    residual = quiet()
    residual[at] += wild(size, at=at)
    (one,) = found_in(residual)
    assert at.start - 2 <= one.first <= at.start + 1
    assert at.stop - 1 <= one.last <= at.stop + 2
    assert one.times_usual == pytest.approx(size / NOISE, rel=0.6)


def test_two_bursts_are_two_and_dropouts_do_not_split_one():
    residual = quiet()
    residual[BURST] += wild()
    residual[3000:3020] += wild(at=slice(3000, 3020), seed=5)
    usable = np.random.default_rng(7).random(COUNT) > 0.05
    found = found_in(residual, usable)
    assert len(found) == 2
    assert found[0].first >= BURST.start - 3
    assert found[0].last <= BURST.stop + 3


def test_a_burst_before_a_long_gap_does_not_reach_across_it():
    residual, stamps = quiet(), stamps_of()
    residual[BURST] += wild()
    stamps[BURST.stop :] += 3600 * SECOND
    (one,) = found_in(residual, stamps=stamps)
    assert one.last <= BURST.stop
    assert one.first >= BURST.start - 2


@pytest.mark.parametrize(
    "effect",
    [
        lambda t: 20.0 * np.sin(2 * np.pi * t / 5600.0),
        lambda t: 20.0 * (t % 2460.0 < 900.0),
        lambda t: 500.0 * (t > 30_000.0),
        lambda t: 30.0 * ((t > 30_000.0) & (t < 30_800.0)),
        lambda t: 30.0 * np.exp(-np.clip(t - 30_000.0, 0.0, None) / 600.0) * (t > 30_000.0),
        lambda t: 5.0 * np.sin(2 * np.pi * t / 45.0),
    ],
    ids=["orbit", "switch", "step", "episode", "jump that decays", "fast tone"],
)
def test_an_effect_however_large_is_no_burst(effect):
    seconds = STEP_S * np.arange(COUNT)
    assert found_in(quiet() + effect(seconds)[:, None]) == []


def test_noise_alone_makes_no_burst():
    assert not any(found_in(quiet(seed)) for seed in range(20))


def test_noise_that_is_lively_half_of_the_time_is_usual_there():
    residual = quiet()
    residual[: COUNT // 2 + 200] *= 30.0
    assert found_in(residual) == []


def test_rounded_readings_that_hardly_change_are_no_bursts():
    steps = np.round(quiet(9) * 2.0, 1)
    assert found_in(steps) == []
    assert found_in(np.zeros((COUNT, 1))) == []


def test_a_burst_of_one_of_three_rows_is_one():
    residual = np.concatenate([quiet(1), quiet(2), quiet(3)], axis=1)
    residual[BURST, 1:2] += wild()
    assert len(found_in(residual)) == 1


def test_wild_readings_of_one_instrument_are_no_signal_though_the_field_bends_as_much():
    """At 20 s the field of an orbit bends by 30 nT from sample to sample, in both instruments."""
    residual = quiet()
    residual[BURST] += wild(3.0)
    assert said_signal(residual, rows_of(residual)) == [False]


def test_a_storm_that_both_instruments_see_is_a_signal():
    residual = quiet()
    residual[BURST] += wild(1.0)
    assert said_signal(residual, rows_of(residual, ripple=5.0)) == [True]
    assert said_signal(residual, rows_of(residual, ripple=0.5)) == [True]


def test_wild_readings_in_a_lively_field_are_no_signal():
    residual = quiet()
    residual[BURST] += wild(30.0)
    assert said_signal(residual, rows_of(residual, ripple=0.5)) == [False]


def channel(kind, bins):
    """A channel on bins of 5 samples, of which the burst holds 400 to 408."""
    g, place = np.random.default_rng(11), np.arange(bins)
    inside = (place >= 400) & (place < 408)
    return {
        "on for the burst": 1.0 * inside,
        "busy in the burst": np.where(
            inside[:, None], g.normal(0, 40.0, (bins, 3)), g.normal(0, 1, (bins, 3))
        ),
        "noise": g.normal(0, 1.0, bins),
        "heater": 1.0 * (place % 37 < 12),
        "changed once, in its midst": 1.0 * (place >= 404),
        "missing": np.full(bins, np.nan),
        "still": np.ones(bins),
    }[kind]


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        ("on for the burst", True),
        ("busy in the burst", True),
        ("noise", False),
        ("heater", False),
        ("changed once, in its midst", False),
        ("missing", False),
        ("still", False),
    ],
)
def test_what_goes_with_a_recorded_channel_is_a_signal(kind, told):
    residual = quiet()
    residual[BURST] += wild()
    assert said_signal(residual, rows_of(residual), {"it": channel(kind, COUNT // 5)}, 5) == [told]


def coarse(residual, keep=False):
    rows, stamps = rows_of(residual), stamps_of(len(residual))
    samples = xr.Dataset({"tt2000": ("time", stamps), "vector": (("time", "axis"), rows.field)})
    edges = bin_edges(START, int(stamps[-1]) + 1, int(5 * STEP_S * SECOND))
    return coarsen(samples, rows, edges, {}, {}, {}, keep)


def test_the_rows_of_a_day_leave_bursts_out_and_tell_when_they_were():
    residual = quiet()
    residual[BURST] += wild()
    rows, told = coarse(residual)
    assert not rows.weight[400:408].any()
    assert rows.weight[:399].min() == rows.weight[410:].min() == 1.0
    assert np.abs(rows.residual).max() < 10 * NOISE
    assert told["burst_count"] == 1
    assert 40 <= told["burst_samples"] <= 43
    assert told["count"] == COUNT - told["burst_samples"]
    start, end, samples, times = told["bursts"][0]
    assert abs(start - stamps_of()[2000]) <= 2 * STEP_S * SECOND
    assert abs(end - stamps_of()[2039]) <= 2 * STEP_S * SECOND
    assert samples == told["burst_samples"]
    assert times > 100


def test_bursts_that_are_to_be_kept_are_counted_and_stay():
    residual = quiet()
    residual[BURST] += wild()
    rows, told = coarse(residual, keep=True)
    assert told["burst_samples"] >= 40
    assert told["count"] == COUNT
    assert np.abs(rows.residual[400:408]).max() > 1.0


def test_outliers_of_a_span_are_the_sum_of_its_blocks_and_its_share_that_of_all_samples():
    residual = quiet()
    residual[BURST] += wild()
    reports = [coarse(residual)[1], coarse(quiet(4))[1]]
    told = OutlierReport.of(reports, kept=False)
    assert told.share == pytest.approx(told.burst_samples / (2 * COUNT))
    assert OutlierReport.of([coarse(residual, True)[1], coarse(quiet(4))[1]], kept=True).share == told.share
    said = told.as_json()
    assert said["samples"] == told.burst_samples + told.spikes
    assert said["bursts"][0]["start"].endswith("Z")
    assert len(said["bursts"]) == said["burst_count"] == 1
