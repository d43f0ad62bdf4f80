"""Choosing estimates, deciding on updates, and the table of twelve."""

import numpy as np
import pytest
from bokeh.models import GlyphRenderer
from eight_cases import PRESENT, TRUTH, by_joint, by_selection, two_fields
from orbit_fields import steady

from inflight.errors import CalibrationError
from inflight.figures import SubintervalEstimates, estimates_figure, uncertainty_figure
from inflight.spin import (
    PARAMETER_NAMES,
    SPIN_RELATED,
    CalibrationParameters,
    ExternalValue,
    choose_estimates,
    join_parameters,
)
from inflight.spin.update import decide_update

AT = {name: index for index, name in enumerate(SPIN_RELATED)}


def decided(value, sigma, present, known):
    old = present.spin_related()
    return {
        name: decide_update(name, (old[at], known[name]), (value[at], sigma[at])) for name, at in AT.items()
    }


def test_the_automatic_threshold_takes_what_lowers_the_error_of_the_mean():
    alike, how = choose_estimates(np.full(40, 2.0))
    assert alike.all()
    assert "least expected error" in how
    mixed, _ = choose_estimates(np.concatenate([np.full(30, 1.0), np.full(30, 100.0), [np.nan]]))
    assert mixed[:30].all()
    assert not mixed[30:].any()


def test_an_accuracy_wanted_is_the_threshold_or_nothing_is_taken():
    sizes = np.linspace(0.1, 2.0, 20)
    chosen, _ = choose_estimates(sizes, accuracy=1.05)
    assert np.array_equal(chosen, sizes < 1.05)
    none, how = choose_estimates(sizes, accuracy=0.15)
    assert not none.any()
    assert "best 0.1" in how
    assert not choose_estimates(np.array([1.0, np.nan, np.inf]))[0].any()


def test_what_is_not_known_well_enough_keeps_its_value():
    record = steady(1, hours=1.0)
    truth = PRESENT.changed({"spin_axis[x]": 0.002})
    found = by_selection(
        record, truth.disturb(record.field), accuracy={"elevation[1]": 1e-9, "elevation[2]": 1e-9}
    )
    assert not found.determined[AT["elevation[1]"]]
    assert found.parameters.elevation == PRESENT.elevation
    assert found.parameters.spin_axis[0] == pytest.approx(0.002, abs=5 * found.sigma[AT["spin_axis[x]"]])
    assert "at least 5 needed" in found.reasons[AT["elevation[1]"]]


def test_mean_and_median_agree_within_their_errors():
    record = two_fields(2, hours=0.7)
    readings = TRUTH.disturb(record.field)
    mean, median = (by_selection(record, readings, statistic=one) for one in ("mean", "median"))
    assert np.all(np.abs(mean.value - median.value) < 3.0 * median.sigma)
    with pytest.raises(CalibrationError, match="mode"):
        by_selection(record, readings, statistic="mode")


def test_updates_are_made_where_they_help_and_not_where_they_add_jitter():
    present = CalibrationParameters()
    value, sigma = present.spin_related(), np.full(8, 1e-5)
    value[AT["spin_axis[x]"]] = 1e-4  # ten sigma from a value that is hardly known
    value[AT["spin_axis[y]"]] = 1e-5  # one sigma
    value[AT["elevation[1]"]], sigma[AT["elevation[1]"]] = 5e-4, 4e-4
    value[AT["elevation[2]"]], sigma[AT["elevation[2]"]] = 5e-3, 4e-4
    sigma[AT["azimuth"]] = np.inf
    known = dict.fromkeys(SPIN_RELATED, 1e-3) | {"elevation[1]": 1e-4, "elevation[2]": 1e-4}
    found = decided(value, sigma, present, known)
    assert found["spin_axis[x]"].verdict == "update"
    assert found["spin_axis[y]"].verdict == "confirm"
    assert found["elevation[1]"].verdict == "keep"
    assert "jitter" in found["elevation[1]"].reason
    assert found["elevation[2]"].verdict == "update"
    assert "both uncertainties" in found["elevation[2]"].reason
    assert found["azimuth"].verdict == "keep"
    assert "does not tell" in found["azimuth"].reason


def test_an_unchanged_sensor_is_hardly_ever_updated_and_a_changed_one_always():
    again = 0
    for seed in range(10):
        record = two_fields(seed, hours=0.4)
        found = by_joint(record, TRUTH.disturb(record.field), TRUTH)
        known = dict(zip(SPIN_RELATED, 3.0 * found.sigma, strict=True))
        again += sum(
            one.verdict == "update" for one in decided(found.value, found.sigma, TRUTH, known).values()
        )
        before = TRUTH.changed({"gain_ratio": TRUTH.gain_ratio + 20.0 * float(found.sigma[0])})
        assert decided(found.value, found.sigma, before, known)["gain_ratio"].verdict == "update"
    assert again <= 2


def test_twelve_parameters_say_where_they_came_from():
    record = two_fields(5, hours=0.5)
    found = by_joint(record, TRUTH.disturb(record.field))
    sigmas = dict.fromkeys(PARAMETER_NAMES, 1e-3) | {"offset[3]": 5.0}
    table = join_parameters(
        (found.value, found.sigma, found.parameters),
        PRESENT,
        sigmas,
        {"offset[3]": ExternalValue(3.0, 0.2, "minimum correlation")},
    )
    source = dict(zip(PARAMETER_NAMES, table.source, strict=True))
    assert {name for name in PARAMETER_NAMES if source[name] == "spin"} == set(SPIN_RELATED)
    assert source["offset[3]"] == "minimum correlation"
    assert {name for name in PARAMETER_NAMES if source[name] == "ground"} == {
        "spin_plane_gain", "axial_gain", "rotation",
    }  # fmt: skip
    assert np.array_equal(table.determined, [source[name] != "ground" for name in PARAMETER_NAMES])
    assert table.parameters == CalibrationParameters.from_values(table.value)
    assert np.allclose(table.parameters.offset, [1.0, -2.0, 3.0], atol=0.01)


def test_a_new_axial_offset_moves_the_spin_plane_ones_along_so_that_no_tone_comes_back():
    """The plane sees C O: with the third offset 3 nT off, the second is 0.12 nT off until it is known."""
    record = two_fields(6, hours=1.0)
    truth = TRUTH.changed({"elevation[2]": -2e-2, "spin_axis[y]": 2e-2})
    found = by_joint(record, truth.disturb(record.field), CalibrationParameters())
    assert abs(found.parameters.offset[1] - truth.offset[1]) == pytest.approx(0.12, rel=0.1)
    spin = (found.value, found.sigma, found.parameters)
    table = join_parameters(
        spin, CalibrationParameters(), {}, {"offset[3]": ExternalValue(3.0, 0.5, "mirror mode")}
    )
    assert np.allclose(table.parameters.offset, truth.offset, atol=4.5 * found.sigma[-2:].max())
    matrix = found.parameters.matrix()
    before, after = (matrix @ np.array(one.offset) for one in (found.parameters, table.parameters))
    assert np.allclose(before[:2], after[:2], atol=1e-12)


def test_what_the_spin_does_not_determine_stays_as_on_the_ground():
    value, sigma = PRESENT.spin_related() + 1e-6, np.full(8, np.inf)
    table = join_parameters((value, sigma, PRESENT), PRESENT, dict.fromkeys(PARAMETER_NAMES, 1e-4))
    assert set(table.source) == {"ground"}
    assert np.array_equal(table.value, PRESENT.values())
    assert table.sigmas()["azimuth"] == 1e-4


def test_the_spin_cannot_be_overruled_and_names_must_exist():
    spin = (PRESENT.spin_related(), np.full(8, 1.0), PRESENT)
    for name in ("gain_ratio", "offset_3"):
        with pytest.raises(CalibrationError, match="cannot be joined"):
            join_parameters(spin, PRESENT, {}, {name: ExternalValue(1.0, 1.0, "guess")})


def test_the_joint_sigma_is_that_of_its_covariance():
    record = two_fields(7, hours=0.5)
    joint = by_joint(record, TRUTH.disturb(record.field))
    assert np.allclose(np.sqrt(np.diag(joint.covariance)), joint.sigma)


def test_figures_show_every_estimate():
    record = two_fields(8, hours=0.7)
    readings = TRUTH.disturb(record.field)
    selection, joint = by_selection(record, readings), by_joint(record, readings)
    cloud = SubintervalEstimates.of(selection)
    for drawn, panels in (
        (estimates_figure(cloud, (joint.value, joint.sigma)), 8),
        (uncertainty_figure(cloud), 4),
    ):
        plots = [one for one, *_ in drawn.children]
        assert len(plots) == panels
        for plot in plots:
            counts = [
                len(next(iter(one.data_source.data.values())))
                for one in plot.renderers
                if isinstance(one, GlyphRenderer) and type(one.glyph).__name__ == "Scatter"
            ]
            assert sum(counts) == int(selection.estimates.usable.sum())
