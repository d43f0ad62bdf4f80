"""The model by the command line: shown, compared, its history listed; looking saves nothing."""

import pytest

from inflight.catalog import Catalog, Workspace
from inflight.tasks import current_model


@pytest.fixture
def champ(tmp_path) -> Workspace:
    """A workspace of the shipped mission whose model has two versions."""
    workspace = Workspace.create(tmp_path / "champ", "champ")
    cat = Catalog(workspace.root)
    first = current_model(cat, workspace.mission())
    later = first.model.with_values({"time_shift.seconds": 0.016}).drop("induced_second")
    cat.save_model(later.name, later.text, parent=first.version, message="clock refitted")
    return workspace


def test_show_prints_every_effect_with_values_and_uncertainties(inflight, champ):
    told = inflight("model", "show", "-w", champ.root)
    assert told.code == 0
    assert told.out.startswith("champ-preflight version 2 (from version 1): clock refitted")
    row = next(line.split() for line in told.out.splitlines() if "time_shift" in line)
    assert row == ["time_shift", "ovm", "seconds", "0.0160", "0.0020", "s", "constant", "free"]
    assert "misalignment[xy]" in told.out
    assert "induced_second" not in told.out


@pytest.mark.parametrize("named", ["1", "champ-preflight:1"])
def test_show_takes_a_version(inflight, champ, named):
    told = inflight("model", "show", named, "--json", "-w", champ.root).json
    assert (told["command"], told["name"], told["version"], told["parent"]) == (
        "model show",
        "champ-preflight",
        1,
        None,
    )
    names = [entry.get("name", entry["effect"]) for entry in told["model"]["effects"]]
    assert "induced_second" in names
    assert told["model"]["mission"] == "champ"


def test_show_takes_a_name_for_its_newest_version(inflight, champ):
    assert inflight("model", "show", "champ-preflight", "--json", "-w", champ.root).json["version"] == 2


def test_a_model_that_was_never_used_is_shown_and_not_saved(inflight, tmp_path):
    root = Workspace.create(tmp_path / "new", "champ").root
    told = inflight("model", "show", "--json", "-w", root).json
    assert told["version"] is None
    assert told["model"]["effects"]
    assert inflight("model", "history", "--json", "-w", root).json["items"] == []
    assert "not used yet" in inflight("model", "show", "-w", root).out


def test_diff_tells_what_changed_as_sentences_and_as_fields(inflight, champ):
    told = inflight("model", "diff", "1", "--json", "-w", champ.root).json
    assert (told["from"]["version"], told["to"]["version"]) == (1, 2)
    assert [(one["change"], one["effect"], one["key"]) for one in told["changes"]] == [
        ("dropped", "induced_second", ""),
        ("changed", "time_shift", "seconds.value"),
    ]
    assert (told["changes"][1]["from"], told["changes"][1]["to"]) == (0.0145, 0.016)
    shown = inflight("model", "diff", "2", "1", "-w", champ.root).out
    assert "added induced_second" in shown
    (moved,) = [line for line in shown.splitlines() if line.startswith("time_shift.seconds")]
    assert moved.strip().split("  ")[1:] == ["0.0160 ± 0.0020", "0.0145 ± 0.0020", "s"]
    assert "nothing differs" in inflight("model", "diff", "2", "2", "-w", champ.root).out


def test_history_lists_versions_and_marks_the_one_in_use(inflight, champ):
    items = inflight("model", "history", "--json", "-w", champ.root).json["items"]
    assert [(item["version"], item["parent"], item["message"], item["used"]) for item in items] == [
        (1, None, "pre-flight model", False),
        (2, 1, "clock refitted", True),
    ]
    assert all(len(item["sha256"]) == 64 and item["created"] for item in items)
    lines = inflight("model", "history", "-w", champ.root).out.splitlines()
    assert [line for line in lines if line.startswith("*")] == [line for line in lines if "refitted" in line]
    assert lines[-1].startswith("next: inflight")


@pytest.mark.parametrize("named", ["9", "champ-preflight:9", "champ-prefligt"])
def test_a_version_that_is_not_there_is_answered_with_those_that_are(inflight, champ, named):
    told = inflight("model", "show", named, "--json", "-w", champ.root)
    assert told.code == 1
    assert "champ-preflight:1, champ-preflight:2" in told.json["error"]["remedy"]


def test_an_unknown_comparison_is_wrong_usage(inflight, champ):
    told = inflight("model", "show", "--comparison", "man", "--json", "-w", champ.root)
    assert told.code == 2
    assert "did you mean 'main'" in told.json["error"]["message"]


def test_an_effect_of_a_channel_that_is_not_there_is_refused_before_any_data_are_read(
    inflight, champ, monkeypatch
):
    from inflight.tasks.analysis import revise

    monkeypatch.setattr(revise.Workbench, "__post_init__", lambda bench: pytest.fail("data were read"))
    for wrong in ("channel_field(heater_curent)", "{effect: channel_field, channel: heater_curent}"):
        told = inflight("add", wrong, "--workspace", champ.root)
        assert told.code == 1
        assert "heater_current" in told.out + told.err
    for wrong in ("{effect: channel_feld, channel: heater_current}",):
        told = inflight("add", wrong, "--workspace", champ.root)
        assert "channel_field" in told.out + told.err


@pytest.mark.parametrize("asked", ["day_night", "{effect: day_night}", "channel_field(sunlit)"])
def test_an_effect_of_the_orbit_is_refused_where_the_mission_has_no_positions(
    inflight, tmp_path, monkeypatch, asked
):
    from tiny_mission import make_tiny_workspace

    from inflight.tasks.analysis import revise

    monkeypatch.setattr(revise.Workbench, "__post_init__", lambda bench: pytest.fail("data were read"))
    root = make_tiny_workspace(tmp_path / "tiny")
    assert inflight("ingest", "--no-prefect", "--workspace", root).code == 0
    told = inflight("add", asked, "--json", "--workspace", root)
    assert told.code == 1
    assert "'sunlit', which the mission has not" in told.json["error"]["message"]
    assert "positions" in told.json["error"]["remedy"]
