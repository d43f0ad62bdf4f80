"""How Prefect and Dask are set up: quiet, private, and giving way to what a team has already."""

import os
import sqlite3
import subprocess
import sys
import time
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from inflight.errors import InflightError, ReadError, WorkerError
from inflight.flows import DaySpan, available_cores, dask_client, lazy_client
from inflight.flows import runner as runner_module
from inflight.flows.launch import prefect_environment, prefect_settings
from inflight.flows.runner import PrefectRunner, is_transient, progress_to
from inflight.flows.server import EmbeddedServer, _not_at_start, _prepare_database, is_own
from inflight.tasks.batches import end_processes, give_back_memory_at_times, iter_results


def test_the_embedded_server_is_private_and_quiet(monkeypatch, tmp_path):
    for name in ("PREFECT_API_URL", "PREFECT_HOME", "DO_NOT_TRACK"):
        monkeypatch.delenv(name, raising=False)
    environment = prefect_environment(tmp_path)
    assert environment["PREFECT_HOME"] == str(tmp_path)
    assert environment["DO_NOT_TRACK"] == "1"
    assert environment["PREFECT_SERVER_ANALYTICS_ENABLED"] == "false"
    assert environment["PREFECT_SERVER_SERVICES_SCHEDULER_ENABLED"] == "false"


def test_a_named_server_is_used_and_its_own_settings_are_left_alone(monkeypatch, tmp_path):
    monkeypatch.setenv("PREFECT_API_URL", "http://localhost:4200/api")
    environment = prefect_environment(tmp_path)
    assert "PREFECT_HOME" not in environment
    assert not any(name.startswith("PREFECT_SERVER_SERVICES") for name in environment)


def test_what_the_user_has_set_wins(monkeypatch, tmp_path):
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    monkeypatch.setenv("PREFECT_HOME", "/mine")
    assert prefect_environment(tmp_path)["PREFECT_HOME"] == "/mine"


def test_a_second_workspace_in_one_process_has_a_server_of_its_own(embedded, monkeypatch, tmp_path):
    from prefect.settings import get_current_settings

    first = get_current_settings().api.url
    monkeypatch.delenv("PREFECT_HOME", raising=False)
    with prefect_settings(tmp_path):
        second = get_current_settings().api.url
        assert is_own(second)
        assert second != first
        assert (tmp_path / "prefect.db").exists()
    assert get_current_settings().api.url == first


def test_a_home_of_another_prefect_is_migrated_once_and_a_new_one_is_not(monkeypatch, tmp_path):
    def settings_of(home):
        prepared = _prepare_database(home, {"PREFECT_HOME": str(home)})
        return _not_at_start(home, prepared=prepared)

    migrate, vacuum = "PREFECT_SERVER_DATABASE_MIGRATE_ON_START", "PREFECT_SERVER_SERVICES_DB_VACUUM_ENABLED"
    new, old = tmp_path / "new", tmp_path / "old"
    for home in (new, old):
        home.mkdir()
    assert settings_of(new)[migrate] == "false"
    # Without tables: a server that does not migrate would fail at its first question.
    sqlite3.connect(old / "prefect.db").close()
    assert migrate not in settings_of(old)
    server = EmbeddedServer(old, {"PREFECT_HOME": str(old)})
    server.wait()
    asked = urllib.request.Request(
        f"{server.url}/flows/count", data=b"{}", headers={"Content-Type": "application/json"}
    )
    with urllib.request.urlopen(asked, timeout=30) as answer:
        assert answer.read() == b"0"
    server.stop()
    assert settings_of(old)[migrate] == "false"
    # Old events of a small database stay, those of a large one go.
    assert vacuum in settings_of(old)
    monkeypatch.setattr("inflight.flows.server._SMALL", 1)
    assert vacuum not in settings_of(old)
    # What the user has set wins, and a database that is elsewhere is looked at by its server.
    monkeypatch.setenv("PREFECT_SERVER_DATABASE_CONNECTION_URL", "sqlite+aiosqlite:////elsewhere.db")
    assert migrate not in settings_of(old)


def test_a_server_that_cannot_start_is_told_with_its_log_and_the_way_around_it(monkeypatch, tmp_path, capfd):
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho no such port >&2\nexit 1\n")
    python.chmod(0o755)
    monkeypatch.setattr("inflight.flows.server.sys.executable", str(python))
    with pytest.raises(WorkerError, match="does not answer; its log is ") as raised:
        EmbeddedServer(tmp_path, {"PREFECT_HOME": str(tmp_path)}).wait()
    assert "--no-prefect" in raised.value.remedy
    assert (tmp_path / "server.log").read_text() == "no such port\n"
    assert not capfd.readouterr().err


def test_a_server_ends_with_a_command_that_is_killed(tmp_path):
    code = (
        "import sys, time; from pathlib import Path; from inflight.flows.server import EmbeddedServer\n"
        f"server = EmbeddedServer(Path({str(tmp_path)!r}), {{'PREFECT_HOME': {str(tmp_path)!r}}})\n"
        "server.wait(); print(server.url, flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as command:
        url = command.stdout.readline().strip()
        with urllib.request.urlopen(f"{url}/health", timeout=10) as answer:
            assert answer.status == 200
        command.kill()
    until = time.monotonic() + 20
    while time.monotonic() < until:
        try:
            urllib.request.urlopen(f"{url}/health", timeout=5).close()
        except OSError:
            return
        time.sleep(0.1)
    pytest.fail("the server outlives the command that started it")


def test_the_heartbeat_of_flow_runs_is_off_inside(embedded):
    from prefect.settings import get_current_settings

    assert get_current_settings().flows.heartbeat_frequency is None


def test_dask_processes_use_one_thread_and_one_blas_thread(monkeypatch):
    monkeypatch.delenv("INFLIGHT_DASK_SCHEDULER", raising=False)

    def threads() -> int:
        import numpy as np
        from threadpoolctl import threadpool_info

        np.ones((8, 8)) @ np.ones((8, 8))
        return max(item["num_threads"] for item in threadpool_info())

    with dask_client(1, niceness=1) as client:
        assert client.submit(threads).result() == 1
        # Those of a backfill stand behind others.
        assert client.submit(os.nice, 0).result() == min(os.nice(0) + 1, 19)
        assert sum(client.nthreads().values()) == 1
    assert available_cores() >= 1


def test_a_running_scheduler_is_used_when_named(monkeypatch):
    monkeypatch.delenv("INFLIGHT_DASK_SCHEDULER", raising=False)
    with dask_client(1) as client:
        address = str(client.scheduler.address)
        monkeypatch.setenv("INFLIGHT_DASK_SCHEDULER", address)
        with dask_client(7) as other:
            assert str(other.scheduler.address) == address
            assert len(other.nthreads()) == 1


def test_a_span_gives_its_days_as_text_and_refuses_to_run_backwards():
    assert DaySpan.model_validate({"start": "2005-01-01"}).as_text() == ("2005-01-01", None)
    with pytest.raises(ValueError, match="holds no day"):
        DaySpan.model_validate({"start": "2005-01-01", "end": "2005-01-01"})


def test_the_flow_modules_are_not_needed_to_read_settings():
    text = Path(prefect_settings.__code__.co_filename).read_text(encoding="utf-8")
    assert not any(line.startswith(("import prefect", "from prefect")) for line in text.splitlines())


@pytest.fixture
def counted_clusters(monkeypatch):
    """Clusters that only count how often they were started and ended."""
    told = []

    @contextmanager
    def start(workers, niceness):
        told.append("started")
        time.sleep(0.05)
        yield SimpleNamespace(submit=lambda function, *given, **options: function(*given))
        told.append("ended")

    monkeypatch.delenv("INFLIGHT_DASK_SCHEDULER", raising=False)
    monkeypatch.setattr("inflight.flows.cluster.dask_client", start)
    monkeypatch.setattr("inflight.flows.cluster.start_early", lambda: None)
    # Tests before this one may have started the process that workers are forks of.
    monkeypatch.setattr("inflight.flows.cluster._fork_server", lambda: 0)
    return told


def test_threads_that_bring_the_first_work_at_once_share_one_cluster(counted_clusters):
    with lazy_client(2) as client, ThreadPoolExecutor(4) as threads:
        assert list(threads.map(lambda number: client.submit(abs, number), [-3, -2, -1])) == [3, 2, 1]
        assert counted_clusters == ["started"]
    assert counted_clusters == ["started", "ended"]


def test_processes_end_when_asked_and_others_start_with_the_next_work(counted_clusters):
    with lazy_client(2) as client:
        end_processes(client)
        assert counted_clusters == []
        client.submit(abs, -1)
        end_processes(client)
        assert counted_clusters == ["started", "ended"]
        assert client.submit(abs, -2) == 2
    assert counted_clusters == ["started", "ended"] * 2
    end_processes(None)


def test_work_that_comes_when_the_run_has_ended_is_refused_and_starts_no_processes(counted_clusters):
    with lazy_client(2) as client:
        client.submit(abs, -1)
    for pieces in (1, 20):
        # Tasks that waited when a run was cancelled still bring their work.
        client.expect(pieces)
        with pytest.raises(InflightError, match="run has ended") as refused:
            client.submit(abs, -2)
        assert not is_transient(refused.value)
    assert counted_clusters == ["started", "ended"]


def test_few_quick_pieces_of_work_start_no_processes(counted_clusters):
    with lazy_client(2) as client:
        assert list(iter_results(client, abs, [(number,) for number in (-3, -2, -1)])) == [3, 2, 1]
        # One more than was told of is no longer little.
        assert client.submit(abs, -4) == 4
    assert counted_clusters == ["started", "ended"]


def test_what_processes_are_forks_of_gets_ready_while_the_first_of_some_pieces_is_tried(
    counted_clusters, monkeypatch
):
    asked = []
    monkeypatch.setattr("inflight.flows.cluster.start_early", lambda: asked.append(1))
    with lazy_client(2) as client:
        client.expect(2)
        assert not asked
        client.expect(3)
        assert asked == [1]
    client.expect(3)
    assert asked == [1]


def test_processes_start_when_the_first_of_few_pieces_took_long(counted_clusters, monkeypatch):
    monkeypatch.setattr("inflight.flows.cluster._START_S", 0.02)
    started = []

    def slow(number):
        time.sleep(0.02)
        started.append(len(counted_clusters))
        return number

    with lazy_client(2) as client:
        client.expect(4)
        found = [client.submit(slow, number) for number in range(4)]
    # The first alone was done here: the other three would have taken longer than a start.
    assert started == [0, 1, 1, 1]
    assert [one if isinstance(one, int) else one.result() for one in found] == [0, 1, 2, 3]


@pytest.mark.parametrize(("age_s", "first"), [(1.0, 0), (10.0, 1)], ids=["importing", "ready"])
def test_some_pieces_are_given_to_processes_at_once_where_they_need_only_be_forked(
    counted_clusters, monkeypatch, age_s, first
):
    monkeypatch.setattr("inflight.flows.cluster._fork_server", lambda: 7)
    monkeypatch.setattr("inflight.flows.cluster._fork_server_began", {7: time.monotonic() - age_s})
    with lazy_client(2) as client:
        client.expect(2)
        client.submit(abs, -1)
        assert counted_clusters == []
        client.expect(3)
        client.submit(abs, -1)
        assert len(counted_clusters) == first


def test_many_pieces_and_those_for_a_running_scheduler_are_given_to_processes(counted_clusters, monkeypatch):
    with lazy_client(2) as client:
        client.expect(7)
        client.submit(abs, -1)
        assert counted_clusters == ["started"]
    monkeypatch.setenv("INFLIGHT_DASK_SCHEDULER", "tcp://127.0.0.1:1")
    with lazy_client(2) as client:
        client.expect(1)
        client.submit(abs, -1)
    assert counted_clusters == ["started", "ended"] * 2


def test_what_work_raises_here_is_raised_where_its_result_is_asked_for(counted_clusters):
    def broken(number):
        raise ReadError(f"piece {number}")

    with lazy_client(2) as client, pytest.raises(ReadError, match="piece 7"):
        list(iter_results(client, broken, [(7,)]))
    assert counted_clusters == []


def test_a_process_gives_memory_back_after_some_batches(monkeypatch):
    given = []
    monkeypatch.setattr("inflight.tasks.batches.give_back_memory", lambda: given.append(1))
    for _ in range(24):
        give_back_memory_at_times()
    assert len(given) == 3


@pytest.mark.parametrize(("pieces", "others", "ends"), [(13, 0, 1), (12, 0, 0), (13, 1, 0)])
def test_what_processes_were_forks_of_ends_after_much_work(
    counted_clusters, monkeypatch, pieces, others, ends
):
    ended = []
    # Tests before this one may have left a cluster that lives as long as theirs.
    monkeypatch.setattr("inflight.flows.cluster._living", [object()] * others)
    monkeypatch.setattr("inflight.flows.cluster._end_fork_server", lambda: ended.append(1))
    with lazy_client(2) as client:
        for number in range(pieces):
            client.submit(abs, number)
        end_processes(client)
        assert len(ended) == ends


class _Done:
    """A task, or a future, that has its result at once."""

    def __init__(self, found):
        self.found = found

    def result(self):
        return self.found


def test_a_stage_of_many_batches_has_few_tasks_and_yields_outcomes_in_order(monkeypatch):
    submitted, seen = [], []

    class Task:
        def __init__(self, name, function):
            self.function = function

        def submit(self, *arguments):
            submitted.append(arguments)
            return _Done(self.function(*(one.unquote() for one in arguments)))

    class Client:
        def submit(self, function, *arguments, pure):
            return _Done(function(*arguments))

    monkeypatch.setattr(runner_module, "_as_task", Task)
    monkeypatch.setattr(runner_module, "TASKS_OF_A_STAGE", 4)
    with progress_to(lambda *report: seen.append(report)):
        mapper = PrefectRunner().mapper(Client())
        assert list(mapper("calibrate", lambda number: 10 * number, [(number,) for number in range(9)])) == [
            10 * number for number in range(9)
        ]
        assert list(mapper("calibrate", lambda number: number, [])) == []
    assert len(submitted) == 3
    assert seen[:10] == [("calibrate", done, 9) for done in range(10)]
