"""Channels on one time base: accurate where samples are, and nothing where they are not."""

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from inflight.errors import SamplesError
from inflight.flags import Flag
from inflight.samples import align
from inflight.time import SECOND, day_bounds

START, _ = day_bounds("2005-03-01")
ORBIT = 5580.0


def polar_field(seconds: np.ndarray) -> np.ndarray:
    """A field as it changes along a polar orbit, with its multipoles; (time, 3) nT."""
    u = 2 * np.pi * seconds / ORBIT
    return np.stack(
        [
            22_000 * np.cos(u) + 900 * np.cos(7 * u + 1) + 30 * np.cos(40 * u),
            3_000 * np.sin(u + 0.3) + 500 * np.sin(11 * u),
            -44_000 * np.sin(u) + 2_000 * np.sin(3 * u + 2) + 40 * np.sin(60 * u),
        ],
        axis=1,
    )


def ticks(seconds: np.ndarray) -> np.ndarray:
    return START + np.round(np.asarray(seconds) * 1e9).astype(np.int64)


def channel(values: np.ndarray, seconds: np.ndarray, cadence_s: float, **attrs: object) -> xr.DataArray:
    flag = attrs.pop("flag", None)
    coords: dict[str, object] = {"tt2000": ("time", ticks(seconds))}
    if flag is not None:
        coords["flag"] = ("time", flag)
    dims = ("time", "axis", "other")[: values.ndim]
    return xr.DataArray(
        values, dims=dims, coords=coords, attrs={"cadence_ns": round(cadence_s * 1e9), **attrs}
    )


def inner(samples: xr.Dataset, margin_s: float = 20.0) -> np.ndarray:
    stamps = samples["tt2000"].values
    return (stamps >= stamps[0] + margin_s * SECOND) & (stamps <= stamps[-1] - margin_s * SECOND)


@pytest.mark.parametrize("offset", [0.3, 0.5, -0.2, 0.013])
def test_a_field_0_3_s_off_the_base_is_carried_to_a_picotesla(offset):
    t = np.arange(0.0, 3000.0)
    vector = channel(polar_field(t), t, 1.0)
    scalar = channel(np.ones(t.size), t + offset, 1.0)
    samples = align({"vector": vector, "scalar": scalar}, "scalar")
    good = inner(samples)
    error = np.abs(samples["vector"].values - polar_field(t + offset))[good]
    assert samples["vector"].attrs["resampling"] == "band_limited"
    assert np.isfinite(error).all()
    assert error.max() < 1e-3


def test_linear_interpolation_would_not_have_been_good_enough():
    """What the picotesla above is worth: a line between samples misses by far more."""
    t = np.arange(0.0, 3000.0)
    line = np.stack([np.interp(t[:-1] + 0.5, t, part) for part in polar_field(t).T], axis=1)
    assert np.abs(line - polar_field(t[:-1] + 0.5)).max() > 5e-3


def test_coinciding_stamps_pass_every_value_unchanged():
    t = np.arange(0.0, 500.0)
    values = np.random.default_rng(1).normal(0, 1, (t.size, 3))
    samples = align({"vector": channel(values, t, 1.0), "scalar": channel(1 + t, t, 1.0)}, "scalar")
    assert samples["vector"].attrs["resampling"] == "exact"
    assert np.array_equal(samples["vector"].values, values)


@pytest.mark.parametrize("shift", [0.0, 0.04], ids=["stamps coincide", "stamps between"])
def test_a_10_hz_field_is_low_passed_before_it_is_sampled_at_1_hz(shift):
    """A 1.9 Hz tone would appear at 0.1 Hz; noise above the Nyquist frequency must not fold down."""
    t = np.arange(0.0, 1500.0, 0.1)
    tone = 10.0 * np.cos(2 * np.pi * 1.9 * t)[:, None] * np.ones(3)
    slow = polar_field(t)
    base = np.arange(0.0, 1500.0) + shift
    make = {"scalar": channel(np.ones(base.size), base, 1.0)}
    samples = align(make | {"vector": channel(slow + tone, t, 0.1)}, "scalar")
    good = inner(samples, 25.0)
    error = np.abs(samples["vector"].values - polar_field(base))[good]
    assert samples["vector"].attrs["resampling"] == "band_limited"
    assert error.max() < 5e-3, "the tone is 80 dB down and the field itself unharmed"


@given(st.integers(-2000, 2000))
@settings(max_examples=20, deadline=None)
def test_a_lag_of_either_sign_takes_the_value_from_the_right_time(lag_ms):
    t = np.arange(-50.0, 350.0)
    slope = channel(3.0 * t, t, 1.0, lag_ns=lag_ms * 10**6, kind="temperature")
    base = np.arange(0.0, 300.0)
    samples = align({"scalar": channel(1 + base, base, 1.0), "temperature": slope}, "scalar")
    expected = 3.0 * (base - lag_ms / 1000)
    assert np.allclose(samples["temperature"].values, expected, rtol=0, atol=1e-9)
    other = align(
        {"scalar": channel(1 + base, base, 1.0), "temperature": slope}, "scalar", {"temperature": 0}
    )
    assert np.allclose(other["temperature"].values, 3.0 * base, rtol=0, atol=1e-9), "a stated lag wins"


def test_housekeeping_is_linear_between_its_samples_only():
    t = np.concatenate([np.arange(0.0, 300.0, 10.0), np.arange(400.0, 700.0, 10.0)])
    base = np.arange(0.0, 690.0)
    samples = align({"scalar": channel(1 + base, base, 1.0), "current": channel(2.0 * t, t, 10.0)}, "scalar")
    got = samples["current"].values
    gap = (base > 290) & (base < 400)
    assert np.isnan(got[gap]).all()
    assert np.allclose(got[~gap], 2.0 * base[~gap], rtol=0, atol=1e-9)


@given(
    st.lists(st.integers(100, 500), min_size=1, max_size=4, unique=True),
    st.integers(1, 3),
    st.sampled_from([0.0, 0.3, 0.5, 0.7]),
)
@settings(max_examples=60, deadline=None)
def test_no_value_is_made_from_a_window_with_a_missing_sample(gone, width, offset):
    """Rows that are absent, not NaN: whatever is given must be as accurate as without the gap."""
    t = np.arange(0.0, 600.0)
    keep = np.ones(t.size, dtype=bool)
    for at in gone:
        keep[at : at + width] = False
    vector = channel(polar_field(t)[keep], t[keep], 1.0)
    base = t[:-1] + offset
    samples = align({"vector": vector, "scalar": channel(1 + base, base, 1.0)}, "scalar")
    error = np.abs(samples["vector"].values - polar_field(base)).max(axis=1)
    there = np.isfinite(error)
    assert error[there].max() < 2e-3
    bad = np.isin(t[:-1], t[~keep])
    assert not there[bad & (offset == 0.0)].any()
    if offset:
        near = np.min(np.abs(base[:, None] - t[~keep][None, :]), axis=1) < 14
        assert not there[near].any()
    flagged = samples["flag"].values & np.uint32(Flag.VECTOR_MISSING) != 0
    assert (flagged == ~there).all()
    assert (samples["weight"].values[~there] == 0).all()


@pytest.mark.parametrize("name", ["vector", "current"])
@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_values_outside_the_span_of_a_channel_are_missing(name, offset):
    t = np.arange(100.0, 200.0)
    base = np.arange(0.0, 300.0) + offset
    values = polar_field(t) if name == "vector" else t
    samples = align({"scalar": channel(1 + base, base, 1.0), name: channel(values, t, 1.0)}, "scalar")
    outside = (base < 100) | (base > 199)
    got = samples[name].values.reshape(base.size, -1)
    assert np.isnan(got[outside]).all()


def test_flags_of_both_neighbours_come_along_when_a_value_is_interpolated():
    t = np.arange(0.0, 300.0)
    flag = np.zeros(t.size, dtype=np.uint32)
    flag[150] = Flag.CLOCK_REPAIRED
    base = t[:-1] + 0.3
    vector = channel(polar_field(t), t, 1.0, flag=flag)
    samples = align({"vector": vector, "scalar": channel(1 + base, base, 1.0)}, "scalar")
    marked = np.flatnonzero(samples["flag"].values & np.uint32(Flag.CLOCK_REPAIRED))
    assert marked.tolist() == [149, 150]
    exact = align({"vector": vector, "scalar": channel(1 + t, t, 1.0)}, "scalar")
    assert np.flatnonzero(exact["flag"].values).tolist() == [150]
    assert np.array_equal(exact["vector"].values, polar_field(t)), "a flagged value itself is kept"


def test_a_reading_its_instrument_rejects_does_not_leak_into_good_ones():
    """A spike flagged bad by its own instrument, between stamps of the base."""
    t = np.arange(0.0, 400.0)
    values, flag = polar_field(t), np.zeros(t.size, dtype=np.uint32)
    values[200] += 5000.0
    flag[200] = Flag.INSTRUMENT_FLAG
    base = t[:-1] + 0.3
    vector = channel(values, t, 1.0, flag=flag)
    samples = align({"vector": vector, "scalar": channel(1 + base, base, 1.0)}, "scalar")
    usable = samples["weight"].values > 0
    assert usable[100:180].all()
    assert np.abs(samples["vector"].values - polar_field(base))[usable].max() < 2e-3


def test_a_gap_takes_no_flags_from_far_away():
    t = np.arange(0.0, 100.0)
    flag = np.full(t.size, Flag.CLOCK_REPAIRED, dtype=np.uint32)
    base = np.arange(0.0, 300.0)
    vector = channel(polar_field(t), t, 1.0, flag=flag)
    samples = align({"vector": vector, "scalar": channel(1 + base, base, 1.0)}, "scalar")
    assert not (samples["flag"].values[102:] & np.uint32(Flag.CLOCK_REPAIRED)).any()


def turned(seconds: np.ndarray) -> np.ndarray:
    """Quaternions of a turn about one axis, once an orbit."""
    half = np.pi * seconds / ORBIT
    axis = np.array([0.6, 0.0, 0.8])
    return np.concatenate([np.sin(half)[:, None] * axis, np.cos(half)[:, None]], axis=1)


@given(st.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_attitude_is_the_same_rotation_whatever_signs_its_quaternions_come_with(seed):
    generator = np.random.default_rng(seed)
    t = np.arange(0.0, 600.0, 5.0)
    quaternion = turned(t)
    flips = generator.choice([-1.0, 1.0], t.size)[:, None]
    base = np.arange(0.0, 590.0)
    made = [
        align(
            {
                "scalar": channel(1 + base, base, 1.0),
                "attitude": channel(some, t, 5.0, kind="attitude"),
            },
            "scalar",
        )["attitude"].values
        for some in (quaternion, quaternion * flips)
    ]
    assert np.allclose(np.linalg.norm(made[1], axis=1), 1.0, rtol=0, atol=1e-14)
    alike = np.abs(np.einsum("ti,ti->t", *made))
    assert np.allclose(alike, 1.0, rtol=0, atol=1e-13)
    true = np.abs(np.einsum("ti,ti->t", made[0], turned(base)))
    assert np.rad2deg(2 * np.arccos(np.minimum(true, 1.0))).max() < 1e-4


def test_a_sample_inside_a_leap_second_is_marked_and_still_usable():
    _, end = day_bounds("2005-12-31")
    stamps = end + SECOND * np.arange(-5, 5)
    series = xr.DataArray(
        np.arange(10.0), dims="time", coords={"tt2000": ("time", stamps)}, attrs={"cadence_ns": SECOND}
    )
    samples = align({"scalar": series}, "scalar")
    marked = samples["flag"].values & np.uint32(Flag.LEAP_SECOND) != 0
    assert np.flatnonzero(marked).tolist() == [4]
    assert samples["weight"].values[4] == 1.0
    assert (np.diff(samples["tt2000"].values) == SECOND).all()


def test_stamps_that_do_not_increase_are_refused():
    t = np.array([0.0, 1.0, 1.0, 2.0])
    with pytest.raises(SamplesError, match="increase"):
        align({"scalar": channel(1 + t, t, 1.0)}, "scalar")


def test_a_channel_without_stamps_is_refused():
    bare = xr.DataArray(np.zeros(3), dims="time")
    with pytest.raises(SamplesError, match="stamps"):
        align({"scalar": bare}, "scalar")


def test_an_empty_channel_is_all_missing():
    t = np.arange(0.0, 10.0)
    empty = channel(np.zeros((0, 3)), np.zeros(0), 1.0)
    samples = align({"vector": empty, "scalar": channel(1 + t, t, 1.0)}, "scalar")
    assert np.isnan(samples["vector"].values).all()
    assert (samples["flag"].values & np.uint32(Flag.VECTOR_MISSING) != 0).all()


@pytest.mark.parametrize("base", ["vector", "scalar"])
def test_an_averaged_field_is_the_mean_of_what_is_between_its_samples(base):
    """Over 1 s at 1 s: no mean of readings could do it."""
    t, wave = np.arange(0.0, 600.0), 2 * np.pi * 0.2
    vector = np.stack([np.sin(wave * t), np.cos(wave * t), 100.0 + t], axis=1)
    there = t if base == "vector" else t + 0.3
    samples = align(
        {
            "vector": channel(vector, t, 1.0, average_ns=SECOND),
            "scalar": channel(np.ones(t.size), t + 0.3, 1.0),
        },
        base,
    )
    gain = np.sin(wave / 2) / (wave / 2)
    expected = np.stack([gain * np.sin(wave * there), gain * np.cos(wave * there), 100.0 + there], axis=1)
    good = inner(samples)
    assert np.abs(samples["vector"].values - expected)[good].max() < 2e-5
    assert samples["vector"].attrs["resampling"] == "band_limited"


def test_a_mean_that_lacks_samples_is_missing():
    t = np.delete(np.arange(0.0, 200.0), slice(100, 110))
    vector = channel(np.ones((t.size, 3)), t, 1.0, average_ns=SECOND)
    samples = align({"vector": vector}, "vector")
    lost = ~np.isfinite(samples["vector"].values).all(axis=1)
    assert lost[(t > 85) & (t < 125)].all()
    assert not lost[(t > 20) & (t < 80)].any()
    assert ((samples["flag"].values & np.uint32(Flag.VECTOR_MISSING)) != 0).tolist() == lost.tolist()
