"""Derived channels: names, the slow response and the play against what is known of them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from inflight.errors import ModelError
from inflight.samples import ChannelFactor, base_channels, channel_product, parse_channel, slow_response
from inflight.samples.derived import derive_channel, history_s, play

NAN = float("nan")
values = arrays(np.float64, st.integers(1, 80), elements=st.floats(-100, 100, allow_nan=False))


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("current", [ChannelFactor("current")]),
        ("power.current", [ChannelFactor("power.current")]),
        ("current@lag=600s", [ChannelFactor("current", lag_s=600.0)]),
        ("current@lag=10min", [ChannelFactor("current", lag_s=600.0)]),
        ("warmth@width=2", [ChannelFactor("warmth", width=2.0)]),
        ("warmth@width=.5@lag=1 h", [ChannelFactor("warmth", lag_s=3600.0, width=0.5)]),
        ("heater@delay=-20s", [ChannelFactor("heater", delay_s=-20.0)]),
        ("heater@delay=20s@lag=60s", [ChannelFactor("heater", lag_s=60.0, delay_s=20.0)]),
        ("warmth@about=-2.5", [ChannelFactor("warmth", about=-2.5)]),
        ("warmth@about=20@lag=60s", [ChannelFactor("warmth", lag_s=60.0, about=20.0)]),
        ("current~3", [ChannelFactor("current", placebo=3)]),
        ("current@lag=90s~12", [ChannelFactor("current", lag_s=90.0, placebo=12)]),
        ("a*b", [ChannelFactor("a"), ChannelFactor("b")]),
        ("a@lag=600s*b", [ChannelFactor("a", lag_s=600.0), ChannelFactor("b")]),
    ],
)
def test_a_name_says_what_it_is_made_from(name, parts):
    assert list(parse_channel(name).parts) == parts
    assert base_channels(name) == tuple(part.channel for part in parts)
    assert parse_channel(name).name == name.replace(" * ", "*")


@pytest.mark.parametrize(
    "name",
    [
        "",
        "@lag=3s",
        "a@",
        "a@lag",
        "a@lag=",
        "a@lag=5",
        "a@lag=-5s",
        "a@lag=0s",
        "a@width=x",
        "a@width=nan",
        "a@width=-1",
        "a@delay=5",
        "a@late=5s",
        "a@lag=5s@lag=6s",
        "a*",
        "*a",
        "a**b",
        "a~0",
        "a~x",
        "a~1@lag=5s",
    ],
)
def test_what_is_no_name_is_refused_with_a_remedy(name):
    with pytest.raises(ModelError) as caught:
        parse_channel(name)
    assert "600s" in caught.value.remedy


@given(st.floats(1e-3, 1e6), st.floats(0, 1e3), st.integers(0, 20))
def test_a_part_reads_its_own_name(lag, width, placebo):
    part = ChannelFactor("channel", round(lag, 6), round(width, 6), placebo)
    again = parse_channel(part.name).parts[0]
    assert again.lag_s == pytest.approx(part.lag_s, rel=1e-9)
    assert again.width == pytest.approx(part.width, rel=1e-9)
    assert again.placebo == placebo


def test_a_channel_named_twice_is_needed_once_and_histories_are_those_of_the_slowest():
    assert base_channels("a@lag=600s*b*a") == ("a", "b")
    assert history_s("a") == 0
    assert history_s("a@lag=600s*b@lag=60s") == 4800
    assert history_s("a@width=2") == 86_400


@pytest.mark.parametrize("lag", [3.0, 100.0, 5000.0])
def test_the_response_to_a_ramp_and_a_step_is_the_textbook_one(lag):
    t = np.arange(0.0, 5 * lag, lag / 50)
    step = np.where(t > 0, 1.0, 0.0)
    # Between samples a step is a ramp of one sample: it comes half a sample late.
    late = lag / 100
    assert slow_response(step, lag / 50, lag)[2:] == pytest.approx(
        1 - np.exp(-(t[2:] - late) / lag), abs=2e-4
    )
    slope = slow_response(0.3 * t, lag / 50, lag)
    assert slope == pytest.approx(0.3 * (t - lag * (1 - np.exp(-t / lag))), abs=1e-9 * lag)


@pytest.mark.parametrize("step", [1.0, 10.0, 60.0])
def test_a_sine_is_damped_and_delayed_alike_at_every_cadence(step):
    lag, omega = 600.0, 2 * np.pi / 5580
    t = np.arange(0.0, 80_000, step)
    found = slow_response(np.sin(omega * t), step, lag)
    expected = np.sin(omega * t - np.arctan(omega * lag)) / np.hypot(1, omega * lag)
    assert found[t > 8 * lag] == pytest.approx(expected[t > 8 * lag], abs=1e-3)


@given(values, st.floats(0.1, 1e4), st.floats(0.1, 100))
@settings(deadline=None)
def test_a_response_stays_between_the_extremes_and_keeps_a_constant(series, lag, step):
    found = slow_response(series, step, lag)
    assert found.min() >= series.min() - 1e-9
    assert found.max() <= series.max() + 1e-9
    assert slow_response(np.full(20, series[0]), step, lag) == pytest.approx(np.full(20, series[0]))


@given(values, st.floats(1, 1e3), st.integers(1, 79))
@settings(deadline=None)
def test_a_response_is_causal_and_linear(series, lag, cut):
    found = slow_response(series, 10.0, lag)
    assert slow_response(series[:cut], 10.0, lag) == pytest.approx(found[:cut])
    assert slow_response(3 * series + 2, 10.0, lag) == pytest.approx(3 * found + 2, abs=1e-7)


def test_a_short_gap_is_bridged_and_a_long_one_starts_anew():
    t = np.arange(0.0, 4000, 10)
    series = np.where(t < 2000, 0.0, 0.01 * (t - 2000))
    whole = slow_response(series, 10.0, 200.0)
    holed = series.copy()
    holed[250:260] = NAN
    found = slow_response(holed, 10.0, 200.0)
    assert np.isnan(found[250:260]).all()
    # The series is straight in the gap, so nothing is lost.
    assert found[260:] == pytest.approx(whole[260:], abs=1e-9)
    holed[100:300] = NAN
    assert slow_response(holed, 10.0, 200.0)[300] == series[300]
    kept = np.isfinite(holed)
    assert slow_response(series[kept], np.diff(t[kept]), 200.0) == pytest.approx(
        slow_response(holed, 10.0, 200.0)[kept]
    )


def test_stamps_may_be_uneven():
    t = np.unique(np.random.default_rng(0).integers(0, 40_000, 3000)).astype(float)
    even = np.arange(0.0, 40_000)
    series = np.sin(even / 900)
    found = slow_response(np.interp(t, even, series), np.diff(t), 300.0)
    expected = np.interp(t, even, slow_response(series, 1.0, 300.0))
    assert found[t > 3000] == pytest.approx(expected[t > 3000], abs=2e-3)


def test_a_response_that_is_faster_than_the_cadence_is_the_channel():
    series = np.random.default_rng(1).normal(size=50)
    assert slow_response(series, 60.0, 0.5) == pytest.approx(series, abs=0.05)
    assert np.array_equal(slow_response(series, 60.0, 0.0), series)


@given(values, st.floats(0, 50))
@settings(deadline=None)
def test_a_play_stays_within_half_its_width_and_moves_only_when_pushed(series, width):
    found = play(series, width)
    assert np.all(np.abs(found - series) <= width / 2 + 1e-9)
    moved = np.flatnonzero(np.diff(found)) + 1
    assert np.abs(found - series)[moved] == pytest.approx(np.full(moved.size, width / 2), abs=1e-9)


def test_a_play_makes_a_closed_loop_and_forgets_where_it_began():
    t = np.arange(0, 4000)
    series = 5 * np.sin(t / 100)
    one, other = play(series, 2.0), play(series[100:], 2.0)
    assert other[1000:] == pytest.approx(one[1100:])
    rising, falling = (np.gradient(series) > 0), (np.gradient(series) < 0)
    near = (np.abs(series) < 0.5) & (t > 1000)
    assert one[near & rising].mean() - one[near & falling].mean() == pytest.approx(-2.0, abs=0.05)


def test_a_play_stands_where_it_is_not_pushed_until_the_channel_has_moved_by_its_width():
    """Before that it hardly depends on where a record begins: a day goes on from the day before."""
    swing = np.sin(np.arange(4000) / 300)
    assert np.ptp(play(swing, 3.0)) == 0.0
    assert play(swing, 3.0)[0] == pytest.approx(play(swing[700:], 3.0)[0], abs=1e-3)
    rising = np.arange(50.0)
    assert play(rising, 20.0)[:20] == pytest.approx(10.0)
    assert play(-rising, 20.0)[:20] == pytest.approx(-10.0)


def test_missing_values_are_passed_over():
    series = np.array([0.0, 5.0, NAN, 5.5, NAN, 3.0])
    assert play(series, 2.0) == pytest.approx([1.0, 4.0, NAN, 4.5, NAN, 4.0], nan_ok=True)
    assert np.isnan(play(np.full(3, NAN), 1.0)).all()


def test_vectors_keep_their_shape_and_columns_do_not_mix():
    series = np.random.default_rng(2).normal(size=(100, 3)).cumsum(axis=0)
    assert slow_response(series, 1.0, 9.0)[:, 1] == pytest.approx(slow_response(series[:, 1], 1.0, 9.0))
    assert play(series, 1.0)[:, 2] == pytest.approx(play(series[:, 2], 1.0))


def test_a_product_is_that_of_its_parts():
    a, b = np.array([1.0, 2.0, NAN]), np.arange(9.0).reshape(3, 3)
    assert channel_product([a, b])[1] == pytest.approx([6.0, 8.0, 10.0])
    channels = {"a": np.arange(50.0), "b": np.sin(np.arange(50.0))}
    found = derive_channel("a@lag=20s*b", channels, 10.0)
    assert found == pytest.approx(slow_response(channels["a"], 10.0, 20.0) * channels["b"])
    assert np.array_equal(derive_channel("a", channels, 1.0), channels["a"])
    with pytest.raises(ModelError, match="3 and 4 components"):
        channel_product([np.ones((2, 3)), np.ones((2, 4))])


@pytest.mark.parametrize("name", ["c", "a~1"])
def test_what_is_not_there_and_what_is_a_placebo_is_not_made(name):
    with pytest.raises(ModelError):
        derive_channel(name, {"a": np.ones(3)}, 1.0)


def test_impossible_sizes_are_refused():
    with pytest.raises(ValueError, match="negative"):
        slow_response(np.ones(3), 1.0, -1.0)
    with pytest.raises(ValueError, match="negative"):
        play(np.ones(3), -1.0)


def test_a_channel_about_a_value_is_what_it_is_above_it_before_its_response():
    values = np.array([20.0, 22.0, 22.0, 22.0])
    factor = ChannelFactor("warmth", lag_s=30.0, about=20.0)
    np.testing.assert_allclose(ChannelFactor("warmth", about=20.0).of(values, 10.0), values - 20.0)
    np.testing.assert_allclose(factor.of(values, 10.0), slow_response(values - 20.0, 10.0, 30.0))
    assert not factor.is_plain
    assert parse_channel(factor.name).parts == (factor,)


@pytest.mark.parametrize("delay", [25.0, -25.0, 10.0])
def test_a_delayed_channel_is_what_it_was_with_straight_lines_between(delay):
    t = np.arange(100) * 10.0
    series = np.stack([t, np.abs(t - 500.0)], axis=1)
    late = ChannelFactor("heater", delay_s=delay).of(series, 10.0)
    inside = (t - delay >= 0.0) & (t - delay <= t[-1])
    assert late[inside, 0] == pytest.approx((t - delay)[inside])
    far = inside & (np.abs(t - delay - 500.0) > 10.0)
    assert late[far, 1] == pytest.approx(np.abs(t - delay - 500.0)[far])
    assert np.isfinite(late).all()


def test_a_delay_needs_what_came_before():
    assert ChannelFactor("heater", delay_s=300.0).history_s == 300.0
    assert ChannelFactor("heater", delay_s=-300.0).history_s == 0.0
    assert parse_channel("heater@delay=20s").name == "heater@delay=20s"
