"""What drifts within a day is taken out as if its rows had been made so; parts of days keep whole."""

import numpy as np
import pytest
import xarray as xr

from inflight.calibration import NormalEquations
from inflight.lsq import RESIDUAL
from inflight.mission_fit import DayDrift
from inflight.tasks.pipelines.mission_fit.day import (
    means_of_channels,
    pack_parts,
    unify_variables,
    unpack_part,
)

WIDTH, ROWS, DAYS = 5, 400, 3
SCALE = np.array([1e-5, 2e-5, 1e-5, 1.0, 0.5])


def day_of(random: np.random.Generator, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the Gram matrix of a day, what drifts in it, and the matrix of rows made with the drift."""
    columns, residual = random.standard_normal((ROWS, WIDTH)), random.standard_normal(ROWS)
    drifting = columns[:, :3] * np.linspace(-0.5, 0.5, ROWS)[:, None]
    every = np.column_stack([columns, residual, drifting])
    moved = np.column_stack([columns, residual + drifting @ (rate / SCALE[:3])])
    gram = every.T @ every
    return gram[: WIDTH + 1, : WIDTH + 1], gram[WIDTH + 1 :], moved.T @ moved


def test_a_drift_that_is_taken_out_is_as_if_the_rows_had_it():
    random = np.random.default_rng(2)
    rate = 3e-5 * random.standard_normal((DAYS, 3))
    grams, drifts, expected = (
        np.array(one) for one in zip(*(day_of(random, one) for one in rate), strict=True)
    )
    names = [*"abcde", RESIDUAL]
    row = ("block", "column", "other")
    equations = NormalEquations(
        xr.Dataset(
            {"gram": (row, grams), "scale": ("column", np.append(SCALE, 1.0))},
            coords={"column": names, "other": names},
        )
    )
    made = DayDrift(drifts).remove_drift(equations, rate)
    np.testing.assert_allclose(made.dataset["gram"].values, expected, rtol=1e-12, atol=1e-9)
    # The days' own equations stay as they were.
    np.testing.assert_array_equal(equations.dataset["gram"].values, grams)


def epochs(count: int, first: int) -> xr.Dataset:
    value = np.arange(count * 6, dtype=np.float64).reshape(count, 2, 3) + first
    value[0, 0, 0] = np.nan
    return xr.Dataset(
        {
            "column": (("epoch", "current", "axis"), value, {"units": "A"}),
            "contrast": ("epoch", np.linspace(0.0, 1.0, count), {"units": "nT"}),
            "time": ("epoch", 2**60 + np.arange(count) + first, {"units": "ns"}),
        },
        coords={"current": ["solar", "heater"], "axis": list("xyz"), "lag": ("lag", [0.5, 1.5])},
        attrs={"window_s": 80.0},
    )


def blank() -> xr.Dataset:
    return xr.Dataset({"count": ("block", np.ones(1))})


def test_parts_of_days_come_back_together_to_the_last_bit():
    parts = [epochs(4, 0), epochs(7, 100)]
    days = unify_variables(
        [pack_parts(blank(), {"epoch": part}) for part in parts] + [pack_parts(blank(), {})]
    )
    assert {str(name) for name in days[2].variables} == {str(name) for name in days[0].variables}
    (found,) = unpack_part(days, "epoch")
    expected = xr.concat(parts, "epoch", data_vars="minimal", join="exact")
    xr.testing.assert_identical(found.transpose(*expected.dims), expected)


def test_more_rows_than_are_kept_are_spread_over_the_day():
    (found,) = unpack_part([pack_parts(blank(), {"epoch": epochs(100, 0)})], "epoch")
    assert found.sizes["epoch"] == 48
    assert found["time"].values[[0, -1]].tolist() == [2**60, 2**60 + 99]


def test_days_without_a_part_have_none():
    assert unpack_part([pack_parts(blank(), {"epoch": None})], "epoch") == []


def test_means_of_channels_are_found_by_name_on_days_that_have_others():
    def day(names: list[str]) -> xr.Dataset:
        told = {name: ("channel", np.arange(len(names), dtype=float)) for name in ("mean", "spread", "count")}
        return pack_parts(blank(), {"channel": xr.Dataset(told, coords={"channel": names})})

    found = means_of_channels([day(["a", "b"]), blank(), day(["b"])])
    assert found["a"][0].tolist() == [0.0, 0.0, 0.0]
    assert np.isnan(found["a"][1:]).all()
    assert found["b"][[0, 2], 0] == pytest.approx([1.0, 0.0])
