"""Tones of the spin: signs, noise, and what a record may lack."""

from dataclasses import replace

import numpy as np
import pytest
from eight_cases import PRESENT, TRUTH, by_joint
from orbit_fields import steady

from inflight.errors import CalibrationError, SamplesError
from inflight.spin import (
    SPIN_RELATED,
    CalibrationParameters,
    Exclusion,
    SubIntervals,
    cut_into_blocks,
    estimate_pairs,
    measure_tones,
    spin_equations,
)
from inflight.spin.kernels import SERIES
from inflight.spin.tones import check_turning, turn_ratio

SPREAD = {"spin axis": 1e-4, "elevations": 1e-4, "offsets": 0.1}
Z, M = SERIES.index("z"), SERIES.index("m")


def tones_of(record, readings, parameters=None, **options):
    layout = cut_into_blocks(readings, record.phase, record.stamps, **options)
    return measure_tones(readings, record.phase, record.stamps, layout, parameters or CalibrationParameters())


def quiet(**options):
    """A field without fluctuations."""
    return steady(1, hours=0.5, density=0.0, **options)


@pytest.mark.parametrize("sign", [1, -1])
def test_tones_have_the_signs_of_the_derivation(sign):
    """Modulus and Bz of a steady field under small errors; SCIENCE section 6, from eqs. (24) to (26)."""
    bp, ba = 200.0, 300.0
    record = quiet(mean=(bp, 0.0, ba))
    small = 1e-5 * sign
    errors = CalibrationParameters(
        gain_ratio=1.0 + small,
        elevation=(2 * small, -small),
        azimuth=3 * small,
        spin_axis=(-small, 2 * small),
        offset=(0.02 * sign, -0.01 * sign, 0.0),
    )
    found = tones_of(record, errors.disturb(record.field)).tones[0]
    (e1, e2), (sx, sy), (o1, o2, _) = errors.elevation, errors.spin_axis, errors.offset
    expected_m = [o1 + ba * (sx - e1), -(o2 + ba * (sy - e2)), -bp * small, bp * 3 * small / 2]
    assert np.allclose(found[:, M], expected_m, atol=2e-5)
    assert np.allclose(found[:, Z], [-bp * sx, bp * sy, 0, 0], atol=2e-5)


def test_gains_rotation_and_axial_offset_give_no_tone():
    record = quiet(mean=(200.0, 0.0, 300.0))
    others = CalibrationParameters(1.0, 1.01, 0.99, rotation=0.02, offset=(0.0, 0.0, 5.0))
    found = tones_of(record, others.disturb(record.field)).tones
    assert np.abs(found[:, :, [Z, M]]).max() < 1e-9


def test_amplitudes_are_the_papers_fourier_components():
    """Eq. (30) written out, at 85, 115, 185 and 215 % over whole evenly sampled spins."""
    record = steady(3, hours=0.5, density=0.05)
    found = tones_of(record, record.field, settings=SubIntervals(overlap=0.0))
    part = slice(0, 1200)
    phase, field = record.phase[part], record.field[part]
    for column, (series, around) in enumerate((("z", 1.0), ("m", 1.0), ("m", 2.0))):
        values = field[:, 2] if series == "z" else np.hypot(field[:, 0], field[:, 1])
        shapes = np.column_stack(
            [np.ones(1200), phase] + [f(k * phase) for k in (1, 2) for f in (np.cos, np.sin)]
        )
        left = values - shapes @ np.linalg.lstsq(shapes, values)[0]
        sizes = [abs(2 / 1200 * np.sum(left * np.exp(-1j * (around + d) * phase))) for d in (-0.15, 0.15)]
        assert np.isclose(found.amplitude[0, column], max(sizes), rtol=2e-3)


def test_tones_and_derivatives_are_those_of_a_least_squares_fit_to_each_sub_interval():
    """With a line of its own for each block, over gaps; derivatives by differences of the exact equation."""
    record = steady(3, hours=0.5, density=0.05)
    readings, step = TRUTH.disturb(record.field), 1e-6
    readings[np.random.default_rng(2).random(len(readings)) < 0.1] = np.nan
    readings[900:1000] = np.nan
    layout = cut_into_blocks(readings, record.phase, record.stamps)
    found = spin_equations(measure_tones(readings, record.phase, record.stamps, layout, PRESENT))
    parts = [np.arange(layout.start[1 + b], layout.stop[1 + b]) for b in range(2)]
    parts = [part[layout.good[part]] for part in parts]
    angle, one = record.phase[np.concatenate(parts)], np.repeat([0, 1], [len(part) for part in parts])
    lines = [(one == b) * shape for b in range(2) for shape in (np.ones(angle.size), angle - angle.mean())]
    shapes = np.column_stack([*lines, *(f(k * angle) for k in (1, 2) for f in (np.cos, np.sin))])

    def tones(parameters):
        field = parameters.correct(readings[np.concatenate(parts)])
        fits = np.linalg.lstsq(shapes, np.column_stack([field[:, 2], np.hypot(*field[:, :2].T)]))[0][4:]
        return np.concatenate([fits[:2, 0], fits[:, 1]])

    assert np.allclose(found.residual[1], tones(PRESENT), rtol=0, atol=1e-10)
    for at, name in enumerate(SPIN_RELATED):
        value = PRESENT.spin_related()[at]
        up, down = (PRESENT.changed({name: value + way * step}) for way in (1, -1))
        slope = (tones(up) - tones(down)) / (2 * step)
        assert np.allclose(found.design[1, :, at], slope, rtol=0, atol=1e-6), name


def test_published_uncertainty_is_1p7_sigma_in_white_noise_and_sigma_is_the_scatter():
    generator = np.random.default_rng(5)
    record = steady(1, hours=16.0, density=0.0, mean=(200.0, 0.0, 300.0))
    readings = record.field + 0.1 * generator.normal(size=record.field.shape)
    estimates = estimate_pairs(tones_of(record, readings), SPREAD)
    scatter = estimates.value.std(axis=0)
    rms = [np.sqrt(np.mean(one**2, axis=0)) for one in (estimates.sigma, estimates.uncertainty)]
    assert np.allclose(rms[0] / scatter, 1.0, atol=0.15)
    for name in ("gain_ratio", "azimuth", "spin_axis[x]", "spin_axis[y]"):
        at = SPIN_RELATED.index(name)
        assert abs(rms[1][at] / scatter[at] - np.sqrt(3.0)) < 0.3


@pytest.mark.parametrize("lack", ["gaps", "one NaN", "uneven", "phase missing"])
def test_gaps_and_uneven_sampling_leave_the_estimates_as_they_are(lack):
    record = steady(4, hours=1.0, density=0.01, mean=(200.0, 40.0, 100.0))
    readings, phase = TRUTH.disturb(record.field), record.phase.copy()
    generator = np.random.default_rng(6)
    if lack == "gaps":
        for low in generator.integers(0, readings.shape[0], 30):
            readings[low : low + 20] = np.nan
    elif lack == "one NaN":
        readings[5000, 1] = np.nan
    elif lack == "phase missing":
        phase[3000:3100] = np.nan
    # A random choice of samples turns slow fluctuations into noise of its own.
    keep = generator.random(phase.size) > 0.2 if lack == "uneven" else np.ones(phase.size, dtype=bool)
    part = replace(record, stamps=record.stamps[keep], phase=phase[keep])
    whole = by_joint(record, TRUTH.disturb(record.field))
    less = by_joint(part, readings[keep])
    assert np.all(np.abs(less.value - whole.value) < 3.0 * less.sigma)
    assert np.all(less.sigma < (4.0 if lack == "uneven" else 1.5) * whole.sigma)


def test_a_gap_longer_than_the_part_allowed_costs_its_sub_intervals_only():
    record = steady(4, hours=1.0, density=0.01)
    readings = record.field.copy()
    readings[4000:5000] = np.nan
    found = tones_of(record, readings)
    short = dict(found.excluded)["too few samples"]
    assert 1 <= short.sum() <= 4
    assert np.isfinite(found.tones[~short]).all()
    assert "too few samples" in found.summary()


@pytest.mark.parametrize("wrong", [1.01, 0.98, -1.0])
def test_a_wrong_spin_period_is_refused_and_the_right_one_said(wrong):
    """The phase turns by 1 where the field turns by `wrong`; -1 is a spacecraft that spins the other way."""
    record = steady(7, hours=1.0, density=0.01)
    field = record.field if wrong > 0 else record.field * [1.0, -1.0, 1.0]
    phase = record.phase / abs(wrong)
    layout = cut_into_blocks(field, phase, record.stamps)
    found = measure_tones(field, phase, record.stamps, layout, CalibrationParameters())
    with pytest.raises(CalibrationError, match="does not turn with the phase"):
        check_turning(found, field, phase, layout)
    assert turn_ratio(field, phase, layout.good) == pytest.approx(wrong, abs=1e-3)


def test_a_jump_of_the_phase_costs_the_sub_intervals_around_it():
    record = steady(8, hours=1.0, density=0.01, mean=(100.0, 0.0, 50.0))
    phase = record.phase.copy()
    phase[7000:] += 1.0
    layout = cut_into_blocks(record.field, phase, record.stamps)
    found = measure_tones(record.field, phase, record.stamps, layout, CalibrationParameters())
    jumped = dict(found.excluded)["phase jump"]
    assert 1 <= jumped.sum() <= 3
    inside = (found.start <= record.stamps[7000]) & (found.end >= record.stamps[6999])
    assert np.all(jumped[inside])


def test_saturated_readings_and_excluded_spans_are_left_out_by_name():
    record = steady(9, hours=1.0, density=0.01)
    readings = record.field.copy()
    readings[2000] = 3e4
    eclipse = Exclusion(int(record.stamps[9000]), int(record.stamps[9600]), "eclipse")
    found = tones_of(record, readings, exclusions=(eclipse,))
    hit = dict(found.excluded)
    assert hit["saturated"][(found.start <= record.stamps[2000]) & (found.end >= record.stamps[2000])].all()
    touched = (found.start < eclipse.end) & (found.end >= eclipse.start)
    assert np.array_equal(hit["eclipse"], touched)
    assert not found.usable[touched].any()
    assert "saturated" in found.summary()


def test_a_spike_makes_its_own_sub_interval_uncertain():
    record = steady(10, hours=1.0, density=0.01)
    readings = record.field.copy()
    readings[5000] += [20.0, -15.0, 30.0]
    estimates = estimate_pairs(tones_of(record, readings), SPREAD)
    inside = (estimates.start <= record.stamps[5000]) & (estimates.end >= record.stamps[5000])
    assert estimates.uncertainty[inside, 4].min() > 3 * np.median(estimates.uncertainty[~inside, 4])


def test_what_cannot_be_cut_is_refused_with_the_reason():
    record = steady(11, hours=0.05)
    with pytest.raises(CalibrationError, match="spins of known phase found, 100 needed"):
        cut_into_blocks(record.field, record.phase, record.stamps)
    with pytest.raises(SamplesError, match="shape"):
        cut_into_blocks(record.field[:, :2], record.phase, record.stamps)
    with pytest.raises(SamplesError, match="rise"):
        cut_into_blocks(record.field, record.phase, record.stamps[::-1])
    with pytest.raises(CalibrationError, match="not whole"):
        SubIntervals(overlap=0.3)
    with pytest.raises(CalibrationError, match="spins a block"):
        SubIntervals(spins=12)
    longer = steady(11, hours=0.5)
    with pytest.raises(CalibrationError, match="no sub-interval is usable: 0 of"):
        by_joint(longer, longer.field, PRESENT, good=np.zeros(longer.phase.size, dtype=bool))
