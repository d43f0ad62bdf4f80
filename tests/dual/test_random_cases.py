"""The short form of ``python -m tests.dual_cases``: no harm on random cases."""

import numpy as np
import pytest

from tests.dual_cases.scenarios import FAMILIES, make_case
from tests.dual_cases.score import score_seed

SEEDS = range(900, 924)


def test_cases_are_made_of_their_seed_and_of_all_families():
    first, second = make_case(7), make_case(7)
    assert np.array_equal(first.readings.outboard, second.readings.outboard, equal_nan=True)
    assert {make_case(seed).family for seed in range(40)} == set(FAMILIES)
    null = make_case(3, family="null")
    assert not null.stray.any()


@pytest.mark.slow
def test_no_random_case_is_made_worse_and_most_strong_ones_better():
    scores = [score_seed(seed) for seed in SEEDS]
    assert max(one.ratio for one in scores) < 1.02
    strong = [one.ratio for one in scores if one.exceeds]
    assert np.median(strong) < 0.6
    assert all(one.ratio == 1.0 for one in scores if not one.applied)
