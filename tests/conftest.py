"""Fixtures of more than one folder of tests."""

from pathlib import Path

import pytest
from tiny_mission import make_tiny_workspace


@pytest.fixture
def tiny_workspace(tmp_path) -> Path:
    """A fresh workspace of the tiny mission with two delivered days, nothing ingested."""
    return make_tiny_workspace(tmp_path / "tiny")
