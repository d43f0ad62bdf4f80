"""Spin phase from pulses, angles and periods, when these are not as they should be."""

import numpy as np
import pytest
from farrell_cases import TURN, phase_of, record, sensors, stamps_of

from inflight.errors import CalibrationError, SamplesError
from inflight.flags import Flag
from inflight.spin import check_period, phase_from_angle, phase_from_pulses
from inflight.spin.phase import count_turns
from inflight.time import SECOND

PERIOD = 3.03
JITTER = 1e-4


def ticks(seconds):
    return np.rint(np.asarray(seconds) * SECOND).astype(np.int64)


class Spin:
    """A spin whose period changes slowly, with Sun pulses and samples."""

    def __init__(self, turns=2000, jitter=JITTER, seed=0):
        self.rng = np.random.default_rng(seed)
        self.turns = np.arange(turns)
        self.times = self.turns * PERIOD * (1 + 2e-4 * np.sin(self.turns / 400))
        self.pulses = self.times + jitter * self.rng.standard_normal(turns)
        self.samples = np.arange(5.0, self.times[-1] - 5.0, 0.25)

    def error(self, found):
        """Radians, less the whole turns that no pulse tells."""
        off = found.phase - TURN * np.interp(self.samples, self.times, self.turns)
        return off - TURN * np.rint(np.nanmedian(off) / TURN)

    def found(self, pulses, **given):
        return phase_from_pulses(ticks(pulses), ticks(self.samples), **given)


def finely_read(readings):
    """A spin of 300 turns with an angle read so many times a turn: spin, times in s, degrees."""
    spin = Spin(turns=300)
    at = np.arange(0.0, spin.times[-1], PERIOD / readings)
    return spin, at, (360.0 * np.interp(at, spin.times, spin.turns)) % 360.0


def test_missing_and_spurious_and_repeated_pulses_leave_the_phase_right():
    spin = Spin()
    kept = spin.rng.random(spin.pulses.size) > 0.1
    kept[500:560] = False
    wrong = spin.rng.uniform(0, spin.times[-1], 60)
    pulses = spin.rng.permutation(np.concatenate([spin.pulses[kept], wrong, spin.pulses[kept][900:905]]))
    found = spin.found(pulses)
    assert found.good.all()
    assert np.abs(spin.error(found)).max() < 0.01
    bridged = (found.flag & Flag.PHASE_BRIDGED) > 0
    assert bridged[np.searchsorted(spin.samples, spin.times[530])]
    assert 0.05 < bridged.mean() < 0.30
    told = found.summary()
    for part in ("spurious Sun pulses dropped", "Sun pulses missing", "5 repeated Sun pulses dropped"):
        assert part in told


@pytest.mark.parametrize("nominal", [1.5, 2.2, 6.0])
def test_a_wrong_nominal_period_is_said_and_does_no_harm(nominal):
    spin = Spin()
    found = spin.found(spin.pulses, nominal_period=nominal)
    assert found.period == pytest.approx(PERIOD, rel=1e-3)
    assert np.abs(spin.error(found)).max() < 0.003
    assert f"stated spin period of {nominal:g} s is wrong" in found.summary()


def test_a_nominal_period_tells_pulses_that_come_every_other_turn():
    spin = Spin()
    every = spin.pulses[::2].copy()
    assert spin.found(every).period == pytest.approx(2 * PERIOD, rel=1e-3)
    some = np.sort(np.concatenate([every, spin.pulses[1::10]]))
    found = spin.found(some, nominal_period=3.0)
    assert found.period == pytest.approx(PERIOD, rel=1e-3)
    assert np.abs(spin.error(found)).max() < 0.003


def test_a_jump_of_the_phase_is_found_with_its_size_and_time():
    spin = Spin()
    pulses = spin.pulses.copy()
    pulses[1000:] += 0.4
    found = spin.found(pulses)
    jump = np.flatnonzero(found.marks.jumped)
    assert jump.tolist() == [999]
    assert 360 * found.marks.residual[999] == pytest.approx(360 * 0.4 / PERIOD, abs=0.3)
    bad = np.flatnonzero(~found.good)
    lost = spin.samples[bad]
    assert lost.min() > pulses[999]
    assert lost.max() < pulses[1000]
    assert (found.flag[bad] & Flag.PHASE_JUMP).all()
    assert "jumps by +47" in found.summary()


def test_a_gap_too_long_to_count_turns_has_no_phase_and_the_rest_has():
    spin = Spin(turns=4000, jitter=2e-3)
    kept = np.ones(4000, dtype=bool)
    kept[1000:3500] = False
    found = spin.found(spin.pulses[kept])
    # A turn from the last pulse, as beyond the ends of a record, the phase is carried on.
    inside = spin.samples > spin.pulses[999] + 1.01 * PERIOD
    inside &= spin.samples < spin.pulses[3500] - 1.01 * PERIOD
    beside = spin.samples > spin.pulses[999] + 0.99 * PERIOD
    beside &= spin.samples < spin.pulses[3500] - 0.99 * PERIOD
    assert not found.good[inside].any()
    assert found.good[~beside].all()
    assert "too long to count turns" in found.summary()


def test_stated_sigmas_cover_the_jitter_of_the_pulses():
    # At the pulses themselves: between two of them the error is smaller than that of either.
    spin = Spin(jitter=3e-3)
    found = phase_from_pulses(ticks(spin.pulses), ticks(spin.pulses))
    off = found.phase - TURN * spin.turns
    off -= np.median(off)
    true = TURN * (np.interp(spin.pulses, spin.times, spin.turns) - spin.turns)
    assert found.sigma[5:-5].mean() == pytest.approx(true.std(), rel=0.1)
    assert 0.60 < np.mean(np.abs(true[5:-5]) < found.sigma[5:-5]) < 0.76
    assert np.abs(off).max() < 1e-9


def test_samples_far_outside_the_pulses_have_no_phase():
    spin = Spin(turns=100)
    found = phase_from_pulses(ticks(spin.pulses), ticks([-30.0, -2.0, 50.0, spin.times[-1] + 2.0, 400.0]))
    assert found.good.tolist() == [False, True, True, True, False]


def test_pulses_of_noise_or_none_are_refused():
    with pytest.raises(CalibrationError, match="2 Sun pulses found"):
        phase_from_pulses(ticks([0.0, 3.0]), ticks([1.0]))


@pytest.mark.parametrize("sense", [1, -1])
@pytest.mark.parametrize("cadence", [0.5, 10.0])
def test_a_delivered_angle_gives_the_phase_fast_or_slow(cadence, sense):
    spin = Spin()
    at = np.arange(0.0, spin.times[-1], cadence)
    angle = (sense * 360.0 * np.interp(at, spin.times, spin.turns)) % 360.0
    angle[7] = np.nan
    angle[50] = (angle[50] + 100.0) % 360.0
    found = phase_from_angle(ticks(at), angle, ticks(spin.samples), nominal_period=3.0, sense=sense)
    assert np.abs(spin.error(found)).max() < 0.003
    assert found.good.mean() > 0.99


@pytest.mark.parametrize("readings", [5, 12, 100, 1000])
@pytest.mark.parametrize("nominal", [2.0, 3.0, 3.3])
def test_an_angle_read_many_times_a_turn_gives_the_phase(readings, nominal):
    spin, at, angle = finely_read(readings)
    found = phase_from_angle(ticks(at), angle, ticks(spin.samples), nominal_period=nominal)
    assert np.abs(spin.error(found)).max() < 1e-5
    assert found.good.all()
    assert found.period == pytest.approx(PERIOD, rel=1e-3)
    assert "spurious" not in found.summary()
    assert 2.4 < np.median(1.0 / np.diff(found.marks.turn)) < 4.0


@pytest.mark.parametrize("readings", [5, 12, 100])
def test_a_fine_angle_may_scatter_have_gaps_and_jump_for_a_reading(readings):
    spin, at, angle = finely_read(readings)
    angle += 0.1 * spin.rng.standard_normal(at.size)
    wrong = spin.rng.integers(0, at.size, at.size // 50)
    angle[wrong] += spin.rng.uniform(20.0, 340.0, wrong.size)
    kept = (spin.rng.random(at.size) > 0.2) & ((at < 300.0) | (at > 330.0))
    rows = np.sort(np.concatenate([np.flatnonzero(kept), np.flatnonzero(kept)[100:120]]))
    found = phase_from_angle(ticks(at[rows]), angle[rows], ticks(spin.samples), nominal_period=3.0)
    assert found.good.all()
    error = spin.error(found)
    assert np.abs(error).max() < np.deg2rad(1.0)
    assert np.std(error) < 2.0 * found.sigma.mean()
    assert "20 repeated angles dropped" in found.summary()
    bridged = spin.samples[(found.flag & Flag.PHASE_BRIDGED) > 0]
    assert np.mean((bridged > 297.0) & (bridged < 333.0)) > 0.8


def test_a_fine_angle_tells_the_samples_up_to_its_gap_and_to_its_end():
    _, at, angle = finely_read(100)
    kept = (at < 300.0) | (at > 330.0)
    samples = np.array([299.9, 300.1, 329.9, 330.1, at[-1] - 0.05])
    found = phase_from_angle(ticks(at[kept]), angle[kept], ticks(samples), nominal_period=3.0)
    assert ((found.flag & Flag.PHASE_BRIDGED) > 0).tolist() == [False, True, True, False, False]


def test_the_phase_of_a_fine_angle_may_jump():
    spin, at, angle = finely_read(12)
    angle[at > 450.0] += 40.0
    found = phase_from_angle(ticks(at), angle, ticks(spin.samples), nominal_period=3.0)
    assert np.count_nonzero(found.marks.jumped) == 1
    assert "the phase jumps by -40" in found.summary()
    assert found.good.mean() > 0.99


def test_a_burst_of_fine_readings_among_slow_ones_is_used():
    spin, at, angle = finely_read(3)
    burst = np.arange(400.0, 430.0, 0.02)
    times = np.sort(np.concatenate([at, burst]))
    angle = 360.0 * np.interp(times, spin.times, spin.turns)
    found = phase_from_angle(ticks(times), angle, ticks(spin.samples), nominal_period=3.0)
    assert np.abs(spin.error(found)).max() < 1e-5
    assert not (found.flag & Flag.PHASE_BRIDGED).any()


def test_a_fine_angle_that_stands_falls_or_is_too_short_is_refused():
    spin, at, angle = finely_read(100)
    stamps = ticks(spin.samples)
    for one in (np.full(at.size, 30.0), -angle % 360.0):
        with pytest.raises(CalibrationError, match="does not grow"):
            phase_from_angle(ticks(at), one, stamps, nominal_period=3.0)
    for size in (3, 5, 20):
        with pytest.raises(CalibrationError, match="angles found, of"):
            phase_from_angle(ticks(at[:size]), angle[:size] + 1.0, stamps, nominal_period=3.0)
    with pytest.raises(CalibrationError, match="without a spin period"):
        phase_from_angle(ticks(at), angle, stamps, nominal_period=None)


def test_marks_of_one_turn_are_refused():
    with pytest.raises(CalibrationError, match="of one turn"):
        count_turns(ticks([0.0, 0.001, 0.002]), np.zeros(3), 3.0)


def test_an_angle_too_slow_for_its_stated_period_is_refused():
    spin = Spin()
    at = np.arange(0.0, spin.times[-1], 10.0)
    angle = (360.0 * np.interp(at, spin.times, spin.turns)) % 360.0
    with pytest.raises(CalibrationError, match="do not fit"):
        phase_from_angle(ticks(at), angle, ticks(spin.samples), nominal_period=2.2)
    with pytest.raises(SamplesError, match="sense 0"):
        phase_from_angle(ticks(at), angle, ticks(spin.samples), nominal_period=3.0, sense=0)


def test_the_sensor_may_look_elsewhere_than_along_xa():
    spin = Spin()
    straight, aside = spin.found(spin.pulses), spin.found(spin.pulses, mark_phase=-0.5)
    np.testing.assert_allclose(aside.phase - straight.phase, -0.5, atol=1e-9)


def test_the_summary_begins_with_the_period():
    spin = Spin(turns=300)
    found = spin.found(spin.pulses)
    assert found.marks.period == pytest.approx(PERIOD, rel=1e-3)
    assert found.summary().startswith("spin period")


@pytest.mark.parametrize("factor", [0.99, 1.003, 1.5, 2.0])
def test_the_field_shows_that_a_phase_turns_at_a_wrong_rate(factor):
    stamps, readings, phase, _ = record(0, sensors(), [5.0, 2.0, 3.0])
    readings[500:900] = np.nan
    readings[2000] = 1e4
    assert check_period(stamps, readings, phase).agrees
    found = check_period(stamps, readings, factor * phase)
    assert not found.agrees
    assert "WRONG" in found.summary()
    assert found.period == pytest.approx(3.0, rel=1e-3)


def test_the_period_of_the_field_is_within_its_sigma():
    pulls = []
    for seed in range(20):
        found = check_period(*record(seed, sensors(-1.0), [5.0, 2.0, 3.0], spins=400)[:3])
        pulls.append((found.period - 3.0) / found.sigma)
    # The sigma is an upper bound where the field's direction comes back.
    assert np.mean(np.abs(pulls) < 1) > 0.60


def test_a_field_without_a_tone_or_too_short_is_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(CalibrationError, match="no tone stands out"):
        check_period(stamps_of(4000), rng.standard_normal((4000, 3)))
    with pytest.raises(CalibrationError, match="at least 64"):
        check_period(stamps_of(50), rng.standard_normal((50, 3)), phase_of(50))


def test_readings_slower_than_half_a_turn_tell_nothing():
    stamps, readings, phase, _ = record(0, sensors(), [5.0, 2.0, 3.0])
    found = check_period(stamps[::7], readings[::7], phase[::7])
    assert found.aliased
    assert "too slow" in found.summary()
