import pytest
from catalog_cases import end_leases, state_url
from postgres_server import running_server

from inflight.catalog import Catalog

postgres_server = pytest.fixture(scope="session")(running_server)


@pytest.fixture(scope="session")
def template(postgres_server, tmp_path_factory):
    """The name of a database with all tables, which others are copied from."""
    with postgres_server.database() as name:
        workspace = tmp_path_factory.mktemp("template")
        state_url(workspace, postgres_server.url(name))
        Catalog(workspace)
        postgres_server.execute("DELETE FROM setting", name)
        yield name


def pytest_generate_tests(metafunc):
    """Run what a module says is the same on both databases on both."""
    if "workspace" in metafunc.fixturenames and getattr(metafunc.module, "BOTH_DATABASES", False):
        metafunc.parametrize("workspace", ["sqlite", "postgresql"], indirect=True)


@pytest.fixture
def workspace(request, tmp_path):
    """An empty folder whose catalog is in SQLite, or in the database that the test asks for."""
    folder = tmp_path / "workspace"
    if getattr(request, "param", "sqlite") == "sqlite":
        yield folder
        return
    server, template = request.getfixturevalue("postgres_server"), request.getfixturevalue("template")
    with server.database(template) as name:
        state_url(folder, server.url(name))
        yield folder


@pytest.fixture
def catalog(workspace):
    return Catalog(workspace)


@pytest.fixture
def reopened_after_death(catalog):
    """Open the catalog again some time after a process was killed: its lease has ended."""

    def reopen():
        end_leases(catalog)
        return Catalog(catalog.workspace)

    return reopen
