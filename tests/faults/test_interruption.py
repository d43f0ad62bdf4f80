"""Ctrl-C reaches every process of a command, as a terminal sends it: it ends soon and says one thing."""

import os
import signal
import subprocess
import sys
import time

from store_cases import unfinished_stores
from tiny_mission import make_tiny_workspace

from inflight.catalog import Catalog


def test_an_interrupted_ingest_ends_soon_and_goes_on_where_it_was(tmp_path):
    root = make_tiny_workspace(tmp_path / "tiny", 60)
    verb = ["ingest", "--workspace", str(root)]
    command = [sys.executable, "-c", "from inflight.cli import main; main()", *verb]
    running = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    until = time.monotonic() + 90
    while time.monotonic() < until and running.poll() is None and not (root / "stores").is_dir():
        time.sleep(0.05)
    while running.poll() is None and not any((root / "stores").iterdir()) and time.monotonic() < until:
        time.sleep(0.01)
    os.killpg(running.pid, signal.SIGINT)
    said, _ = running.communicate(timeout=60)
    assert running.returncode == 130, said
    assert "interrupted; what is published is unchanged" in said
    assert "Traceback" not in said
    again = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "60 planned" in again.stdout or "120 planned" in again.stdout
    assert len(Catalog(root).days("l1/turning", states=("published",))) == 60
    assert unfinished_stores(root) == []
