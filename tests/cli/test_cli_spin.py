"""A spinning spacecraft from the command line: simulated, ingested, calibrated."""

import pytest

PLAIN = ("--no-prefect", "--workers", 1, "--json")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("spin") / "imp8"


def test_a_spinning_mission_goes_through_the_verbs(inflight, root):
    assert inflight("new", "imp8", root).code == 0
    told = inflight("simulate", "--days", 1, "--start", "2012-03-01", "--workers", 1, "--json", "-w", root)
    assert told.json["files"] == 4
    assert inflight("ingest", *PLAIN, "-w", root).json["days"]["failed"] == 0
    told = inflight("reprocess", "--table", "daily", *PLAIN, "-w", root)
    assert told.code == 0
    assert told.json["days"]["done"] == 1
    assert told.json["residual"]["after_nT"] < 0.02 < 1.0 < told.json["residual"]["before_nT"]
    shown = inflight("catalog", "show", "tables/main-daily", "--json", "-w", root)
    assert shown.code == 0


def test_compare_says_why_it_has_nothing_to_draw(inflight, root):
    told = inflight("compare", "--json", "-w", root)
    assert told.code != 0
    assert "no residual a sample" in told.json["error"]["message"]
    assert "diagnose" in told.json["error"]["remedy"]
