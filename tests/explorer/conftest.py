"""A workspace with a hidden field, calibrated, to be looked at."""

import shutil

import pytest
from heated_mission import make_heated_workspace

from inflight.catalog import Catalog, Workspace
from inflight.tasks.analysis import diagnose_span
from inflight.tasks.pipelines import reprocess


@pytest.fixture(scope="session")
def calibrated(tmp_path_factory) -> Workspace:
    """Four days with the field of a heater that no model knows, diagnosed; copied, never changed."""
    made = make_heated_workspace(tmp_path_factory.mktemp("calibrated") / "heated")
    reprocess(Catalog(made.root), made.mission())
    diagnose_span(made, "2024-03-01", "2024-03-05")
    return made


@pytest.fixture
def workspace(calibrated, tmp_path) -> Workspace:
    shutil.copytree(calibrated.root, tmp_path / "copy")
    return Workspace.open(tmp_path / "copy")
