"""One seed of every case: nothing wrong is claimed, and the truth is named or honestly confused."""

import pytest

from .run import run_case
from .scenarios import scenarios

SEED = 1
#: Cases that every test run makes; the others are marked slow and run with ``make cases``.
QUICK = {
    "null_polar",
    "offset_step",
    "slow_response",
    "two_days",
}
#: Cases that fail, with what was measured; each is to be taken out when it passes.
FAILING: dict[str, str] = {}


def marked(name):
    marks = [] if name in QUICK else [pytest.mark.slow]
    if name in FAILING:
        marks.append(pytest.mark.xfail(strict=True, reason=FAILING[name]))
    return pytest.param(name, marks=marks)


@pytest.mark.parametrize("name", [marked(name) for name in scenarios()])
def test_the_hidden_effect_is_named_or_honestly_confused(tmp_path, name):
    outcome = run_case(name, SEED, tmp_path)
    assert not outcome.error, outcome.error
    told = outcome.score
    assert not told.confident_wrong, f"FOUND {told.false_additions}, hidden {outcome.truth['effects']}"
    assert told.family is not False, f"{told.verdict} does not name {outcome.truth['effects']}"
    if not outcome.truth["effects"]:
        assert told.passed, f"{told.verdict}: nothing is hidden"
