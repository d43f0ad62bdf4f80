import logging

import pytest
from serve_cases import ID, Client, collection_of, make_workspace

from inflight.serve import make_app


@pytest.fixture(autouse=True)
def _heard(monkeypatch):
    """The server's log is heard, though importing everything (tests/house) silences loggers."""
    monkeypatch.setattr(logging.getLogger("inflight.serve"), "disabled", False)


@pytest.fixture(scope="session")
def workspace(tmp_path_factory):
    """A workspace that no test changes."""
    return make_workspace(tmp_path_factory.mktemp("serve") / "probe")


@pytest.fixture(scope="session")
def client(workspace):
    return Client(make_app(collection_of(workspace)))


@pytest.fixture(scope="session")
def ask(client):
    """Ask an endpoint about the product, or another dataset."""
    return lambda endpoint, **query: client.get(f"/hapi/{endpoint}", {"dataset": ID, **query})
