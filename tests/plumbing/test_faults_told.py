"""A wrong line in a mission's YAML is told, in plain words, with the line that mends it."""

from functools import partial

import numpy as np
import pytest
from plumbing_cases import survey_of, wrong

from inflight.plumbing import find_faults
from inflight.plumbing.channels import angle_findings, stale_findings, temperature_findings
from inflight.plumbing.check import pairs_of
from inflight.plumbing.clocks import clock_findings
from inflight.plumbing.fields import axes_findings, unit_findings
from inflight.plumbing.orbit import Orbit, field_ratios, orbit_axes, position_findings


def clocks(survey, orbit=True):
    return clock_findings(survey.mission, pairs_of(survey, Orbit.of(survey) if orbit else None))


def units(survey):
    orbit = Orbit.of(survey)
    return unit_findings(survey, field_ratios(survey, orbit) if orbit else None)


def axes(survey):
    return orbit_axes(survey, Orbit.of(survey))


def temperatures(survey):
    return [one for record in survey.records for one in temperature_findings(record)]


FGM, OVM = "instruments.fgm", "instruments.ovm"
#: Line that is wrong, its value, the test, what is told, and the line that mends it.
FAULTS = {
    "exchanged axes": (
        f"{FGM}.channels.field.axes",
        "[y, x, z]",
        axes,
        "axes x and y are exchanged",
        "[x, y, z]",
    ),
    "reversed axis": (f"{FGM}.channels.field.axes", "[x, y, -z]", axes, "axis z is reversed", "[x, y, z]"),
    "scalar part first": (
        "instruments.attitude.channels.attitude.axes",
        "[w, x, y, z]",
        axes,
        "The attitude is not what the mission states",
        None,
    ),
    "inverse attitude": (
        "instruments.attitude.channels.attitude.axes",
        "[-x, -y, -z, w]",
        axes,
        "the quaternion turns the other way",
        "[x, y, z, w]",
    ),
    "attitude's frame": (
        "instruments.attitude.channels.attitude.frame",
        "gcrf",
        axes,
        "the quaternion is towards itrf",
        "itrf",
    ),
    "microtesla": (f"{FGM}.channels.field.file_unit", "uT", units, "the unit of 'fgm' is wrong", "nT"),
    "ten times": (f"{OVM}.channels.field.factor", "10", units, "the unit of 'ovm' is wrong", "1"),
    "metres": (
        "instruments.orbit.channels.position.file_unit",
        "m",
        position_findings,
        "'position' of 'orbit' is not in km",
        "km",
    ),
    "kelvins": (
        f"{FGM}.channels.coil_temperature.file_unit",
        "K",
        temperatures,
        "'coil_temperature' of 'fgm' is in degC",
        "degC",
    ),
    "a leap second": (
        f"{OVM}.files.clock_offset",
        "1 s",
        clocks,
        "'ovm' are 1 s late (a leap second)",
        "0 s",
    ),
    "GPS time": (
        f"{FGM}.files.clock_offset",
        "13 s",
        clocks,
        "'fgm' are 13 s late (GPS time less UTC)",
        "0 s",
    ),
    "a time zone": (f"{FGM}.files.clock_offset", "-3600 s", clocks, "'fgm' are 1 h early", "0 s"),
    "attitude's clock": (
        "instruments.attitude.files.clock_offset",
        "7200 s",
        clocks,
        "'attitude' are 2 h late",
        "0 s",
    ),
    "orbit's clock": (
        "instruments.orbit.files.clock_offset",
        "-60 s",
        clocks,
        "'orbit' are 60 s early",
        "0 s",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_line_is_told_with_the_right_one(champ, fault):
    text, folder = champ
    path, value, test, words, right = FAULTS[fault]
    changed = wrong(text, path, value)
    (found,) = test(survey_of(changed, folder))
    assert words in found.sentence
    assert found.sure
    assert found.p < 1e-4
    assert found.after < 0.5 * abs(found.before)
    if right is not None:
        assert found.remedies[0].text == f"{path}: {right}"
    assert f"mends it: {path}: " in found.sentence
    assert not test(survey_of(found.remedies[0].applied(changed), folder))


def test_a_sensor_that_a_rotation_mends_has_two_lines_and_both_do(champ):
    text, folder = champ
    changed = wrong(text, f"{FGM}.channels.field.axes", "[y, -x, z]")
    (found,) = axes(survey_of(changed, folder))
    assert not found.sure
    assert "These data cannot tell which" in found.sentence
    assert [one.lines[0][0][-1] for one in found.remedies] == ["axes", "orientation"]
    for remedy in found.remedies:
        assert not axes(survey_of(remedy.applied(changed), folder))


@pytest.mark.parametrize(
    ("path", "value", "test"),
    [
        ("files.clock_offset", "37 s", partial(clocks, orbit=False)),
        ("channels.field.factor", "100", units),
        ("channels.field.axes", "[z, y, x]", axes_findings),
    ],
)
def test_of_two_vectors_alone_both_may_be_at_fault(champ, path, value, test):
    """Without an orbit nothing tells which of two fluxgates is wrong: both lines are named, and mend."""
    text, folder = champ
    changed = wrong(text, f"instruments.fgm2.{path}", value)
    alone = partial(survey_of, folder=folder, comparison="between", without=("orbit", "attitude"))
    (found,) = test(alone(changed))
    assert {one.lines[0][0][1] for one in found.remedies} == {"fgm", "fgm2"}
    for remedy in found.remedies:
        assert not test(alone(remedy.applied(changed)))


@pytest.mark.parametrize("comparison", ["main", "between"])
def test_right_lines_have_no_finding(champ, comparison):
    text, folder = champ
    assert find_faults(survey_of(text, folder, comparison)) == ()


def test_of_a_scalar_instrument_without_an_orbit_axes_cannot_be_told(champ):
    text, folder = champ
    changed = wrong(text, f"{FGM}.channels.field.axes", "[z, -y, x]")
    assert find_faults(survey_of(changed, folder, without=("orbit", "attitude"))) == ()


@pytest.mark.parametrize(("name", "axis"), [("vector", 1), ("scalar", None), ("coil_temperature", None)])
def test_a_stale_reading_is_told_with_its_time_and_axis(champ, name, axis):
    text, folder = champ
    record = {one.name: one for one in survey_of(text, folder).records}[name]
    assert stale_findings(record) == []
    held = record.values if axis is None else record.values[:, axis]
    held[3000:4000] = held[3000]
    (found,) = stale_findings(record)
    assert found.start == record.stamps[3000]
    assert found.end == record.stamps[3999]
    assert found.axes == (() if axis is None else ("y",))
    assert "the same number 1000 times in a row" in found.sentence
    assert "most_repeats" in found.remedies[0].text


def test_a_switched_current_that_rests_is_not_stale(champ):
    """A channel at rest, at a level, at an end of its range or with few readings tells nothing."""
    text, folder = champ
    record = survey_of(text, folder).channels["heater_current"]
    assert stale_findings(record) == []
    levels = np.repeat(np.arange(400) % 3, 20).astype(float)
    levels[1000:3000] = 1.0
    levels[5000:7000] = 1.0
    rest = np.concatenate([np.random.default_rng(1).normal(50.0, 10.0, 4000), np.zeros(4000)])
    for values in (levels, rest, np.full(50, 3.0)):
        stamps = record.stamps[0] + 10**10 * np.arange(values.size)
        assert stale_findings(type(record)(**{**vars(record), "values": values, "stamps": stamps})) == []


@pytest.mark.parametrize(("unit", "really"), [("deg", "rad"), ("rad", "deg")])
def test_an_angle_that_goes_round_shows_its_unit(champ, unit, really):
    text, folder = champ
    record = survey_of(text, folder).channels["heater_current"]
    turn = 2 * np.pi if really == "rad" else 360.0
    angle = (np.arange(record.values.size) * 0.013 * turn) % turn
    entry = record.entry.model_copy(update={"unit": unit})
    made = type(record)(**{**vars(record), "values": angle, "entry": entry})
    (found,) = angle_findings(made)
    assert found.remedies[0].text.endswith(f"file_unit: {really}")
    right = type(record)(**{**vars(made), "entry": entry.model_copy(update={"unit": really})})
    assert angle_findings(right) == []
