"""Progress of long stages: bars for a person, lines for a log, nothing for a program."""

import sys

import pytest

from inflight.cli import command


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(command.time, "monotonic", lambda: now[0])
    return now


def test_a_log_gets_rate_and_remaining_time_of_a_long_stage(clock, capsys):
    with command.Command().progress() as show:
        for done in range(11):
            show("pass", done, 10)
            clock[0] += 10.0
    assert capsys.readouterr().err.splitlines()[0] == "pass: 1 of 10, 0.1/s, 90 s left"


def test_a_short_stage_writes_no_line(clock, capsys):
    with command.Command().progress() as show:
        for done in range(11):
            show("pass", done, 10)
            clock[0] += 0.15
    assert capsys.readouterr().err == ""


def test_a_stage_of_one_step_says_once_that_it_runs(clock, capsys):
    with command.Command().progress() as show:
        for stage in ("tables", "intervals", "tables"):
            show(stage, 0, 1)
            clock[0] += 60.0
            show(stage, 1, 1)
    assert capsys.readouterr().err.splitlines() == ["tables: running", "intervals: running"]


def test_a_program_gets_no_progress(clock, capsys):
    with command.Command(json=True).progress() as show:
        for done in range(11):
            show("pass", done, 10)
            clock[0] += 60.0
    assert capsys.readouterr().err == ""


def test_a_terminal_gets_a_bar_with_the_time_that_is_left(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "120")
    with command.Command().progress() as show:
        for done in range(4):
            show("pass", done, 3)
    printed = capsys.readouterr().err
    assert "3/3" in printed
    assert "left" in printed


def test_the_rate_of_a_stage_that_begins_again_is_its_own(clock, capsys):
    with command.Command().progress() as show:
        for step in (10.0, 1.0):
            for done in range(11):
                show("intervals", done, 10)
                clock[0] += step
    lines = capsys.readouterr().err.splitlines()
    assert "intervals: 2 of 10, 1/s, 8 s left" in lines


def test_a_bar_that_begins_again_counts_anew(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "120")
    with command.Command().progress() as show:
        for done in (0, 1, 2, 0, 1):
            show("intervals", done, 2)
    # The time that is left is not that of a stage that has ended.
    last = [line for line in capsys.readouterr().err.splitlines() if "intervals" in line][-1]
    assert "1/2" in last
    assert "-:--:--" in last
