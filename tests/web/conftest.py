"""A real browser on a page that a real command serves."""

import os
from pathlib import Path

import pytest
from chromium import Chromium, Served, find_chromium


@pytest.fixture(scope="module")
def serve():
    """Serve workspaces; each server ends with the module's tests."""
    servers = []

    def begin(root: Path) -> Served:
        servers.append(Served(root))
        return servers[-1]

    yield begin
    for one in servers:
        one.process.kill()
        one.process.communicate(timeout=30)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    program = find_chromium()
    if program is None:
        why = "no Chromium is on the path; install it, or name one by INFLIGHT_CHROMIUM"
        (pytest.fail if "INFLIGHT_NEEDS_BROWSER" in os.environ else pytest.skip)(why)
    made = Chromium(program, tmp_path_factory.mktemp("browser") / "profile")
    yield made
    made.close()
