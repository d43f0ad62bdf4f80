"""The signature of what is in no library: a switch nobody recorded, seen from a turning spacecraft."""

from dataclasses import replace

import numpy as np
import pytest

from inflight.diagnosis.signature import AXES, SIGNATURE_SETTINGS, signature_of
from inflight.residual import (
    SPECTRUM_SETTINGS,
    classify_waveform,
    fold_by_period,
    known_periods,
    record_lines,
    strongest_new,
    waveform_of,
)
from inflight.time import SECOND

STEP_S, ORBIT_S = 60.0, 5580.0
SWITCH_S = 41.0 * 60.0


def turning(days, step_s=STEP_S):
    """Stamps, and the direction of the field of a spacecraft that keeps its attitude to the Earth."""
    count = int(days * 86_400 / step_s)
    seconds = step_s * np.arange(count)
    phase, day = 2 * np.pi * seconds / ORBIT_S, 2 * np.pi * seconds / 86_400
    direction = np.stack(
        [np.cos(phase), 0.25 * np.sin(day + 0.4 * np.sin(phase)), 1.6 * np.sin(phase)], axis=1
    )
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return (seconds * SECOND).astype(np.int64), seconds, direction[:, None, :]


def square(seconds, period, duty, phase=0.3):
    return ((seconds / period + phase) % 1.0 < duty) * 1.0


def lines_of(tt2000, y, direction, weight, orbit=ORBIT_S):
    """Return the spectrum of a record and the lines in it."""
    record = tt2000 / SECOND, np.where(weight[:, None] > 0, y, np.nan), direction
    whole = replace(SPECTRUM_SETTINGS, shortest_s=SIGNATURE_SETTINGS.least_samples * STEP_S)
    return record_lines(record, STEP_S, known_periods({}, orbit), settings=whole)


def found_in(days, field, seed=0, noise=0.09, hole=None):
    """Return the signature of a field (time, axis) in noise, or None."""
    tt2000, _, direction = turning(days)
    y = np.einsum("tra,ta->tr", direction, field)
    y = y + np.random.default_rng(seed).normal(0, noise, y.shape)
    weight = np.ones(len(y))
    if hole is not None:
        weight[hole] = 0.0
        y[hole] = 0.0
    seen, lines = lines_of(tt2000, y, direction, weight)
    line = strongest_new(lines, seen.step)
    if line is None:
        return None
    good = weight > 0
    return signature_of(
        waveform_of(tt2000[good] / SECOND, y[good], direction[good], 1.0 / line.period_s, seen.step)
    )


def along(axis, series):
    return np.outer(series, np.eye(3)[AXES.index(axis)])


@pytest.mark.parametrize(("axis", "duty", "size"), [("z", 0.366, 0.35), ("z", 0.5, -0.35), ("x", 0.4, 0.4)])
def test_a_hidden_switch_is_found_at_its_own_period(axis, duty, size):
    """Not at the sideband that the turning direction makes of it, which is stronger in the plain residual."""
    _, seconds, _ = turning(20)
    found = found_in(20, along(axis, size * square(seconds, SWITCH_S, duty)))
    assert found.period_s == pytest.approx(SWITCH_S, abs=0.1 * 60)
    assert abs(found.period_s - SWITCH_S) < 4 * found.period_sigma_s + 1.0
    assert found.axis == axis
    assert found.shape == "square"
    told = duty if size > 0 else 1.0 - duty
    assert found.duty == pytest.approx(told, abs=0.05)
    assert found.amplitude_nT == pytest.approx(abs(size) / 2, rel=0.15)


def test_the_plain_residual_shows_the_sideband_instead():
    """The reason for demodulating: without it the strongest line has the wrong period."""
    _, seconds, direction = turning(20)
    y = direction[:, 0, 2] * 0.35 * square(seconds, SWITCH_S, 0.366)
    power = np.abs(np.fft.rfft(y - y.mean())) ** 2
    frequency = np.fft.rfftfreq(y.size, STEP_S)
    known = np.min(np.abs(frequency[:, None] - np.arange(1, 30) / ORBIT_S), axis=1) < 3e-6
    strongest = frequency[np.argmax(np.where(known, 0.0, power))]
    assert abs(1.0 / strongest - SWITCH_S) > 300.0
    assert np.min(np.abs(np.abs(strongest - 1 / SWITCH_S) - np.arange(1, 6) / ORBIT_S)) < 2e-6


def test_a_sine_is_told_from_a_switch():
    _, seconds, _ = turning(20)
    found = found_in(20, along("z", 0.2 * np.sin(2 * np.pi * seconds / SWITCH_S + 1.0)))
    assert (found.shape, found.duty, found.axis) == ("sine", None, "z")
    assert found.period_s == pytest.approx(SWITCH_S, abs=6.0)
    assert found.amplitude_nT == pytest.approx(0.2, rel=0.1)


def test_a_short_pulse_is_told_from_a_switch():
    _, seconds, _ = turning(20)
    found = found_in(20, along("z", 0.8 * square(seconds, SWITCH_S, 0.125)))
    assert found.shape == "pulse"
    assert found.duty == pytest.approx(0.125, abs=0.05)


def test_a_switch_is_found_across_gaps():
    _, seconds, _ = turning(20)
    hole = np.concatenate([np.arange(3000, 5000), np.arange(12_000, 12_400)])
    found = found_in(20, along("z", 0.35 * square(seconds, SWITCH_S, 0.4)), hole=hole)
    assert found.period_s == pytest.approx(SWITCH_S, abs=6.0)
    assert (found.axis, found.shape) == ("z", "square")


def test_errors_are_given_for_each_axis():
    """The field hardly ever points along y: what is seen there is noise, and the error says so."""
    _, seconds, _ = turning(20)
    found = found_in(20, along("z", 0.35 * square(seconds, SWITCH_S, 0.4)))
    sigma = {axis: found.amplitudes[axis][1] for axis in AXES}
    assert sigma["y"] > 2 * max(sigma["x"], sigma["z"])
    assert found.amplitudes["x"][0] < 0.3 * found.amplitudes["z"][0]


def test_where_the_field_does_not_turn_no_axis_is_named():
    tt2000, seconds, _ = turning(10)
    direction = np.tile([0.4, -0.1, 0.9], (len(seconds), 1))[:, None, :] / np.sqrt(0.98)
    y = direction @ [0.0, 0.0, 1.0] * 0.4 * square(seconds, SWITCH_S, 0.4)[:, None]
    y = y + np.random.default_rng(0).normal(0, 0.09, y.shape)
    weight = np.ones(len(y))
    seen, lines = lines_of(tt2000, y, direction, weight, None)
    line = strongest_new(lines, seen.step)
    waveform = waveform_of(tt2000 / SECOND, y, direction, 1.0 / line.period_s, seen.step)
    found, part = signature_of(waveform), waveform.part
    assert found.period_s == pytest.approx(SWITCH_S, abs=6.0)
    assert found.axis is None
    assert not found.amplitudes
    assert found.shape == "square"
    assert part > 0.3


def test_noise_has_no_line_in_95_of_100_records():
    tt2000, _, direction = turning(10)
    g = np.random.default_rng(5)
    seen = []
    for _ in range(200):
        noise = g.normal(0, 0.09, (len(tt2000), 1))
        power, lines = lines_of(tt2000, noise, direction, np.ones(len(tt2000)))
        seen.append(strongest_new(lines, power.step))
    assert sum(line is not None for line in seen) <= 10


def test_harmonics_of_the_orbit_are_no_news():
    _, seconds, _ = turning(10)
    wave = 0.5 * np.sin(2 * np.pi * 2 * seconds / ORBIT_S) + 0.5 * np.sin(2 * np.pi * 3 * seconds / ORBIT_S)
    assert found_in(10, along("z", wave)) is None


def test_a_record_too_short_has_no_spectrum():
    tt2000, _, direction = turning(0.05)
    zero = np.zeros((len(tt2000), 1))
    assert lines_of(tt2000, zero, direction, np.ones(len(tt2000))) == (None, [])


def test_a_fold_gives_the_field_of_each_phase():
    _, seconds, direction = turning(20)
    u = direction[:, 0]
    field = along("z", square(seconds, SWITCH_S, 0.5, 0.0))
    curve, sigma = fold_by_period(seconds, np.einsum("ta,ta->t", u, field), u, SWITCH_S)
    assert np.ptp(curve[:, 2]) == pytest.approx(1.0, abs=0.02)
    assert np.ptp(curve[:, 0]) < 0.05
    assert np.isfinite(sigma).all()


@pytest.mark.parametrize("duty", [0.3, 0.5, 0.7])
def test_the_shape_of_a_clean_square_wave_is_read_with_its_duty(duty):
    phase = (np.arange(24) + 0.5) / 24
    shape, read = classify_waveform(1.0 * (phase < duty), np.full(24, 0.01))
    assert shape == "square"
    assert read == pytest.approx(duty, abs=0.03)
    assert classify_waveform(np.sin(2 * np.pi * phase), np.full(24, 0.01)) == ("sine", None)
    assert classify_waveform(phase, np.full(24, 0.01))[0] == "other"
