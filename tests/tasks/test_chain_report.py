"""What the chain found as fields, as a page and as a verb: everything there, or the reason why it is not."""

import json

import numpy as np
import pytest

from benchmarks.archive import simulated_workspace
from inflight.catalog import Catalog, Workspace
from inflight.cli import main
from inflight.errors import CatalogError, SettingsError
from inflight.simulate import SimulationSettings
from inflight.tasks import to_json
from inflight.tasks.pipelines import ReprocessSettings, reprocess, tables_report
from inflight.tasks.pipelines.mission_fit import mission_fit_report
from inflight.tasks.pipelines.mission_fit.report import SECTIONS

DAYS = 12
SETTINGS = SimulationSettings(seed=5, cadence=5)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """A short mission that went through the chain."""
    folder = tmp_path_factory.mktemp("report") / "champ"
    cat = simulated_workspace(folder, DAYS, settings=SETTINGS, model="champ-chain.yaml", workers=1)
    settings = ReprocessSettings(table="continuous", trend="linear", batch_days=12)
    reprocess(cat, Workspace.open(folder).mission(), settings=settings)
    return folder


@pytest.fixture(scope="module")
def told(workspace):
    """Report, page, and what was told while they were made."""
    page, steps = workspace / "reports" / "chain.html", list[tuple[str, int, int]]()
    mission = Workspace.open(workspace).mission()
    made = tables_report(Catalog(workspace), mission, "main", page, progress=lambda *step: steps.append(step))
    return made, page.read_text(encoding="utf-8"), steps


def test_each_section_is_told_as_it_is_made(told):
    assert told[2] == [("sections", done, len(SECTIONS)) for done in range(len(SECTIONS) + 1)]


def test_fields_are_plain_and_hold_every_section(told):
    fields = json.loads(to_json(told[0].as_json()))
    assert fields["days"] == DAYS
    residual = fields["sections"]["residual"]
    assert residual["products_nT"] < residual["own_fit_nT"] < 0.1 * residual["before_nT"]
    assert fields["span"] == ["2005-01-01", "2005-01-12"]
    assert set(fields["sections"]) == {part.key for part in told[0].parts}
    assert len(told[0].parts) == len(SECTIONS)
    for name in ("coil-temperature", "day-night", "cross-talk", "cross-talk-all"):
        assert fields["tables"][name] == f"main-{name}"
    for name in ("continuous", "trend", "daily-after", "clock-faults", "daily-temperature", "panels"):
        assert fields["tables"][name] == f"main-{name}"


def test_a_coefficient_tells_value_error_unit_and_how_far_it_went(told):
    items = {one["name"]: one for one in told[0].as_json()["sections"]["coefficients"]["items"]}
    shift = items["time_shift.seconds"]
    assert shift["determined"]
    assert shift["unit"] == "s"
    assert shift["shift_sigma"] == pytest.approx((shift["value"] - shift["prior"]) / shift["prior_sigma"])
    assert items["heater.coefficient[x]"]["unit"] == "nT/A"
    # A slope in time was not known of beforehand.
    assert items["vector_sensor.scale_factor[x]*b"]["shift_sigma"] is None


def test_page_has_every_section_and_needs_nothing_but_itself(told):
    made, page, _ = told
    for part in made.parts:
        assert f"<h2>{part.heading}</h2>" in page
    assert "<script src" not in page
    assert "<link" not in page
    assert page.count("data-root-id") >= 15


def test_what_the_span_cannot_tell_is_said_with_its_reason(told):
    made, page, _ = told
    absent = {what: why for part in made.parts for what, why in part.absent.items()}
    assert "260 d" in absent["Running mean of the currents"]
    assert "no events" in absent["Steps on event days"]
    assert "--table window" in absent["Jumps of a table of windows"]
    assert "12 days" in absent["Periods"]
    assert all(why for why in absent.values())
    assert page.count('class="absent"') == sum(len(part.absent) for part in made.parts)


def test_days_after_the_fit_scatter_as_they_say(told):
    rows = told[0].as_json()["sections"]["behaviour"]["scatter"]
    assert len(rows) == 10
    assert np.mean([row["over_sigma"] for row in rows]) == pytest.approx(1.0, abs=0.4)


def test_torquer_matrix_lowers_its_band(told):
    matrix = told[0].as_json()["sections"]["torquers"]["matrix"]
    assert matrix["band_after_nT"] < matrix["band_before_nT"]


def test_a_dipole_on_the_boom_shares_its_difference_by_the_cube_of_distance(told):
    factors = told[0].as_json()["sections"]["current_steps"]["dipole"]["factors"]
    assert factors == pytest.approx([1.64001, 0.64001], abs=1e-4)


def test_jumps_of_windows_stand_against_none_of_the_continuous_parameters(workspace, told):
    cat, mission = Catalog(workspace), Workspace.open(workspace).mission()
    reprocess(cat, mission, settings=ReprocessSettings(table="window", window_days=4))
    sections = tables_report(cat, mission, "main").as_json()["sections"]
    # These products are the windows' now.
    assert sections["residual"]["absent"]
    fields = sections["jumps"]
    assert not fields["absent"]
    assert fields["boundaries"] >= 2
    assert fields["continuous_rms_nT"] < 1e-6 < fields["window_rms_nT"]


def test_verb_prints_and_writes_the_page(workspace, tmp_path, capsys):
    page = tmp_path / "made" / "chain.html"
    with pytest.raises(SystemExit) as ended:
        main(["chain", "-w", str(workspace), "--html", str(page)])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert "12 days, 2005-01-01 to 2005-01-12" in shown
    assert "nan" not in shown
    assert "not told: Steps on event days" in shown
    assert str(page) in shown
    assert page.is_file()


def test_verb_tells_what_one_ignored_parameter_does(workspace, capsys):
    asked = "time_shift.seconds"
    with pytest.raises(SystemExit) as ended:
        main(["chain", "-w", str(workspace), "--cross-talk", asked, "--json"])
    assert not ended.value.code
    told = json.loads(capsys.readouterr().out)["sections"]["cross_talk"]
    assert told["asked"]["ignored"] == asked
    alone = {one["parameter"]: one["shift"] for one in told["asked"]["alone"]}
    assert alone["vector_sensor.misalignment[xz]"] == pytest.approx(3.2, abs=0.2)
    assert asked not in {one["parameter"] for one in told["asked"]["together"]}
    assert len(told["nine"]["value"]) == len(told["nine"]["ignored"])
    with pytest.raises(SystemExit) as ended:
        main(["chain", "-w", str(workspace), "--cross-talk", "gravity"])
    assert ended.value.code
    assert "no parameter 'gravity'" in " ".join(capsys.readouterr().err.split())


def test_nothing_processed_says_what_to_run(tmp_path):
    folder = tmp_path / "empty"
    cat = simulated_workspace(folder, 1, settings=SETTINGS, workers=1)
    with pytest.raises(CatalogError) as raised:
        tables_report(cat, Workspace.open(folder).mission(), "main")
    assert "reprocess --table continuous" in raised.value.remedy
    with pytest.raises(SettingsError, match="other"):
        mission_fit_report(cat, Workspace.open(folder).mission(), "other")
