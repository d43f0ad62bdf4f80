"""The eight spin-related parameters come back, with errors that hold, by selection and by all together."""

from dataclasses import replace

import numpy as np
import pytest
from eight_cases import PRESENT, TRUTH, axis_angles, by_joint, by_selection, joined, signed, two_fields
from orbit_fields import SHEATH, SUN_WIND, orbit, steady

from inflight.spin import SPIN_RELATED, CalibrationParameters, phase_from_angle

SIZE = {"gain_ratio": 2e-3, "azimuth": 5e-3, "offset[1]": 4.0, "offset[2]": 4.0}


def shape(name):
    return SIZE.get(name, 3e-3)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("name", SPIN_RELATED)
def test_each_parameter_alone_comes_back_with_either_sign(name, sign):
    record = two_fields(3, hours=0.7)
    value = shape(name) * sign + (1.0 if "gain" in name else 0.0)
    truth = PRESENT.changed({name: value})
    found = by_joint(record, truth.disturb(record.field))
    assert found.settled
    pull = (found.value - truth.spin_related()) / found.sigma
    assert np.all(np.abs(pull) < 4.5)
    at = SPIN_RELATED.index(name)
    assert found.sigma[at] < 0.05 * abs(shape(name))


@pytest.mark.parametrize(
    ("mean", "density"), [((4.0, -3.0, 2.0), 0.01), ((6000.0, 3000.0, 9000.0), 0.05)], ids=["low", "high"]
)
def test_all_together_come_back_in_low_and_in_high_fields(mean, density):
    """In one field offsets and elevations are one tone: their sum is what must hold."""
    record = steady(12, hours=2.0, mean=mean, density=density)
    found = by_joint(record, TRUTH.disturb(record.field))
    assert found.settled
    error = found.value - TRUTH.spin_related()
    assert np.all(np.abs(error / found.sigma) < 4.5)
    for axis in "12":
        assert abs(found.correlation(f"offset[{axis}]", f"elevation[{axis}]")) > 0.9


def test_stated_errors_hold_two_thirds_of_the_time():
    """40 records of turbulence and all signs: eight errors each, for both ways."""
    pulls, chosen = [], []
    for seed in range(40):
        truth, record = signed(seed), two_fields(seed, hours=1.0)
        readings = truth.disturb(record.field)
        one, other = by_joint(record, readings), by_selection(record, readings)
        pulls.append((one.value - truth.spin_related()) / one.sigma)
        chosen.append((other.value - truth.spin_related()) / other.sigma)
    for each in (np.array(pulls), np.array(chosen)):
        assert 0.60 < np.mean(np.abs(each) < 1.0) < 0.76
        assert np.mean(np.abs(each) < 3.0) > 0.97


def test_two_axial_fields_separate_offset_and_elevation_as_far_as_they_differ():
    """1000 +- 500 nT: one tone for two unknowns ties their errors, where the spin axis is well known."""
    low = steady(1, hours=0.7, mean=(9000.0, 0.0, 500.0))
    high = steady(2, hours=0.7, mean=(9000.0, 0.0, 1500.0))
    record = joined(low, high)
    found = by_joint(record, TRUTH.disturb(record.field))
    lever = np.array([500.0, 1500.0])
    expected = lever.mean() / np.sqrt(np.mean(lever**2))
    assert found.correlation("offset[1]", "elevation[1]") == pytest.approx(expected, abs=0.08)
    assert np.all(np.abs(found.value - TRUTH.spin_related()) < 4.5 * found.sigma)


@pytest.mark.parametrize("every", [1, 4])
def test_a_phase_given_with_every_sample_gives_the_eight_as_the_true_one_does(every):
    """An angle read 12 times a turn and once a second: without noise both are the true phase."""
    record = two_fields(3, hours=0.7)
    readings = TRUTH.disturb(record.field)
    angle = np.rad2deg(record.phase)[::every] % 360.0
    told = phase_from_angle(record.stamps[::every], angle, record.stamps, nominal_period=3.0)
    given = np.isfinite(told.phase)
    assert np.all(given[: 1 - every or None])
    found = by_joint(replace(record, phase=told.phase), readings)
    true = by_joint(record, readings)
    np.testing.assert_allclose(found.value, true.value, rtol=0, atol=1e-8)


def test_offsets_larger_than_the_field_are_found():
    record = steady(13, hours=1.0, mean=(3.0, -3.0, 1.0), density=0.005)
    truth = CalibrationParameters(offset=(25.0, -40.0, 0.0))
    for found in (
        by_joint(record, truth.disturb(record.field), CalibrationParameters()),
        by_selection(record, truth.disturb(record.field), CalibrationParameters()),
    ):
        assert found.settled
        assert np.allclose(found.parameters.offset[:2], [25.0, -40.0], atol=0.1)


def test_twenty_spoilt_minutes_hardly_moves_the_joint_estimate():
    record = two_fields(14)
    readings = TRUTH.disturb(record.field)
    clean = by_joint(record, readings)
    spoilt = readings.copy()
    # A line at the spin: nothing beside the tones betrays it.
    spoilt[: 14_400 // 3] += 0.5 * np.cos(record.phase[: 14_400 // 3] + 1.0)[:, None]
    found = by_joint(record, spoilt)
    assert found.robust_weight[:5, [0, 2]].max() < 0.2
    assert found.robust_weight[10:, [0, 2]].min() > 0.0
    assert np.all(np.abs(found.value - clean.value) < 3.0 * found.sigma + 3.0 * clean.sigma)


def test_a_moved_spin_axis_changes_two_parameters_only():
    """A manoeuvre moves the axis by 0.5 deg; with angles of each sensor axis (Kepko) all six would change."""
    record = two_fields(15)
    after = TRUTH.changed(
        {"spin_axis[x]": TRUTH.spin_axis[0] + 8e-3, "spin_axis[y]": TRUTH.spin_axis[1] - 6e-3}
    )
    old = by_joint(record, TRUTH.disturb(record.field))
    later = two_fields(16)
    new = by_joint(later, after.disturb(later.field))
    pull = np.abs(new.value - old.value) / np.hypot(new.sigma, old.sigma)
    moved = {name for name, far in zip(SPIN_RELATED, pull, strict=True) if far > 5.0}
    assert moved == {"spin_axis[x]", "spin_axis[y]"}
    before, after = (axis_angles(one.parameters.matrix()) for one in (old, new))
    assert np.all(np.abs(after[0] - before[0]) > 5e-3)
    assert np.all(np.abs(after[1] - before[1]) > 1e-6)


def test_the_order_of_themis_c_uncertainties_along_its_orbit():
    """Plaschke et al. (2019), section 6: 10 pT in the solar wind, 1e-5 and 1e-4 rad at perigee."""
    record = orbit(1)
    found = by_selection(record, TRUTH.disturb(record.field))
    estimates = found.estimates
    middle = estimates.start // 2 + estimates.end // 2
    region = record.region[np.searchsorted(record.stamps, middle)]
    distance = record.distance[np.searchsorted(record.stamps, middle)]
    best = {
        where: np.nanquantile(estimates.uncertainty[which], 0.1, axis=0)
        for where, which in (
            ("wind", region == SUN_WIND),
            ("sheath", region == SHEATH),
            ("perigee", distance < 3.0),
        )
    }
    at = {name: SPIN_RELATED.index(name) for name in SPIN_RELATED}
    assert best["wind"][at["offset[1]"]] < 0.01
    assert best["sheath"][at["offset[1]"]] > 0.01
    for name in ("gain_ratio", "azimuth", "spin_axis[x]"):
        assert best["perigee"][at[name]] < 1e-5
        assert best["wind"][at[name]] > 1e-4
    assert best["perigee"][at["elevation[1]"]] < 1e-4
    assert best["wind"][at["elevation[1]"]] > 1e-4
    assert best["sheath"][at["elevation[1]"]] > 1e-4
    assert found.settled
    assert np.all(np.abs(found.value - TRUTH.spin_related()) < 4.5 * found.sigma)
