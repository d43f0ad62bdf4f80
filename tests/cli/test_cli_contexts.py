"""Named contexts: made of what was valid when, reprocessed with, compared; validities have a history."""

import shutil

import numpy as np
import pytest
from tiny_mission import TINY_START, make_tiny_workspace

from inflight.catalog import Catalog
from inflight.cli import main
from inflight.time import to_tt2000

FIRST = np.datetime64(TINY_START, "D")


@pytest.fixture(scope="module")
def two_contexts(tmp_path_factory):
    """Four calibrated days, context ``first`` of them, then another model, reprocessed, and ``second``."""
    root = make_tiny_workspace(tmp_path_factory.mktemp("contexts") / "tiny", days=4)

    def run(*arguments):
        with pytest.raises(SystemExit) as left:
            main([*map(str, arguments), "-w", str(root)])
        assert not left.value.code

    run("ingest", "--no-prefect")
    run("reprocess", "--no-prefect", "--window-days", 2)
    run("catalog", "context", "make", "first", "--by", "A. Person", "--reason", "first light")
    run("add", "offset_step@2024-03-03T12:00")
    run("reprocess", "--no-prefect", "--window-days", 2, "--start", FIRST + 2)
    run("catalog", "context", "make", "second", "--by", "B")
    return root


@pytest.fixture
def workspace(two_contexts, tmp_path):
    return shutil.copytree(two_contexts, tmp_path / "copy", symlinks=True)


def test_a_context_is_made_again_with_equal_values_and_products_name_it(inflight, workspace):
    before = {day.day: day for day in Catalog(workspace).revisions("l2/field") if day.revision == 0}
    told = inflight("reprocess", "-w", workspace, "--no-prefect", "--context", "first", "--json")
    assert told.code == 0, told.out
    assert told.json["days"]["done"] == 4
    catalog = Catalog(workspace)
    (named,) = catalog.named_contexts("first")
    for day in catalog.days("l2/field"):
        product, old = catalog.read(day), catalog.read(before[day.day])
        np.testing.assert_array_equal(product["field_sensor"], old["field_sensor"])
        assert product.attrs["calibration_context"] == f"first:{named.context[:12]}"
        assert product.attrs["calibration_model"].endswith("version 1")
        edges = {edge.parent for edge in catalog.lineage(day) if edge.child == day.id}
        assert f"context:{named.context}" in edges
    # Again there is nothing to do, and the version is made again with equal bytes.
    again = inflight("reprocess", "-w", workspace, "--no-prefect", "--context", "first", "--json")
    assert (again.json["days"]["done"], again.json["days"]["unchanged"]) == (0, 4)
    version = catalog.days("l2/field")[-1].version
    remade = inflight("reprocess", "-w", workspace, "--as-of", version, "--json")
    assert all(one["equal"] for one in remade.json["stores"]), remade.out
    shown = inflight("catalog", "show", "context:first", "-w", workspace, "--json").json["items"]
    assert any(item["parent"].startswith("table:") for item in shown)
    # A release made in it keeps the name; without one it can go.
    assert inflight("release", "1.0", "-w", workspace, "--no-prefect").code == 0
    refused = inflight("catalog", "context", "remove", "first", "-w", workspace, "--json")
    assert "release 1.0" in refused.json["error"]["message"]
    assert inflight("catalog", "context", "remove", "second", "-w", workspace).code == 0


def test_affected_tells_the_days_that_come_out_otherwise_and_why(inflight, workspace):
    told = inflight(
        "catalog", "affected", "-w", workspace, "--from", "first", "--to", "second", "--json"
    ).json
    days = [item["day"] for item in told["items"]]
    model = [reason for reason in told["reasons"] if reason.startswith("model")]
    assert ["version 1 -> tiny-ideal version 2" in reason for reason in model] == [True]
    assert days == [str(FIRST + number) for number in range(4)]
    # Nothing was run, and what is in use is the second.
    now = inflight("catalog", "affected", "-w", workspace, "--from", "second", "--json").json
    assert now["days"] == 0
    # Tables of the model before, still valid on the first days, are none of the second's.
    first, second = (
        inflight("catalog", "context", "show", name, "-w", workspace, "--json").json["items"][0][
            "comparisons"
        ]
        for name in ("first", "second")
    )
    (old,), (new,) = (one["main"]["tables"]["main-window"] for one in (first, second))
    assert old["table"] != new["table"]
    assert old["start"] < new["start"]
    same = inflight("catalog", "affected", "-w", workspace, "--from", "first", "--to", "first", "--json")
    assert same.code == 2


def test_affected_by_a_table_alone_is_only_where_its_values_differ(inflight, tmp_path):
    root = make_tiny_workspace(tmp_path / "tiny", days=4)
    for verb in ("ingest", "reprocess"):
        extra = ("--window-days", 2) if verb == "reprocess" else ()
        assert inflight(verb, "-w", root, "--no-prefect", *extra).code == 0
    make = ("catalog", "context", "make", "-w", root, "--by", "A")
    assert inflight(*make, "before").code == 0
    (record,) = Catalog(root).tables("main-window")
    cut = ("--start", FIRST + 3, "--by", "A", "--reason", "reset of the sensor")
    assert inflight("catalog", "decertify", "main-window", "-w", root, *cut).code == 0
    assert inflight(*make, "after").code == 0
    told = inflight("catalog", "affected", "-w", root, "--from", "before", "--to", "after", "--json").json
    assert [item["day"] for item in told["items"]] == [str(FIRST + 3)]
    assert told["reasons"] == {f"table main-window:{record.id} -> none": 1}
    part = inflight("reprocess", "-w", root, "--no-prefect", "--context", "after", "--json")
    assert part.code == 3
    assert (part.json["days"]["done"], part.json["days"]["failed"]) == (3, 1)
    # History: who, why, and what it did; as of before the act the validity is whole.
    (last,) = inflight("catalog", "history", "main-window", "-w", root, "--json").json["items"][-1:]
    assert (last["act"], last["by"], last["reason"]) == ("decertify", "A", "reset of the sensor")
    assert last["became"] == [f"main-window:{record.id} shortened"]
    # What a person took away, the next run does not give back.
    (valid,) = Catalog(root).tables("main-window")[0].certified
    assert inflight("reprocess", "-w", root, "--no-prefect", "--window-days", 2).code == 0
    assert Catalog(root).tables("main-window")[0].certified == (valid,)
    when = Catalog(root).certification_acts()[-1].created[:26]
    assert inflight(*make, "again", "--as-of", when).code == 0
    none = inflight("catalog", "affected", "-w", root, "--from", "before", "--to", "again", "--json").json
    assert none["days"] == 0
    early = inflight(*make, "early", "--as-of", "2020-01-01", "--json")
    assert "no calibration table is valid as of 2020-01-01" in early.json["error"]["message"]


def test_a_context_is_refused_with_settings_that_contradict_it(inflight, workspace):
    run = ("reprocess", "-w", workspace, "--no-prefect", "--json")
    both = inflight(*run, "--context", "first", "--use-table", "main-window")
    assert both.code == 2
    unknown = inflight(*run, "--context", "furst")
    assert "did you mean 'first'" in unknown.json["error"]["message"]
    monthly = inflight(*run, "--context", "first", "--table", "continuous")
    assert "no table 'main-continuous'" in monthly.json["error"]["message"]


def test_a_table_is_held_against_the_newest_one_of_its_name(inflight, workspace, tmp_path):
    catalog = Catalog(workspace)
    first, last = (catalog.tables("main-window")[at] for at in (0, -1))
    picture = tmp_path / "tables.svg"
    told = inflight("catalog", "diff", f"main-window:{first.id}", "-w", workspace, "--svg", picture, "--json")
    assert told.code == 0, told.err
    assert (told.json["before"], told.json["after"]) == (f"main-window:{first.id}", f"main-window:{last.id}")
    for item in told.json["items"]:
        at = np.datetime64(item["at"], "ns")
        values = [
            table.isel(interval=int(np.flatnonzero(table["start"].values <= to_tt2000(at))[-1]))["value"]
            for table in (catalog.table_by_id(first.id), catalog.table_by_id(last.id))
        ]
        apart = float(values[1].sel(parameter=item["parameter"]) - values[0].sel(parameter=item["parameter"]))
        assert item["largest"] == apart
    assert told.json["items"][0]["parameter"] in picture.read_text()
