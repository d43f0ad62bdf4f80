"""Panels of the solar current told apart by local time and by the Sun."""

import json

import numpy as np
import pytest
import xarray as xr
from epoch_cases import stored_epochs

from inflight.effects import SIDE_NORMALS, TOP_NORMAL, effect_class, panel_illumination, panel_weights_at
from inflight.errors import SamplesError
from inflight.mission_fit import fit_by_local_time, select_panel_model

PANELS = np.array([[0.02, 0.01, -0.01], [-0.01, 0.01, 0.02]])
THIRD = np.array([[0.02, 0.01, -0.01], [-0.01, 0.01, 0.02], [0.05, 0.0, 0.06]])


def hours_of(days, a_day):
    """Local time of the node, falling by 24 h in 260.5 d."""
    return np.repeat((9.0 - 24.0 * 10 * np.arange(days) / 260.5) % 24.0, a_day)


def sun_of(hours, random):
    """Sun as a polar orbit sees it from any place of its lit half: y across, z down."""
    across = np.sin((hours - 12.0) * np.pi / 12.0)
    up = random.uniform(0.05, 1.0, hours.size) * np.sqrt(1.0 - across**2)
    along = np.sqrt(np.clip(1.0 - across**2 - up**2, 0.0, None))
    return np.column_stack([along, across, -up])


def test_the_schedule_is_the_thesis_one():
    """Quarters of 65.125 d: the second panel, th rising, the first, th falling; they join."""
    day = np.array([0.0, 65.125, 97.6875, 130.25, 195.375, 227.9375, 260.49])
    weights = panel_weights_at((9.0 - 24.0 * day / 260.5) % 24.0)
    assert weights[:, 0] == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.0, 0.5, 0.0], abs=1e-3)
    assert weights.sum(axis=1) == pytest.approx(1.0)
    angle = np.radians(360.0 / 260.5 * (80.0 - 65.125))
    share = panel_weights_at(np.array([(9.0 - 24.0 * 80.0 / 260.5) % 24.0]))[0]
    assert share[0] == pytest.approx(np.sin(angle) / (np.sin(angle) + np.cos(angle)))


def test_light_is_shared_by_cosine_and_area():
    share = panel_illumination(
        np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]), (*SIDE_NORMALS, TOP_NORMAL), (7.0, 7.0, 0.6)
    )
    assert share[0] == pytest.approx(np.array([7 * 0.5**0.5, 7 * 0.5**0.5, 0.6]) / (14 * 0.5**0.5 + 0.6))
    assert (share[1] == 0.0).all()


def test_two_panels_are_recovered_and_preferred_to_a_constant():
    hours = hours_of(40, 15)
    choice = select_panel_model(stored_epochs(1, days=40, value=PANELS, share=panel_weights_at(hours)), hours)
    assert choice.chosen.name == "two_panels"
    assert np.abs((choice.chosen.value - PANELS) / choice.chosen.sigma).max() < 3.5
    constant = next(one for one in choice.models if one.name == "constant")
    assert constant.behind > 5 * constant.behind_sigma
    assert "constant by" in choice.sentence


def test_a_constant_is_kept_when_the_panels_do_not_differ():
    hours = hours_of(40, 15)
    choice = select_panel_model(stored_epochs(2, days=40), hours)
    assert choice.chosen.name == "constant"
    assert "as well" in choice.sentence or choice.models[0].name == "constant"


def test_the_top_panel_is_found_when_it_matters_and_only_then():
    random = np.random.default_rng(0)
    hours = hours_of(60, 20)
    sun = sun_of(hours, random)
    for value, name in ((THIRD, "three_panels"), (np.vstack([PANELS, [[0, 0, 0]]]), "two_sides")):
        areas = (1.0, 1.0, 0.6) if name == "three_panels" else (1.0, 1.0, 1e-9)
        share = panel_illumination(sun, (*SIDE_NORMALS, TOP_NORMAL), areas)
        epochs = stored_epochs(3, days=60, a_day=20, value=value, share=share)
        epochs["sun_direction"] = ("epoch", "axis"), sun
        choice = select_panel_model(epochs, hours, areas=areas)
        assert choice.chosen.name == name
        count = len(choice.chosen.value)
        assert np.abs((choice.chosen.value - value[:count]) / choice.chosen.sigma).max() < 3.5


def test_the_coefficient_s_course_over_local_time_has_gaps_where_there_are_no_days():
    hours = hours_of(60, 15)
    course = fit_by_local_time(
        stored_epochs(4, days=60, value=PANELS, share=panel_weights_at(hours)), hours, bins=6
    )
    known = np.isfinite(course.value[:, 0])
    wanted = panel_weights_at(course.local_time) @ PANELS
    pull = (course.value - wanted)[known] / course.sigma[known]
    assert known.sum() >= 5
    # Bins are 4 h wide, and the true coefficient turns within them.
    assert np.median(np.abs(pull)) < 2.0
    short = fit_by_local_time(stored_epochs(4, days=4, a_day=15), hours[:60], bins=6)
    assert np.isnan(short.value).all()


def test_the_result_is_the_effect_s_own_values():
    hours = hours_of(40, 15)
    epochs = stored_epochs(1, days=40, value=PANELS, share=panel_weights_at(hours))
    epochs["time"] = "epoch", (np.repeat(np.arange(40) * 10, 15) * 86400 * 10**9).astype(np.int64)
    entry = select_panel_model(epochs, hours).as_effect()
    options = {name: value for name, value in entry.items() if name not in ("effect", "panels")}
    effect = effect_class(str(entry["effect"]))(**options)
    values = {"panels": np.array(entry["panels"])}
    stamps = epochs["time"].values
    samples = xr.Dataset(
        {"tt2000": ("time", stamps), "solar_current": ("time", np.full(stamps.size, 2.0), {"units": "A"})}
    )
    field = effect.field(samples, values, None)
    assert field == pytest.approx(
        2.0 * panel_weights_at(hours) @ np.reshape(entry["panels"], (2, 3)), abs=1e-4
    )
    json.dumps(entry)


def test_panels_of_unequal_areas_are_the_effect_s_own_values_too():
    random = np.random.default_rng(0)
    hours = hours_of(20, 15)
    epochs = stored_epochs(5, days=20)
    epochs["sun_direction"] = ("epoch", "axis"), sun_of(hours, random)
    choice = select_panel_model(epochs, hours, areas=(7.0, 7.0, 0.6))
    entry = choice.as_effect("three_panels")
    assert entry["areas"] == [7.0, 7.0, 0.6]
    assert choice.as_effect("two_sides")["areas"] == [7.0, 7.0]
    options = {name: value for name, value in entry.items() if name not in ("effect", "panels")}
    effect = effect_class("solar_array")(**options)
    sun = epochs["sun_direction"].values
    samples = xr.Dataset(
        {
            "tt2000": ("time", np.arange(len(sun))),
            "solar_current": ("time", np.full(len(sun), 2.0), {"units": "A"}),
            "sun_direction": (("time", "axis"), sun, {"units": "1"}),
        }
    )
    values = np.array(entry["panels"])
    field = effect.field(samples, {"panels": values}, None)
    share = panel_illumination(sun, (*SIDE_NORMALS, TOP_NORMAL), (7.0, 7.0, 0.6))
    assert field == pytest.approx(2.0 * share @ values.reshape(3, 3), abs=1e-9)
    json.dumps(entry)


def test_epochs_that_know_no_place_are_refused_and_the_table_has_units():
    random = np.random.default_rng(0)
    hours = hours_of(20, 15)
    epochs = stored_epochs(5, days=20)
    with pytest.raises(SamplesError, match="local time"):
        select_panel_model(epochs)
    epochs["sun_direction"] = ("epoch", "axis"), sun_of(hours, random)
    table = select_panel_model(epochs, hours, areas=(7.0, 7.0, 0.6)).table()
    assert table["value"].attrs["units"] == "nT/A"
    assert set(table["model"].values) == {"constant", "two_panels", "two_sides", "three_panels"}
