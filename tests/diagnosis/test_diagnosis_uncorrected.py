"""Gaps of a channel: rows an effect cannot be taken off of are no error of the model that has it."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import xarray as xr
from diagnosis_cases import NOISE_NT, POLAR, STEP_S, case_of, evidence_of, flight_of, read

from inflight.design import DesignRows, design_matrix
from inflight.diagnosis import Features, Series, features_of, pack_blocks, run_search, thin_rows
from inflight.diagnosis.residual import (
    correctable_grams,
    held_out_rms,
    uncorrectable_rows,
    unknown_rows,
    with_correctable_rows,
)
from inflight.samples import parse_channel
from inflight.time import SECOND

CHANNELS = ("heater_current", "payload_current")
FIELD = np.array([0.9, 0.0, -0.7])


def gaps_of(count):
    """Return a tenth of the rows, in stretches of an hour to half a day; (time,) of bool."""
    generator, lost = np.random.default_rng(5), np.zeros(count, dtype=bool)
    while lost.mean() < 0.1:
        start = int(generator.integers(0, count))
        lost[start : start + int(generator.uniform(30, 360))] = True
    return lost


@lru_cache(maxsize=1)
def gappy():
    """Twenty days in which a heater's current drives a field and a tenth of it was not recorded."""
    whole = flight_of(POLAR, 20)
    lost = gaps_of(whole.tt2000.size)
    heater = whole["heater_current"].copy()
    heater[lost] = heater[~lost].mean()
    known = replace(
        whole, samples=whole.samples.assign(heater_current=whole.samples["heater_current"].copy(data=heater))
    )
    hidden = read(whole, 2, whole["heater_current"][:, None] * FIELD)
    return case_of(known, [hidden], channels=CHANNELS), lost


def test_columns_of_the_calibration_are_means_where_rows_are_means_of_several():
    case, _ = gappy()
    own = design_matrix(case.library.base, case.rows)
    names = [name for term in case.library.base for name in term.columns]
    made = replace(case.rows, averaged={name: own[:, :, at] for at, name in enumerate(names)})
    step = 10  # a fifth of an orbit
    weight = case.rows.weight.reshape(-1, step, 1, 1)
    expected = (weight * own.reshape(-1, step, *own.shape[1:])).sum(axis=1) / weight.sum(axis=1)

    def thinned(rows):
        features = features_of(rows, CHANNELS)
        stamps, values = thin_rows(rows, features, step)
        edges = [*case.raw.start.tolist(), int(case.raw.end[-1])]
        series = Series.of(pack_blocks(stamps, values, edges, 1000), case.raw.start, features)
        assert set(series.channels) == set(CHANNELS)
        return design_matrix(case.library.base, series.rows({}, {}))

    assert thinned(made) == pytest.approx(expected, rel=1e-5, abs=1e-6 * np.abs(expected).max())
    # A mean reading times a mean direction is not the mean of their product.
    assert np.abs(thinned(case.rows) - expected).max() > 0.1 * np.abs(expected).max()


def searched(option="channel_field(heater_current)"):
    case, lost = gappy()
    search, material = case.search(), case.material()
    series = replace(material.series, missing={"heater_current": lost})
    search = search.add(next(one for one in search.options if one.name == option))
    return search, replace(material, series=series), lost


@lru_cache(maxsize=2)
def told_of(with_gaps):
    case, lost = gappy()
    material = case.material()
    if with_gaps:
        material = replace(material, series=replace(material.series, missing={"heater_current": lost}))
    return run_search(case.search(draws=500), material)[0]


def test_rows_without_the_channel_of_an_effect_count_as_no_error_and_no_structure():
    told = told_of(True)
    assert [one.channels for one in told.effects] == [("heater_current",)]
    assert told.residual["held_out_after_nT"] < 1.02 * NOISE_NT
    assert told.residual["after_nT"] < 1.02 * NOISE_NT
    assert told.remaining["verdict"] == "NOTHING_LEFT"


def test_what_the_record_does_not_tell_is_error_and_structure():
    told = told_of(False)
    assert told.residual["held_out_after_nT"] > 1.05 * NOISE_NT
    assert told.remaining["verdict"] != "NOTHING_LEFT"
    assert told.residual["uncorrected"] == []


def test_the_part_that_could_not_be_corrected_is_told_with_its_channel():
    told, (_, lost) = told_of(True), gappy()
    (one,) = told.as_json()["residual"]["uncorrected"]
    assert one == {"channel": "heater_current", "part": pytest.approx(lost.mean(), rel=1e-3)}
    assert "11% for want of heater_current" in told.sentence


@pytest.mark.parametrize("components", [1, 3])
def test_the_field_of_means_of_several_rows_has_their_strength_where_that_is_compared(components):
    count, step = 600, 10
    angle = 0.2 * np.arange(count)
    strength = 30_000.0 + np.arange(count)
    field = strength[:, None] * np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    samples = xr.Dataset(
        {
            "tt2000": ("time", 1000 * SECOND + 10 * SECOND * np.arange(count)),
            "field": (("time", "axis"), field),
        }
    )
    rows = DesignRows(samples, np.zeros((count, components)), {}, {}, np.ones(count))
    features = features_of(rows, [])
    values = thin_rows(rows, features, step)[1][:, features.place("field")]
    whole = strength.reshape(-1, step).mean(axis=1)
    if components == 1:
        assert np.linalg.norm(values, axis=1) == pytest.approx(whole, rel=1e-9)
    else:
        assert values == pytest.approx(field.reshape(-1, step, 3).mean(axis=1))


def test_sizes_before_and_after_are_of_the_same_rows():
    case, lost = gappy()
    rows = replace(case.rows, weight=np.where(lost, 0.0, case.rows.weight))
    raw, white = evidence_of(case.library, rows, case.residuals)
    alone = replace(case, rows=rows, raw=raw, white=white)
    without = alone.search()
    before = held_out_rms(without, alone.material())
    assert told_of(True).residual["held_out_before_nT"] == pytest.approx(before, rel=1e-3)


@pytest.mark.parametrize("step", [1, 5])
def test_evidence_of_the_known_rows_is_that_of_a_record_without_the_others(step):
    case, lost = gappy()
    search, material, _ = searched()
    features = features_of(case.rows, CHANNELS)
    stamps, values = thin_rows(case.rows, features, step)
    edges = [*case.raw.start.tolist(), int(case.raw.end[-1])]
    series = Series.of(pack_blocks(stamps, values, edges, 1000), case.raw.start, features)
    # Gaps that are whole rows of the thinned series, too.
    lost = np.repeat(lost[: len(series.tt2000) * step : step], step)
    series = replace(series, missing={"heater_current": lost[::step]})
    gaps = uncorrectable_rows(search, series)
    found = correctable_grams(search, gaps, material.sensor_matrices)
    rows = replace(case.rows, weight=np.where(lost, 0.0, case.rows.weight))
    direct = evidence_of(case.library, rows, case.residuals)[0]
    base, sigma = search.base()
    names = list(found.names[:-1])
    wanted = direct.select([*base, *names]).marginalise(
        base, search.intervals, search.precision(direct, base, sigma)
    )
    np.testing.assert_allclose(found.count, wanted.count, rtol=1e-6)
    # Means of five rows know the noise within them in proportion only.
    close = 2e-3 if step == 1 else 0.1
    size = np.sqrt(np.diag(wanted.total))
    assert np.all(np.abs(found.total - wanted.total) < close * np.outer(size, size))


def test_nothing_is_lost_while_no_effect_follows_the_channel():
    search, material, _ = searched("channel_field(payload_current)")
    assert with_correctable_rows(search, material).gaps is None


def test_rows_come_back_with_the_effect_that_lost_them():
    search, material, lost = searched()
    known = with_correctable_rows(search, material)
    assert not (known.series["weight"][lost] > 0).any()
    again = with_correctable_rows(search.drop(search.accepted[0]), known)
    np.testing.assert_array_equal(again.series["weight"], material.series["weight"])


def test_a_channel_that_was_never_recorded_leaves_the_sizes_of_the_whole_record():
    search, material, lost = searched()
    series = replace(material.series, missing={"heater_current": np.ones_like(lost)})
    assert with_correctable_rows(search, replace(material, series=series)).gaps is None


# What a response and a play know after a gap.


def series_with(channel, lost):
    count = channel.size
    names, widths = ("seconds", "residual", "weight", "c"), (1, 1, 1, 1)
    stamps = (np.arange(count) * 10 * SECOND).astype(np.int64)
    values = np.stack([np.zeros(count), np.zeros(count), np.ones(count), channel], axis=1)
    features = Features(names, widths, ("s", "nT", "1", "A"), (), 1)
    return Series(stamps, values, np.zeros(count, dtype=int), features, {"c": lost})


def test_a_response_is_known_again_some_time_after_a_gap():
    lost = np.zeros(1000, dtype=bool)
    lost[300:500] = True
    rows = unknown_rows(series_with(np.zeros(1000), lost), parse_channel("c@lag=100 s").parts[0])
    # It has forgotten all but a fifth of the gap after 1.6 time constants.
    assert rows[305:500].all()
    assert not rows[:300].any()
    after = np.flatnonzero(rows[500:])[-1] * 10.0
    assert after == pytest.approx(100.0 * np.log(5.0), abs=15.0)


def test_a_gap_much_shorter_than_a_response_costs_it_nothing():
    lost = np.zeros(1000, dtype=bool)
    lost[300:310] = True
    assert not unknown_rows(series_with(np.zeros(1000), lost), parse_channel("c@lag=1000 s").parts[0]).any()


def test_a_play_is_known_again_when_its_channel_has_moved_by_the_width():
    lost = np.zeros(100, dtype=bool)
    lost[20:40] = True
    rows = unknown_rows(series_with(np.arange(100.0), lost), parse_channel("c@width=15").parts[0])
    assert np.flatnonzero(rows).tolist() == list(range(20, 55))


def test_a_series_remembers_where_a_channel_was_not_recorded_and_holds_its_usual_value_there():
    count = 60
    c = np.where(np.arange(count) // 10 == 2, np.nan, 3.0)
    weight = np.where(np.arange(count) >= 50, 0.0, 1.0)
    c[50:] = np.nan
    samples = xr.Dataset(
        {
            "tt2000": ("time", (np.arange(count) * STEP_S * SECOND).astype(np.int64)),
            "field": (("time", "axis"), np.ones((count, 3))),
            "c": ("time", c),
        }
    )
    rows = DesignRows(samples, np.zeros((count, 1)), {}, {}, weight)
    features = features_of(rows, ["c"])
    stamps, values = thin_rows(rows, features, 5)
    packed = pack_blocks(stamps, values, [0, int(stamps[-1]) + 1], 20)
    series = Series.of(packed, np.array([0]), features, {"c": 7.0})
    assert np.flatnonzero(series.missing["c"]).tolist() == [4, 5, 10, 11]
    np.testing.assert_array_equal(series["c"], [3, 3, 3, 3, 7, 7, 3, 3, 3, 3, 7, 7])
