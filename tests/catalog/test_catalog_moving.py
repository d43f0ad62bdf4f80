"""A catalog moves to another database and back, whole or not at all."""

import json
import subprocess
import sys

import pytest
from catalog_cases import days_from, delivered, publish, publish_seed, state_url, table
from postgres_server import PASSWORD

from inflight.catalog import Catalog, NamedContext, move_catalog
from inflight.catalog.location import MOVED_SETTING
from inflight.catalog.schema import SettingRow
from inflight.errors import CatalogError, IntegrityError

DAYS = days_from("2005-01-01", 3)


@pytest.fixture
def catalog(tmp_path):
    """A catalog in SQLite with something in every table."""
    catalog = Catalog(tmp_path / "workspace")
    catalog.save_model("m", "text", change={"before": 1.5})
    made = publish_context(catalog)
    publish(catalog, "l1/fgm", DAYS, key="k", context=made)
    publish(catalog, "l1/fgm", DAYS[:1], seed=1)
    with catalog.run("ingest") as run:
        catalog.record_files(run, [delivered(run, "abc", *DAYS, coverage=float("nan"))])
        run.record("l1/fgm", DAYS[2], "failed", "bug", "'quoted' – ünïcode")
        run.publish()
    publish_seed(catalog, 0)
    catalog.set_baseline(2)
    catalog.release("1.0", datasets=["l1/*"])
    return catalog


@pytest.fixture
def url(postgres_server, template):
    with postgres_server.database(template) as name:
        yield postgres_server.url(name)


def publish_context(catalog):
    with catalog.run("calibrate") as run:
        made = run.stage_table("offsets-of-context", table(), start=0, end=10)
    context = catalog.save_context("mission", "m", 1, {"offsets-of-context": [(made, 0, 10)]})
    named = {"name": "flight", "comparison": "main", "context": context, "run": run.id}
    catalog.name_contexts("flight", [NamedContext(**named, author="A", reason="r", as_of="", created="")])
    return context


def view(catalog):
    """Everything a user can ask a catalog."""
    names = [item["dataset"] for item in catalog.inventory()]
    days = [day for name in names for day in (*catalog.days(name), *catalog.revisions(name))]
    return (
        repr(days),
        catalog.inventory(),
        catalog.tables(),
        catalog.certification_acts(),
        catalog.named_contexts(),
        catalog.models(),
        catalog.runs(),
        repr(catalog.files("fgm")),
        catalog.releases(),
        catalog.baseline,
        [sorted(catalog.lineage(day)) for day in days],
    )


def test_a_catalog_moves_to_postgresql_and_back_and_nothing_is_lost(catalog, url):
    workspace, before, told = catalog.workspace, view(catalog), []
    moved = move_catalog(workspace, url, progress=lambda *step: told.append(step))
    assert moved.done
    # Each row is copied and read back.
    assert told[0] == ("move", 0, told[0][2])
    assert told[-1] == ("move", told[0][2], told[0][2])
    assert told[0][2] >= 2 * sum(moved.rows.values())
    assert moved.rows["day"] == 9
    assert not (workspace / "catalog.db").exists()
    there = Catalog(workspace)
    assert there._database.backend.is_shared
    assert view(there) == before
    publish(there, "l1/fgm", DAYS, seed=2)  # numbers of new rows go on behind those that were moved
    there.save_model("m", "other")
    after = view(there)
    back = move_catalog(workspace, "sqlite")
    assert back.rows["day"] == moved.rows["day"] + 3
    assert not (workspace / "catalog.yaml").exists()
    assert view(Catalog(workspace)) == after
    publish(Catalog(workspace), "l1/fgm", DAYS, seed=3)
    assert move_catalog(workspace, url).rows["day"] == back.rows["day"] + 3, "what was moved away is replaced"
    assert [fault for fault in Catalog(workspace).verify() if fault["item"] != "file:abc"] == []


def test_a_dry_run_counts_and_changes_nothing(catalog, url):
    before = view(catalog)
    told = move_catalog(catalog.workspace, url, dry_run=True)
    assert (told.done, told.rows["run"], told.rows["release"]) == (False, len(catalog.runs()), 1)
    reopened = Catalog(catalog.workspace)
    assert not reopened._database.backend.is_shared
    assert view(reopened) == before


def test_the_verb_tells_what_moves_and_where_the_password_belongs(
    catalog, postgres_server, template, monkeypatch
):
    (catalog.workspace / "mission.yaml").write_text("")

    def inflight(*arguments):
        line = ["-c", "from inflight.cli import main; main()", "catalog", *arguments]
        line = [sys.executable, *line, "--workspace", catalog.workspace]
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        assert PASSWORD.split()[0] not in done.stdout + done.stderr
        return done

    with postgres_server.database(template) as name:
        address = postgres_server.tcp_url(name)
        told = json.loads(inflight("move", address, "--dry-run", "--json").stdout)
        assert (told["done"], told["rows"]["model"]) == (False, 1)
        assert (catalog.workspace / "catalog.db").exists()
        assert "PGPASSWORD" in inflight("move", address).stdout
        assert "password" in inflight("list").stderr, "the password was written down"
        monkeypatch.setenv("INFLIGHT_CATALOG", address)
        assert "INFLIGHT_CATALOG is set" in inflight("move", "sqlite").stdout


def test_who_still_has_the_old_address_is_told_where_the_catalog_is(catalog, url):
    workspace = catalog.workspace
    move_catalog(workspace, url)
    move_catalog(workspace, "sqlite")
    state_url(workspace, url)
    with pytest.raises(CatalogError, match=r"was moved: sqlite.*catalog\.db"):
        Catalog(workspace)


def test_a_run_is_not_begun_where_the_catalog_was_moved_away_from(catalog, url):
    move_catalog(catalog.workspace, url)
    there = Catalog(catalog.workspace)
    move_catalog(catalog.workspace, "sqlite")
    with pytest.raises(CatalogError, match=r"was moved: sqlite"):
        there.run("ingest").__enter__()


def test_a_move_while_a_run_is_under_way_is_refused(catalog, url):
    with catalog.run("ingest") as run, pytest.raises(CatalogError, match=run.id):
        move_catalog(catalog.workspace, url)
    assert move_catalog(catalog.workspace, url).done


def test_a_database_that_holds_another_catalog_is_not_overwritten(catalog, url, tmp_path):
    state_url(tmp_path / "other", url)
    other = Catalog(tmp_path / "other")
    publish(other, "l1/fgm", DAYS)
    with pytest.raises(CatalogError, match="holds a catalog already"):
        move_catalog(catalog.workspace, url)
    assert len(other.days("l1/fgm")) == 3


def test_rows_that_do_not_arrive_stop_the_move_and_change_nothing(catalog, url, postgres_server):
    before, name = view(catalog), url.partition("?")[0].rpartition("/")[2]
    postgres_server.execute("CREATE RULE lose AS ON INSERT TO model DO INSTEAD NOTHING", name)
    with pytest.raises(IntegrityError, match="'model' was not copied whole: 1 rows, 0 arrived"):
        move_catalog(catalog.workspace, url)
    reopened = Catalog(catalog.workspace)
    assert not reopened._database.backend.is_shared
    assert view(reopened) == before
    assert postgres_server.execute("SELECT count(*) FROM run", name) == [(0,)]
    postgres_server.execute("DROP RULE lose ON model", name)
    assert move_catalog(catalog.workspace, url).done


@pytest.mark.parametrize("reached", ["target.write", "join", "state_location", "_put_aside"])
def test_a_move_that_was_interrupted_is_finished_by_the_same_call(catalog, url, monkeypatch, reached):
    before = view(catalog)

    def killed(*_arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as interrupted:
        name = "_unmark" if reached == "target.write" else reached
        interrupted.setattr(f"inflight.catalog.moving.{name}", killed)
        with pytest.raises(KeyboardInterrupt):
            move_catalog(catalog.workspace, url)
    assert move_or_open(catalog.workspace, url)
    assert view(Catalog(catalog.workspace)) == before


def move_or_open(workspace, url):
    """Finish the move where the old database is still the one that is stated."""
    if (workspace / "catalog.yaml").exists():
        return Catalog(workspace)._database.backend.is_shared
    with pytest.raises(CatalogError, match="was moved"):
        Catalog(workspace)
    return move_catalog(workspace, url).done


def test_the_mark_of_an_unfinished_move_is_gone_afterwards(catalog, url):
    move_catalog(catalog.workspace, url)
    database = Catalog(catalog.workspace)._database
    assert database.read(lambda session: session.get(SettingRow, MOVED_SETTING)) is None
