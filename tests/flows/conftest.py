"""Flows run on one embedded server a test process; Prefect reads its settings when it is imported."""

import os
import tempfile
from pathlib import Path

import pytest

from inflight.flows.launch import prefect_environment

os.environ.setdefault("PREFECT_HOME", tempfile.mkdtemp(prefix="inflight-prefect-"))
os.environ.update(prefect_environment(Path(os.environ["PREFECT_HOME"])))


@pytest.fixture(scope="session")
def embedded():
    """Keep the project's Prefect settings on, so that all tests share one embedded server."""
    from inflight.flows.launch import prefect_settings

    with prefect_settings(Path(os.environ["PREFECT_HOME"])):
        yield


@pytest.fixture(scope="module")
def shared_cluster():
    """Let every run of a file use the same Dask processes, as a team with a scheduler does.

    A file, not the session: other folders' tests that start processes of their own follow in this process.
    """
    from inflight.flows import dask_client
    from inflight.flows.cluster import SCHEDULER_VARIABLE

    with dask_client(2) as client, pytest.MonkeyPatch.context() as patch:
        patch.setenv(SCHEDULER_VARIABLE, str(client.scheduler.address))
        yield client
