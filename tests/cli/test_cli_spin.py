"""A spinning spacecraft from the command line: simulated, ingested, calibrated."""

import pytest

from inflight.catalog import Catalog
from inflight.flags import Flag

PLAIN = ("--no-prefect", "--workers", 1, "--json")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("spin") / "imp8"


def test_a_spinning_mission_goes_through_the_verbs(inflight, root):
    assert inflight("new", "imp8", root).code == 0
    told = inflight("simulate", "--days", 2, "--start", "2012-03-01", "--workers", 1, "--json", "-w", root)
    assert told.json["files"] == 8
    assert inflight("ingest", *PLAIN, "-w", root).json["days"]["failed"] == 0
    told = inflight("reprocess", "--table", "daily", "--end", "2012-03-02", *PLAIN, "-w", root)
    assert told.code == 0
    assert told.json["days"]["done"] == 1
    assert told.json["residual"]["after_nT"] < 0.02 < 1.0 < told.json["residual"]["before_nT"]
    shown = inflight("catalog", "show", "tables/main-daily", "--json", "-w", root)
    assert shown.code == 0


def test_a_table_is_shown_with_its_values_and_where_they_came_from(inflight, root):
    shown = inflight("catalog", "show", "tables/main-daily", "-w", root).out
    assert "gain_ratio" in shown
    assert "from ground" in shown or "ground" in shown
    assert any(line.startswith("in Python") and "covariance" in line for line in shown.splitlines())
    zero = inflight("catalog", "show", "tables/main-zero-level-daily", "-w", root)
    methods = zero.out if zero.code == 0 else inflight("catalog", "show", "main-zero-level", "-w", root).out
    for method in ("davis-smith", "wang-pan", "minimum correlation"):
        assert method in methods


def test_compare_tells_what_still_goes_with_the_spin(inflight, root):
    told = inflight("compare", "--json", "-w", root)
    assert told.code == 0
    residual = told.json["residual"]
    assert residual["after_nT"] < 0.02 < 1.0 < residual["before_nT"]
    assert 0 < residual["noise_floor_nT"] < 0.02
    again = inflight("reprocess", "--table", "daily", "--end", "2012-03-02", *PLAIN, "-w", root).json
    assert again["residual"] == {
        name: pytest.approx(residual[name], rel=1e-3) for name in ("before_nT", "after_nT")
    }
    assert [(one["row"], one["harmonic"]) for one in told.json["tones"]][:2] == [("axial", 1), ("axial", 2)]
    shown = inflight("compare", "-w", root).out
    assert "noise floor" in shown
    low = residual["noise_floor_interval_nT"][0]
    assert ("the residual is below it" in shown) == (low is not None and residual["after_nT"] < low)
    assert told.json["model_version"] == inflight("model", "show", "--json", "-w", root).json["version"] == 1
    assert "next: " in shown


def test_the_tables_of_the_spin_are_told_and_drawn(inflight, root, tmp_path):
    page = tmp_path / "spin.html"
    told = inflight("chain", "--html", page, "--json", "-w", root)
    assert told.code == 0
    sections = told.json["sections"]
    twelve = {one["name"]: one for one in sections["twelve"]["items"]}
    assert len(twelve) == 12
    assert twelve["gain_ratio"]["decision"] == "update"
    assert twelve["rotation"]["origin"] == "ground"
    assert "What each day decided" in page.read_text(encoding="utf-8")
    shown = inflight("chain", "-w", root).out
    assert "gain_ratio" in shown
    assert "remain at their ground values" in shown


def test_a_day_that_taught_no_table_is_flagged_and_less_certain(inflight, root):
    told = inflight("reprocess", "--start", "2012-03-02", "--use-table", "main-daily", *PLAIN, "-w", root)
    assert told.json["days"]["done"] == 1
    taught, other = (Catalog(root).read_day("l2/field", f"2012-03-0{day}") for day in (1, 2))
    assert not (taught["flag"].values & Flag.EXTRAPOLATED).any()
    assert (other["flag"].values & Flag.EXTRAPOLATED).all()
    # One day tells no changes: what was known before flight stands for them.
    assert (other["uncertainty"].mean("time") > 10 * taught["uncertainty"].mean("time")).all()
    assert other.attrs["calibration_table"].endswith("learnt 2012-03-01 to 2012-03-02, extrapolated")
    assert inflight("reprocess", "--as-of", "v01.00", "--workers", 1, "-w", root).code == 0
