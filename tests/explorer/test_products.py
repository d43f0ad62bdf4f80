"""Products and runs: why a day is missing, what a run did, versions side by side, work planned and done."""

import signal

import numpy as np
import pytest
from heated_mission import deliver_heated_day, heater_field

from inflight.catalog import Catalog, DayData, write_segment
from inflight.errors import CatalogError, SettingsError, WorkerError
from inflight.explorer.product_day import day_table, product_day_sections
from inflight.explorer.session import ExplorerSession
from inflight.explorer.table_versions import list_of_tables, tables_of, told_changes
from inflight.explorer.work import InOwnProcess, WorkRequest, plan_work
from inflight.flows import plan_span
from inflight.tasks import coverage_days, ingest, run_log, runs_progress

PROBLEM = {"day": "2024-03-05", "channel": "turning", "message": "too hot", "remedy": "let it cool"}
EXCLUSION = """
exclusions:
  - {instrument: turning, start: 2024-03-02T06:00, end: 2024-03-02T12:00, author: A. Person, reason: tests}
"""


def nobody(stage, done, total):
    """Take progress that nobody watches."""


def test_each_day_of_the_calendar_says_what_became_of_it_and_why(workspace):
    cat = Catalog(workspace.root)
    text = workspace.mission_file.read_text(encoding="utf-8") + EXCLUSION
    workspace.mission_file.write_text(text, encoding="utf-8")
    with cat.run("reprocess") as run:
        run.record("l2/field", "2024-03-05", "failed", "repeatable", "too hot", {"problem": PROBLEM})
        run.record_no_work("l2/field", {"2024-03-07": "no measurements of turning"})
    told = coverage_days(cat, workspace.mission(), "l2/field")
    assert [str(one.day) for one in told] == [f"2024-03-0{day}" for day in range(1, 8)]
    kinds = ["quick-look", "excluded", "quick-look", "quick-look", "failed", "missing", "missing"]
    assert [one.kind for one in told] == kinds
    whys = [one.why for one in told]
    assert "2024-03-02T06:00" in whys[1]
    assert "tests (A. Person)" in whys[1]
    assert "too hot What to do: let it cool" in whys[4]
    assert "not calibrated yet" in whys[5]
    assert "no measurements of turning" in whys[6]
    assert {one.kind for one in coverage_days(cat, workspace.mission(), "l1/absolute")} == {"archived"}


def test_the_log_of_a_run_says_what_was_asked_what_came_of_it_and_what_to_do(workspace):
    cat = Catalog(workspace.root)
    settings = {"comparison": "main", "days_planned": 3, "reason": "late files"}
    with cat.run("reprocess", settings) as run:
        run.record("l2/field", "2024-03-05", "failed", "repeatable", "too hot", {"problem": PROBLEM})
        going = runs_progress(cat, 1)[0]
        assert (going.record.state, going.days_text(), going.failed) == ("running", "l2/field: 1 of 3", 1)
        # It lives: nobody ends it.
        assert cat.close_dead_runs() == []
    text = "\n".join(run_log(cat, cat.runs()[-1]))
    for part in ("reason: late files", "comparison: main", "3 days to do", "1 failed; 2024-03-05"):
        assert part in text
    assert "day 2024-03-05, channel 'turning': failed (same again until you fix it): too hot" in text
    assert "What to do: let it cool" in text
    assert " done after " in text
    with pytest.raises(CatalogError), cat.run("reprocess"):
        raise CatalogError("no product is published", remedy="ingest first")
    ended = run_log(cat, cat.runs(last=1)[0])
    assert " failed (same again until you fix it) after " in ended[-2]
    assert ended[-1] == "CatalogError: no product is published; ingest first"


def test_versions_of_a_day_stand_side_by_side_with_their_differences(workspace):
    cat = Catalog(workspace.root)
    day = np.datetime64("2024-03-02")
    changed = cat.read_day("l2/field", day).drop_vars("time")
    changed["field_sensor"] = changed["field_sensor"] + np.array([0.0, 3.0, 4.0])
    with cat.run("reprocess", {"reason": "a trial"}) as run:
        parents = (cat.current("l2/field", day).id,)
        data = DayData(day, changed, key="other", parents=parents)
        run.attach(write_segment(cat.workspace, run.id, "l2/field", [data]))
        run.publish()
    sections = {heading: "".join(parts) for heading, parts, _ in product_day_sections(cat, "l2/field", day)}
    assert "v01.00</th><th>v01.01" in sections["Versions"]
    assert "a trial" in sections["Versions"]
    assert "<td>change: field_sensor, nT</td><td></td><td>5, at most 5</td>" in sections["Versions"]
    assert "<svg" in sections["The day"]
    # To the delivered files.
    assert "Lineage of l2/field: 2024-03-02 v01.01" in sections["Made from"]
    assert "no attitude</td><td>1440" in sections["The day"]
    head, first, *rest = day_table(cat, "l2/field", day).splitlines()
    assert len(rest) == 1439
    row = dict(zip(head.split(","), first.split(","), strict=True))
    assert row["time"].startswith("2024-03-02 00:00")
    assert float(row["field_sensor_z"]) == pytest.approx(changed["field_sensor"].values[0, 2])


def test_tables_are_listed_with_where_they_hold_and_two_stand_side_by_side(workspace):
    session = ExplorerSession(workspace, workers=1)
    try:
        cat = session.cat
        (old,) = cat.tables("main-span")
        table = cat.table_by_id(old.id)
        offset = table["parameter"].values.tolist().index("vector_sensor.offset[x]")
        values = table["value"].values.copy()
        values[0, offset] += 2.5
        table["value"] = table["value"].copy(data=values)
        with cat.run("reprocess") as run:
            start, end = old.start, old.end
            number = run.stage_table("main-span", table.drop_attrs(), start=start, end=end)
            run.publish(certify=[(number, start, end, None)], supersede=True)
        rows = "".join(list_of_tables(cat, tables_of(cat, workspace.mission(), "main")))
        assert f"main-span:{number}" in rows
        title = f"main-span:{old.id} to main-span:{number}"
        told = "".join(told_changes(title, session.table_changes(*title.split(" to "), nobody)))
    finally:
        session.close()
    assert "<td>vector_sensor.offset[x]</td><td>+2.5</td><td>2.5</td><td>nT</td>" in told
    assert told.count("<td>vector_sensor") == 1
    assert "<svg" in told


def test_a_plan_is_that_of_the_verb_and_writes_nothing(workspace):
    runs = len(Catalog(workspace.root).runs())
    # Another mission file: every day has to be made anew.
    text = workspace.mission_file.read_text(encoding="utf-8") + EXCLUSION
    workspace.mission_file.write_text(text, encoding="utf-8")
    settings = {"comparison": "main", "table": "daily"}
    request = WorkRequest("reprocess", "2024-03-02", "2024-03-05", settings)
    plan = plan_work(workspace, request)
    told = plan_span(workspace, "2024-03-02", "2024-03-05", settings)
    assert plan.fields == told
    assert told["days"]["planned"] == 3
    assert f"{told['cost']['seconds']:.0f} s and" in plan.lines[1]
    release = plan_work(workspace, WorkRequest("release", version="1.0"))
    assert "release 1.0 (preliminary): 16 days" in release.lines[0]
    assert release.objections == []
    with pytest.raises(SettingsError, match="needs a version"):
        plan_work(workspace, WorkRequest("release"))
    assert len(Catalog(workspace.root).runs()) == runs


@pytest.fixture
def interrupts_ignored():
    """As in a page that a script began behind it: what it starts inherits that."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.slow
@pytest.mark.usefixtures("interrupts_ignored")
def test_work_is_done_by_a_process_of_its_own_stopped_and_taken_up_again(workspace):
    text = workspace.mission_file.read_text(encoding="utf-8") + EXCLUSION
    workspace.mission_file.write_text(text, encoding="utf-8")
    # So many pieces of work that processes start for them: there is time to be stopped.
    for day in range(5, 9):
        deliver_heated_day(workspace.data, f"2024-03-{day:02}", heater_field)
    ingest(Catalog(workspace.root), workspace.mission(), workspace.data)
    request = WorkRequest("reprocess", settings={"comparison": "main", "batch_days": 1}, reason="a trial")
    work = InOwnProcess(workspace.root, request, 1)
    before = [day.id for day in Catalog(workspace.root).days("l2/field")]
    with pytest.raises(WorkerError, match="was stopped; what is published is unchanged"):
        work(lambda stage, done, total: work.stop() if stage == "calibrate" else None)
    cat = Catalog(workspace.root)
    stopped = cat.runs(last=1)[0]
    assert (stopped.state, stopped.settings["reason"]) == ("failed", "a trial")
    assert [day.id for day in cat.days("l2/field")] == before
    report = InOwnProcess(workspace.root, request, 1)(nobody)
    assert (report["days"]["done"], report["run"]) == (8, cat.runs(last=1)[0].id)
    # An error of the step comes back as it is.
    wrong = WorkRequest("reprocess", settings={"comparison": "main", "use_table": "main-span:99"})
    with pytest.raises(CatalogError, match="99"):
        InOwnProcess(workspace.root, wrong, 1)(nobody)


def test_work_that_was_stopped_says_so(workspace):
    work = InOwnProcess(workspace.root, WorkRequest("release", version="2.0"), 1)
    work.stop()
    with pytest.raises(WorkerError, match="was stopped; what is published is unchanged"):
        work(nobody)
    assert not (workspace.root / "releases/2.0").exists()
