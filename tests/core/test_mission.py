from pathlib import Path

import pytest

from inflight.errors import MissionError
from inflight.mission import Mission, sensors_of
from inflight.tasks.archive.ingestion import content_key

MISSIONS = sorted((Path(__file__).parents[2] / "missions").glob("*.yaml"))
SMALL = """mission: probe
instruments:
  mag:
    role: vector
    cadence: 1 s
    files: {pattern: "mag_{day:%Y%m%d}.cdf", reader: cdf, time: Epoch}
    channels:
      field: {variable: B, unit: nT, axes: [x, y, z]}
comparisons:
  main: {kind: spin, vector: mag}
"""


def test_the_small_mission_is_right():
    mission = Mission.parse(SMALL)
    assert mission.instruments["mag"].cadence == 10**9
    assert mission.files("mag").pattern == ["mag_{day:%Y%m%d}.cdf"]


@pytest.mark.parametrize("path", MISSIONS, ids=lambda path: path.stem)
def test_every_shipped_mission_parses_and_states_a_comparison(path):
    mission = Mission.parse(path.read_text(encoding="utf-8"), path.name)
    assert mission.comparisons
    # A variant of a mission is called by the mission's name and what it adds.
    assert path.stem == mission.mission or path.stem.startswith(f"{mission.mission}-")


def test_the_template_shows_every_key():
    text = next(path for path in MISSIONS if path.stem == "template").read_text(encoding="utf-8")
    for model in ("Files", "Channel", "ClockStep", "Instrument", "Mission", "Positions", "ReleaseHeader"):
        import inflight.mission

        for key in getattr(inflight.mission, model).model_fields:
            assert f"{key}:" in text, f"{model}.{key} is not in missions/template.yaml"


@pytest.mark.parametrize(
    ("old", "new", "line", "told"),
    [
        ("cadence: 1 s", "cadence: fast", 5, "instruments.mag.cadence"),
        ("unit: nT", "unit: nanotelsa", 8, "unit"),
        ("role: vector", "roll: vector", 4, "instruments.mag.roll"),
        ("reader: cdf", "reader: excel", 6, "reader"),
        ("{day:%Y%m%d}", "{day:%Q}", 6, "strftime"),
        ("{day:%Y%m%d}", "{date:%Y%m%d}", 6, "{day:...}"),
        ("time: Epoch", 'time: Epoch, good_when: "__import__(1)"', 6, "good_when"),
        ("axes: [x, y, z]", "axes: [x, y]", 3, "three axes"),
        ("vector: mag", "vector: fgm", 10, "there is no instrument 'fgm'"),
        ("  mag:", "  mag: [", 5, "not YAML"),
        ("cadence: 1 s", "cadence: 1 s\n    delay: {value: 1 s}", 3, "delay: {value: ..., sigma: ...}"),
        ("cadence: 1 s", "cadence: 1 s\n    delay: {value: 1 s, sigma: -1 s}", 6, "instruments.mag.delay"),
        ("cadence: 1 s", "cadence: 1 s\n    sigma: 0.1", 3, "beside its value"),
    ],
)
def test_what_is_wrong_is_named_with_line_and_key(old, new, line, told):
    with pytest.raises(MissionError) as caught:
        Mission.parse(SMALL.replace(old, new), "probe.yaml")
    assert "probe.yaml" in str(caught.value)
    assert f"line {line}:" in str(caught.value)
    assert told in str(caught.value)


def test_files_of_another_instrument_are_shared_and_own_options_win():
    text = SMALL.replace(
        "comparisons:",
        """  other:
    role: vector
    cadence: 1 s
    files: {same_as: mag, time: Epoch2, clock_offset: 13 s}
    channels: {field: {variable: B2, unit: nT, axes: [x, y, z]}}
comparisons:""",
    )
    files = Mission.parse(text).files("other")
    assert files.reader == "cdf"
    assert files.time == ["Epoch2"]
    assert [(step.since, step.offset) for step in files.clock_offset] == [(None, 13 * 10**9)]


def test_position_orientation_and_delay_are_written_with_their_sigma_or_without():
    plain = Mission.parse(SMALL.replace("cadence: 1 s", "cadence: 1 s\n    delay: 40 ms"))
    lines = """cadence: 1 s
    position: {value: [4.75, 0, 0], sigma: 0.02}
    orientation: {value: [0, 0, 0, 1], sigma: 0.05}
    delay: {value: 40 ms, sigma: 2 ms}"""
    stated = Mission.parse(SMALL.replace("cadence: 1 s", lines))
    mag = stated.instruments["mag"]
    assert (mag.position, mag.orientation, mag.delay) == ((4.75, 0, 0), (0, 0, 0, 1), 40_000_000)
    assert mag.sigma.model_dump() == {"position": 0.02, "orientation": 0.05, "delay": 2_000_000}
    assert sensors_of(stated)["mag"].sigma == mag.sigma
    assert not any(plain.instruments["mag"].sigma.model_dump().values())
    # What is known of a place or a clock changes no sample: nothing is read anew.
    assert len({content_key(one.files("mag"), one.instruments["mag"]) for one in (plain, stated)}) == 1
