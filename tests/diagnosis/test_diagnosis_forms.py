"""Cells of the table `acts on` x `follows`: products as of joined columns, and effects only they describe."""

from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_cases import NOISE_NT, POLAR, case_of, flight_of, read

from inflight.diagnosis import run_search
from inflight.diagnosis.forms import (
    ACTS_ON,
    CellProducts,
    CellRows,
    Followed,
    _at_best_lag,
    _cells,
    _entry,
    _is_own_square,
    _option,
    add_forms,
    by_one_channel,
    scalar_channels,
)
from inflight.diagnosis.refine import join_terms
from inflight.diagnosis.residual import remaining_residual
from inflight.diagnosis.scoring import make_folds, score
from inflight.diagnosis.stepwise import _one_round
from inflight.diagnosis.verdict import held_against_others

CHANNELS = ("solar_current", "boom_temperature", "heater_current")


def shapes(flight):
    """What the scalar reading has, or the vector sensor's scale: nT of each sample."""
    warmth, current = flight["boom_temperature"], flight["heater_current"]
    strength = np.linalg.norm(flight["field"], axis=1)
    rate = np.gradient(strength, flight.tt2000 / 1e9)
    about = warmth - warmth.mean()
    return {
        "bias": 0.1 * about / about.std(),
        "clock": 3e-3 * rate * about / about.std(),
        "scale": -2.5e-6
        * strength
        * (current - current.mean())
        / current.std()
        * flight.direction[:, 2] ** 2,
    }


@lru_cache(maxsize=1)
def flown():
    flight = flight_of(POLAR, 30)
    hidden = [read(flight, seed, scalar=one) for seed, one in enumerate(shapes(flight).values())]
    # Where the field along an axis is large, another measuring range with another gain reads it; and a
    # scalar sensor whose reading depends on the field's direction.
    wide = np.where(np.abs(flight["field"]) > 20_000.0, 2e-5, 0.0) * flight["field"]
    heading = 0.3 * flight.direction[:, 0] ** 2
    hidden += [read(flight, 9), read(flight, 10, wide), read(flight, 11, scalar=heading)]
    return case_of(flight, hidden, channels=CHANNELS)


# A mounting shows against a field model alone.
@pytest.mark.parametrize("label", [one for one in ACTS_ON.values() if one != "channel_turn"])
def test_products_of_cells_are_those_of_columns_that_join(label):
    case = flown()
    search, data = case.search(), case.material()
    search = search.add(next(one for one in search.options if one.name == "channel_field(solar_current)"))
    cells = _cells(search, data, label, ["boom_temperature"])
    assert len(cells) >= (1 if label == "channel_field" else 5)
    made = [_option(search, data, one, _entry(data, label, one)) for one in cells]
    products = CellProducts.of(CellRows(search, data), {label: dict.fromkeys(cells, made[0][0].entry)})[label]
    joined = join_terms(search.of_model(), data, [term for term, _ in made])
    grams = joined.forms["raw"]
    folds = make_folds(len(grams))
    slow = score(grams, joined.present(), [grams.index(o.columns) for _, o in made], joined.y(), folds)
    places = [products.places(k) for k in range(len(cells))]
    quick = score(products, search.present_in(products), places, products.residuals[0], folds)
    np.testing.assert_allclose(quick.loss0, slow.loss0, rtol=1e-4)
    np.testing.assert_allclose(quick.gain, slow.gain, atol=2e-4)
    np.testing.assert_allclose(quick.t, slow.t, atol=0.05)


def test_rows_of_the_table_made_together_are_those_made_alone(monkeypatch):
    case = flown()
    search, data = case.search(), case.material()
    asked = {}
    for label in ACTS_ON.values():
        cells = _cells(search, data, label, list(CHANNELS))
        if cells:
            asked[label] = {one: _entry(data, label, one) for one in cells}
    assert len({tuple(cells) for cells in asked.values()}) > 1
    rows = CellRows(search, data)
    # A few cells at a time, which are not the same ones of each row.
    monkeypatch.setattr("inflight.diagnosis.forms._AT_ONCE", 3 * len(rows.left))
    together = CellProducts.of(rows, asked)
    assert list(together) == list(asked)
    for label, one in asked.items():
        alone = CellProducts.of(rows, {label: one})[label]
        for own, other in ((together[label].table, alone.table), (together[label].inner, alone.inner)):
            size = np.abs(other).max(axis=0)
            assert (np.abs(own - other) <= 1e-9 * size).all()


@pytest.mark.parametrize(
    ("place", "label", "channel"),
    [(0, "channel_bias", "boom_temperature"), (1, "channel_clock", "boom_temperature")],
)
def test_what_the_scalar_sensor_does_with_its_heat_is_found(place, label, channel):
    found = flown().diagnose(place)
    names = [one.name for one in found.effects]
    assert any(name.startswith(f"{label}({channel}") for name in names), found.sentence
    assert found.residual["held_out_after_nT"] < 1.03 * NOISE_NT


def test_nothing_joins_where_nothing_is_left():
    case = flown()
    search = case.search(3)
    assert add_forms(search, case.material(3)) == (search, False)


def test_angles_and_channels_that_stand_still_are_no_channels_of_cells():
    names = scalar_channels(flown().material())
    assert set(CHANNELS) <= set(names)
    assert not {"orbit_phase", "local_time", "longitude"} & set(names)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5])
def test_a_channel_of_two_levels_has_no_square_of_its_own_however_long_it_is_on(share):
    on = np.arange(1000) < 1000 * share
    assert _is_own_square(np.where(on, 500.3, 0.1))
    assert not _is_own_square(np.where(on, 500.3, np.arange(1000.0)))


def test_an_effect_that_becomes_one_of_the_model_in_its_best_form_is_not_taken_twice(monkeypatch):
    """One form of the blocks sees another lag than the model has, and all samples the same one."""
    case = flown()
    search, data = case.search(), case.material()
    plain, lagged = (
        next(one for one in search.options if one.name == f"channel_field(solar_current){lag}")
        for lag in ("", "@lag=1000s")
    )
    search = search.add(plain)
    table = search.table()
    monkeypatch.setattr("inflight.diagnosis.stepwise.refine", lambda state, data, option: (state, plain))
    after = _one_round(search, data, table, lagged, "within")
    assert after.accepted == (plain,)
    assert lagged.name not in {one.name for one in after.table().options}


@pytest.mark.parametrize("lag", [0.5, 340.0, 12345.0])
def test_a_response_has_any_lag_that_is_best(monkeypatch, lag):
    case = flown()
    monkeypatch.setattr("inflight.diagnosis.forms.best_lag", lambda *_: (lag, 0.0))
    cell = Followed("response", "heater_current", "heater_current@lag=4000s", 4000.0)
    found = _at_best_lag(case.search(), case.material(), None, "channel_field", cell)
    assert found is not None
    assert found[0].lag_s == pytest.approx(lag, rel=1e-3)
    assert found[1].effect.channels == (found[0].name,)


def test_an_effect_of_the_field_that_leaves_another_function_of_it_may_stand_in_for_that():
    found = flown().diagnose(4)
    taken = [one for one in found.effects if not one.channels]
    assert taken
    assert {one.left_follows for one in taken} == {"the field along the axes"}
    assert "sure" not in {one.status for one in taken}


def test_an_effect_of_the_field_of_the_right_form_leaves_no_other_function_of_it():
    found = flown().diagnose(5)
    assert [(one.name, one.status, one.left_follows) for one in found.effects] == [
        ("heading_anisotropy", "sure", "")
    ]


@pytest.mark.parametrize(("part", "status"), [(0.01, "sure"), (0.2, "stand-in")])
def test_an_effect_of_which_hardly_anything_is_left_is_nearly_right(monkeypatch, part, status):
    """A hundredth of an effect, in another form of its kind, makes no doubt of the cause."""
    case = flown()
    data = case.material()
    told, search = run_search(case.search(), data)
    (effect,) = told.effects
    monkeypatch.setattr("inflight.diagnosis.verdict.left_follows", lambda *_: {effect.name: "another form"})
    size = SimpleNamespace(rms_nT=part * effect.rms_nT)
    left = SimpleNamespace(is_there=True, structure=size, signature=None)
    (found,) = held_against_others(search, data, told.effects, remaining_residual(search, data), left)
    assert (effect.status, found.status, found.left_follows) == ("sure", status, "another form")


@lru_cache(maxsize=1)
def of_one_or_of_two():
    """Twenty days; residuals of a field that is no line of a temperature, and of two causes of their own."""
    flight = flight_of(POLAR, 20)
    warm = flight["boom_temperature"] - flight["boom_temperature"].mean()
    bent = np.tanh(warm / (0.3 * warm.std()))
    along = np.array([0.3, 0.0, 0.5])
    current = flight["heater_current"] - flight["heater_current"].mean()
    both = 0.4 * (warm / warm.std())[:, None] * along + 0.4 * (current / current.std())[:, None] * along[::-1]
    hidden = [read(flight, 0, 0.6 * bent[:, None] * along), read(flight, 1, both)]
    return case_of(flight, hidden, channels=("battery_current", "boom_temperature", "heater_current"))


def parts_of_one(residual, *names):
    case = of_one_or_of_two()
    search = case.search(residual)
    taken = [next(one for one in search.options if one.name == name) for name in names]
    return by_one_channel(search.with_accepted(taken), case.material(residual))


def test_effects_that_one_channel_explains_in_a_way_of_its_own_are_told_as_its_parts():
    names = ("channel_field(boom_temperature)", "channel_field(heater_current)")
    said = "a field that follows boom_temperature in a way of its own"
    assert parts_of_one(0, *names) == dict.fromkeys(names, said)


def test_causes_of_their_own_are_no_parts_of_one():
    assert parts_of_one(1, "channel_field(boom_temperature)", "channel_field(heater_current)") == {}
    # Nor is one effect, nor two of the channel itself.
    assert parts_of_one(0, "channel_field(boom_temperature)") == {}
    assert (
        parts_of_one(0, "channel_field(boom_temperature)", "channel_field(boom_temperature)@lag=240s") == {}
    )
