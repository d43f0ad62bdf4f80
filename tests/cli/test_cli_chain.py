"""The whole chain by the command line, on the tiny mission: what is printed, what is left, how it ends."""

import shutil
from pathlib import Path

import pytest
from istp_checks import istp_findings
from tiny_mission import deliver_tiny_day, make_tiny_workspace

REPORT = {"command", "run", "context", "days", "problems", "outputs"}
RELEASE_KEYS = """\
acknowledgement: Thank you
release:
  source_name: TINY>A tiny mission
  project: Test>A test
  discipline: Space Physics>Magnetospheric Science
  pi_name: Someone
  pi_affiliation: Somewhere
  rules_of_use: Free
"""
COUNTS = {"planned", "done", "unchanged", "failed", "no_work"}


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A workspace with two calibrated days; tests that change it take a copy."""
    from inflight.catalog import Workspace
    from inflight.flows import run_without_prefect

    root = make_tiny_workspace(tmp_path_factory.mktemp("chain") / "tiny")
    for name in ("ingest", "reprocess"):
        assert run_without_prefect(name, Workspace.open(root), {}).exit_code == 0
    return root


@pytest.fixture
def copied(finished, tmp_path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "copy"))


def test_ingest_reports_days_by_outcome_and_the_second_time_nothing_is_left_to_do(inflight, tiny_workspace):
    command = ("ingest", "--no-prefect", "--json", "-w", tiny_workspace)
    first, second = inflight(*command), inflight(*command)
    assert first.code == second.code == 0
    assert set(first.json) >= REPORT
    assert set(first.json["days"]) == COUNTS
    assert first.json["days"]["done"] == 4
    assert second.json["days"]["unchanged"] == 4
    assert second.json["days"]["done"] == 0


def test_ingest_takes_one_instrument_and_one_span_when_asked(inflight, tiny_workspace):
    span = ("--start", "2024-03-02", "--end", "2024-03-03", "--instrument", "turning")
    told = inflight("ingest", *span, "--no-prefect", "--json", "-w", tiny_workspace)
    assert told.json["days"]["done"] == 1


def test_a_bad_day_is_told_with_its_remedy_and_ends_with_days_missing(inflight, tiny_workspace):
    (tiny_workspace / "data" / "turning_20240302.csv").write_text("time,x,y,z\n", encoding="utf-8")
    command = ("ingest", "--no-prefect", "-w", tiny_workspace)
    told = inflight(*command, "--json")
    assert told.code == 3
    assert told.json["days"]["done"] == 3
    assert told.json["problems"][0]["remedy"]
    again = inflight(*command)
    assert again.code == 3
    assert "turning_20240302.csv" in again.out


def test_an_archive_without_days_is_an_error_that_says_what_to_do(inflight, tiny_workspace):
    told = inflight("reprocess", "--no-prefect", "--json", "-w", tiny_workspace)
    assert told.code == 1
    assert "ingest" in told.json["error"]["remedy"]


def test_reprocess_again_finds_nothing_to_do_and_tells_the_residual(inflight, finished):
    told = inflight("reprocess", "--no-prefect", "--json", "-w", finished)
    assert told.code == 0
    assert told.json["days"]["unchanged"] == 2
    assert told.json["residual"]["after_nT"] < 0.1 < told.json["residual"]["before_nT"]


def test_an_update_prints_what_was_made_and_then_the_verdict(inflight, copied):
    deliver_tiny_day(copied / "data", "2024-03-03")
    told = inflight("update", "--no-prefect", "-w", copied)
    assert told.code == 0, told.err
    assert told.out.index("update: days 3 planned") < told.out.index("residual")
    again = inflight("update", "--json", "-w", copied).json
    assert (again["command"], again["ingest"]["days"]["done"], again["days"]["done"]) == ("update", 0, 0)
    assert again["diagnosis"]["unchanged"] is True


def test_the_plan_of_a_backfill_is_printed_and_nothing_is_done(inflight, copied):
    deliver_tiny_day(copied / "data", "2024-03-03")
    assert inflight("ingest", "--no-prefect", "-w", copied).code == 0
    span = ("--start", "2024-03-01", "--end", "2024-03-05")
    told = inflight("backfill", *span, "--dry-run", "--json", "-w", copied)
    assert told.code == 0
    assert told.json["days"] == {"planned": 1, "unchanged": 2, "no_work": 1}
    assert told.json["batches"] == [["2024-03-03", "2024-03-03", 1]]
    assert len(inflight("catalog", "show", "l2/field", "--json", "-w", copied).json["items"]) == 2
    rate = inflight("catalog", "runs", "reprocess", "--json", "-w", copied).json["items"][-1]
    assert told.json["cost"]["run"] == rate["run"]
    assert told.json["cost"]["seconds"] >= 0
    assert told.json["cost"]["bytes"] > 0
    assert "at the rate of run" in inflight("backfill", *span, "--dry-run", "-w", copied).out
    done = inflight("backfill", *span, "--reason", "late attitude", "--no-prefect", "--json", "-w", copied)
    assert done.code == 0
    listed = inflight("catalog", "runs", "--json", "-w", copied).json["items"]
    assert [one["kind"] for one in listed if one["reason"] == "late attitude"] == ["reprocess"]
    assert "late attitude" in inflight("catalog", "runs", "reprocess", "-w", copied).out
    assert done.json["days"]["done"] >= 1
    assert done.json["plan"]["cost"]["run"] == rate["run"]
    assert len(inflight("catalog", "show", "l2/field", "--json", "-w", copied).json["items"]) >= 3


def test_compare_writes_a_page_and_prints_before_and_after(inflight, finished, tmp_path):
    page = tmp_path / "page.html"
    told = inflight("compare", "--json", "-w", finished, "--output", page)
    assert told.code == 0
    assert set(told.json) >= {"residual", "by_day", "fails_where"}
    assert told.json["residual"]["after_nT"] < told.json["residual"]["before_nT"] / 100
    assert len(told.json["by_day"]) == 2
    assert page.read_text(encoding="utf-8").lstrip().lower().startswith("<!doctype html")
    shown = inflight("compare", "-w", finished)
    assert "residual  pre-flight model" in shown.out
    assert "left above the noise floor" in shown.out
    assert str(finished / "reports" / "compare-main.html") in shown.out


def test_catalog_lists_shows_and_verifies(inflight, finished):
    listed = inflight("catalog", "list", "--json", "-w", finished).json
    assert {"l1/turning", "l1/absolute", "l2/field"} <= {item["dataset"] for item in listed["items"]}
    days = inflight("catalog", "show", "l2/field", "--json", "-w", finished).json["items"]
    assert [day["version"] for day in days] == ["v01.00", "v01.00"]
    table = inflight("catalog", "show", "main-window", "-w", finished).out
    assert "learnt from: 2024-03-01T00:00:00\n  up to: 2024-03-03T00:00:00" in table
    assert "residual with these values, nT rms: " in table
    table = inflight("catalog", "show", "main-window", "--json", "-w", finished).json["items"]
    assert "2024-0" in table[0]["valid"]
    edges = inflight("catalog", "show", days[0]["id"], "--json", "-w", finished).json["items"]
    assert edges
    assert inflight("catalog", "verify", "--json", "-w", finished).json["faults"] == []
    assert inflight("catalog", "gc", "--dry-run", "--json", "-w", finished).json["items"] == []
    assert inflight("catalog", "gc", "-w", finished).out.strip() == "everything that is stored is in use"


def test_catalog_tells_the_same_to_a_person(inflight, finished):
    assert "l2/field" in inflight("catalog", "list", "-w", finished).out
    assert "2024-03-02" in inflight("catalog", "show", "l2/field", "-w", finished).out
    # What the software keeps for itself is no dataset of a person's, and has no gaps.
    listed = inflight("catalog", "list", "-w", finished).out
    assert not [line for line in listed.splitlines() if line.startswith(("comparison/", "equations/"))]
    assert listed.splitlines()[-1].startswith("next: inflight compare")
    assert "no gaps" in inflight("catalog", "gaps", "-w", finished).out
    assert "whole" in inflight("catalog", "verify", "-w", finished).out


def test_a_name_the_catalog_does_not_know_is_an_error(inflight, finished):
    told = inflight("catalog", "show", "l9/nothing", "--json", "-w", finished)
    assert told.code == 1
    assert "catalog list" in told.json["error"]["remedy"]


def test_a_damaged_store_is_found(inflight, copied):
    chunk = next((copied / "stores").rglob("c.*"))
    chunk.chmod(0o644)
    whole = chunk.read_bytes()
    chunk.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    told = inflight("catalog", "verify", "--json", "-w", copied)
    assert told.code == 1
    assert told.json["faults"]


def test_gaps_tell_the_cause(inflight, copied):
    deliver_tiny_day(copied / "data", "2024-03-04")
    inflight("ingest", "--no-prefect", "-w", copied)
    told = inflight("catalog", "gaps", "l1/turning", "--json", "-w", copied).json
    assert [(item["day"], item["cause"]) for item in told["items"]] == [("2024-03-03", "no_work")]


def test_a_release_is_copied_out_once(inflight, copied):
    command = ("release", "1.0", "--no-prefect", "--json", "-w", copied)
    told = inflight(*command)
    assert told.code == 0
    assert (copied / told.json["outputs"][0] / "days.csv").is_file()
    assert inflight(*command).code == 1


def test_a_release_in_the_formats_that_teams_read_is_told_before_it_is_made(inflight, copied):
    command = ("release", "1.0", "--format", "cdf", "--format", "netcdf", "--json", "-w", copied)
    refused = inflight(*command, "--dry-run")
    assert refused.code == 1
    assert "release.discipline" in refused.json["objections"][0]["message"]
    assert inflight(*command, "--no-prefect").code == 1
    assert list((copied / "releases").iterdir()) == []
    with (copied / "mission.yaml").open("a", encoding="utf-8") as mission:
        mission.write(RELEASE_KEYS)
    plan = inflight(*command, "--dry-run")
    assert (plan.code, plan.json["objections"]) == (0, [])
    assert {part["format"] for part in plan.json["parts"]} == {"cdf", "netcdf"}
    told = inflight(*command, "--no-prefect")
    assert told.code == 0
    assert told.json["days"]["done"] == 6
    folder = copied / told.json["outputs"][0]
    files = [*(folder / "cdf").rglob("*.cdf"), *folder.rglob("*.nc")]
    assert len(files) == sum(part["files"] for part in plan.json["parts"]) == 12
    stated = (folder / "MANIFEST.sha256").read_text(encoding="utf-8")
    assert all(path.name in stated for path in files)
    assert "Someone" in (folder / "CITATION.cff").read_text(encoding="utf-8")
    for path in (folder / "cdf").rglob("*.cdf"):
        assert istp_findings(path) == []


def test_a_format_that_there_is_not_is_wrong_usage(inflight, copied):
    told = inflight("release", "1.0", "--format", "cfd", "--no-prefect", "-w", copied)
    assert told.code == 2
    assert "did you mean 'cdf'" in told.err


def test_the_demo_tells_residual_products_and_what_to_type_next(inflight, tmp_path):
    told = inflight("demo", tmp_path / "demo", "--days", 1, "--no-prefect")
    assert told.code == 0
    for text in (
        "compare    residual",
        "noise alone is",
        "diagnose",
        "What to type next",
        "compare-main.html",
    ):
        assert text in told.out
    again = inflight("demo", "--days", 1, "--no-prefect", "--json", "-w", tmp_path / "demo")
    assert again.json["days"]["unchanged"] == 1
    assert again.json["residual"]["after_nT"] < again.json["residual"]["before_nT"]
