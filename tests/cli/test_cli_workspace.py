"""Making a workspace: shipped missions, one's own YAML, what is copied and what is refused."""

import pytest
from tiny_mission import TINY_YAML

from inflight.catalog import Workspace, shipped_missions
from inflight.errors import MissionError, WorkspaceError


@pytest.mark.parametrize("name", sorted(shipped_missions()))
def test_every_shipped_mission_makes_a_workspace_whole(name, tmp_path):
    workspace = Workspace.create(tmp_path / name, name)
    mission = Workspace.open(workspace.root).mission()
    assert mission.text == shipped_missions()[name].read_text(encoding="utf-8")
    for companion in filter(None, [mission.preflight, *mission.effects]):
        assert (workspace.root / companion).is_file()


def test_the_shipped_missions_are_those_promised():
    assert {"champ", "conrad", "usgs-bou", "goes16", "wik-cobenzl", "template"} <= set(shipped_missions())


def test_new_without_arguments_lists_the_missions(inflight):
    told = inflight("new", "--json")
    assert told.code == 0
    assert {item["name"] for item in told.json["missions"]} == set(shipped_missions())


def test_new_makes_a_workspace_and_says_what_comes_next(inflight, tmp_path):
    told = inflight("new", "conrad", tmp_path / "work")
    assert told.code == 0
    assert "inflight ingest" in told.out
    assert (tmp_path / "work" / "data").is_dir()
    assert Workspace.open(tmp_path / "work").mission().mission == "conrad"


def test_new_takes_a_yaml_with_its_model_and_effect_files(inflight, tmp_path):
    source = tmp_path / "mine.yaml"
    source.write_text(TINY_YAML + "preflight: models/start.yaml\neffects: [mine.py]\n", encoding="utf-8")
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "start.yaml").write_text("model: start\n", encoding="utf-8")
    (tmp_path / "mine.py").write_text("# effect\n", encoding="utf-8")
    assert inflight("new", source, tmp_path / "work").code == 0
    assert (tmp_path / "work" / "models" / "start.yaml").read_text(encoding="utf-8") == "model: start\n"
    assert (tmp_path / "work" / "mine.py").is_file()


def test_new_refuses_a_yaml_whose_model_is_missing_and_leaves_nothing(inflight, tmp_path):
    source = tmp_path / "mine.yaml"
    source.write_text(TINY_YAML + "preflight: models/gone.yaml\n", encoding="utf-8")
    told = inflight("new", source, tmp_path / "work", "--json")
    assert told.code == 2
    assert "models/gone.yaml" in told.json["error"]["message"]
    assert not (tmp_path / "work").exists()


def test_new_refuses_a_wrong_yaml_naming_line_and_key(inflight, tmp_path):
    source = tmp_path / "mine.yaml"
    source.write_text(TINY_YAML.replace("cadence: 60 s", "cadence: often", 1), encoding="utf-8")
    told = inflight("new", source, tmp_path / "work", "--json")
    assert told.code == 1
    assert "line 6" in told.json["error"]["message"]
    assert "instruments.turning.cadence" in told.json["error"]["message"]


def test_new_never_overwrites_a_workspace(inflight, tiny_workspace):
    before = (tiny_workspace / "mission.yaml").read_bytes()
    told = inflight("new", "conrad", tiny_workspace)
    assert told.code == 2
    assert (tiny_workspace / "mission.yaml").read_bytes() == before


def test_an_unknown_mission_is_answered_with_those_there_are(inflight, tmp_path):
    told = inflight("new", "voyager", tmp_path / "work", "--json")
    assert told.code == 2
    assert "conrad" in told.json["error"]["remedy"]


def test_a_companion_outside_the_missions_folder_is_refused(tmp_path):
    (tmp_path / "secret.py").write_text("", encoding="utf-8")
    (tmp_path / "in").mkdir()
    source = tmp_path / "in" / "mine.yaml"
    source.write_text(TINY_YAML + "effects: [../secret.py]\n", encoding="utf-8")
    with pytest.raises(WorkspaceError, match="secret"):
        Workspace.create(tmp_path / "work", source)


def test_a_damaged_mission_is_reported_when_the_workspace_is_used(tiny_workspace):
    (tiny_workspace / "mission.yaml").write_text("mission: [", encoding="utf-8")
    with pytest.raises(MissionError, match="line"):
        Workspace.open(tiny_workspace).mission()
