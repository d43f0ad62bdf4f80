"""`diagnose` and `compare` tell faults of plumbing before all else; the line they name mends the archive."""

import numpy as np
import pytest
from heated_mission import HEATED_DAYS, HEATER_FIELD, HOUSEKEEPING, deliver_heated_day, heater_field
from plumbing_cases import wrong
from tiny_mission import TINY_YAML

from inflight.catalog import Catalog, Workspace
from inflight.tasks import check_plumbing
from inflight.tasks.analysis import DiagnoseSettings, compare, diagnose_span
from inflight.tasks.archive import ingest
from inflight.tasks.pipelines import reprocess

MODEL = f"""model: heated
version: 1
mission: tiny
comparison: main
effects:
  - effect: vector_sensor
    sensor: turning
    scale_factor: {{time: block, unit: "1", value: [1, 1, 1], sigma: [2.0e-3, 2.0e-3, 2.0e-3]}}
    misalignment: {{time: block, unit: deg, value: [90, 90, 90], sigma: [0.1, 0.1, 0.1]}}
    offset: {{time: block, unit: nT, value: [0, 0, 0], sigma: [100, 100, 100]}}
  - effect: channel_field
    channel: heater_current
    sensor: turning
    coefficient: {{unit: nT/A, value: {HEATER_FIELD.tolist()}, sigma: [0.1, 0.1, 0.1]}}
"""
TEXT = TINY_YAML.replace("comparisons:", HOUSEKEEPING).replace(
    "boom_temperature: {variable: boom, unit: degC, kind: temperature}",
    "pump_current: {variable: boom, unit: mA, kind: current}",
)
TEXT += "preflight: models/heated.yaml\n"
HEATER = "instruments.power.channels.heater_current"


@pytest.fixture
def made(tmp_path):
    """Return a function that ingests four days under a mission's text; the folder is one workspace's."""
    source = tmp_path / "yaml" / "heated.yaml"
    (source.parent / "models").mkdir(parents=True)
    (source.parent / "models" / "heated.yaml").write_text(MODEL, encoding="utf-8")
    source.write_text(TEXT, encoding="utf-8")
    place = Workspace.create(tmp_path / "w", source)
    for day in HEATED_DAYS:
        deliver_heated_day(place.data, day, heater_field)

    def read(text):
        """Ingest as a mission's text says; return catalog and mission."""
        place.mission_file.write_text(text, encoding="utf-8")
        assert ingest(Catalog(place.root), place.mission(), place.data).exit_code == 0
        return Catalog(place.root), place.mission()

    read.place = place
    return read


def test_a_wrong_unit_of_a_current_heads_the_verdict_until_it_is_mended(made):
    changed = wrong(TEXT, f"{HEATER}.file_unit", "A")
    cat, mission = made(changed)
    settings = DiagnoseSettings(draws=200, rounds=0)
    told = diagnose_span(made.place, settings=DiagnoseSettings(draws=200, rounds=2), save=True)
    assert told["entries"], "something would be added"
    assert told["versions"] == []
    told = diagnose_span(made.place, settings=settings)
    (fault,) = told["plumbing"]
    assert told["sentence"].startswith("Mend the data first. 'heater_current' of 'power'")
    assert "what follows is not to be trusted" in told["sentence"]
    assert fault["remedies"][0]["yaml"] == f"{HEATER}.file_unit: mA"
    assert fault["sure"]
    (found,) = check_plumbing(cat, mission)
    cat, mission = made(found.remedies[0].applied(changed))
    assert check_plumbing(cat, mission) == ()
    told = diagnose_span(made.place, settings=settings)
    assert told["plumbing"] == []
    assert not told["sentence"].startswith("Mend")


def test_exchanged_currents_are_told_by_the_coefficients_of_the_model(made, monkeypatch):
    changed = wrong(
        wrong(TEXT, f"{HEATER}.variable", "boom"), HEATER.replace("heater", "pump") + ".variable", "heater"
    )
    cat, mission = made(changed)
    (found,) = check_plumbing(cat, mission)
    assert found.fault == "exchanged"
    assert "'heater_current' of 'power' and 'pump_current' are exchanged" in found.sentence
    with monkeypatch.context() as context:
        context.setattr(Catalog, "read", None)
        assert check_plumbing(cat, mission) == (found,), "asked again, no samples are read"
    assert check_plumbing(*made(found.remedies[0].applied(changed))) == ()


def test_compare_tells_of_a_stale_reading_and_most_repeats_takes_it_out(made):
    path = made.place.data / f"turning_{HEATED_DAYS[1].replace('-', '')}.csv"
    head, *rows = path.read_text(encoding="utf-8").splitlines()
    held = rows[400].split(",", 1)[1]
    rows[400:700] = [f"{row.split(',', 1)[0]},{held}" for row in rows[400:700]]
    path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    cat, mission = made(TEXT)
    assert reprocess(cat, mission).exit_code == 0
    report = compare(cat, mission)
    line = report.summary()[0].text
    assert line.startswith(
        "mend the data first: 'field' of 'turning' repeats a stale value (2024-03-02T06:40"
    )
    (fault,) = report.as_json()["plumbing"]
    assert (fault["fault"], fault["before"], fault["unit"]) == ("stale", 300 * 60.0, "s")
    (found,) = report.plumbing
    cat, mission = made(found.remedies[0].applied(TEXT))
    assert check_plumbing(cat, mission) == ()
    readings = cat.read_day("l1/turning", HEATED_DAYS[1])["field"].values
    assert np.isfinite(readings[400]).all()
    assert np.isnan(readings[401:700]).all()
    assert np.isfinite(np.delete(readings, slice(401, 700), axis=0)).all()
