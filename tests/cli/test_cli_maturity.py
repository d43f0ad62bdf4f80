"""How far a product is checked: maturity, tables approved by a person, readings excluded by one."""

import csv
import json

import cdflib
import numpy as np
import pytest
from test_cli_release_header import RELEASE_KEYS
from tiny_mission import TINY_START, make_tiny_workspace

from inflight.catalog import Catalog
from inflight.flags import Flag
from inflight.serve import Collection


@pytest.fixture
def calibrated(inflight, tmp_path):
    """A workspace of two calibrated days whose mission says what files need."""
    root = make_tiny_workspace(tmp_path / "tiny")
    mission = root / "mission.yaml"
    mission.write_text(mission.read_text("utf-8") + RELEASE_KEYS, "utf-8")
    for verb in ("ingest", "reprocess"):
        assert inflight(verb, "-w", root, "--no-prefect").code == 0
    return root


def test_a_definitive_release_takes_only_tables_that_a_person_approved(inflight, calibrated):
    release = ("release", "1.0", "-w", calibrated, "--no-prefect", "--maturity", "definitive")
    refused = inflight(*release, "--json")
    assert refused.code == 1
    assert "not approved" in refused.json["error"]["message"]
    # The remedy is the command that helps.
    words = refused.json["error"]["remedy"].partition(",")[0].removeprefix("inflight ").split()
    words[words.index("NAME")] = "A. Person"
    assert inflight(*words, "--note", "held against the quiet days", "-w", calibrated).code == 0
    assert inflight(*release).code == 0
    shown = inflight("catalog", "show", "main-window", "-w", calibrated, "--json").json["items"]
    assert [one["approved_by"] for one in shown] == ["A. Person"]
    with (calibrated / "releases" / "1.0" / "tables.csv").open() as stream:
        approved = {row["name"]: row["approved_by"] for row in csv.DictReader(stream)}
    assert approved["main-window"] == "A. Person"
    assert approved["main-daily"] == ""


def test_an_approval_is_of_one_table_and_not_of_the_next(inflight, calibrated):
    release = ("release", "1.0", "-w", calibrated, "--no-prefect", "--maturity", "definitive")
    assert inflight("catalog", "approve", "main-window", "--by", "A. Person", "-w", calibrated).code == 0
    assert inflight("reprocess", "-w", calibrated, "--no-prefect", "--table", "daily").code == 0
    assert inflight(*release).code == 1
    assert inflight("catalog", "approve", "main-spam", "--by", "A. Person", "-w", calibrated).code == 1
    assert inflight("catalog", "approve", "main-daily", "--by", " ", "-w", calibrated).code == 1


def test_maturity_stands_in_catalog_file_name_header_and_for_clients(inflight, calibrated):
    show = ("catalog", "show", "l2/field", "-w", calibrated, "--json")
    assert {one["maturity"] for one in inflight(*show).json["items"]} == {"quick-look"}
    formats = ("--format", "cdf", "--format", "netcdf", "--format", "zarr")
    assert inflight("release", "1.0", "-w", calibrated, "--no-prefect", *formats).code == 0
    assert {one["maturity"] for one in inflight(*show).json["items"]} == {"preliminary"}
    folder = calibrated / "releases" / "1.0"
    names = sorted(path.name for path in folder.rglob("*.cdf") if "field" in path.name)
    assert names[0] == "tiny_l2_field-preliminary_20240301_v01.00.cdf"
    assert not list(folder.rglob("tiny_l1*preliminary*"))
    stated = cdflib.CDF(next(folder.rglob(names[0]))).globalattsget()
    assert stated["Maturity"] == ["preliminary"]
    assert stated["Logical_file_id"] == [names[0].removesuffix(".cdf")]
    assert Catalog(folder).read_day("l2/field", TINY_START).attrs["maturity"] == "preliminary"
    assert json.loads((folder / "release.json").read_text())["maturity"] == "preliminary"
    for place in (folder, calibrated):
        served = Collection.open(place).find("tiny/1.0/l2/field")
        assert served.info([])["x_maturity"] == "preliminary"


def test_excluded_readings_teach_no_table_and_say_who_excluded_them_and_why(inflight, tmp_path):
    root = make_tiny_workspace(tmp_path / "tiny")
    mission = root / "mission.yaml"
    excluded = (
        "exclusions:\n  - {instrument: turning, start: 2024-03-01T06:00, end: 2024-03-01T12:00, "
        "author: A. Person, reason: magnet tests}\n"
    )
    mission.write_text(mission.read_text("utf-8") + RELEASE_KEYS + excluded, "utf-8")
    for verb in ("ingest", "reprocess"):
        assert inflight(verb, "-w", root, "--no-prefect").code == 0
    catalog = Catalog(root)
    product = catalog.read_day("l2/field", TINY_START)
    inside = np.zeros(1440, dtype=bool)
    inside[360:720] = True
    np.testing.assert_array_equal((product["flag"].values & Flag.EXCLUDED) > 0, inside)
    # The field is there, and no fit took it.
    assert np.isfinite(product["field_sensor"].values).all()
    assert [day.report["used"] for day in catalog.days("equations/main/base")] == [1080, 1440]
    words = "turning 2024-03-01T06:00:00Z to 2024-03-01T12:00:00Z: magnet tests (A. Person)"
    assert product.attrs["exclusions"] == [words]
    assert inflight("release", "1.0", "-w", root, "--no-prefect", "--format", "cdf").code == 0
    folder = root / "releases" / "1.0"
    assert "A. Person,magnet tests" in (folder / "exclusions.csv").read_text()
    (file,) = folder.rglob("*field*20240301*.cdf")
    assert cdflib.CDF(file).globalattsget()["Exclusions"] == [words]


@pytest.mark.parametrize(
    ("wrong", "told"),
    [("reason: tests", "author"), ("author: A, reason: tests, instrument: spinning", "spinning")],
)
def test_an_exclusion_needs_a_known_instrument_author_and_reason(inflight, tmp_path, wrong, told):
    root = make_tiny_workspace(tmp_path / "tiny")
    mission = root / "mission.yaml"
    named = "" if "instrument" in wrong else "instrument: turning, "
    text = f"exclusions: [{{{named}start: 2024-03-01, end: 2024-03-02, {wrong}}}]\n"
    mission.write_text(mission.read_text("utf-8") + text, "utf-8")
    refused = inflight("catalog", "gaps", "-w", root, "--json")
    assert refused.code == 1
    assert told in json.dumps(refused.json["error"])
