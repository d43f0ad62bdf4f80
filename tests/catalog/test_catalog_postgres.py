"""The catalog in PostgreSQL: where it is stated, many writers, leases, and a server that goes away."""

import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from catalog_cases import (
    days_from,
    end_leases,
    publish,
    publish_one_day,
    publish_own_dataset,
    samples,
    spawn,
    state_url,
    table,
)
from postgres_server import PASSWORD, PostgresServer, server_programs

from inflight.catalog import Catalog
from inflight.catalog.database import address_without_password
from inflight.catalog.location import database_url, parse_url, state_location
from inflight.catalog.runs import close_dead_runs
from inflight.catalog.schema import CertificationRow
from inflight.errors import CatalogError, StorageError, ValidityError, WorkspaceError

DAY = days_from("2005-01-01", 1)[0]


@pytest.fixture
def database(postgres_server, template):
    with postgres_server.database(template) as name:
        yield name


@pytest.fixture
def catalog(postgres_server, database, tmp_path):
    state_url(tmp_path / "workspace", postgres_server.url(database))
    return Catalog(tmp_path / "workspace")


# --- where it is stated ------------------------------------------------------------------------------


def test_the_variable_goes_before_the_file_of_the_workspace(postgres_server, database, tmp_path, monkeypatch):
    monkeypatch.setenv("INFLIGHT_CATALOG", postgres_server.url(database))
    state_url(tmp_path, "sqlite:////nowhere/at/all")
    publish(Catalog(tmp_path), "l1/fgm", [DAY])
    assert not (tmp_path / "catalog.db").exists()
    assert postgres_server.execute("SELECT count(*) FROM current", database) == [(1,)]


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        ("url: [1]", "one key"),
        ("adress: x", "one key"),
        ("url: '{", "cannot be read"),
        ("url: nonsense", "no address"),
    ],
)
def test_a_file_that_states_no_address_is_told(tmp_path, content, fault):
    (tmp_path / "catalog.yaml").write_text(content)
    with pytest.raises(CatalogError, match=fault) as caught:
        Catalog(tmp_path)
    assert str(tmp_path / "catalog.yaml") in str(caught.value)


def test_a_wrong_password_is_told_and_no_password_is_shown(postgres_server, database, tmp_path):
    state_url(tmp_path, postgres_server.tcp_url(database, password="battery"))
    with pytest.raises(StorageError, match="password authentication failed") as caught:
        Catalog(tmp_path)
    shown = str(caught.value) + repr(caught.value.as_json())
    assert "battery" not in shown
    assert "127.0.0.1" in shown
    state_url(tmp_path, postgres_server.tcp_url(database))
    assert PASSWORD.split()[0] not in repr(Catalog(tmp_path)._database.place)


def test_an_address_is_shown_and_written_without_any_password(tmp_path):
    url = parse_url("postgres://u:secret@h:5/d?sslmode=require&password=secret&sslpassword=secret", "here")
    assert address_without_password(url) == "postgresql+psycopg://u@h:5/d?sslmode=require"
    state_location(tmp_path, url)
    assert "secret" not in (tmp_path / "catalog.yaml").read_text()
    assert database_url(tmp_path) == url._replace(password=None, query={"sslmode": "require"})
    with pytest.raises(CatalogError) as caught:
        parse_url("postgres//u:secret@h", "here")
    assert "secret" not in str(caught.value)


def test_a_password_may_stand_in_the_environment(postgres_server, database, tmp_path, monkeypatch):
    address = postgres_server.tcp_url(database).replace(PASSWORD.replace(" ", "%20"), "")
    state_url(tmp_path, address.replace(":@", "@"))
    monkeypatch.setenv("PGPASSWORD", PASSWORD)
    assert Catalog(tmp_path).models() == []


def test_a_server_that_is_not_there_is_told_at_once(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        state_url(tmp_path, f"postgresql://u@127.0.0.1:{free.getsockname()[1]}/none")
        begun = time.monotonic()
        with pytest.raises(StorageError, match="see that the server runs"):
            Catalog(tmp_path)
    assert time.monotonic() - begun < 5


def test_a_driver_that_is_not_installed_is_told(tmp_path):
    state_url(tmp_path, "postgresql://u@localhost/none")
    program = (
        "import sys; sys.modules['psycopg'] = None\n"
        "from inflight.catalog import Catalog\n"
        "from inflight.errors import CatalogError\n"
        "try: Catalog(sys.argv[1])\n"
        "except CatalogError as error: print(error)\n"
    )
    told = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True
    )
    assert "pip install 'inflight-magnetometer[postgres]'" in told.stdout


def test_an_embedded_catalog_never_imports_the_driver(tmp_path):
    program = (
        "import sys; from inflight.catalog import Catalog; Catalog(sys.argv[1]).inventory()\n"
        "print([name for name in sys.modules if name.startswith('psycopg')])\n"
    )
    told = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True
    )
    assert told.stdout.strip() == "[]"


def test_a_database_of_another_folder_is_refused_before_anything_is_taken_for_garbage(
    catalog, postgres_server, database, template, tmp_path
):
    publish(catalog, "l1/fgm", [DAY])
    state_url(tmp_path / "other", postgres_server.url(database))
    with pytest.raises(WorkspaceError, match="do not belong together"):
        Catalog(tmp_path / "other")
    with postgres_server.database(template) as empty:
        state_url(catalog.workspace, postgres_server.url(empty))
        with pytest.raises(WorkspaceError, match="the database has none"):
            Catalog(catalog.workspace)


# --- many writers ------------------------------------------------------------------------------------


def test_the_database_excludes_overlapping_validity_as_an_error_of_validity(catalog):
    with catalog.run("calibrate") as run:
        made = run.stage_table("offsets", table(), start=0, end=20)
    catalog.certify(made, 0, 10)
    row = {"table_id": made, "name": "offsets", "context": "", "start": 9, "end": 12}
    with pytest.raises(ValidityError, match="certification_never_overlaps"):
        catalog._database.write(lambda session: session.add(CertificationRow(**row)))
    row["start"] = 10  # half-open: one may end where the next begins
    catalog._database.write(lambda session: session.add(CertificationRow(**row)))


def test_two_publishers_of_one_day_make_twenty_revisions_none_lost(catalog):
    writers = [spawn(publish_one_day, catalog.workspace, number, 10) for number in range(2)]
    assert [ended(writer) for writer in writers] == [0, 0]
    revisions = catalog.revisions("l2/field")
    assert sorted(day.revision for day in revisions) == list(range(20))
    assert catalog.current("l2/field", DAY).revision == 19


def test_eight_backfills_at_once_publish_thirty_two_days(catalog):
    writers = [spawn(publish_own_dataset, catalog.workspace, f"l2/part-{number}", 4) for number in range(8)]
    assert [ended(writer) for writer in writers] == [0] * 8
    items = catalog.inventory()
    assert [(item["days"], item["failed"]) for item in items] == [(4, 0)] * 8
    assert {run.state for run in catalog.runs()} == {"done"}


def test_writers_of_two_datasets_do_not_wait_for_each_other(catalog):
    order = []

    def hold(session, inside, go_on):
        inside.set()
        assert go_on.wait(20)
        order.append("held")

    inside, go_on = threading.Event(), threading.Event()
    holder = threading.Thread(
        target=catalog._database.write_to, args=(["l1/fgm"], hold, inside, go_on), daemon=True
    )
    holder.start()
    assert inside.wait(20)
    catalog._database.write_to(["l1/ovm"], lambda _session: order.append("other dataset"))
    same = threading.Thread(
        target=catalog._database.write_to, args=(["l1/fgm"], lambda _session: order.append("same"))
    )
    same.start()
    same.join(0.3)
    assert order == ["other dataset"]
    go_on.set()
    holder.join()
    same.join()
    assert order == ["other dataset", "held", "same"]


def test_a_transaction_that_a_deadlock_ended_is_done_again(catalog):
    for name in ("a", "b"):
        catalog.save_model(name, "text")
    both = threading.Barrier(2)
    attempts = []

    def update(session, names):
        attempts.append(names)
        for number, name in enumerate(names):
            if number and len(attempts) <= 2:
                both.wait(10)
            session.connection().exec_driver_sql(
                f"UPDATE model SET message = message || 'x' WHERE name = '{name}'"
            )

    threads = [
        threading.Thread(target=catalog._database.write_to, args=([], update, names))
        for names in ("ab", "ba")
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(attempts) == 3, "there was no deadlock"
    assert [record.message for record in catalog.models()] == ["xx", "xx"]


# --- leases ------------------------------------------------------------------------------------------


def test_a_killed_run_is_closed_when_its_lease_ends_and_not_before(catalog):
    killed = spawn(publish_one_day, catalog.workspace, 0, 1, kill_at="publish_begun")
    assert ended(killed) == -signal.SIGKILL
    assert [run.state for run in Catalog(catalog.workspace).runs()] == ["running"]
    end_leases(catalog)
    (run,) = Catalog(catalog.workspace).runs()
    assert (run.state, run.cause) == ("failed", "transient")


def test_a_run_that_works_longer_than_its_lease_lives_wherever_it_is(catalog, monkeypatch):
    catalog._database.backend.lease_s = 1.0
    with catalog.run("far") as run:
        monkeypatch.setattr(socket, "gethostname", lambda: "another-host")
        time.sleep(2.5)
        assert close_dead_runs(catalog.workspace, catalog._database) == []
        run.stage("l1/fgm", samples(DAY), day=DAY)
        assert len(run.publish()) == 1
    assert [run.state for run in catalog.runs()] == ["done"]


def test_a_run_that_was_taken_for_dead_publishes_nothing(catalog):
    def work():
        with catalog.run("paused") as run:
            run.stage("l1/fgm", samples(DAY), day=DAY)
            end_leases(catalog)
            Catalog(catalog.workspace)
            run.publish()

    with pytest.raises(StorageError, match="sign of life"):
        work()
    assert catalog.current("l1/fgm", DAY) is None
    (recorded,) = catalog.runs()
    assert (recorded.state, recorded.cause) == ("failed", "transient")


# --- the server goes away ----------------------------------------------------------------------------


@pytest.fixture
def own_server():
    """A server that a test may stop."""
    if server_programs() is None:
        pytest.skip("there is no PostgreSQL server program")
    server = PostgresServer(server_programs())
    yield server
    server.remove()


def test_a_server_that_is_gone_for_ten_seconds_is_waited_for(own_server, tmp_path):
    with own_server.database() as name:
        state_url(tmp_path, own_server.url(name))
        catalog = Catalog(tmp_path)
        with catalog.run("ingest") as run, ThreadPoolExecutor(1) as apart:
            run.stage("l1/fgm", samples(DAY), day=DAY)
            own_server.stop(signal.SIGQUIT)  # a crash: what was committed is recovered
            publication = apart.submit(run.publish)
            time.sleep(10)
            assert not publication.done()
            own_server.start()
            (day,) = publication.result()
        assert catalog.current("l1/fgm", DAY).id == day.id
        assert [run.state for run in catalog.runs()] == ["done"]


def test_a_server_that_is_gone_for_good_ends_the_run_with_what_to_do(own_server, tmp_path, monkeypatch):
    monkeypatch.setattr("inflight.catalog.backends.PATIENCE_S", 1.0)
    with own_server.database() as name:
        state_url(tmp_path, own_server.url(name))
        catalog = Catalog(tmp_path)

        def work():
            with catalog.run("ingest") as run:
                run.stage("l1/fgm", samples(DAY), day=DAY)
                own_server.stop()
                run.publish()

        begun = time.monotonic()
        with pytest.raises(StorageError, match=r"not answered for \d s.*see that the server runs") as caught:
            work()
        assert time.monotonic() - begun < 8
        assert caught.value.cause == "transient"
        assert any("could not be closed" in note for note in caught.value.__notes__)
        own_server.start()
        end_leases(catalog)
        reopened = Catalog(tmp_path)
        assert [run.state for run in reopened.runs()] == ["failed"]
        with reopened.run("ingest") as again:
            assert again.adopt("l1/fgm", DAY, "") is None
            again.stage("l1/fgm", samples(DAY), day=DAY)
            again.publish()


class Proxy(threading.Thread):
    """Passes bytes between one client after the other and a server; may cut after a word was passed on."""

    def __init__(self, port):
        super().__init__(daemon=True)
        self._server_port, self.cut_after = port, b""
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.cuts = 0

    def run(self):
        while True:
            client, _ = self._listener.accept()
            server = socket.create_connection(("127.0.0.1", self._server_port))
            for source, sink in ((client, server), (server, client)):
                threading.Thread(target=self._pass, args=(source, sink, client), daemon=True).start()

    def _pass(self, source, sink, client):
        try:
            while data := source.recv(65536):
                cut = source is client and self.cut_after and self.cut_after in data
                if cut:
                    self.cut_after = b""
                    self.cuts += 1
                    client.shutdown(socket.SHUT_RDWR)  # the answer cannot arrive
                sink.sendall(data)
                if cut:
                    time.sleep(0.2)
            sink.shutdown(socket.SHUT_WR)
        except OSError:
            pass


@pytest.mark.parametrize(("word", "committed_first"), [(b"COMMIT", True), (b"UPDATE file", False)])
def test_a_connection_cut_while_publishing_publishes_once(
    postgres_server, database, tmp_path, word, committed_first
):
    proxy = Proxy(postgres_server.port)
    proxy.start()
    state_url(
        tmp_path, postgres_server.tcp_url(database, port=proxy.port) + "?sslmode=disable&gssencmode=disable"
    )
    catalog = Catalog(tmp_path)
    with catalog.run("ingest") as run:
        run.stage("l1/fgm", samples(DAY), day=DAY)
        proxy.cut_after = word
        (day,) = run.publish()
    assert proxy.cuts == 1
    assert day.version == "v01.00"
    assert [day.id for day in catalog.revisions("l1/fgm")] == [day.id]


def ended(process):
    process.join(timeout=120)
    return process.exitcode


def test_a_catalog_opened_in_a_forked_process_has_connections_of_its_own(catalog):
    publish(catalog, "l1/fgm", [DAY])
    context = multiprocessing.get_context("fork")
    mine, theirs = context.Pipe()

    def look():
        theirs.send(len(catalog.days("l1/fgm")))
        os._exit(0)

    child = context.Process(target=look)
    child.start()
    assert mine.recv() == 1
    child.join()
    assert len(catalog.days("l1/fgm")) == 1
