"""`catalog repair` by the command line, and folders of deliveries that are not there."""

import shutil
from pathlib import Path

import pytest
from tiny_mission import make_tiny_workspace

from inflight.catalog import Catalog, Workspace
from inflight.mission import Mission
from inflight.tasks.archive import ingest


def taken_in(root: Path) -> Path:
    workspace = Workspace.open(make_tiny_workspace(root))
    mission: Mission = workspace.mission()
    ingest(Catalog(workspace.root), mission, workspace.data)
    return workspace.root


def test_verify_names_repair_and_repair_names_what_comes_next(inflight, tmp_path):
    root = taken_in(tmp_path / "tiny")
    chunk = next((root / "stores").rglob("c.*"))
    whole = chunk.read_bytes()
    chunk.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert "inflight catalog repair" in inflight("catalog", "verify", "-w", root).out
    listed = inflight("catalog", "repair", "--dry-run", "--json", "-w", root).json
    assert inflight("catalog", "verify", "-w", root).code == 1
    told = inflight("catalog", "repair", "-w", root)
    assert told.code == 0
    assert "inflight ingest" in told.out
    assert listed["items"][0]["path"] in told.out
    assert listed["items"][0]["days"] == ["2024-03-01", "2024-03-02"]
    assert inflight("catalog", "verify", "-w", root).code == 0
    assert inflight("catalog", "repair", "--json", "-w", root).json["items"] == []


@pytest.mark.parametrize("form", [("{}",), ("--data", "{}")])
def test_a_folder_of_deliveries_that_is_not_there_is_wrong_usage(inflight, tmp_path, form):
    root = make_tiny_workspace(tmp_path / "tiny")
    absent = str(tmp_path / "absent")
    told = inflight("ingest", *(part.format(absent) for part in form), "--no-prefect", "--json", "-w", root)
    assert told.code == 2
    assert absent in told.json["error"]["message"]
    assert told.json["error"]["remedy"]


def test_an_absent_default_folder_is_told_of_each_instrument(inflight, tmp_path):
    root = make_tiny_workspace(tmp_path / "tiny")
    shutil.rmtree(root / "data")
    told = inflight("ingest", "--no-prefect", "--workers", 1, "--json", "-w", root)
    assert told.code == 1
    assert told.json["days"]["planned"] == 0
    problems = told.json["problems"]
    assert [one["instrument"] for one in problems] == ["turning", "absolute"]
    assert all(str(root / "data") in one["message"] and one["remedy"] for one in problems)
