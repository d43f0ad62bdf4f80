"""A run that would change nothing is not made: its report is that of the last one."""

import json
import os
import re
import shutil
from dataclasses import replace
from io import StringIO

import pytest
import xarray as xr
from heated_mission import deliver_heated_day, heater_field, make_heated_workspace
from rich.console import Console
from tiny_mission import deliver_tiny_day, make_tiny_workspace

from inflight.catalog import Catalog, Workspace
from inflight.cli import main
from inflight.cli.diagnosis_text import print_diagnosis
from inflight.errors import CatalogError
from inflight.flows import launch, run_with_prefect, run_without_prefect
from inflight.tasks import ModelHistory, analysis, ingest, pipelines, reprocess, to_json
from inflight.tasks.analysis import (
    DiagnoseSettings,
    Workbench,
    diagnose_if_unchanged,
    diagnose_span,
    diagnosis_page,
    kept_comparison,
    kept_diagnosis,
    kept_page,
    later_days,
    report_if_unchanged,
    revise,
)
from inflight.tasks.archive import ingest_if_unchanged
from inflight.tasks.pipelines import ReprocessSettings
from inflight.tasks.pipelines.scalar import tables


def copied(workspace, folder):
    shutil.copytree(workspace.root, folder)
    return Workspace.open(folder)


@pytest.fixture(scope="module")
def reprocessed(tmp_path_factory):
    """Two days taken through the chain, and the last report; copied, never changed."""
    workspace = Workspace.open(make_tiny_workspace(tmp_path_factory.mktemp("done") / "tiny", 2))
    cat, mission = Catalog(workspace.root), workspace.mission()
    ingest(cat, mission, workspace.data)
    return workspace, reprocess(cat, mission)


@pytest.fixture
def done(reprocessed, tmp_path):
    workspace, report = reprocessed
    return copied(workspace, tmp_path / "tiny"), report


def test_the_same_again_gives_the_same_report_and_no_run(done):
    place, first = done
    cat = Catalog(place.root)
    runs = len(cat.runs())
    again = reprocess(cat, place.mission())
    assert again.run == ""
    assert again.days == {**first.days, "done": 0, "unchanged": first.days["done"]}
    assert (again.outputs, again.problems, again.extra) == (first.outputs, first.problems, first.extra)
    assert len(cat.runs()) == runs


def test_another_table_is_work_and_so_is_the_first_one_after_it(done):
    place, _ = done
    cat, daily = Catalog(place.root), ReprocessSettings(table="daily")
    assert reprocess(cat, place.mission(), settings=daily).run
    assert not reprocess(cat, place.mission(), settings=daily).run
    assert reprocess(cat, place.mission()).run


def test_a_new_day_is_work(done):
    place, _ = done
    deliver_tiny_day(place.data, "2024-03-03")
    cat = Catalog(place.root)
    assert ingest_if_unchanged(cat, place.mission(), place.data) is None
    ingest(cat, place.mission(), place.data)
    report = ingest_if_unchanged(cat, place.mission(), place.data)
    assert report is not None
    assert report.days["unchanged"] == 6
    assert reprocess(cat, place.mission()).days["done"] >= 1


def test_equations_kept_together_are_those_of_their_days(done, monkeypatch):
    place, _ = done
    monkeypatch.setattr(tables, "JOINED_DAYS", 2)
    deliver_tiny_day(place.data, "2024-03-03")
    cat = Catalog(place.root)
    ingest(cat, place.mission(), place.data)
    reprocess(cat, place.mission())
    # On a fixed grid of dates: the first day waits for one that never was.
    (joined,) = cat.days("equations/main/base-joined", states=("published",))
    assert str(joined.day) == "2024-03-02"
    days, read = cat.days("equations/main/base", states=("published",)), Catalog.read
    asked = []
    monkeypatch.setattr(Catalog, "read", lambda *given: asked.append(given[1].dataset) or read(*given))
    together = tables.load_equations(cat, days).dataset
    assert asked.count("equations/main/base-joined") == 1
    monkeypatch.setattr(tables, "JOINED_DAYS", 99)
    xr.testing.assert_identical(together, tables.load_equations(cat, days).dataset)
    # Other revisions of a day are not what was kept.
    monkeypatch.setattr(tables, "JOINED_DAYS", 2)
    other = [replace(day, key="another") if str(day.day) == "2024-03-03" else day for day in days]
    asked.clear()
    tables.load_equations(cat, other)
    assert "equations/main/base-joined" not in asked


def test_a_span_of_its_own_is_work_of_its_own(done):
    place, _ = done
    cat = Catalog(place.root)
    assert reprocess(cat, place.mission(), "2024-03-01", "2024-03-02").run


def test_a_product_that_is_gone_is_made_again(done):
    place, _ = done
    cat = Catalog(place.root)
    store = place.root / next(day.segment for day in cat.days("l2/field", states=("published",)))
    chunk = min(store.glob("*/c*"))
    chunk.write_bytes(b"")
    cat.repair()
    report = reprocess(Catalog(place.root), place.mission())
    assert report.run
    assert report.days["done"] == 2


def test_no_server_is_started_for_it(done, monkeypatch):
    place, first = done

    def refuse(*arguments):
        raise AssertionError("a server was asked for")

    monkeypatch.setattr(launch, "prefect_settings", refuse)
    assert run_with_prefect("reprocess", place, {}).days["unchanged"] == first.days["done"]
    assert run_with_prefect("ingest", place, {}).days["unchanged"] == 4
    span = {"start": "2024-03-01", "end": "2024-03-02"}
    with pytest.raises(AssertionError, match="a server"):
        run_with_prefect("backfill", place, span)


@pytest.fixture(scope="module")
def found_once(tmp_path_factory):
    """Four days with the field of a heater, and what is found in them; copied, never changed."""
    workspace = make_heated_workspace(tmp_path_factory.mktemp("found") / "heated")
    return workspace, diagnose_span(workspace)


@pytest.fixture
def diagnosed(found_once, tmp_path):
    workspace, found = found_once
    return copied(workspace, tmp_path / "heated"), found


def test_a_diagnosis_of_what_has_not_changed_is_the_last_one(diagnosed, monkeypatch):
    workspace, found = diagnosed
    again = diagnose_if_unchanged(workspace, None, None, DiagnoseSettings())
    assert again.pop("unchanged") is True
    assert again["effects"] == [dict(one) for one in found["effects"]]
    assert again["verdict"] == found["verdict"]
    monkeypatch.setattr(launch, "prefect_settings", lambda *given: pytest.fail("a server was asked for"))
    report = run_with_prefect("diagnose", workspace, {})
    assert report.extra["verdict"] == found["verdict"]


def test_other_settings_another_span_and_another_model_are_work(diagnosed):
    workspace, found = diagnosed
    assert diagnose_if_unchanged(workspace, None, None, DiagnoseSettings(rounds=1)) is None
    assert diagnose_if_unchanged(workspace, "2024-03-01", None, DiagnoseSettings()) is None
    bench = Workbench(Catalog(workspace.root), workspace.mission())
    assert bench.diagnose().verdict == found["verdict"]
    bench.add(found["effects"][0]["name"])
    assert diagnose_if_unchanged(workspace, None, None, DiagnoseSettings()) is None


def test_what_was_added_and_undone_leaves_verdict_and_products_as_they_are(diagnosed):
    workspace, found = diagnosed
    cat, mission = Catalog(workspace.root), workspace.mission()
    bench = Workbench(cat, mission)
    bench.add(found["effects"][0]["name"])
    bench.undo()
    assert diagnose_if_unchanged(workspace, None, None, DiagnoseSettings())["unchanged"] is True
    made = reprocess(cat, mission).days["done"]
    bench.add(found["effects"][0]["name"])
    assert reprocess(cat, mission, "2024-03-01", "2024-03-02").days["done"] == 1
    bench.undo()
    again = reprocess(cat, mission).days
    assert (again["done"], again["unchanged"]) == (1, made - 1)
    assert ModelHistory(cat, mission).stale_contexts(name for _, name in cat.published("l2/field")) == set()


def test_products_leave_a_verdict_as_it_is_unless_they_follow_a_trend(diagnosed, monkeypatch):
    workspace, _ = diagnosed
    cat, mission = Catalog(workspace.root), workspace.mission()
    assert reprocess(cat, mission).days["done"] == 4
    assert cat.tables("main-window")
    assert diagnose_if_unchanged(workspace, None, None, DiagnoseSettings())["unchanged"] is True
    assert reprocess(cat, mission, settings=ReprocessSettings(table="continuous")).days["done"] == 4
    # A verdict tells of products with a trend that they follow it: of these, and not of what was before.
    monkeypatch.setattr(pipelines, "trend_of_products", lambda *given: "linear")
    assert diagnose_if_unchanged(workspace, None, None, DiagnoseSettings()) is None
    monkeypatch.setattr(pipelines, "trend_of_products", lambda *given: "")
    diagnose_span(workspace)
    assert diagnose_if_unchanged(workspace, None, None, DiagnoseSettings())["unchanged"] is True
    monkeypatch.setattr(pipelines, "trend_of_products", lambda *given: "linear")
    assert diagnose_if_unchanged(workspace, None, None, DiagnoseSettings()) is None


def test_what_changes_while_it_is_searched_is_work(diagnosed, monkeypatch):
    workspace, _ = diagnosed
    own = revise.search_on_one_thread

    def meanwhile(*given):
        deliver_heated_day(workspace.data, "2024-03-05", heater_field)
        ingest(Catalog(workspace.root), workspace.mission(), workspace.data)
        return own(*given)

    monkeypatch.setattr(revise, "search_on_one_thread", meanwhile)
    diagnose_span(workspace, search=True)
    assert diagnose_if_unchanged(workspace, None, None, DiagnoseSettings()) is None


def test_a_file_that_the_mission_names_is_part_of_what_a_verdict_is_made_from(diagnosed, monkeypatch):
    workspace, _ = diagnosed
    monkeypatch.setattr(kept_diagnosis, "hashes_of_companions", lambda *given: ["another"])
    assert diagnose_if_unchanged(workspace, None, None, DiagnoseSettings()) is None


@pytest.fixture
def drawn(diagnosed):
    """A workspace diagnosed with its page, and the page as it is asked for again."""
    workspace, _ = diagnosed
    run_without_prefect("diagnose", workspace, {"search": True}, workers=1)

    def again(output=workspace.reports / "report-main.html", start=None):
        return report_if_unchanged(workspace, output, start, None, DiagnoseSettings())

    return workspace, again


def test_the_page_of_a_diagnosis_is_written_with_it_and_given_again(drawn, tmp_path):
    workspace, again = drawn
    page = workspace.reports / "report-main.html"
    stamp, told = page.stat().st_mtime_ns, again().as_json()
    assert page.stat().st_mtime_ns == stamp
    assert again(tmp_path / "elsewhere" / "page.html").path.read_bytes() == page.read_bytes()
    # It is what another search writes, but for the numbers that a process gives its figures.
    made = analysis.report(workspace, tmp_path / "anew.html")
    both = [re.sub(rb'"p\d+"', b'"p"', one.read_bytes()) for one in (made.path, page)]
    assert both[0] == both[1]
    assert told == json.loads(to_json(made.as_json() | {"path": str(page)}))
    # Which is kept, then.
    page.unlink()
    assert again().path.read_bytes() == made.path.read_bytes()


def test_a_page_that_is_there_is_opened_where_nothing_can_be_written(drawn, monkeypatch, capsys):
    workspace, _ = drawn
    page = workspace.reports / "report-main.html"
    whole = page.read_bytes()
    monkeypatch.setattr(os, "access", lambda path, mode, **how: mode != os.W_OK)
    monkeypatch.setattr(kept_page, "write_page", lambda *given: pytest.fail("it was written"))
    root = ["-w", str(workspace.root), "--json"]
    for output, code in ((page, 0), (workspace.reports / "other.html", 1)):
        named = [] if output == page else ["--output", str(output)]
        with pytest.raises(SystemExit) as left:
            main(["report", *named, *root])
        told = json.loads(capsys.readouterr().out)
        assert (left.value.code or 0) == code
        assert told.get("path") == (str(page) if code == 0 else None)
    assert told["error"]["kind"] == "StorageError"
    assert page.read_bytes() == whole
    # Nor is it copied there from where it lies.
    other = page.rename(workspace.reports / "moved.html")
    kept = workspace.reports / "report-main.json"
    kept.write_text(kept.read_text("utf-8").replace(str(page), str(other)), encoding="utf-8")
    with pytest.raises(SystemExit):
        main(["report", *root])
    assert json.loads(capsys.readouterr().out)["error"]["kind"] == "StorageError"


def test_a_page_that_shows_something_else_is_not_given_again(drawn):
    workspace, again = drawn
    page = workspace.reports / "report-main.html"
    assert again(start="2024-03-02") is None
    whole = page.read_bytes()
    page.write_bytes(whole + b"<!-- a note -->")
    assert again() is None
    page.write_bytes(whole)
    # That other days were diagnosed since does not matter to it, but another model does.
    diagnose_span(workspace, "2024-03-02")
    assert again() is not None
    Workbench(Catalog(workspace.root), workspace.mission()).add("channel_field(heater_current)")
    assert again() is None
    # The search of a page is a diagnosis like any other; of other days it is not what 'add' goes on from.
    settings = DiagnoseSettings()
    assert diagnose_if_unchanged(workspace, "2024-03-02", None, settings) is None
    made = analysis.report(workspace, page.with_name("some.html"), "2024-03-02")
    found = diagnose_if_unchanged(workspace, "2024-03-02", None, settings)
    assert found["verdict"] == made.fields["verdict"]
    analysis.report(workspace, page)
    assert again() is not None
    assert diagnose_if_unchanged(workspace, "2024-03-02", None, settings) == found


def test_a_verdict_that_stands_for_a_later_day_has_no_page_of_it(drawn, monkeypatch):
    workspace, again = drawn
    with_later_day(workspace, heater_field, monkeypatch)
    assert diagnose_span(workspace)["later_days"]["stands"]
    assert again() is None
    # Page and fields are of one search, of all days.
    made = analysis.report(workspace, workspace.reports / "report-main.html")
    assert again().as_json() == json.loads(to_json(made.as_json()))
    assert again().fields["blocks"]["end"].startswith("2024-03-06")


def test_a_page_that_cannot_be_written_is_told_beside_the_verdict(diagnosed, monkeypatch):
    workspace, found = diagnosed
    run_without_prefect("diagnose", workspace, {"search": True, "page": False}, workers=1)
    assert not (workspace.reports / "report-main.html").exists()

    def full(*given):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(diagnosis_page, "write_page", full)
    report = run_without_prefect("diagnose", workspace, {"search": True}, workers=1)
    assert report.extra["verdict"] == found["verdict"]
    assert "the page of the diagnosis was not written: " in report.problems[0]["message"]
    assert "No space left on device" in report.problems[0]["message"]
    assert report.exit_code == 0
    assert not (workspace.reports / "report-main.html").exists()
    text = StringIO()
    print_diagnosis(Console(file=text, width=200), report.as_json())
    assert "No space left on device. What to do: make room in reports" in text.getvalue()


def with_later_day(workspace, hidden, monkeypatch):
    """Take in a fifth day, which four are enough to be compared with."""
    settings = later_days.LaterDaysSettings(share=0.3, compared=4)
    monkeypatch.setattr(later_days, "LATER_DAYS_SETTINGS", settings)
    deliver_heated_day(workspace.data, "2024-03-05", hidden)
    ingest(Catalog(workspace.root), workspace.mission(), workspace.data)


def test_a_later_day_like_those_searched_is_held_against_their_verdict(diagnosed, monkeypatch):
    workspace, found = diagnosed
    with_later_day(workspace, heater_field, monkeypatch)
    monkeypatch.setattr(revise, "Workbench", lambda *given, **named: pytest.fail("it was searched"))
    again = diagnose_span(workspace)
    later = again["later_days"]
    assert (later["stands"], later["days"], later["searched"]) == (True, 1, "2024-03-04")
    # The model found leaves of it what it leaves of the others: it holds the heater, which they need.
    assert later["residual_nT"]["2024-03-05"] == pytest.approx(later["usual_nT"][1], rel=0.1)
    assert later["residual_nT"]["2024-03-05"] < 0.5 * found["residual"]["before_nT"]
    assert again["effects"] == [dict(one) for one in found["effects"]]
    assert diagnose_if_unchanged(workspace, None, None, DiagnoseSettings())["later_days"] == later
    text = StringIO()
    print_diagnosis(Console(file=text, width=200), again)
    assert "the verdict of the days up to 2024-03-04 stands for 2024-03-05" in text.getvalue()
    assert "no candidate was tried on later days" in text.getvalue()


def test_a_search_of_many_days_notes_those_that_later_ones_are_compared_with(diagnosed, monkeypatch):
    workspace, _ = diagnosed
    many = later_days.LaterDaysSettings(share=1.0, compared=4)
    monkeypatch.setattr(later_days, "LATER_DAYS_SETTINGS", many)
    diagnose_span(workspace, search=True)
    own, made = later_days._numbers, []
    monkeypatch.setattr(later_days, "_numbers", lambda *given: made.append(str(given[5])) or own(*given))
    deliver_heated_day(workspace.data, "2024-03-05", heater_field)
    ingest(Catalog(workspace.root), workspace.mission(), workspace.data)
    assert diagnose_span(workspace)["later_days"]["stands"]
    assert made == ["2024-03-05"]


@pytest.mark.parametrize("part", [0.0, 1.5])
def test_a_later_day_that_contradicts_the_verdict_asks_for_a_search(diagnosed, monkeypatch, part):
    workspace, _ = diagnosed
    with_later_day(workspace, lambda day, reading: part * heater_field(day, reading), monkeypatch)
    later = later_days.check_later_days(
        workspace, None, None, DiagnoseSettings(), lambda stage, done, total: None
    )["later_days"]
    assert not later["stands"]
    assert "2024-03-05" in later["reasons"][0]
    assert "nT are left of it" in later["reasons"][0]


@pytest.fixture
def updated(diagnosed, monkeypatch):
    """A fifth day taken as far as the verdict, in one run, and its report."""
    workspace, _ = diagnosed
    run_without_prefect("reprocess", workspace, {}, workers=1)
    monkeypatch.setattr(
        later_days, "LATER_DAYS_SETTINGS", later_days.LaterDaysSettings(share=0.3, compared=4)
    )
    deliver_heated_day(workspace.data, "2024-03-05", heater_field)
    return workspace, run_without_prefect("update", workspace, {}, workers=1)


def test_an_update_takes_a_new_day_as_far_as_the_verdict(updated):
    workspace, report = updated
    assert (report.command, report.exit_code) == ("update", 0)
    assert report.extra["ingest"]["days"]["done"] == 3
    assert report.days["planned"] == 5
    assert report.extra["diagnosis"]["later_days"]["days"] == 1
    assert len(Catalog(workspace.root).days("l2/field", states=("published",))) == 5
    assert diagnose_if_unchanged(workspace, None, None, DiagnoseSettings()) is not None


def test_an_update_of_what_is_up_to_date_starts_nothing(updated, monkeypatch):
    workspace, report = updated
    monkeypatch.setattr(launch, "prefect_settings", lambda *given: pytest.fail("a server was asked for"))
    again = run_with_prefect("update", workspace, {})
    assert (again.days["done"], again.days["unchanged"]) == (0, 5)
    assert again.extra["ingest"]["days"]["done"] == 0
    assert again.extra["diagnosis"]["verdict"] == report.extra["diagnosis"]["verdict"]


def test_an_update_that_cannot_be_diagnosed_says_why_and_keeps_its_products(done, monkeypatch):
    workspace, _ = done

    def refuse(*given, **named):
        raise CatalogError("too few samples", remedy="wait for more days")

    monkeypatch.setattr(analysis, "diagnose_span", refuse)
    deliver_tiny_day(workspace.data, "2024-03-03")
    report = run_without_prefect("update", workspace, {}, workers=1)
    assert [(one["message"], one["remedy"]) for one in report.problems] == [
        ("too few samples", "wait for more days")
    ]
    assert "diagnosis" not in report.extra
    assert report.exit_code == 3
    assert len(Catalog(workspace.root).days("l2/field", states=("published",))) == 3


def test_a_comparison_without_a_residual_to_search_is_updated_without_a_verdict(done, monkeypatch):
    workspace, _ = done
    monkeypatch.setattr(analysis, "sampled_comparisons", lambda mission: [])
    report = run_without_prefect("update", workspace, {}, workers=1)
    assert report.exit_code == 0
    assert "diagnosis" not in report.extra


@pytest.fixture
def compared(done):
    """A workspace that was compared, with the report, and the comparison as it is asked again."""
    place, _ = done
    page = place.reports / "compare-main.html"
    first = analysis.compare(Catalog(place.root), place.mission(), output=page)

    def again(output=page, **asked):
        return analysis.compare_if_unchanged(Catalog(place.root), place.mission(), output=output, **asked)

    return place, first, again


def test_the_same_comparison_again_draws_nothing(compared):
    place, first, again = compared
    page = first.path.read_bytes()
    stamp, runs = first.path.stat().st_mtime_ns, len(Catalog(place.root).runs())
    found = again()
    told, before = found.as_json(), json.loads(to_json(first.as_json()))
    assert told.pop("unchanged") is True
    assert told == before
    assert found.summary()[1:] == first.summary()
    assert "last comparison" in found.summary()[0].text
    assert (first.path.read_bytes(), first.path.stat().st_mtime_ns) == (page, stamp)
    assert len(Catalog(place.root).runs()) == runs


def test_its_page_is_copied_to_where_it_is_asked_for(compared, tmp_path):
    _, first, again = compared
    found = again(tmp_path / "elsewhere" / "page.html")
    assert found.path == tmp_path / "elsewhere" / "page.html"
    assert found.path.read_bytes() == first.path.read_bytes()


def _other_model(place):
    cat = Catalog(place.root)
    name, version, text = cat.model_text()
    cat.save_model(name, f"{text}# as flown\n", parent=version, message="set")


def _new_day(place):
    cat = Catalog(place.root)
    deliver_tiny_day(place.data, "2024-03-05")
    ingest(cat, place.mission(), place.data)


def _other_mission(place):
    path = place.root / "mission.yaml"
    path.write_text(path.read_text(encoding="utf-8") + "acknowledgement: thanks\n", encoding="utf-8")


def _other_table(place):
    reprocess(Catalog(place.root), place.mission(), settings=ReprocessSettings(table="daily"))


def _without_validity(place):
    cat = Catalog(place.root)
    cat.decertify(cat.tables("main-daily")[-1].id, author="ada", reason="looked odd")


def _damaged(place):
    cat = Catalog(place.root)
    day = cat.days("l2/field", states=("published",))[0]
    chunk = next((cat.workspace / day.segment).glob("*/c*"))
    chunk.write_bytes(chunk.read_bytes()[:-3])
    cat.repair()


def _page_changed(place):
    page = place.reports / "compare-main.html"
    page.write_text(page.read_text(encoding="utf-8") + "<!-- mine -->", encoding="utf-8")


def _page_gone(place):
    (place.reports / "compare-main.html").unlink()


def _kept_damaged(place):
    (place.reports / "comparison-main.json").write_text("{", encoding="utf-8")


@pytest.mark.parametrize(
    "change",
    [
        _other_model,
        _new_day,
        _other_mission,
        _other_table,
        _without_validity,
        _damaged,
        _page_changed,
        _page_gone,
        _kept_damaged,
    ],
)
def test_a_comparison_is_made_anew_when_what_it_is_made_from_changed(compared, change):
    place, _, again = compared
    change(place)
    assert again() is None


def test_a_comparison_of_something_else_is_made_anew(compared, monkeypatch):
    _, first, again = compared
    day = first.by_day[1]["day"]
    assert again(start=day) is None
    assert again(against=1) is None
    monkeypatch.setattr(kept_comparison, "hash_of_software", lambda packages: "newer")
    assert again() is None


def test_a_comparison_whose_data_could_not_be_asked_for_faults_is_not_kept(done, monkeypatch):
    place, _ = done

    def unreadable(*_given):
        raise CatalogError("a store is damaged")

    page = place.reports / "compare-main.html"
    with monkeypatch.context() as patch:
        patch.setattr("inflight.tasks.analysis.comparing.check_plumbing", unreadable)
        analysis.compare(Catalog(place.root), place.mission(), output=page)
    assert page.exists()
    assert analysis.compare_if_unchanged(Catalog(place.root), place.mission(), output=page) is None


def test_a_page_whose_name_is_no_text_is_written_and_not_kept(done, tmp_path):
    place, _ = done
    page = tmp_path / os.fsdecode(b"caf\xe9.html")
    assert analysis.compare(Catalog(place.root), place.mission(), output=page).path == page
    assert page.exists()
    assert analysis.compare_if_unchanged(Catalog(place.root), place.mission(), output=page) is None


def test_datasets_of_instruments_count_whatever_they_are_called():
    kept_for_themselves = ["comparison/main/60s", "equations/main/library", "equations/main/own"]
    assert all(map(kept_comparison._NOT_READ.fullmatch, kept_for_themselves))
    assert not any(map(kept_comparison._NOT_READ.fullmatch, ["l1/native", "l1/own", "equations/main/base"]))


def test_what_searches_and_comparisons_keep_for_themselves_changes_no_comparison(compared):
    place, _, again = compared
    analysis.compare(Catalog(place.root), place.mission())
    diagnose_span(place, None, None, DiagnoseSettings())
    assert again() is not None
