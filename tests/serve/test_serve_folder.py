"""A release's folder is served as the workspace it came from, and both by a real command."""

import http.client
import json
import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from contextlib import contextmanager

import pytest
from serve_cases import ID, MISSION, SPAN, Client, from_csv, split_header

from inflight.catalog import Catalog
from inflight.errors import CatalogError, SettingsError, WorkspaceError
from inflight.serve import Collection, Server, make_app


@pytest.fixture(scope="module")
def folder(workspace, tmp_path_factory):
    """Release 1.0 copied away."""
    return shutil.copytree(workspace / "releases" / "1.0", tmp_path_factory.mktemp("copied") / "probe")


def test_a_folder_without_database_gives_the_same_answers(client, folder):
    before = sorted(folder.rglob("*"))
    alone = Client(make_app(Collection.open(folder)))
    for text in (
        "catalog",
        "about",
        f"info?dataset={ID}",
        f"data?dataset={ID}&start=2005-12-31T12Z&stop=2006-01-02&include=header",
        f"data?dataset={ID}&start=2005-12-30&stop=2006-01-04&format=binary",
        "info?dataset=probe/1.1/l2/field",
    ):
        mine, theirs = alone.get(f"/hapi/{text}"), client.get(f"/hapi/{text}")
        assert (mine.status_code, mine.content) == (theirs.status_code, theirs.content), text
    assert sorted(folder.rglob("*")) == before


def test_a_release_that_does_not_state_its_mission_is_served_without(workspace, tmp_path):
    catalog = Catalog(shutil.copytree(workspace, tmp_path / "probe"))
    folder = catalog.release("1.1", datasets=("l2/field",))
    answer = Client(make_app(Collection.open(folder))).get("/hapi/catalog").json()
    assert [item["id"] for item in answer["catalog"]] == ["mission/1.1/l2/field"]


def test_what_cannot_be_served_is_told_at_the_start(workspace, tmp_path):
    with pytest.raises(WorkspaceError, match="is no workspace"):
        Collection.open(tmp_path)
    (tmp_path / "mission.yaml").write_text(MISSION.text)
    with pytest.raises(CatalogError, match="nothing was released here") as refused:
        Collection.open(tmp_path)
    assert "inflight release" in refused.value.remedy
    catalog = Catalog(shutil.copytree(workspace, tmp_path / "probe"))
    files = catalog.release("1.1", datasets=("l1/*",), formats=("netcdf",), mission=MISSION)
    with pytest.raises(CatalogError, match="holds no Zarr stores"):
        Collection.open(files)
    # The workspace still has what it released.
    assert "probe/1.1/l1/fgm" in [served.id for served in Collection.open(tmp_path / "probe").datasets()]


def test_an_address_that_cannot_be_listened_on_is_wrong_usage(folder):
    collection = Collection.open(folder)
    first = Server(collection)
    port = int(first.url.split(":")[2].split("/")[0])
    with pytest.raises(SettingsError, match="cannot be listened on"):
        Server(collection, port=port)
    with pytest.raises(SettingsError, match="cannot be listened on"):
        Server(collection, host="192.0.2.1")


@contextmanager
def running(*source):
    """Run `inflight serve` and yield its process and what it printed."""
    code = "from inflight.cli import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-c", code, "serve", "--json", "--port", "0", *map(str, source)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        told = ""
        while not told.endswith("}\n"):
            line = process.stdout.readline()
            assert line, process.stderr.read()
            told += line
        yield process, json.loads(told)
    finally:
        process.kill()
        process.communicate(timeout=30)


@pytest.fixture(params=["workspace", "folder"])
def served(request, workspace, folder):
    """A running server."""
    with running(*(["-w", workspace] if request.param == "workspace" else [folder])) as one:
        yield one


def test_a_real_client_reads_over_a_real_socket_until_the_server_is_interrupted(served, client):
    process, told = served
    assert told["datasets"] == ["probe/1.0/l1/fgm", ID]
    assert told["url"].startswith("http://127.0.0.1:")
    query = f"dataset={ID}&start={SPAN['start']}&stop={SPAN['stop']}&include=header"
    with urllib.request.urlopen(f"{told['url']}/data?{query}") as answer:
        header, rest = split_header(answer.read())
    assert from_csv(rest.decode(), header).size == header["x_samples"]
    assert rest == client.get("/hapi/data", {"dataset": ID, **SPAN}).content
    request = urllib.request.Request(f"{told['url']}/data?{query}", method="HEAD")
    with urllib.request.urlopen(request) as answer:
        assert (answer.status, answer.read()) == (200, b"")
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(f"{told['url']}/data?{query}&fields=x")
    assert json.loads(refused.value.read())["status"]["code"] == 1401
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=20) == 0
    assert process.stderr.read() == ""


def test_damage_met_on_the_way_ends_the_connection_and_is_one_line_for_who_runs_it(folder, tmp_path):
    copied = shutil.copytree(folder, tmp_path / "probe")
    chunks = list(copied.glob("data/l2.field-20060101*/temperature/c.*"))
    assert chunks
    for chunk in chunks:
        chunk.unlink()
    with running(copied) as (process, told):
        query = f"dataset={ID}&start={SPAN['start']}&stop={SPAN['stop']}"
        answer = urllib.request.urlopen(f"{told['url']}/data?{query}")
        with answer, pytest.raises(http.client.IncompleteRead):
            answer.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20) == 0
        (line,) = process.stderr.read().splitlines()
    assert line.startswith("an answer broke off:")
    assert "Traceback" not in line
