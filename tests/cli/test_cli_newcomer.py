"""What somebody meets who tries the command line for the first time: slips of the hand, told in full."""

import io

import pytest
from rich.console import Console
from tiny_mission import make_tiny_workspace

from inflight.cli.command import PIPED_WIDTH, Command, text_table
from inflight.tasks import RunReport, print_report
from inflight.tasks.report import problem

PLAIN = ("--no-prefect", "--workers", 1)


@pytest.fixture
def root(tmp_path):
    return make_tiny_workspace(tmp_path / "tiny")


def test_a_pattern_that_matches_nothing_is_named_with_its_folder(inflight, root):
    yaml = root / "mission.yaml"
    yaml.write_text(yaml.read_text(encoding="utf-8").replace("absolute_{", "absolut_{"), encoding="utf-8")
    told = inflight("ingest", *PLAIN, "--json", "-w", root)
    assert told.code == 3  # one instrument of two is there
    (only,) = told.json["problems"]
    assert f"no file below {root / 'data'} matches 'absolut_{{day:%Y%m%d}}.csv'" in only["message"]
    assert "the nearest names are absolute_2024" in only["message"]
    assert "'absolute_{day:%Y%m%d}.csv' would match" in only["remedy"]
    assert only["instrument"] == "absolute"
    gaps = inflight("catalog", "gaps", "-w", root).out
    assert "l1/absolute" in gaps
    assert "nothing was ever taken in" in gaps
    again = inflight("ingest", "-w", root)
    assert again.code == 3  # and without a server, for there is nothing to do
    assert "same again until you fix it" in again.out
    assert "repeatable" not in again.out
    assert "next: inflight reprocess" in again.out


def test_where_no_pattern_matches_anything_the_ingest_fails(inflight, root):
    yaml = root / "mission.yaml"
    text = yaml.read_text(encoding="utf-8").replace("absolute_{", "a_{").replace("turning_{", "t_{")
    yaml.write_text(text, encoding="utf-8")
    assert inflight("ingest", *PLAIN, "-w", root).code == 1


def test_files_are_taken_in_by_their_names(inflight, root):
    first = sorted((root / "data").glob("*_20240301.csv"))
    told = inflight("ingest", *first, *PLAIN, "--json", "-w", root)
    assert told.code == 0
    assert told.json["files"]["read"] == len(first) == 2
    listed = inflight("catalog", "show", "l1/absolute", "--json", "-w", root).json["items"]
    assert [item["day"] for item in listed] == ["2024-03-01"]
    strange = root / "strange.csv"
    strange.write_text("1,2\n", encoding="utf-8")
    refused = inflight("ingest", strange, "--json", "-w", root)
    assert refused.code == 2
    assert "no instrument's file pattern matches" in refused.json["error"]["message"]
    assert "absolute_{day:%Y%m%d}.csv" in refused.json["error"]["remedy"]
    assert inflight("ingest", "nowhere.csv", "-w", root).code == 2


def test_small_findings_of_one_kind_are_one_line_and_details_lists_them():
    console = Console(file=io.StringIO(), width=200)
    items = [
        problem(
            "partial", f"temperature: {count} samples without coil", day=f"2024-03-0{count}", channel="coil"
        )
        for count in (1, 2, 3)
    ]
    report = RunReport("reprocess", days={"done": 3}, problems=[*items, problem("bug", "broken", day="x")])
    print_report(report, console)
    text = console.file.getvalue()
    assert "3 days" in text
    assert "temperature: 6 samples without coil" in text
    assert "2024-03-02" not in text
    assert "broken" in text
    print_report(report, console, details=True)
    assert "2024-03-02" in console.file.getvalue()


def test_rows_that_were_dropped_and_gaps_are_told(inflight, root):
    file = root / "data" / "absolute_20240301.csv"
    rows = file.read_text(encoding="utf-8").splitlines()
    del rows[101:131]
    file.write_text("\n".join([*rows, rows[-1], "2030-01-01T00:00:00,1"]) + "\n", encoding="utf-8")
    told = inflight("ingest", *PLAIN, "-w", root)
    assert "l1/absolute: rows dropped: 1 outside span of file name" in told.out
    shown = inflight("catalog", "show", "l1/absolute", "-w", root).out
    assert "30 of 1440 samples missing in 1 gaps, most 30 from 01:40:00" in shown
    assert "1 repeated dropped" in shown


def test_simulated_files_are_kept_out_of_another_missions_data(inflight, root):
    before = sorted(root.rglob("*"))
    told = inflight("simulate", "--days", 1, "--json", "-w", root)
    assert told.code == 2
    assert "'tiny'" in told.json["error"]["message"]
    assert "--workspace" in told.json["error"]["remedy"]
    assert sorted(root.rglob("*")) == before


@pytest.mark.parametrize("typed", ["2024-13-03", "03.03.2024"])
def test_a_day_that_is_no_date_is_told_as_typed_with_the_form_expected(inflight, root, typed):
    message = inflight("reprocess", "--start", typed, *PLAIN, "--json", "-w", root).json["error"]["message"]
    assert typed in message
    assert "YYYY-MM-DD" in message


def test_a_kind_of_table_that_is_none_is_refused_with_those_there_are(inflight, root):
    told = inflight("reprocess", "--table", "weekly", "--json", "-w", root)
    assert told.code == 2
    assert all(kind in told.json["error"]["message"] for kind in ("weekly", "daily", "window", "span"))


@pytest.mark.parametrize("verb", [("verify",), ("gaps",)])
def test_a_dataset_that_is_not_there_is_not_called_whole(inflight, root, verb):
    told = inflight("catalog", *verb, "l9/nothing", "--json", "-w", root)
    assert told.code == 1
    assert "l9/nothing" in told.json["error"]["message"]


def test_a_lineage_of_nothing_is_an_error(inflight, root):
    told = inflight("catalog", "show", "day:9999", "--json", "-w", root)
    assert told.code == 1
    assert "day:9999" in told.json["error"]["message"]


def test_a_comparison_that_is_not_there_is_wrong_usage(inflight, root):
    told = inflight("compare", "--comparison", "mian", "--json", "-w", root)
    assert told.code == 2
    assert "main" in told.json["error"]["remedy"]


def test_tables_in_a_pipe_are_wide_enough_for_paths(monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    assert Command().console.width == PIPED_WIDTH
    monkeypatch.setenv("COLUMNS", "70")
    assert Command().console.width == 70


WIDE_ROW = ("channel_field(electronics_temperature)", "temperature", "0.00011", "0.277")
HEADS = ("candidate", "family", "alone takes off, nT", "t")


@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_no_word_of_a_table_is_broken_or_lost_however_narrow_the_window(width):
    from io import StringIO

    from rich.console import Console

    made = StringIO()
    Console(file=made, width=width).print(text_table(HEADS, [WIDE_ROW], right=("t",), folded=HEADS[:1]))
    shown = made.getvalue().split()
    for word in WIDE_ROW:
        assert any(part.strip(",") == word for part in shown), made.getvalue()
    assert max(map(len, made.getvalue().splitlines())) <= width


def test_a_table_that_fits_is_one_line_a_row():
    from io import StringIO

    from rich.console import Console

    made = StringIO()
    Console(file=made, width=200).print(text_table(HEADS, [WIDE_ROW]))
    assert len(made.getvalue().splitlines()) == 2
