"""Real instruments whose missions are described rightly have no fault of plumbing; what is put in is told."""

import pytest
from injections import REAL, ROOT
from plumbing_cases import survey_of, wrong

from inflight.plumbing import find_faults

pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not REAL.is_dir(), reason=f"the folder of real measurements {REAL} is absent"),
]

FOLDERS = {
    "conrad": "conrad-wic-storm-may2024",
    "usgs-bou": "usgs-bou-201601",
    "goes16": "goes16-mag-ib-ob",
    "wik-cobenzl": "wik-cobenzl-2011",
    "magnav-tl": "magnav-tl",
}
PAIRS = [
    ("conrad", "main"),
    ("usgs-bou", "main"),
    ("usgs-bou", "published"),
    ("goes16", "main"),
    ("wik-cobenzl", "main"),
    ("wik-cobenzl", "dependent"),
    ("wik-cobenzl", "variometer"),
    ("magnav-tl", "main"),
]


def text_of(mission):
    return (ROOT / "missions" / f"{mission}.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize(("mission", "comparison"), PAIRS)
def test_no_pair_of_real_instruments_has_a_fault(mission, comparison):
    assert find_faults(survey_of(text_of(mission), REAL / FOLDERS[mission], comparison)) == ()


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("gp20s3.files.clock_offset", "18 s", "18 s early against those of 'gp20s3' (GPS time less UTC)"),
        ("gp20s3.files.clock_offset", "-3600 s", "1 h late against those of 'gp20s3'"),
        ("lemi.channels.field.file_unit", "uT", "The field of 'lemi' is 1000 times that of 'gp20s3'"),
    ],
)
def test_a_fault_put_into_the_storm_at_conrad_is_told_and_mended(path, value, words):
    """Nothing tells which of two instruments of an observatory is wrong: both lines are named."""
    folder = REAL / FOLDERS["conrad"]
    changed = wrong(text_of("conrad"), f"instruments.{path}", value)
    (found,) = find_faults(survey_of(changed, folder))
    assert words in found.sentence
    assert {one.lines[0][0][1] for one in found.remedies} == {"lemi", "gp20s3"}
    assert find_faults(survey_of(found.remedies[0].applied(changed), folder)) == ()


def test_an_axis_of_a_sensor_of_goes_that_is_reversed_is_told():
    folder = REAL / FOLDERS["goes16"]
    changed = wrong(text_of("goes16"), "instruments.outboard.channels.field.axes", "[x, y, -z]")
    (found,) = find_faults(survey_of(changed, folder))
    assert "axis z is reversed" in found.words
    right = next(one for one in found.remedies if one.lines[0][0][1] == "outboard")
    assert right.text == "instruments.outboard.channels.field.axes: [x, y, z]"
