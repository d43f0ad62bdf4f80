"""A real browser on a page that a real command serves."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from chromium import Chromium, find_chromium


class Served:
    """A running `inflight explore`."""

    def __init__(self, root: Path) -> None:
        code = "from inflight.cli import main; main()"
        command = [sys.executable, "-c", code, "explore", "--json", "--workers", "1", "-w", str(root)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        told = ""
        while not told.endswith("}\n"):
            line = self.process.stdout.readline()
            assert line, self.process.stderr.read()
            told += line
        self.told = json.loads(told)
        self.url = self.told["url"]


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
