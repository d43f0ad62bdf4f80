"""What a workspace has to show, and what it says has to be done first."""

import numpy as np
import pytest

from inflight.catalog import Catalog, Workspace
from inflight.explorer.loop_state import LoopState
from inflight.explorer.overview import ComparisonOverview, list_comparisons, next_step, summarise_comparison
from inflight.explorer.session import Days, ExplorerSession
from inflight.tasks.archive import ingest


def offered(workspace: Workspace) -> ComparisonOverview:
    return summarise_comparison(Catalog(workspace.root), workspace.mission(), "main")


def test_an_empty_workspace_says_that_files_are_to_be_ingested(tiny_workspace):
    workspace = Workspace.open(tiny_workspace)
    found = offered(workspace)
    assert found.is_empty
    assert found.span() is None
    assert "inflight ingest" in next_step(workspace, found)


def test_an_archive_without_products_says_that_it_is_to_be_calibrated(tiny_workspace):
    workspace = Workspace.open(tiny_workspace)
    ingest(Catalog(workspace.root), workspace.mission(), workspace.data)
    found = offered(workspace)
    assert (found.archived, found.products) == (2, 0)
    assert found.span() == (np.datetime64("2024-03-01"), np.datetime64("2024-03-02"))
    assert "inflight reprocess" in next_step(workspace, found)


def test_a_calibrated_workspace_asks_for_nothing(calibrated):
    found = offered(calibrated)
    assert next_step(calibrated, found) == ""
    assert found.products == 4
    assert {"main-daily", "main-window"} <= set(found.tables)
    assert found.model.endswith("version 1")
    cat = Catalog(calibrated.root)
    assert cat.published("l2/field") == [
        (one.day, one.context) for one in cat.days("l2/field", states=("published",))
    ]


def test_of_a_long_mission_the_newest_days_are_shown_unasked():
    first, last = np.datetime64("2001-01-01"), np.datetime64("2008-12-31")
    found = ComparisonOverview("main", "scalar", first, last, 2922, 2922, "champ version 1", ())
    assert found.span() == (np.datetime64("2008-12-02"), last)


def test_the_last_day_belongs_to_what_is_shown():
    days = Days(np.datetime64("2024-02-28"), np.datetime64("2024-02-29"))
    assert days.bounds() == ("2024-02-28", "2024-03-01")


def test_main_comes_first():
    from inflight.catalog import shipped_missions
    from inflight.mission import Mission

    path = shipped_missions()["champ-two-fluxgates"]
    names = list_comparisons(Mission.parse(path.read_text(encoding="utf-8")))
    assert names[0] == "main"
    assert sorted(names[1:]) == names[1:]
    assert len(names) > 1


@pytest.mark.parametrize(("table", "owner"), [("main-daily", "main"), ("main-b-daily", "main-b")])
def test_a_table_belongs_to_the_comparison_whose_whole_name_it_has(table, owner):
    from types import SimpleNamespace

    from inflight.explorer.overview import owner_of_table

    mission = SimpleNamespace(comparisons={"main": None, "main-b": None})
    assert owner_of_table(table, mission) == owner


def test_a_comparison_that_cannot_be_diagnosed_says_what_to_do_instead(calibrated, tmp_path):
    session = ExplorerSession(Workspace.create(tmp_path / "ace", "ace"))
    try:
        state, step = LoopState(None, [], "ace", 0, 3, session.instead_of_diagnosis("main")).sentences()
    finally:
        session.close()
    assert state == "Ace is in use."
    assert "what still goes with the spin" in step
    assert "'sun_pulse'" in step
    assert "Diagnose" not in step
    # One that can be is asked to be.
    session = ExplorerSession(calibrated)
    try:
        instead = session.instead_of_diagnosis("main")
    finally:
        session.close()
    assert LoopState(None, [], "heated", 0, 4, instead).sentences()[1].startswith("Diagnose")
