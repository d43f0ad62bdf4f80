"""Slow corrections from stored tables: a simulated mission in which only the daily z offset is wrong."""

import datetime as dt
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.archive import simulated_workspace
from docs.figures.slow_corrections import BODY_EFFECT, BODY_MODEL, BODY_SETTINGS, fitted_eta
from docs.figures.stray_fields import MODEL, TrueError
from inflight.catalog import Workspace
from inflight.catalog.workspace import find_mission
from inflight.errors import CatalogError
from inflight.mission import Mission
from inflight.simulate import SimulationSettings, simulate_day
from inflight.tasks.analysis.revise import open_workbench
from inflight.tasks.analysis.stored_effects import stored_entry
from inflight.tasks.pipelines import ReprocessSettings, reprocess

DAYS = 6
SETTINGS = SimulationSettings(
    seed=5,
    start=dt.date(2005, 1, 1),
    days=DAYS,
    cadence=10,
    defects=(),
    without=tuple(sorted(set(SimulationSettings.standard_effects) - {"offset", "misalignment"})),
    include=("offset_drift",),
    overrides={"offset_axes": (0.0, 0.0, 1.0), "offset_drift_rms": 1.5},
)
CHAMP = find_mission("champ").read_text(encoding="utf-8")


class FewTables:
    """A catalog that has one table of each name."""

    def __init__(self, *names):
        self.names = names

    def tables(self, name=None):
        key = "0123456789abcdef"
        return [
            SimpleNamespace(name=one, id=1, key=key, damaged=False)
            for one in self.names
            if name in (None, one)
        ]


def test_what_a_user_adds_names_one_table_for_good():
    mission, cat = Mission.parse(CHAMP), FewTables("main-z-offset", "main-torquer-mean")
    offset = stored_entry(cat, mission, "main", "z_offset")
    assert offset["sensor"] == "fgm"
    assert offset["vector"] == {"time": "table", "table": "main-z-offset:0123456789ab"}
    # Of the scalar sensor alone, data would tell the field with the other sign.
    assert stored_entry(cat, mission, "main", "remanent_moment")["sensor"] == "fgm"
    both = stored_entry(
        cat, mission, "main", "{effect: remanent_moment, dipole: {position: [-1, 0, 0], sigma: 1}}"
    )
    assert both["sensor"] == "fgm"
    assert both["current"]["table"] == "main-torquer-mean:0123456789ab"
    assert stored_entry(cat, mission, "main", "day_night") is None
    assert stored_entry(cat, mission, "main", "{effect: tone, period: 900 s}") is None


def test_what_a_table_is_made_from_is_said_where_the_mission_lacks_it():
    with pytest.raises(CatalogError, match="main-torquer-mean") as absent:
        stored_entry(FewTables(), Mission.parse(CHAMP), "main", "remanent_moment")
    assert "reprocess --table continuous" in str(absent.value.remedy)
    without = Mission.parse(CHAMP.replace("kind: torquer_current, ", ""))
    with pytest.raises(CatalogError, match="no channel of kind torquer_current"):
        stored_entry(FewTables(), without, "main", "remanent_moment")


@pytest.mark.slow
def test_the_bodys_field_is_taken_off_with_the_torquers_mean(tmp_path):
    """Nothing but the body's moment changes: what takes 260 days and years takes 3 days in two weeks here."""
    mission = BODY_SETTINGS.model_copy(update={"days": 14})
    cat = simulated_workspace(tmp_path / "champ", 14, str(mission.start), settings=mission, workers=1)
    root, errors = cat.workspace, []
    (root / "models" / "champ-preflight.yaml").write_text(BODY_MODEL, encoding="utf-8")
    settings = ReprocessSettings(table="continuous", trend="constant", mean_days=3)
    for effect in ("", BODY_EFFECT):
        if effect:
            (told,) = open_workbench(Workspace.open(root)).add(effect).values or ()
        report = reprocess(cat, Workspace.open(root).mission(), settings=settings).as_json()
        assert ("remanent_moment" in str(report.get("warnings"))) == (not effect)
        errors.append(TrueError.of(cat, mission))
    before, after = errors
    # What a model does not have is in no uncertainty; with it the field is right and stated.
    assert (before.mean > 1.5 * before.stated)[1:].all()
    assert (after.mean < after.stated).all()
    assert (after.mean < 0.2 * before.mean)[1:].all()
    eta, sigma = fitted_eta(cat)
    parameters = mission.parameters
    (there, *_), (body, *_) = parameters.vector_position, parameters.remanent_position
    at_vector = (
        parameters.remanent_per_current * ((parameters.scalar_position[0] - body) / (there - body)) ** 3
    )
    assert sigma < 0.05 * at_vector
    assert abs(eta - at_vector) < 3 * sigma
    # Days at the ends have the mean of the next day: with them in the fit, eta was 6 % too large.
    assert abs(told["value"] - at_vector) < 3 * told["sigma"] < 0.05 * at_vector


def made(cat):
    """Reprocess; return the report, the product's true error and what it states, (time, axis) nT."""
    settings = ReprocessSettings(table="continuous", trend="constant", batch_days=DAYS)
    report = reprocess(cat, Workspace.open(cat.workspace).mission(), settings=settings).as_json()
    products = [cat.read_day("l2/field", day) for day in SETTINGS.day_list]
    truth = [simulate_day(SETTINGS, day).truth["FIELD"].values for day in SETTINGS.day_list]
    off = np.concatenate([one["field_sensor"].values for one in products]) - np.concatenate(truth)
    return report, off, np.concatenate([one["uncertainty"].values for one in products])


def rms(values):
    return np.sqrt(np.nanmean(values**2, axis=0))


@pytest.mark.slow
def test_the_daily_z_offset_is_taken_off_and_its_table_does_not_depend_on_itself(tmp_path):
    cat = simulated_workspace(tmp_path / "champ", DAYS, settings=SETTINGS, workers=1)
    root = cat.workspace
    (root / "models" / "champ-preflight.yaml").write_text(MODEL, encoding="utf-8")
    mission = Workspace.open(root).mission()
    with pytest.raises(CatalogError, match="main-z-offset") as absent:
        stored_entry(cat, mission, "main", "z_offset")
    assert "reprocess --table continuous" in str(absent.value.remedy)

    _, before, _ = made(cat)
    first = cat.table_by_id(cat.tables("main-z-offset")[-1].id)
    revision = open_workbench(Workspace.open(root)).add("z_offset")
    assert revision.in_sample[1] <= revision.in_sample[0]
    report, after, sigma = made(cat)
    assert report["days"]["done"] == DAYS
    # Only z was wrong, and only z becomes right; what is stated covers it.
    assert rms(before)[2] > 4 * rms(after)[2]
    np.testing.assert_allclose(rms(after)[:2], rms(before)[:2], atol=0.05)
    assert (rms(after / sigma) < 1.3).all()
    # What was taken off is put back where the offsets are told: the same table again.
    again = cat.table_by_id(cat.tables("main-z-offset")[-1].id)
    np.testing.assert_allclose(again["value"].values, first["value"].values, atol=0.1)
    day = next(one for one in cat.days("l2/field", states=("published",)))
    tables = {edge.parent for edge in cat.lineage(day) if edge.child == day.id and "table:" in edge.parent}
    assert f"table:{cat.tables('main-z-offset')[0].id}" in tables
    assert len(tables) == 2
    product = cat.read_day("l2/field", SETTINGS.day_list[2])
    np.testing.assert_allclose(product["correction_z_offset"].values[:, :2], 0.0)
    assert any("z_offset.vector[z]" in one for one in product.attrs["calibration_coefficients"])
