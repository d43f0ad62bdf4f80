"""A day of the mission with two fluxgates, every 10 s."""

from pathlib import Path

import pytest

from inflight.simulate import SimulationSettings
from inflight.tasks.archive import simulate

MISSIONS = Path(__file__).parents[2] / "missions"


@pytest.fixture(scope="session")
def champ(tmp_path_factory):
    """Return the mission's text and the folder of its files."""
    folder = tmp_path_factory.mktemp("champ")
    simulate(SimulationSettings(days=1, cadence=10, second_fluxgate=True), folder, workers=1)
    text = (MISSIONS / "champ-two-fluxgates.yaml").read_text(encoding="utf-8")
    return text.replace("cadence: 1 s", "cadence: 10 s"), folder
