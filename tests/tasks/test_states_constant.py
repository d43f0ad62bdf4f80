"""The constant part of the field goes on from window to window, by whichever method, or it is told."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from inflight.catalog import Catalog, Workspace
from inflight.dual import (
    WHOLE,
    AppliedPart,
    Candidates,
    choose_correction,
    correction_by_stored_gradiometer,
    training_from_dataset,
    training_to_dataset,
)
from inflight.dual.training import relative_to
from inflight.simulate.dual import DualSettings
from inflight.tasks.archive import ingest, simulate
from inflight.tasks.pipelines import ReprocessSettings, pipeline_of
from inflight.tasks.pipelines.two_sensor import constant_sentences
from inflight.tasks.pipelines.two_sensor.day import body_of, correction_of, table_of, window_readings
from inflight.tasks.pipelines.two_sensor.tables import (
    constant_changes,
    continue_table,
    describe_constant,
    gradiometer_with_states,
)

MISSION = Path(__file__).parents[2] / "missions" / "venus-express.yaml"


@pytest.fixture(scope="module")
def days(tmp_path_factory):
    """Two days learnt from one by one: readings and, whatever was chosen, a table of either method each."""
    folder = tmp_path_factory.mktemp("constant")
    source = folder / "boom.yaml"
    source.write_text(MISSION.read_text(encoding="utf-8").replace("cadence: 1 s", "cadence: 8 s"))
    made = Workspace.create(folder / "w", source)
    simulate(DualSettings(days=2, seed=102, overrides={"cadence": 8.0}), made.data, workers=1)
    cat, mission = Catalog(made.root), made.mission()
    assert ingest(cat, mission, made.data).days["failed"] == 0
    settings = ReprocessSettings(table="daily")
    planned = pipeline_of(mission, "main", settings).make_plan(cat, mission, settings, (None, None))
    return [forced(cat, mission, planned, day) for day in planned.days]


def forced(cat, mission, planned, day):
    around = planned.index.around([day])
    readings, _ = window_readings(cat, mission, planned.model, [day], planned.needs, around)
    candidates = Candidates(readings, body_of(mission, "main"))
    found = choose_correction(readings, candidates.fit, candidates.priors)
    applied = replace(found.correction, applied=True, reason="forced")
    tables = {}
    for method in ("states", "matrix"):
        for name, part in ((method, WHOLE), (f"quick {method}", AppliedPart(1.0, 20_000.0))):
            scores = found.scores | {method: replace(found.scores[method], part=part)}
            told = replace(found, chosen=method, correction=applied, scores=scores)
            tables[name] = table_of(candidates, told)
    return readings, tables


def relative(table, number):
    """Return a table whose corrections are relative to another of its states."""
    told = training_to_dataset(relative_to(training_from_dataset(table), number))
    return table.assign(told.data_vars).assign_attrs(told.attrs)


def test_a_gradiometer_has_the_constant_of_the_states_whichever_they_are_relative_to(days):
    readings, tables = days[0]
    free = correction_by_stored_gradiometer(tables["matrix"], readings)
    far = []
    for number in tables["states"]["number"].values[:6].tolist():
        states = correction_of(relative(tables["states"], number), readings)
        table = relative(tables["matrix"], number)
        found = correction_of(table, readings)
        both = states.known & found.known
        apart = (found.field - states.field)[both].mean(axis=0)
        assert np.all(np.abs(apart) < 2.0 * np.median(found.sigma[both], axis=0))
        assert describe_constant(table) == f"relative to state {number}"
        far.append(np.abs((free.field - states.field)[both].mean(axis=0) / np.abs(apart)))
    # Left where its median is zero it would be off by as much as the states differ.
    assert np.median(far) > 2.0


def test_a_gradiometer_tells_the_states_it_passes_through(days):
    readings, tables = days[0]
    found, states = (correction_of(tables[method], readings) for method in ("matrix", "states"))
    assert found.method == "gradiometer"
    np.testing.assert_array_equal(found.state, states.state)


def test_a_window_by_a_gradiometer_goes_on_from_one_by_states(days):
    first = continue_table([], days[0][1]["states"])
    readings, tables = days[1]
    states, gradiometer = (continue_table([first], tables[method]) for method in ("states", "matrix"))
    assert {describe_constant(table) for table in (states, gradiometer, first)} == {"relative to state 0"}
    one, other = (correction_of(table, readings) for table in (states, gradiometer))
    both = one.known & other.known
    apart = (other.field - one.field)[both].mean(axis=0)
    assert np.all(np.abs(apart) < 2.0 * np.median(other.sigma[both], axis=0))


@pytest.mark.parametrize("method", ["states", "matrix"])
def test_a_window_that_leaves_alone_what_is_slow_has_no_constant_however_it_is_joined(days, method):
    readings, tables = days[0]
    table = tables[f"quick {method}"]
    found = correction_of(table, readings)
    for number in table["number"].values[:4].tolist():
        later = continue_table([relative(table, number)], table)
        assert later.attrs["reference"] == number
        moved = (later["correction"] - table["correction"]).values[0]
        again = correction_of(later, readings)
        assert describe_constant(later) == "as measured"
        np.testing.assert_allclose(again.field, found.field, atol=1e-6)
    assert np.abs(moved).max() > 0.1


def test_a_window_that_was_left_alone_does_not_end_the_chain(days):
    first = continue_table([], days[0][1]["states"])
    # Learnt from one state that nobody knows, and not applied.
    lost = days[0][1]["states"].isel(state=[0], next=[0])
    lost = lost.assign(centre=lost["centre"] + 500.0).assign_attrs(applied="no", method="none", reference=0)
    lost = continue_table([first], lost)
    (number,) = lost["number"].values
    assert number >= first.attrs["next_number"]
    later = continue_table([lost, first], days[1][1]["states"])
    assert later.attrs["goes_on"] == "yes"
    assert describe_constant(later) == describe_constant(first)
    # Numbers are never given twice.
    assert later.attrs["next_number"] > number
    assert number not in later["number"].values


def test_a_gradiometer_without_states_stands_alone_and_that_is_told(days):
    _, tables = days[0]
    bare = tables["matrix"].drop_vars("gradiometer_in_states")
    told = describe_constant(bare)
    assert told == "that of the window from 2006-05-14 alone"
    first, second = np.datetime64("2006-05-14"), np.datetime64("2006-05-15")
    changes = constant_changes({first: told, second: "relative to state 0"})
    assert [one["day"] for one in changes] == ["2006-05-15"]
    assert "may step by a constant" in constant_sentences(changes)[0]
    assert constant_changes({first: "absolute", second: "absolute"}) == []


def test_what_is_left_as_measured_is_told_as_such():
    assert describe_constant(xr.Dataset(attrs={"applied": "no"})) == "as measured"


def test_the_error_of_the_constant_is_not_in_what_is_quick(days):
    readings, tables = days[0]
    whole, quick = (gradiometer_with_states(tables[name], readings) for name in ("matrix", "quick matrix"))
    more = np.einsum("tii->ti", whole.covariance - quick.covariance)[whole.known]
    assert more.min() > 0.0
    assert more == pytest.approx(np.broadcast_to(more[0], more.shape))
