"""Trends over blocks come from the stored equations alone, and scores say what a block still wants."""

import numpy as np
import xarray as xr

from inflight.calibration import NormalEquations
from inflight.time import DAY

RNG = np.random.default_rng(5)
SCALE = np.array([1e-5, 1.0])
BLOCKS, ROWS = 40, 300


def blocks_with_trend(slope, reference):
    """Blocks of 40 days whose first parameter grows by `slope` a day about `reference`; noise 0.1 nT."""
    grams = []
    for day in range(BLOCKS):
        columns = RNG.normal(size=(ROWS, 2))
        truth = np.array([slope * day, 0.3]) / SCALE
        # The residual at the reference is minus what the parameters would have to add to remove it.
        y = -columns @ truth + 0.1 * RNG.normal(size=ROWS)
        rows = np.column_stack([columns, y])
        grams.append(rows.T @ rows)
    names = ["a", "b", "residual"]
    start = np.arange(BLOCKS, dtype=np.int64) * DAY
    scatter = np.array([gram * 0.01 for gram in grams])
    scatter[:, -1, :] = scatter[:, :, -1] = 0.0
    row = ("block", "column", "other")
    return NormalEquations(
        xr.Dataset(
            {
                "gram": (row, np.array(grams)),
                "scatter": (row, scatter),
                "reference": (("block", "column"), np.tile(np.append(reference, 0.0), (BLOCKS, 1))),
                "start": ("block", start),
                "end": ("block", start + DAY),
                "count": ("block", np.full(BLOCKS, float(ROWS))),
                "scale": ("column", np.append(SCALE, 1.0)),
            },
            coords={"column": names, "other": names},
            attrs={"comparison": "main", "model": "m", "filter": "raw"},
        )
    )


def days(tt2000):
    return tt2000 / DAY - 0.5


def test_a_linear_trend_is_recovered_from_daily_equations_within_its_sigma():
    equations = blocks_with_trend(3e-6, np.array([1.0, 5.0]))
    trended = equations.with_trends({"a": {"constant": np.ones_like, "linear": days}})
    assert trended.columns == ["a*constant", "a*linear", "b"]
    solution = trended.solve(np.array([1.0, 1.0, 100.0]))
    value, covariance = trended.physical(solution)
    sigma = np.sqrt(np.diag(covariance))
    assert np.all(np.abs(value - [0.0, 3e-6, 5.3]) < 4 * sigma)
    assert sigma[1] < 1e-7, "a trend of 3 ppm a day must stand out"


def test_without_the_trend_the_scores_of_first_and_last_blocks_differ_in_sign():
    equations = blocks_with_trend(3e-6, np.array([1.0, 5.0]))
    value, _ = equations.physical(equations.solve(np.array([1.0, 100.0])))
    scores = equations.scores(value)
    assert abs(scores[:, 0].sum()) < 1e-6 * np.abs(scores[:, 0]).sum()
    assert scores[:10, 0].mean() * scores[-10:, 0].mean() < 0


def test_expanding_by_a_constant_changes_nothing_but_the_name():
    equations = blocks_with_trend(0.0, np.array([1.0, 5.0]))
    same = equations.with_trends({"b": {"constant": np.ones_like}})
    plain = equations.solve(np.array([1.0, 100.0]))
    expanded = same.solve(np.array([1.0, 100.0]))
    np.testing.assert_allclose(expanded.value, plain.value, rtol=1e-10)
    np.testing.assert_allclose(expanded.covariance, plain.covariance, rtol=1e-10)
