"""Workspaces that can only be read: reading goes on, also beside a writer, and writing is refused."""

import json
import os
import subprocess
import sys

import pytest
from fault_cases import DAYS, PRODUCTS, view
from test_faults_storage import mounted

from inflight.catalog import Catalog
from inflight.catalog.schema import SettingRow
from inflight.errors import StorageError


@pytest.fixture
def sealed(fresh, tmp_path):
    """A workspace, and a place where the same can only be read."""
    workspace, place = fresh("reprocessed"), tmp_path / "sealed"
    mounted(place, "--bind", str(workspace))
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", str(place)], check=True)
        yield workspace, place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def command(*arguments, user=None):
    line = [sys.executable, "-c", "from inflight.cli import main; main()", *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True, check=False, user=user, timeout=300)


def test_everything_that_reads_reads_a_sealed_workspace(sealed):
    workspace, place = sealed
    open_there, here = Catalog(place), Catalog(workspace)
    for name in PRODUCTS:
        assert open_there.open(name).load().identical(here.open(name).load())
    assert open_there.table("main-window", DAYS[0]).identical(here.table("main-window", DAYS[0]))
    assert open_there.verify() == []
    assert view(place) == view(workspace)


def test_the_command_line_lists_and_compares_a_sealed_workspace(sealed, tmp_path):
    _, place = sealed
    listed = command("catalog", "list", "--json", "-w", place)
    assert "l2/field" in {item["dataset"] for item in json.loads(listed.stdout)["items"]}
    told = command("compare", "-w", place)
    assert told.returncode == 0, told.stderr
    assert "--output names another place" in told.stdout
    assert command("compare", "--output", tmp_path / "page.html", "-w", place).returncode == 0
    assert (tmp_path / "page.html").is_file()
    refused = command("compare", "--json", "--output", place / "page.html", "-w", place)
    assert json.loads(refused.stdout)["error"]["kind"] == "StorageError"


def test_writing_to_a_sealed_workspace_is_refused(sealed):
    workspace, place = sealed
    before = view(workspace)
    catalog = Catalog(place)
    for write in (lambda: catalog.set_baseline(2), lambda: catalog.run("example").__enter__()):
        with pytest.raises(StorageError, match="make the workspace writable"):
            write()
    assert view(workspace) == before


def test_a_reader_who_cannot_write_sees_what_a_writer_beside_has_committed(sealed):
    workspace, place = sealed
    writer, reader = Catalog(workspace), Catalog(place)

    def change(session):
        session.merge(SettingRow(name="baseline", value="3"))
        session.flush()
        assert reader.baseline == 1

    def look(session):
        session.connection()  # holds the log open, so that it is not yet merged into the database
        writer.set_baseline(4)
        assert (workspace / "catalog.db-wal").stat().st_size > 0
        assert reader.baseline == 4

    writer._database.write(change)
    writer._database.read(look)
    assert reader.baseline == 4


def test_a_user_without_the_right_to_write_reads_a_shared_workspace(fresh):
    if os.geteuid() != 0:
        pytest.skip("only root can become another user; the read-only mount is tested")
    workspace = fresh("reprocessed")
    for path in (workspace, *workspace.parents):
        if path.stat().st_mode & 0o005 != 0o005 and path.parent != path:
            path.chmod(path.stat().st_mode | 0o055)
    for path in workspace.rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o644)
    try:
        told = command("catalog", "list", "--json", "-w", workspace, user=65534)
    except PermissionError:
        pytest.skip("another user cannot run this Python; the read-only mount is tested")
    assert told.returncode == 0, told.stderr
    assert "l2/field" in {item["dataset"] for item in json.loads(told.stdout)["items"]}
