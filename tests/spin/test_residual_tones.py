"""Tones of a residual: how large, what they follow, and what is said of it."""

from dataclasses import replace

import numpy as np
import pytest

from inflight.spin import (
    TONES,
    ToneCoordinate,
    Tones,
    error_by_tones,
    rank_tone_dependences,
    tone_dependence,
    tones_of,
)

INTERVALS = 600
BLOCK = np.arange(INTERVALS) // 30
AXIAL, MODULUS, TWICE = (TONES.index(one) for one in ((0, 1), (1, 1), (1, 2)))


def noisy(seed, size=0.01):
    generator = np.random.default_rng(seed)
    value = generator.normal(size=(INTERVALS, 8)) + 1j * generator.normal(size=(INTERVALS, 8))
    return Tones(size * value, np.ones(INTERVALS), np.full(INTERVALS, 4.0 * size))


def shifted(tones, tone, by):
    value = tones.value.copy()
    value[:, tone] += by
    return Tones(value, tones.weight, tones.noise)


def coordinates(seed):
    generator = np.random.default_rng(seed)
    wave = np.sin(np.arange(INTERVALS) / 37.0)
    wheel = (generator.random(INTERVALS) > 0.5) * 80.0 * np.exp(1j * generator.normal(size=INTERVALS))
    return {
        "spin phase": ToneCoordinate("spin phase", "", "spin_phase", np.zeros(INTERVALS)),
        "time": ToneCoordinate("time", "d", "time", np.arange(INTERVALS) / 360.0),
        "sensor": ToneCoordinate("sensor", "degC", "temperature", 20.0 * wave),
        "shadow": ToneCoordinate("shadow", "1", "flag", (np.arange(INTERVALS) % 50 < 8).astype(float)),
        "coil at the spin": ToneCoordinate("coil at the spin", "mA", "torquer_current", np.abs(wheel), wheel),
    }


def test_a_row_gives_back_the_tones_it_is_made_of():
    phase = (np.arange(12) + 0.5) * 2.0 * np.pi / 12
    wanted = np.array([0.3 - 0.4j, 0.0, 0.1j, 0.0])
    row = np.real(wanted @ np.exp(-1j * np.arange(1, 5)[:, None] * phase))
    found = tones_of(np.column_stack([row, np.zeros(12)]), 12)
    assert found.shape == (1, 8)
    assert np.allclose(found[0, :4], wanted)
    assert np.allclose(found[0, 4:], 0.0)
    size = Tones(found, np.ones(1), np.ones(1)).size
    assert np.sum(size**2) == pytest.approx(np.mean(row**2))


def test_an_offset_of_some_hours_is_an_error_of_these_hours_and_nature_is_none():
    hours, size, noise = slice(100, 160), 0.3, 0.01
    # Rows have a fourth of the power of eight amplitudes of two parts each.
    nature = [replace(noisy(seed, noise), noise=np.full(INTERVALS, 2.0 * noise)) for seed in range(10)]
    assert np.mean([error_by_tones(one).any(axis=1).mean() for one in nature]) < 2e-3
    value = nature[0].value.copy()
    value[hours, MODULUS] += size * np.exp(1j * np.linspace(0.0, 3.0, 60))  # the field's direction turns
    found = error_by_tones(replace(nature[0], value=value))
    # Along x or y the offset is `size`, and the sum over both axes is what is known of it; z leaves no tone.
    assert np.sqrt(np.mean(np.sum(found[hours, :2] ** 2, axis=1))) == pytest.approx(size, rel=0.03)
    assert np.allclose(found[hours, 2], found[hours, 0], rtol=0.03)
    assert not found[:90].any()
    assert not found[170:].any()


def test_noise_follows_nothing():
    told = 0
    for seed in range(10):
        failures, _ = rank_tone_dependences(noisy(seed), coordinates(seed), BLOCK)
        told += len(failures)
    # Eight tones and five coordinates, five sigma each.
    assert told <= 1


@pytest.mark.parametrize("sign", [1, -1])
def test_a_state_is_found_with_its_size(sign):
    named = coordinates(3)
    made = shifted(noisy(3), MODULUS, sign * 0.1j * named["shadow"].values)
    (first, *rest), _ = rank_tone_dependences(made, named, BLOCK)
    assert first.coordinate == "shadow"
    assert first.tone == MODULUS
    # What is told of a state is its change: the mean of it stays, as a steady tone.
    assert {one.coordinate for one in rest} <= {"spin phase"}
    rms = 0.1 * np.std(named["shadow"].values) / np.sqrt(2.0)
    assert abs(first.amplitude - rms) < 4.0 * first.sigma + 0.02 * rms
    assert "offset of a spin-plane sensor" in first.sentence
    assert "light and shadow" in first.sentence


def test_a_channel_in_step_is_found_whatever_its_phase():
    """A coil whose phase wanders: the mean tone says nothing, the tone in step with it all."""
    named = coordinates(4)
    wheel = named["coil at the spin"].channel_tone
    made = shifted(noisy(4), AXIAL, 2e-3 * wheel)
    (first, *_), found = rank_tone_dependences(made, named, BLOCK)
    assert first.coordinate == "coil at the spin"
    assert first.tone == AXIAL
    step = next(one for one in found if one.coordinate.channel_tone is not None)
    assert abs(step.mean[0, AXIAL] - 2e-3) < 4.0 * step.sigma[0, AXIAL]
    assert "stray field" in first.sentence


def test_a_steady_tone_is_told_as_such():
    made = shifted(noisy(5), TWICE, 0.05 + 0.02j)
    (first, *_), _ = rank_tone_dependences(made, coordinates(5), BLOCK)
    assert first.coordinate == "spin phase"
    assert abs(first.amplitude - abs(0.05 + 0.02j) / np.sqrt(2.0)) < 4.0 * first.sigma + 1e-4
    assert "gain ratio or the azimuth" in first.sentence


def test_what_cannot_be_told_apart_is_named():
    named = coordinates(6)
    named["copy"] = ToneCoordinate("copy", "degC", "temperature", 3.0 * named["sensor"].values + 1.0)
    made = shifted(noisy(6), MODULUS, 0.004 * named["sensor"].values)
    (first, *_), _ = rank_tone_dependences(made, named, BLOCK)
    assert {first.coordinate, *first.rivals} >= {"sensor", "copy"}
    assert "cannot tell it from" in first.sentence


def test_a_gap_and_too_few_blocks_are_no_answer():
    tones = noisy(7)
    tones.value[10:200] = np.nan
    assert tones.size.max() < 0.05
    one = coordinates(7)["sensor"]
    assert tone_dependence(tones, one, np.zeros(INTERVALS, dtype=int)) is None
    flat = ToneCoordinate("flat", "degC", "temperature", np.ones(INTERVALS))
    assert tone_dependence(tones, flat, BLOCK) is None
