"""Two sensors on one boom in the explorer: the sections of `inflight compare`, with units and verdict."""

from pathlib import Path

import numpy as np

from inflight.catalog import Catalog, Workspace
from inflight.explorer.session import Days, ExplorerSession
from inflight.simulate.dual import DualSettings
from inflight.tasks.archive import ingest, simulate
from inflight.tasks.pipelines import reprocess

MISSION = Path(__file__).parents[2] / "missions" / "venus-express.yaml"


def test_states_units_and_verdict_are_shown(tmp_path):
    source = tmp_path / "boom.yaml"
    text = MISSION.read_text(encoding="utf-8").replace("cadence: 1 s", "cadence: 4 s")
    source.write_text(text, encoding="utf-8")
    made = Workspace.create(tmp_path / "w", source)
    simulate(DualSettings(days=2, seed=31, overrides={"cadence": 4.0}), made.data, workers=1)
    ingest(Catalog(made.root), made.mission(), made.data)
    reprocess(Catalog(made.root), made.mission())
    session = ExplorerSession(made)
    try:
        day = np.datetime64("2006-05-14")
        shown = dict(session.compare("main", Days(day, day + 1), lambda stage, done, total: None))
        told = {heading: make() for heading, make in shown.items()}
    finally:
        session.close()
    assert list(told) == ["Steps at switchings", "Where it fails", "States", "Units", "Before and after"]
    assert "held out" in " ".join(told["Steps at switchings"][0])
    units = " ".join(told["Units"][0])
    assert "spectrometer_current" in units
    assert "a unit without housekeeping" in units
    assert len(told["States"][1]) == 4
    assert len(told["Before and after"][1]) == 4


def test_a_spacecraft_without_units_is_shown_as_such(tmp_path):
    """Nothing switches: the table has neither states with units nor units, and is whole all the same."""
    source = tmp_path / "boom.yaml"
    text = MISSION.read_text(encoding="utf-8").replace("cadence: 1 s", "cadence: 4 s")
    source.write_text(text, encoding="utf-8")
    made = Workspace.create(tmp_path / "w", source)
    silent = ("transmitter", "spectrometer", "camera", "survival_heater")
    settings = DualSettings(days=1, seed=41, without=silent, overrides={"cadence": 4.0})
    simulate(settings, made.data, workers=1)
    ingest(Catalog(made.root), made.mission(), made.data)
    reprocess(Catalog(made.root), made.mission())
    session = ExplorerSession(made)
    try:
        day = np.datetime64("2006-05-14")
        shown = dict(session.compare("main", Days(day, day), lambda stage, done, total: None))
        assert "nothing was seen to switch" in " ".join(shown["Units"]()[0])
        assert shown["States"]()[0]
    finally:
        session.close()
