"""``inflight figures``: the table for a person, a section with --json, wrong usage told."""

import json


def test_the_table_shows_published_and_obtained_side_by_side(inflight):
    shown = inflight("figures", "--only", "lag.xz", "--only", "dipole")
    assert shown.code == 0
    row = next(line for line in shown.out.splitlines() if line.startswith("lag.xz"))
    assert "-4.1" in row
    assert "-3.2" in row
    assert "contradicted" in row
    assert "1.64001" in shown.out
    assert "2 figures printed: 1 reproduced, 1 contradicted" in shown.out


def test_a_section_can_be_asked_for_alone(inflight):
    told = json.loads(inflight("figures", "--section", "spacecraft-fields", "--json").out)
    assert {one["section"] for one in told["figures"]} == {"spacecraft-fields"}


def test_an_unknown_figure_or_section_is_wrong_usage_with_what_there_is(inflight):
    told = inflight("figures", "--only", "lagg", "--json")
    assert told.code == 2
    assert "lag.xz" in json.loads(told.out)["error"]["remedy"]
    assert inflight("figures", "--section", "nine").code == 2
