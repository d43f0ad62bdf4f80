"""Rows of benchmarks: what is kept of a commit, how it is printed, and the memory of processes."""

import json
import sys

import pytest

from benchmarks import measured
from benchmarks.measured import Row, in_process, keep, kept_file, kept_rows, table


def test_rows_measured_later_join_those_of_the_commit(tmp_path):
    keep([Row(what="a", seconds=[1.0], part="growth"), Row(what="b", seconds=[2.0], part="growth")], tmp_path)
    keep([Row(what="rank", seconds=[1.0], part="ranking")], tmp_path)
    path = keep(
        [Row(what="a", seconds=[3.0], part="growth"), Row(what="c", seconds=[4.0], part="growth")], tmp_path
    )
    assert list(tmp_path.iterdir()) == [path] == [kept_file(tmp_path)]
    found = [(row.part, row.what, row.seconds) for row in kept_rows(path)]
    assert found == [
        ("growth", "a", [3.0]),
        ("growth", "b", [2.0]),
        ("growth", "c", [4.0]),
        ("ranking", "rank", [1.0]),
    ]
    # How fast the machine was when each of them was measured.
    assert all(0.0 < row.additions_s < 60.0 for row in kept_rows(path))


def test_rows_of_another_machine_stay_in_their_file(tmp_path):
    path = keep([Row(what="a", seconds=[1.0])], tmp_path)
    content = json.loads(path.read_text())
    content["machine"]["processor"] = "another"
    path.write_text(json.dumps(content))
    assert keep([Row(what="a", seconds=[2.0])], tmp_path) != path
    assert kept_rows(path)[0].seconds == [1.0]


def test_the_table_tells_ratios_amounts_and_what_was_measured_once():
    rows = [
        Row(what="a", seconds=[2.0], floor_s=1.0, floor="read", naive_s=20.0, naive="scipy"),
        Row(what="b", seconds=[1.0, 3.0, 2.0]),
        Row(what="kept", amount=0.1, whole=0.4, unit="MB"),
    ]
    text = "\n".join(table(rows))
    for words in ("once", "1.00-3.00 (3)", "25.0 % of 0.4 MB", "10.0x", "read", "scipy"):
        assert words in text


def _hold() -> list[Row]:
    # Held for less than the pause between two looks: only the system's own record of the most has it.
    held = b"x" * 200_000_000
    del held
    return [Row(what="held", seconds=[0.0])]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the system says no more")
def test_what_a_process_held_between_two_looks_is_found():
    (row,) = in_process(_hold)
    assert row.peaks > 190


def test_a_command_that_ends_otherwise_is_an_error(tmp_path):
    with pytest.raises(RuntimeError, match="ended with"):
        measured.command("a verb there is not", ["no-such-verb"], tmp_path)
