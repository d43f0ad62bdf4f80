"""An old version made again by one command: its own model, tables and archive, and the same bytes."""

import shutil

import numpy as np
import pytest
from tiny_mission import TINY_OFFSET, TINY_START, deliver_tiny_day, make_tiny_workspace

from inflight.catalog import Catalog, Workspace
from inflight.catalog.manifest import manifest_sha256
from inflight.cli import main

FIRST = np.datetime64(TINY_START, "D")


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A workspace of four days whose release 1.0 is not what is published any more: each part changed since.

    One of its days was calibrated with the table of others, by hand.
    """
    root = make_tiny_workspace(tmp_path_factory.mktemp("as-of") / "tiny", days=4)

    def run(*arguments):
        with pytest.raises(SystemExit) as left:
            main([*map(str, arguments), "-w", str(root)])
        assert not left.value.code

    run("ingest", "--no-prefect")
    run("reprocess", "--no-prefect", "--table", "continuous", "--batch-days", 2, "--distribute")
    run("reprocess", "--no-prefect", "--end", FIRST + 2, "--table", "span")
    run("reprocess", "--no-prefect", "--start", FIRST + 3, "--use-table", "main-span")
    run("release", "1.0", "--no-prefect")
    # Another delivery of a day, another mission file, another model.
    deliver_tiny_day(Workspace.open(root).data, TINY_START, 5, 1.5 * TINY_OFFSET)
    mission = root / "mission.yaml"
    mission.write_text(mission.read_text("utf-8").replace("one sample a minute", "60 s"), "utf-8")
    run("ingest", "--no-prefect")
    run("add", "offset_step@2024-03-02T12:00")
    run("reprocess", "--no-prefect")
    return root


@pytest.fixture
def revised(original, tmp_path):
    """A copy of the workspace for one test."""
    return shutil.copytree(original, tmp_path / "copy", symlinks=True)


def test_a_release_is_made_again_with_equal_bytes_whatever_changed_since(inflight, revised):
    catalog = Catalog(revised)
    released = catalog.days("l2/field", release="1.0")
    assert len(released) == 4
    now = {day.day: day for day in catalog.days("l2/field")}
    assert all(now[day.day].segment != day.segment for day in released)
    told = inflight("reprocess", "-w", revised, "--as-of", "1.0", "--json")
    assert told.code == 0, told.out
    assert len(told.json["stores"]) == 3
    assert all(one["equal"] for one in told.json["stores"])
    for day in released:
        again = revised / "as-of" / "1.0" / day.segment
        assert contents(again) == contents(revised / day.segment)
    # Nothing was published.
    assert {day.day: day.id for day in Catalog(revised).days("l2/field")} == {
        day: one.id for day, one in now.items()
    }


def test_a_store_that_is_gone_is_made_again_from_what_the_catalog_knows(inflight, revised, tmp_path):
    (day, *_) = Catalog(revised).days("l2/field", release="1.0")
    sha256, _ = Catalog(revised).stored_together(day)
    shutil.rmtree(revised / day.segment)
    where = ("--destination", tmp_path / "again", "--end", FIRST + 1)
    assert inflight("reprocess", "-w", revised, "--as-of", "1.0", *where).code == 0
    assert manifest_sha256(tmp_path / "again" / day.segment) == sha256


def test_what_comes_out_otherwise_is_told_with_its_days(inflight, revised):
    catalog = Catalog(revised)
    (day, *_) = catalog.days("l2/field", release="1.0")
    (source,) = [
        one
        for one in catalog.days_by_id(edge.parent for edge in catalog.lineage(day))
        if one.dataset == "l1/turning" and one.day == FIRST
    ]
    (revised / source.segment / "field" / "c.0.0").unlink()
    told = inflight("reprocess", "-w", revised, "--as-of", "1.0", "--end", FIRST + 1, "--json")
    assert told.code != 0
    assert str(FIRST) in {one["day"] for one in told.json["problems"]}
    assert not told.json["stores"][0]["equal"]


def test_as_of_refuses_settings_of_its_own_and_versions_that_are_not_there(inflight, revised):
    told = inflight("reprocess", "-w", revised, "--as-of", "1.0", "--table", "daily", "--json")
    assert told.code == 2
    assert "--as-of 1.0" in told.json["error"]["message"]
    assert inflight("reprocess", "-w", revised, "--as-of", "7.0").code == 1
    assert inflight("reprocess", "-w", revised, "--as-of", "v09.00").code == 1
