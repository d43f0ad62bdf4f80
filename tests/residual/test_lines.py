"""Lines of a residual: their periods, axes and amplitudes, what is known of them, and none in noise."""

import numpy as np
import pytest
import scipy

from inflight.residual import (
    SpectrumSum,
    add_power,
    drawn_periods,
    find_lines,
    finest_power,
    format_period,
    known_periods,
    name_slow_changes,
    record_power,
    resolve_lines,
    stretch_power,
    thin_spectrum,
)
from inflight.residual.lines import local_maxima
from inflight.residual.spectrum import hann_power

ORBIT, STEP, DAY = 5550.0, 60.0, 86_400.0
KNOWN = known_periods({"orbit": 5580.0, "torquer": 20.0, "local_time": 2.2e7}, ORBIT)


def record(days=20, seed=0, step=STEP):
    """Return seconds, white noise, and a direction that turns along the orbit with a tilted pole."""
    t = np.arange(0.0, days * DAY, step)
    phase, turn = 2 * np.pi * t / ORBIT, 2 * np.pi * t / DAY
    field = np.stack(
        [np.cos(phase), 0.15 * np.sin(turn + phase), -2 * np.sin(phase) + 0.2 * np.cos(turn)], axis=1
    )
    direction = field / np.linalg.norm(field, axis=1, keepdims=True)
    return t, np.random.default_rng(seed).normal(0, 0.02, t.size), direction


def switched(t, period, duty=0.4):
    return np.where((t / period) % 1.0 < duty, 1.0, 0.0)


def found_in(t, residual, direction, known=KNOWN):
    slow = record_power(t, residual, direction, STEP)
    return resolve_lines(t, residual, direction, find_lines(slow, known, shortest=240.0), slow)


@pytest.mark.parametrize("axis", [0, 2])
@pytest.mark.parametrize("period", [1020.0, 2461.0, 4099.0])
def test_a_switch_nobody_recorded_is_found_with_period_axis_and_size(period, axis):
    t, noise, direction = record()
    residual = noise + 0.1 * switched(t, period) * direction[:, axis]
    first = found_in(t, residual, direction)[0]
    assert first.period_s == pytest.approx(period, rel=2e-3)
    assert first.is_new
    assert first.axis == "xyz"[axis]
    # First harmonic of a rectangle of this duty.
    expected = 0.1 * 2 / np.pi * np.sin(np.pi * 0.4)
    assert first.amplitude[1 + axis] == pytest.approx(expected, rel=0.05)
    others = [index for index in (1, 2, 3) if index != 1 + axis]
    assert np.all(first.amplitude[others] < 0.5 * expected)


def test_parts_of_a_rectangle_are_told_as_its_multiples_and_sidebands_are_not_told():
    t, noise, direction = record()
    lines = found_in(t, noise + 0.3 * switched(t, 2461.0) * direction[:, 2], direction)
    new = [line for line in lines if line.is_new]
    assert new[0].period_s == pytest.approx(2461.0, rel=2e-3)
    assert all(line.strength < 0.03 * new[0].strength for line in new[1:])
    assert {line.follows for line in lines[1:]} >= {"multiple: (41 min)/2", "multiple: (41 min)/3"}


def test_the_residual_alone_shows_it_beside_its_period():
    """What makes the demodulation necessary: the first peak of the residual is a sideband."""
    t, noise, direction = record()
    residual = noise + 0.1 * (switched(t, 2461.0) - 0.4) * direction[:, 2]
    slow = record_power(t, residual, direction, STEP)
    peak = 1.0 / slow.frequency[np.argmax(slow.density[0])]
    assert abs(1 / peak - 1 / 2461.0) == pytest.approx(1 / ORBIT, rel=0.01)


def test_the_error_of_an_amplitude_is_honest():
    t, _, direction = record(days=8)
    pulls = []
    for seed in range(25):
        noise = np.random.default_rng(seed).normal(0, 0.02, t.size)
        residual = noise + 0.02 * np.cos(2 * np.pi * t / 2461.0) * direction[:, 2]
        line = found_in(t, residual, direction)[0]
        pulls.append((line.amplitude[3] - 0.02) / line.sigma[3])
    assert 0.5 < np.std(pulls) < 1.6
    assert abs(np.mean(pulls)) < 1.0


def test_noise_has_no_lines():
    told = 0
    for seed in range(20):
        t, noise, direction = record(days=12, seed=seed)
        told += len(found_in(t, noise, direction))
        days = [
            stretch_power(noise[at : at + 1440], direction[at : at + 1440], STEP)
            for at in range(0, t.size, 1440)
        ]
        sums = {}
        for day in days:
            add_power(sums, day)
        told += len(find_lines(finest_power(sums), KNOWN))
    assert told <= 2


def test_lines_of_orbit_day_and_mission_are_known_by_name():
    t, noise, direction = record(days=20)
    waves = 0.1 * np.cos(6 * np.pi * t / ORBIT) + 0.1 * np.cos(2 * np.pi * t * (5 / ORBIT + 3 / DAY))
    residual = noise + waves + 0.1 * np.cos(2 * np.pi * t / DAY)
    lines = find_lines(record_power(t, residual, direction, STEP), KNOWN, shortest=240.0)
    assert {"orbit/3", "orbit/5 + 3/day", "day"} <= {line.label for line in lines}


def test_a_known_line_that_changes_in_the_record_makes_no_unknown_periods():
    """A wave of the orbit that jumps where a calibration window ends has sidebands, which are no periods."""
    t, noise, direction = record(days=20)
    size = np.where(t < 10 * DAY, 0.3, -0.1)
    own = 0.2 * np.cos(2 * np.pi * t / 3300.0) * direction[:, 2]
    residual = noise + size * np.cos(4 * np.pi * t / ORBIT) + own
    lines = found_in(t, residual, direction)
    assert len([line for line in lines if line.is_new]) > 1
    named = name_slow_changes(lines, record_power(t, residual, direction, STEP).step)
    told = [line.follows for line in named if line.follows]
    assert len(told) > 1
    assert all(text.startswith("orbit") and text.endswith(", changing within the record") for text in told)
    own, *rest = sorted((line for line in named if line.is_new), key=lambda line: -line.strength)
    assert own.period_s == pytest.approx(3300.0, rel=1e-3)
    assert all(line.strength < 0.02 * own.strength for line in rest)


def test_a_short_period_of_the_mission_is_known_with_its_multiples_and_sidebands():
    t, noise, direction = record(days=3, step=2.0)
    residual = noise + 0.05 * switched(t, 20.0) * direction[:, 2]
    sums = {}
    for at in range(0, t.size, 43_200):
        add_power(sums, stretch_power(residual[at : at + 43_200], direction[at : at + 43_200], 2.0))
    lines = find_lines(finest_power(sums), KNOWN, longest=300.0)
    assert "torquer" in {line.label for line in lines}
    assert [line for line in lines if line.is_new] == []


def test_gaps_are_bridged_and_a_stretch_of_little_but_gaps_has_no_spectrum():
    t, noise, direction = record()
    residual = noise + 0.1 * switched(t, 2461.0) * direction[:, 2]
    generator = np.random.default_rng(1)
    residual[generator.random(t.size) < 0.05] = np.nan
    residual[5000:6000] = np.nan
    first = found_in(t, residual, direction)[0]
    assert first.period_s == pytest.approx(2461.0, rel=2e-3)
    holed = residual[:1440].copy()
    holed[:800] = np.nan
    assert stretch_power(holed, direction[:1440], STEP) is None
    assert record_power(t[:2000], residual[:2000], direction[:2000], STEP) is None


def test_white_noise_has_its_level_with_gaps_too():
    _, noise, direction = record()
    for part in (0.0, 0.2):
        holed = np.where(np.random.default_rng(2).random(noise.size) < part, np.nan, noise)
        power = stretch_power(holed, direction, STEP)
        high = power.density[0][power.frequency < 0.3 * power.frequency[-1]].mean()
        assert high == pytest.approx(2 * STEP * 0.02**2, rel=0.15)


def test_periods_are_named_and_harmonics_beyond_the_sixth_are_not_drawn():
    assert KNOWN["orbit"] == ORBIT
    assert KNOWN["orbit/6"] == ORBIT / 6
    drawn = drawn_periods(KNOWN)
    assert {"orbit", "orbit/6", "day", "torquer"} <= set(drawn)
    assert not {"orbit/7", "orbit/16", "day/2"} & set(drawn)
    assert known_periods({}, None) == {"day": DAY, "day/2": DAY / 2, "day/3": DAY / 3}
    assert [format_period(s) for s in (19.97, 2461.0, 7200.0, 200_000.0)] == [
        "20 s",
        "41 min",
        "2 h",
        "2.31 d",
    ]


def test_a_thinned_spectrum_keeps_its_power_and_its_slow_end():
    frequency = np.arange(1, 43_201) / DAY
    density = np.random.default_rng(0).exponential(size=(4, 43_200))
    shown, thin = thin_spectrum(frequency, density)
    assert shown.size <= 1200
    assert thin.shape == (4, shown.size)
    assert np.array_equal(thin[:, :20], density[:, :20])
    assert thin[:, -100:].mean() == pytest.approx(1.0, rel=0.1)
    assert thin_spectrum(frequency[:10], density[:, :10])[0].size == 10


def test_sums_of_spectra_are_means():
    power = SpectrumSum(np.array([1.0, 2.0]), np.ones((4, 2)), 1, np.ones(4))
    sums = {}
    for scale in (1.0, 3.0):
        add_power(sums, SpectrumSum(power.frequency, scale * np.ones((4, 2)), 1, np.ones(4)))
    add_power(sums, None)
    assert finest_power(sums).density == pytest.approx(np.full((4, 2), 2.0))
    assert finest_power({}) is None


def test_local_maxima_are_those_of_scipy():
    random = np.random.default_rng(5)
    values = np.round(random.gamma(1.0, 1.0, 5000), 1)  # rounded: with equal neighbours
    apart = values + 1e-9 * np.arange(5000)
    for least, distance in ((0.5, 1), (2.0, 3), (3.0, 40)):
        expected, _ = scipy.signal.find_peaks(apart, height=least, distance=distance)
        assert local_maxima(apart, least, distance) == expected.tolist()
    assert local_maxima(values, 1.0, 1) == scipy.signal.find_peaks(values, height=1.0)[0].tolist()
    assert local_maxima(np.ones(3), 1.0, 1) == []


@pytest.mark.parametrize("count", [16, 1440, 1441])
def test_the_power_of_a_series_is_that_of_scipy(count):
    series = np.random.default_rng(6).normal(3.0, 1.0, (2, count)) + 0.1 * np.arange(count)
    levelled = scipy.signal.detrend(series, axis=1)
    _, expected = scipy.signal.periodogram(
        levelled, fs=1.0 / STEP, window="hann", detrend=False, return_onesided=False
    )
    found = hann_power(series, STEP)
    assert found.shape == (2, count // 2 + 1)
    assert found == pytest.approx(expected[:, : count // 2 + 1], rel=1e-9, abs=1e-9 * expected.max())
