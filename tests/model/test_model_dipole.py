"""Effects of a dipole that both sensors see: exact inverses, columns, errors of its place, refusals."""

import numpy as np
import pytest
import xarray as xr

from inflight.catalog.workspace import find_mission
from inflight.design import DesignRows, term_of
from inflight.design.columns import term_columns
from inflight.dipole import DipoleSource, dipole_split
from inflight.errors import ModelError
from inflight.mission import Mission
from inflight.model import Model, place_variance, rows_of

MISSION = Mission.parse(find_mission("champ").read_text(encoding="utf-8"))
SOURCE = (-0.6, 0.2, 0.1)
TEXT = """
effects:
  - effect: vector_sensor
    sensor: fgm
    scale_factor: {{value: [1.001, 1.002, 0.999], sigma: 0.01}}
    misalignment: {{unit: deg, value: [90.02, 89.97, 90.01], sigma: 0.1}}
    offset: {{unit: nT, value: [20, -10, 5], sigma: 10}}
  - effect: channel_field
    name: battery
    sensor: fgm
    channel: battery_current
    {dipole}
    coefficient: {{unit: nT/A, value: [0.3, -0.2, 0.5], sigma: 1}}
"""


def model_of(dipole=f"dipole: {{position: {list(SOURCE)}, sigma: 0.1}}", mission=MISSION):
    return Model.parse(TEXT.format(dipole=dipole), mission)


def samples_of(count=400):
    g = np.random.default_rng(4)
    field = 3e4 * np.array([np.sin(x := np.linspace(0, 20, count)), np.cos(1.3 * x), np.sin(0.7 * x)]).T
    field += g.normal(size=field.shape)
    return xr.Dataset(
        {
            "vector": (("time", "axis"), field),
            "scalar": ("time", np.linalg.norm(field, axis=1)),
            "battery_current": ("time", np.sin(np.linspace(0, 9, count)), {"units": "A"}),
            "tt2000": ("time", np.arange(count) * 10**9),
            "flag": ("time", np.zeros(count, np.uint32)),
        }
    )


def test_both_sensors_read_the_field_of_one_dipole():
    truth, model = samples_of(), model_of()
    raw = model.disturb(truth)
    # At the scalar sensor alone, the dipole's field along the field: its reading is of the true strength.
    source = DipoleSource(SOURCE, 0.1)
    current = truth["battery_current"].values[:, None]
    at_vector = current * [0.3, -0.2, 0.5]
    at_scalar = at_vector @ source.transfer([4.75, 0, 0], [6.5, 0, 0]).T
    along = truth["vector"].values / truth["scalar"].values[:, None]
    added = np.einsum("ta,ta->t", along, at_scalar)
    np.testing.assert_allclose(raw["scalar"] - truth["scalar"], added, atol=1e-9)
    assert np.abs(added).max() > 0.1
    back = model.correct(raw)
    np.testing.assert_allclose(back["vector"], truth["vector"], atol=1e-8)
    np.testing.assert_allclose(back["scalar"], truth["scalar"], atol=1e-8)
    terms = model.correction_terms(back)
    assert set(terms) == {"battery", "battery_ovm"}
    np.testing.assert_allclose(terms["battery"], at_vector, atol=1e-12)
    np.testing.assert_allclose(terms["battery_ovm"], added, atol=1e-9)


def test_on_the_booms_axis_the_shares_are_the_published_ones():
    split = dipole_split([1.0, 1.0, 1.0], 4.75, 6.5)
    ratio = DipoleSource((0, 0, 0), 0).transfer([4.75, 0, 0], [6.5, 0, 0])
    np.testing.assert_allclose(np.linalg.inv(np.eye(3) - ratio), split.factor[0] * np.eye(3), rtol=1e-12)
    assert split.factor[0] == pytest.approx(1.64, abs=0.001)


@pytest.mark.parametrize(("place", "factor"), [((-0.5, 0, 0), 1.73), ((0.5, 0, 0), 1.55)])
def test_a_source_half_a_metre_away_has_the_published_factors(place, factor):
    ratio = DipoleSource(place, 0).transfer([4.75, 0, 0], [6.5, 0, 0])
    assert 1 / (1 - ratio[0, 0]) == pytest.approx(factor, abs=0.005)


def test_the_column_is_the_change_of_the_residual():
    model = model_of()
    samples = model.disturb(samples_of())
    rows = rows_of(model, samples)
    corrected = model.correct(samples)
    design = DesignRows(corrected, rows.residual, rows.directions, {}, np.ones(samples.sizes["time"]))
    entry = model.effect("battery")
    columns = term_columns(term_of(entry, "battery"), design)
    step = entry.effect.parameters()["coefficient"].step
    for axis in range(3):
        moved = model.with_values({f"battery.coefficient[{'xyz'[axis]}]": [0.3, -0.2, 0.5][axis] + step})
        change = moved.residual(samples) - rows.residual
        assert np.abs(change).max() > 3e-3
        np.testing.assert_allclose(columns[:, :, axis], change, rtol=1e-3, atol=2e-5)


def test_the_error_of_the_place_is_the_scatter_over_places():
    """Told from what a source makes at either sensor, as if it stood at the stated place."""
    truth, sigma = np.array([0.3, -0.2, 0.5]), 0.2
    stated = model_of(f"dipole: {{position: [0, 0, 0], sigma: {sigma}}}")
    assumed = stated.effect("battery").transfers()["ovm"]
    places = sigma * np.random.default_rng(2).normal(size=(2000, 3))
    moved = [DipoleSource(tuple(place), 0).transfer([4.75, 0, 0], [6.5, 0, 0]) for place in places]
    told = np.array([np.linalg.solve(np.eye(3) - assumed, truth - one @ truth) for one in moved])
    samples = samples_of(2).assign(battery_current=("time", np.ones(2), {"units": "A"}))
    expected = np.sqrt(place_variance(stated.effects, samples)[0])
    np.testing.assert_allclose(np.sqrt(np.mean((told - truth) ** 2, axis=0)), expected, rtol=0.1)


@pytest.mark.parametrize("sensor", ["fgm", "ovm"])
def test_the_error_of_a_sensors_place_is_the_scatter_over_its_places(sensor):
    """Of two sources the errors add up, sign by sign: it is one sensor that stands elsewhere."""
    sigma, places = 0.1, {"fgm": np.array([4.75, 0.3, 0]), "ovm": np.array([6.5, 0, 0])}
    text = find_mission("champ").read_text(encoding="utf-8").replace("[4.75, 0, 0]", "[4.75, 0.3, 0]")
    place = f"position: {places[sensor].tolist()}".replace(".0,", ",").replace(".0]", "]")
    assert place in text
    known = Mission.parse(
        text.replace(place, place.replace("[", "{value: [").replace("]", f"], sigma: {sigma}}}"))
    )
    one = TEXT.format(dipole="dipole: {position: [0, 0, 0], sigma: 0}")
    two = one + one[one.index("  - effect: channel_field") :].replace("battery\n", "other\n")
    model, samples = Model.parse(two, known), samples_of(2)
    samples = samples.assign(battery_current=("time", np.ones(2), {"units": "A"}))
    field, source = 2 * np.array([0.3, -0.2, 0.5]), DipoleSource((0, 0, 0), 0)
    difference = field - source.transfer(*places.values()) @ field
    draws = sigma * np.random.default_rng(3).normal(size=(2000, 3))
    moved = [source.transfer(*{**places, sensor: places[sensor] + draw}.values()) for draw in draws]
    off = np.array([np.linalg.solve(np.eye(3) - transfer, difference) for transfer in moved]) - field
    stated = np.sqrt(place_variance(model.effects, samples)[0])
    np.testing.assert_allclose(stated, np.sqrt(np.mean(off**2, axis=0)), rtol=0.1)


def test_the_text_holds_it_and_gives_the_same_model():
    model = model_of()
    again = Model.parse(model.text, MISSION)
    assert again.sha == model.sha
    assert again.effect("battery").dipole == DipoleSource(SOURCE, 0.1)
    assert "dipole" not in model_of("").text


@pytest.mark.parametrize(
    ("dipole", "words"),
    [
        ("dipole: {sigma: -1}", "position: "),
        ("dipole: {position: [0, 0], sigma: 0.1}", "sigma: 0.2"),
        ("dipole: {position: [0, 0, 0]}", "sigma: 0.2"),
        ("dipole: yes", "sigma: 0.2"),
        ("dipole: {position: [4.75, 0, 0], sigma: 0.1}", "stands at the dipole"),
        ("dipole: {position: [5.625, 3.0, 0], sigma: 0.0}", "same field"),
    ],
)
def test_what_cannot_be_is_refused_with_what_to_write(dipole, words):
    with pytest.raises(ModelError) as caught:
        model_of(dipole)
    assert words in str(caught.value)


def test_without_positions_the_mission_file_is_named(tmp_path):
    instruments = MISSION.instruments
    nowhere = instruments["ovm"].model_copy(update={"position": None})
    mission = MISSION.model_copy(update={"instruments": {**instruments, "ovm": nowhere}})
    with pytest.raises(ModelError, match=r"does not say where ovm stands"):
        model_of(mission=mission)


def test_an_effect_that_follows_the_field_is_no_dipole_of_a_current():
    text = "effects:\n  - {effect: induced, sensor: ovm, dipole: {sigma: 0.1}}\n"
    with pytest.raises(ModelError, match="more than add a field"):
        Model.parse(text, MISSION)


def test_the_numbers_of_a_dipole_are_those_of_the_vector_sensor():
    text = TEXT.replace("name: battery\n    sensor: fgm", "name: battery\n    sensor: ovm")
    with pytest.raises(ModelError, match="name the vector sensor"):
        Model.parse(text.format(dipole="dipole: {sigma: 0.1}"), MISSION)
