import os
from pathlib import Path

import pytest
from catalog_cases import end_leases
from postgres_server import NEEDED, PostgresServer, server_programs

from inflight.catalog import Catalog


@pytest.fixture(scope="session")
def postgres_server():
    """A PostgreSQL server with a database ``template_catalog`` that has all tables."""
    programs = server_programs()
    if programs is None:
        if os.environ.get(NEEDED):
            pytest.fail(f"{NEEDED} is set, and there is no PostgreSQL server program")
        pytest.skip("there is no PostgreSQL server program (Debian: apt-get install postgresql)")
    if not os.environ.get(NEEDED):
        pytest.importorskip("psycopg", reason="psycopg is not installed")
    server = PostgresServer(programs)
    yield server
    server.remove()


@pytest.fixture(scope="session")
def template(postgres_server, tmp_path_factory):
    """The name of a database with all tables, which others are copied from."""
    name = postgres_server.new_database()
    workspace = tmp_path_factory.mktemp("template")
    state_url(workspace, postgres_server.url(name))
    Catalog(workspace)
    postgres_server.execute("DELETE FROM setting", name)
    return name


@pytest.fixture(params=["sqlite", "postgresql"])
def workspace(request, tmp_path):
    """An empty folder whose catalog is in either database."""
    folder = tmp_path / "workspace"
    if request.param == "postgresql":
        server, template = request.getfixturevalue("postgres_server"), request.getfixturevalue("template")
        state_url(folder, server.url(server.new_database(template)))
    return folder


@pytest.fixture
def catalog(workspace):
    return Catalog(workspace)


@pytest.fixture
def reopened_after_death(catalog):
    """Open the catalog again as it is some time after a process was killed: a lease ends, a process is seen."""

    def reopen():
        end_leases(catalog)
        return Catalog(catalog.workspace)

    return reopen


def state_url(workspace: Path, url: str) -> None:
    """Say in a workspace where its catalog is."""
    workspace.mkdir(parents=True, exist_ok=True)
    (workspace / "catalog.yaml").write_text(f"url: {url}\n")
