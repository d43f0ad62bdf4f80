"""A real Prefect server and process worker: deploy `deployments/prefect.yaml`, run, look into the catalog."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest
from store_cases import unfinished_stores
from tiny_mission import make_tiny_workspace

from inflight.catalog import Catalog, Workspace
from inflight.flows import scheduled_flows
from inflight.tasks.archive import ingest

pytestmark = pytest.mark.server

DEPLOYMENTS = Path(__file__).parents[2] / "deployments"
PATIENCE = 120
#: States in which a flow run stays.
FINAL = ("COMPLETED", "FAILED", "CRASHED", "CANCELLED")
WORKER = ("worker", "start", "--pool", "inflight", "--install-policy", "never")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def prefect(*arguments: str, environment: dict[str, str], cwd: Path = DEPLOYMENTS) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "prefect", "--no-prompt", *arguments],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def wait_for(question, what: str):
    """Ask until the answer is true, at most `PATIENCE` seconds."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        answer = question()
        if answer:
            return answer
        time.sleep(0.3)
    raise AssertionError(f"no {what} within {PATIENCE} s")


def healthy(api: httpx.Client) -> bool:
    try:
        return api.get("health").status_code == httpx.codes.OK
    except httpx.TransportError:
        return False


@pytest.fixture(scope="module")
def workspace(tmp_path_factory) -> Path:
    return make_tiny_workspace(tmp_path_factory.mktemp("served") / "tiny")


@pytest.fixture(scope="module")
def environment(tmp_path_factory, workspace) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    return kept | {
        "PREFECT_HOME": str(tmp_path_factory.mktemp("home")),
        "PREFECT_API_URL": f"http://127.0.0.1:{free_port()}/api",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "PREFECT_SERVER_UI_ENABLED": "false",
        "PREFECT_SERVER_SERVICES_SCHEDULER_LOOP_SECONDS": "2",
        "PREFECT_WORKER_QUERY_SECONDS": "1",
        "DO_NOT_TRACK": "1",
        "INFLIGHT_WORKSPACE": str(workspace),
    }


@pytest.fixture(scope="module")
def api(environment):
    """Start the server, deploy everything, and hand out a client of its API."""
    port = environment["PREFECT_API_URL"].split(":")[2].split("/")[0]
    log = Path(environment["PREFECT_HOME"]) / "server.log"
    command = [sys.executable, "-m", "prefect", "server", "start", "--host", "127.0.0.1", "--port", port]
    with (
        log.open("w") as out,
        subprocess.Popen(command, env=environment, stdout=out, stderr=out) as server,
        httpx.Client(base_url=environment["PREFECT_API_URL"], timeout=60) as client,
    ):
        try:
            wait_for(lambda: healthy(client), f"server; {log}")
            prefect("work-pool", "create", "inflight", "--type", "process", environment=environment)
            prefect("deploy", "--all", environment=environment)
            yield client
        finally:
            server.terminate()


def deployment(api: httpx.Client, name: str) -> dict:
    answer = api.get(f"deployments/name/{name}")
    assert answer.status_code == httpx.codes.OK, answer.text
    return answer.json()


def test_the_full_mission_is_scheduled_with_its_parameters(api, workspace):
    made = deployment(api, "reprocess/full-mission")
    assert [item["schedule"]["cron"] for item in made["schedules"]] == ["30 2 * * *"]
    assert made["parameters"]["workspace"] == str(workspace)
    assert made["parameters"]["settings"]["batch_days"] == 30


def test_the_schedule_makes_runs(api):
    """An SQLAlchemy the server cannot work with would deploy everything and never run it."""
    question = {"deployments": {"name": {"any_": ["full-mission"]}}}
    runs = wait_for(lambda: api.post("flow_runs/filter", json=question).json(), "scheduled run")
    assert {run["state_type"] for run in runs} == {"SCHEDULED"}


def test_the_page_is_told_what_is_scheduled(api, environment, workspace, monkeypatch):
    monkeypatch.setenv("PREFECT_API_URL", environment["PREFECT_API_URL"])

    def scheduled():
        found = {one.name: one for one in scheduled_flows(workspace)}
        return found if found["reprocess/full-mission"].next_run else None

    found = wait_for(scheduled, "next run")
    nightly = found["reprocess/full-mission"]
    assert (nightly.schedule, nightly.paused, nightly.last_state) == ("30 2 * * *", False, "")
    assert nightly.next_run[11:16] == "02:30"
    assert found["reprocess/daily-spin"].paused
    assert found["backfill/span"].schedule == ""
    assert scheduled_flows(workspace.parent) == []


@pytest.mark.parametrize(
    "parameters", [{"settings": {"batch_days": 0}}, {"settings": {"bogus": 1}}, {"workers": "many"}]
)
def test_the_server_refuses_wrong_parameters(api, parameters):
    made = deployment(api, "reprocess/full-mission")
    answer = api.post(f"deployments/{made['id']}/create_flow_run", json={"parameters": parameters})
    assert answer.is_client_error, answer.text


def end_of(api: httpx.Client, run: str) -> dict:
    """Wait for the end of a flow run and return its state."""

    def final() -> dict | None:
        state = api.get(f"flow_runs/{run}").json()["state"]
        return state if state["type"] in FINAL else None

    return wait_for(final, "finished run")


def test_a_worker_runs_a_backfill_and_the_catalog_has_it(api, environment, workspace):
    span = ["--param", "start=2024-03-01", "--param", "end=2024-03-03"]
    prefect("deployment", "run", "backfill/span", *span, environment=environment)
    prefect(*WORKER, "--run-once", environment=environment)
    question = {"deployments": {"name": {"any_": ["span"]}}}
    run = api.post("flow_runs/filter", json=question).json()[0]
    state = end_of(api, run["id"])
    assert state["type"] == "COMPLETED", state
    published = Catalog(workspace).days("l2/field", states=["published"])
    assert [str(day.day) for day in published] == ["2024-03-01", "2024-03-02"]


def test_a_cancelled_run_publishes_nothing_and_the_next_one_makes_all(api, environment, tmp_path):
    days, log = 30, tmp_path / "worker.log"
    root = make_tiny_workspace(tmp_path / "cancelled", days)
    place, cat = Workspace.open(root), Catalog(root)
    ingest(cat, place.mission(), place.data)
    # Of this deployment one run is let in at a time.
    made = deployment(api, "reprocess/full-mission")

    def ask(batch_days: int) -> str:
        """Ask for a reprocessing of all days; return which flow run it is."""
        settings = {"table": "span", "batch_days": batch_days}
        request = {"parameters": {"workspace": str(root), "workers": 1, "settings": settings}}
        return api.post(f"deployments/{made['id']}/create_flow_run", json=request).json()["id"]

    def published() -> list[int]:
        return [len(cat.days(name, states=["published"])) for name in ("equations/main/base", "l2/field")]

    cancelled, command = ask(batch_days=1), [sys.executable, "-m", "prefect", *WORKER]
    how = {"env": environment, "start_new_session": True}
    with log.open("w") as out, subprocess.Popen(command, stdout=out, stderr=out, **how) as worker:
        try:
            wait_for(lambda: any((root / "stores").glob("*-reprocess-*/*.zarr")), f"first batch; {log}")
            # As `prefect flow-run cancel` does.
            answer = api.post(f"flow_runs/{cancelled}/set_state", json={"state": {"type": "CANCELLING"}})
            assert answer.json()["status"] == "ACCEPT", answer.text
            state = end_of(api, cancelled)
            assert state["type"] == "CANCELLED", state
            last = cat.runs()[-1]
            assert (last.kind, last.state, last.cause) == ("reprocess", "failed", "transient")
            assert published() == [0, 0]
            assert cat.verify() == []
            state = end_of(api, ask(batch_days=days))
            assert state["type"] == "COMPLETED", state
        finally:
            # With whatever it began. A worker that is asked to end while its last run is ending never does.
            os.killpg(worker.pid, signal.SIGKILL)
    assert published() == [days, days]
    assert unfinished_stores(root) == []
