"""Coverage of tables: every pipeline has rows, and a table says what is outside."""

import numpy as np
import pytest

from benchmarks.table_coverage import CASES, TableCoverage, table, zero_level
from inflight.tasks.pipelines import PIPELINES


def test_every_pipeline_is_counted():
    counted = {tag for tags in CASES for tag in tags}
    # Spinning sensors have a table of their own; `tables` are what the fit of all days makes beside.
    assert counted == {one.tag for one in PIPELINES} - {"spin"} | {"tables"}


def test_errors_that_are_too_small_or_too_large_are_marked():
    right, missions = np.random.default_rng(1).normal(size=(40, 9)), 40
    rows = [
        TableCoverage(pipeline="scalar", of="window table", pulls=factor * right)
        for factor in (1.0, 3.0, 0.2)
    ]
    assert [row.is_right() for row in rows] == [True, False, False]
    lines = list(table(rows))
    assert [line.endswith("* |") for line in lines[2:5]] == [False, True, True]
    assert f"| {missions} | 360 |" in lines[2]
    gone = TableCoverage(pipeline="scalar", of="product", pulls=np.full((3, 2), np.nan))
    assert "| 0 | - | - | - |" in list(table([gone]))[2]


@pytest.mark.slow
def test_a_mission_of_a_zero_level_gives_values(tmp_path):
    pulls = zero_level(3, tmp_path / "w")["zero_level"]
    assert set(pulls) == {"daily table", "window table", "span table", "steps table", "product"}
    assert all(np.isfinite(one).any() for one in pulls.values())
