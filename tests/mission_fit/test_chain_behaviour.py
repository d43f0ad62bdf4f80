"""Behaviour over two years of daily values, made up: what was put in is told, figure by figure."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from inflight.figures import html_page
from inflight.tasks.pipelines.mission_fit.day import StoredDays
from inflight.tasks.pipelines.mission_fit.fit import MissionFitResults
from inflight.tasks.pipelines.mission_fit.parameter_sections import behaviour, clock, temperature
from inflight.time import DAY, day_bounds

DAYS, EVENT = 800, 400
NAMES = ("vector_sensor.scale_factor[x]", "vector_sensor.offset[z]", "time_shift.seconds")
SIGMA = np.array([1e-7, 0.05, 4e-5])


@pytest.fixture(scope="module")
def found():
    """A mission whose scale factor lags the temperature, whose offset steps once, and whose clock fails."""
    random = np.random.default_rng(1)
    day = np.arange(DAYS)
    bounds = np.array([day_bounds(np.datetime64("2001-01-01") + one) for one in day])
    warm = 10 + 5 * np.sin(2 * np.pi * day / 130)
    away = SIGMA * random.standard_normal((DAYS, 3))
    away[:, 0] += 5e-7 * np.sin(2 * np.pi * day / 130 - 0.8)
    away[EVENT + 1 :, 1] += 0.5
    away[600:605, 2] += 1e-3
    each, edges = ("interval", "parameter"), {"start": ("interval", bounds[:, 0])}
    edges["end"] = ("interval", bounds[:, 1])
    daily = xr.Dataset(
        {
            "value": (each, 1.0 + away),
            "continuous": (each, np.ones((DAYS, 3))),
            "sigma": (each, np.broadcast_to(SIGMA, (DAYS, 3)).copy()),
            "units": ("parameter", ["1", "nT", "s"]),
            **edges,
        },
        coords={"parameter": list(NAMES)},
    )
    means = xr.Dataset(
        {"value": (("interval", "channel"), warm[:, None]), **edges}, coords={"channel": ["coil_temperature"]}
    )
    event = SimpleNamespace(at=f"{np.datetime64('2001-01-01') + EVENT}T12:00:00Z", name="reset")
    mission = SimpleNamespace(
        periods={"orbit": 5580 * 10**9, "local_time": round(260.5 * DAY)}, events=[event]
    )
    tables = {"daily-after": daily, "daily-temperature": means}
    return MissionFitResults(mission, "main", None, None, "", StoredDays(None, []), tables)


def test_periods_means_and_steps_are_told(found):
    part = behaviour(found)
    scale = part.fields["periods"][NAMES[0]]
    assert any(one.startswith("130 d: 0.4") or one.startswith("130 d: 0.5") for one in scale)
    assert {one["window_days"] for one in part.fields["running_means"][NAMES[0]]} == {60.0, 260.0}
    steps = {name: rows[0] for name, rows in part.fields["steps"].items()}
    assert steps[NAMES[1]]["found"]
    assert steps[NAMES[1]]["step"] == pytest.approx(0.5, abs=5 * steps[NAMES[1]]["sigma"])
    assert not steps[NAMES[0]]["found"]
    assert all("no day of the week stands out" in told for told in part.fields["weekdays"].values())
    assert not any("Running mean" in what for what in part.absent)
    assert "<h2>" in html_page("t", [(part.heading, part.text, part.plots)])


def test_a_wrong_clock_is_told_with_its_days(found):
    part = clock(found)
    assert len(part.fields["faults"]) == 1
    assert part.fields["faults"][0]["shift"] == pytest.approx(1e-3, rel=0.1)
    assert len(part.plots) == 1


def test_a_lag_behind_the_temperature_opens_the_loop(found):
    part = temperature(found)
    assert part.fields["loops"][NAMES[0]]["open"]
    assert not part.fields["loops"][NAMES[2]]["open"]
    assert len(part.plots) == 3


def test_without_daily_values_the_reason_stands_there(found):
    empty = replace(found, tables={}, skipped={"daily-after": "no daily-after"})
    for make in (behaviour, clock, temperature):
        part = make(empty)
        assert list(part.absent.values()) == ["no daily-after"]
        assert not part.plots
