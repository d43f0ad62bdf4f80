"""How far a search is: every stage is told from its beginning to its end."""

import numpy as np
from diagnosis_cases import POLAR, case_of, flight_of, read

from inflight.diagnosis import run_search


def told_of(field):
    flight = flight_of(POLAR, 15)
    hidden = flight["solar_current"][:, None] * np.array(field)
    case = case_of(flight, [read(flight, 1, field=hidden)], channels=("solar_current",))
    told = []
    found, _ = run_search(case.search(), case.material(), progress=lambda *one: told.append(one))
    steps = {stage: [one[1:] for one in told if one[0] == stage] for stage, _, _ in told}
    for own in steps.values():
        assert own[0][0] == 0
        assert own[-1][0] == own[-1][1]
        assert all(done <= total for done, total in own)
    return found, steps


def test_rounds_rivals_and_the_verdict_are_told_from_their_beginning_to_their_end():
    found, steps = told_of([2.0, -1.5, 1.2])
    assert len(found.effects) == 1
    assert next(iter(steps)) == "search"
    # The round that takes the effect, and the one in which nothing more is justified.
    assert steps["search"] == [(0, 1), (1, 2), (2, 2)]
    assert steps["rivals"] == [(0, 1), (1, 1)]
    assert [done for done, _ in steps["verdict"]] == list(range(7))


def test_where_nothing_is_found_one_round_is_told_and_no_rivals():
    found, steps = told_of([0.0, 0.0, 0.0])
    assert not found.effects
    assert steps["search"] == [(0, 1), (1, 1)]
    assert "rivals" not in steps
