"""Parameters whose values over time are a stored table: what is corrected, how sure, and what is refused."""

import numpy as np
import pytest
import xarray as xr

from inflight.catalog.workspace import find_mission
from inflight.errors import ModelError
from inflight.mission import Mission
from inflight.model import Model, table_variance
from inflight.time import DAY, SECOND

MISSION = Mission.parse(find_mission("champ").read_text(encoding="utf-8"))
NAME = "main-z-offset:0123456789ab"
OFFSET = f"""
effects:
  - {{effect: remanent, name: z_offset, sensor: fgm, vector: {{time: table, table: "{NAME}"}}}}
"""
MOMENT = """
effects:
  - effect: remanent_moment
    sensor: fgm
    dipole: {position: [-1.1, 0, 0], sigma: 0.0}
    eta: {unit: nT/A, value: 15.0, sigma: 3.0}
    current: {time: table, table: "main-torquer-mean:0123456789ab"}
"""


def table(values, sigma, dim="parameter", names=("offset_from_spread[z]",), unit="nT"):
    """A table of one interval a day from 0; values of shape (interval, name)."""
    start, each = np.arange(len(values)) * DAY, ("interval", dim)
    return xr.Dataset(
        {
            "value": (each, np.asarray(values, dtype=float), {"units": unit}),
            "sigma": (each, np.full(np.shape(values), sigma)),
            "start": ("interval", start),
            "end": ("interval", start + DAY),
        },
        coords={dim: list(names)},
    )


def currents(values, sigma, unit="A"):
    return table(values, sigma, "axis", ("x", "y", "z"), unit)


def samples_at(*days):
    stamps = np.array([int((day + 0.5) * DAY) for day in days]) + np.arange(len(days)) * SECOND
    field = np.tile([2e4, 1e4, -3e4], (len(days), 1))
    return xr.Dataset(
        {
            "vector": (("time", "axis"), field),
            "scalar": ("time", np.linalg.norm(field, axis=1)),
            "tt2000": ("time", stamps),
        }
    )


def bound(text, found):
    return Model.parse(text, MISSION).with_tables(lambda name: found)


def test_each_day_has_its_value_along_the_axis_that_the_table_has():
    model = bound(OFFSET, table([[0.5], [-1.0], [2.0]], 0.1))
    samples = samples_at(0, 1, 2)
    off = samples["vector"].values - model.correct(samples)["vector"].values
    np.testing.assert_allclose(off, [[0, 0, 0.5], [0, 0, -1.0], [0, 0, 2.0]], atol=1e-9)
    np.testing.assert_allclose(
        model.disturb(model.correct(samples))["vector"].values, samples["vector"].values, atol=1e-9
    )
    np.testing.assert_allclose(table_variance(model.effects, samples), np.tile([0, 0, 0.01], (3, 1)))


def test_beyond_the_table_the_nearest_value_is_held_and_less_sure():
    timed = bound(OFFSET, table([[0.5], [-1.0], [2.0]], 0.1)).effect("z_offset").parameters["vector"]
    inside, after, before = (int(day * DAY) for day in (1.5, 40.0, -3.0))
    assert timed.at(after)[2] == 2.0
    assert timed.at(before)[2] == 0.5
    assert not timed.is_held_at(inside)
    assert timed.is_held_at(after)
    assert timed.sigma_at(inside)[2] == pytest.approx(0.1)
    assert timed.sigma_at(after)[2] == pytest.approx(np.hypot(0.1, np.sqrt(2) * np.std([0.5, -1, 2])))


def test_the_body_is_seen_by_both_sensors_and_eta_and_current_make_it_unsure():
    # A table in mA: the parameter is in A.
    model = bound(MOMENT, currents([[1.0, -40.0, 20.0]], 2.0, "mA"))
    samples = samples_at(0)
    corrected = model.correct(samples)
    np.testing.assert_allclose(
        samples["vector"].values - corrected["vector"].values, [[0, -0.6, 0.3]], atol=1e-9
    )
    # Farther by 7.6 to 5.85 m, a dipole's field across its direction is smaller by the cube.
    direction = corrected["vector"].values[0] / np.linalg.norm(corrected["vector"].values[0])
    seen = direction @ np.array([0, -0.6, 0.3]) * (5.85 / 7.6) ** 3
    assert float(samples["scalar"][0] - corrected["scalar"][0]) == pytest.approx(seen, rel=1e-9)
    sure = [0.0, (15 * 0.002) ** 2 + (3 * 0.04) ** 2, (15 * 0.002) ** 2 + (3 * 0.02) ** 2]
    np.testing.assert_allclose(table_variance(model.effects, samples), [sure], rtol=1e-9)


def test_the_text_names_the_table_and_no_values():
    model = bound(OFFSET, table([[0.5]], 0.1))
    assert NAME in model.text
    assert Model.parse(model.text, MISSION).sha == model.sha
    assert model.columns == []


def test_what_is_missing_or_of_another_kind_is_said():
    with pytest.raises(ModelError, match="not there") as missing:
        Model.parse(OFFSET, MISSION).correct(samples_at(0))
    assert "inflight set z_offset.vector=main-z-offset" in str(missing.value.remedy)
    with pytest.raises(ModelError, match="has no values for 'z_offset"):
        bound(OFFSET, table([[0.5]], 0.1, unit="s"))
    with pytest.raises(ModelError, match="names none"):
        Model.parse(OFFSET.replace(f', table: "{NAME}"', ""), MISSION)
    with pytest.raises(ModelError, match="a value of its own"):
        Model.parse(OFFSET.replace("time: table,", "time: table, value: [0, 0, 1],"), MISSION)


def test_torquers_taken_off_without_the_body_are_told():
    torquer = "  - {effect: torquer, sensor: ovm, channel: torquer_current}\n"
    told = Model.parse("effects:\n" + torquer, MISSION).torquers_alone
    assert "inflight add remanent_moment" in told
    assert Model.parse(MOMENT + torquer, MISSION).torquers_alone == ""
    # Without a place the body is told as a difference, as a current is.
    difference = MOMENT.replace("dipole: {position: [-1.1, 0, 0], sigma: 0.0}", "")
    assert "remanent_moment.dipole=" in Model.parse(difference, MISSION).told_by_difference
    assert Model.parse(MOMENT, MISSION).told_by_difference == ""
