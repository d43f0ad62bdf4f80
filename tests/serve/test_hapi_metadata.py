"""What the server says of itself, of its datasets and of their parameters."""

import shutil

import numpy as np
import pytest
from serve_cases import DAYS, ID, MISSION, Client, collection_of, make_workspace, samples

from inflight.catalog import Catalog, DayData, write_segment
from inflight.serve import make_app

#: Keys of HAPI 3.2, sections 3.6.2 and 3.6.6; all others begin with x_.
DATASET_KEYS = {
    "HAPI", "status", "format", "parameters", "startDate", "stopDate", "timeStampLocation", "cadence",
    "sampleStartDate", "sampleStopDate", "maxRequestDuration", "description", "unitsSchema",
    "coordinateSystemSchema", "resourceURL", "resourceID", "creationDate", "citation", "modificationDate",
    "contact", "contactID", "additionalMetadata",
}  # fmt: skip
PARAMETER_KEYS = {
    "name", "type", "length", "size", "units", "fill", "description", "label", "stringType",
    "coordinateSystemName", "vectorComponents", "bins",
}  # fmt: skip


def test_the_catalog_has_one_dataset_a_release_and_product(client):
    answer = client.get("/hapi/catalog")
    assert answer.headers["content-type"] == "application/json"
    assert answer.headers["access-control-allow-origin"] == "*"
    assert answer.json() == {
        "HAPI": "3.2",
        "status": {"code": 1200, "message": "OK"},
        "catalog": [
            {"id": "probe/1.0/l1/fgm", "title": "l1/fgm, release 1.0"},
            {"id": ID, "title": "l2/field, release 1.0"},
        ],
    }


def test_the_catalog_of_all_depth_holds_the_info_of_each(client, ask):
    for item in client.get("/hapi/catalog", {"depth": "all"}).json()["catalog"]:
        info = ask("info", dataset=item["id"]).json()
        assert item["info"] == {key: value for key, value in info.items() if key not in ("HAPI", "status")}


def test_what_the_server_can_and_who_runs_it(client, ask):
    able = client.get("/hapi/capabilities").json()
    assert able["outputFormats"] == ["csv", "binary"]
    about = client.get("/hapi/about").json()
    assert (about["id"], about["contact"]) == ("Somewhere/probe", "Someone, Somewhere")
    query = about["dataTest"]["query"]
    assert query["parameters"] == "Time,field_sensor"
    assert ask("data", **query).text.count("\n") > 10


def test_info_tells_version_frozen_part_doi_and_rules(ask):
    info = ask("info").json()
    assert (info["startDate"], info["stopDate"]) == ("2005-12-30T00:00:00Z", "2006-01-04T00:00:00Z")
    assert info["cadence"].startswith("PT")
    assert (info["x_version"], info["x_frozen"], info["x_doi"]) == ("1.0", True, "10.1234/probe")
    assert info["citation"] == "https://doi.org/10.1234/probe"
    assert (info["x_rules_of_use"], info["x_acknowledgement"]) == ("Free", "Thank you")
    assert info["contact"] == "Someone, Somewhere"
    assert info["description"] == "A probe with one magnetometer: l2/field, release 1.0"
    assert info["x_left_out"] == {"rotation": "it is the same for all samples of a day"}
    assert (info["x_days"], info["x_samples"]) == (4, 4 * (144 + 8))


def test_info_tells_which_days_no_release_holds_yet(workspace, tmp_path, ask):
    assert ask("info").json()["x_newest_release"] == "1.0"
    assert not [key for key in ask("info").json() if key.startswith("x_active")]
    root = tmp_path / "probe"
    shutil.copytree(workspace, root)
    catalog = Catalog(root)
    with catalog.run("reprocess") as run:
        for day in (DAYS[2], np.datetime64("2006-01-04")):
            run.stage("l2/field", samples(day), day=day, key=f"{day} anew")
        run.publish()
    found = Client(make_app(collection_of(root))).get("/hapi/info", {"dataset": ID}).json()
    active = [found[f"x_active_{part}"] for part in ("days", "start", "stop")]
    assert active == [2, "2006-01-01T00:00:00Z", "2006-01-05T00:00:00Z"]
    assert found["stopDate"] == "2006-01-04T00:00:00Z"


def test_the_example_span_of_info_holds_samples(ask):
    info = ask("info").json()
    span = {"start": info["sampleStartDate"], "stop": info["sampleStopDate"]}
    assert ask("data", **span).text.count("\n") > 50


def test_parameters_carry_units_labels_frames_and_sigma(ask):
    parameters = {item["name"]: item for item in ask("info").json()["parameters"]}
    assert list(parameters) == [
        "Time", "field_nec", "field_sensor", "uncertainty", "counter", "flag", "mode", "small", "step",
        "temperature", "tensor", "correction_heater",
    ]  # fmt: skip
    assert parameters["field_nec"] == {
        "name": "field_nec",
        "type": "double",
        "units": "nT",
        "fill": "NaN",
        "description": "calibrated field, nec axes",
        "size": [3],
        "label": ["field_nec north", "field_nec east", "field_nec centre"],
        "coordinateSystemName": "nec",
        "vectorComponents": ["x", "y", "z"],
    }
    assert parameters["field_sensor"]["x_uncertainty"] == "uncertainty"
    assert parameters["Time"]["length"] == 30
    assert (parameters["mode"]["type"], parameters["mode"]["length"]) == ("string", len('a, "quoted" one'))
    assert (parameters["tensor"]["size"], parameters["flag"]["type"]) == ([3, 2], "integer")
    assert parameters["temperature"]["units"] == "degC"
    assert all(item["units"] != "" for item in parameters.values())


def test_no_key_of_its_own_lacks_its_mark(ask):
    for dataset in (ID, "probe/1.0/l1/fgm"):
        info = ask("info", dataset=dataset).json()
        assert {key for key in info if not key.startswith("x_")} <= DATASET_KEYS
        for item in info["parameters"]:
            assert {key for key in item if not key.startswith("x_")} <= PARAMETER_KEYS


def test_people_find_a_page(client):
    assert client.get("/").headers["location"] == "/hapi"
    for path in ("/hapi", "/hapi/"):
        page = client.get(path)
        assert page.headers["content-type"].startswith("text/html")
        assert ID in page.text
        assert MISSION.description in page.text


def test_a_release_made_meanwhile_is_served(tmp_path):
    root = make_workspace(tmp_path / "probe")
    client = Client(make_app(collection_of(root)))
    assert client.get("/hapi/info", {"dataset": "probe/1.1/l1/fgm"}).status_code == 404
    Catalog(root).release("1.1", datasets=("l1/*",))
    assert client.get("/hapi/info", {"dataset": "probe/1.1/l1/fgm"}).json()["x_version"] == "1.1"
    ids = [item["id"] for item in client.get("/hapi/catalog").json()["catalog"]]
    assert ids == ["probe/1.0/l1/fgm", ID, "probe/1.1/l1/fgm"]


@pytest.mark.parametrize("variable", ["field_nec", "flag"])
def test_a_variable_that_is_not_alike_on_all_days_is_left_out_and_named(tmp_path, variable):
    root = make_workspace(tmp_path / "probe")
    catalog = Catalog(root)
    day = np.datetime64("2006-01-04")
    other = samples(day)
    if variable == "flag":
        other = other.assign(flag=("time", np.array(["good"] * other.sizes["time"])))
    else:
        other["field_nec"].attrs["units"] = "T"
    with catalog.run("reprocess") as run:
        run.attach(write_segment(root, run.id, "l2/field", [DayData(day, other, "x", ("file:" + "a" * 64,))]))
        run.publish()
    catalog.release("1.1", datasets=("l2/field",))
    client = Client(make_app(collection_of(root)))
    query = {"dataset": "probe/1.1/l2/field"}
    info = client.get("/hapi/info", query).json()
    assert variable not in [item["name"] for item in info["parameters"]]
    assert "changes between days" in info["x_left_out"][variable]
    data = client.get("/hapi/data", {**query, "start": "2005-12-30", "stop": "2006-01-05"})
    assert data.text.count("\n") == info["x_samples"]
