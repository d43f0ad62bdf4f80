"""What single effects of the library mean: units of coefficients, shapes in time, families, candidates."""

import numpy as np
import pytest
from effect_cases import MISSION, SENSORS, model_of, true_samples
from numpy.testing import assert_allclose

from inflight.effects import Effect, Parameter, family_of, known_effects, with_field
from inflight.effects.families import FAMILIES
from inflight.errors import ModelError, SamplesError
from inflight.mission import Mission
from inflight.model import Model, make_effect
from inflight.time import SECOND, to_tt2000


def added(entry, samples=None, mission=None):
    """What one effect adds to the vector reading, (time, axis) nT."""
    truth = true_samples(0) if samples is None else samples
    made = make_effect({"sensor": "fgm", **entry}, SENSORS, mission=mission)
    full = with_field(truth, truth["vector"].values)
    return made.effect.field(full, made.values(truth["tt2000"].values), made.sensor)


SOLAR = {"effect": "channel_field", "channel": "solar_current"}


@pytest.mark.parametrize("mission", [None, MISSION])
def test_a_coefficient_counts_in_the_unit_it_is_stated_in(mission):
    current = true_samples(0)["solar_current"].values
    for unit, factor in [("nT", 1.0), ("nT/mA", 1.0), ("nT/A", 1e-3), ("pT/A", 1e-6)]:
        field = added({**SOLAR, "coefficient": {"unit": unit, "value": [1, -2, 3]}}, mission=mission)
        assert_allclose(field, factor * current[:, None] * [1, -2, 3], rtol=1e-12)


def test_a_coefficient_without_unit_gets_the_channels_own():
    made = make_effect({**SOLAR, "coefficient": [1, 2, 3]}, SENSORS, mission=MISSION)
    assert made.as_yaml()["coefficient"]["unit"] == "nT/mA"
    power = make_effect({"effect": "channel_power", "channel": "coil_temperature"}, SENSORS, mission=MISSION)
    assert power.as_yaml()["coefficient"]["unit"] == "nT/K^2"
    both = make_effect({**SOLAR, "channel": "sunlit*solar_current"}, SENSORS, mission=MISSION)
    assert both.as_yaml()["coefficient"]["unit"] == "nT/mA"


def test_a_stated_coefficient_survives_a_channel_that_comes_in_another_unit():
    entry = {**SOLAR, "coefficient": {"unit": "nT/A", "value": [1, 1, 1]}}
    truth = true_samples(0)
    in_amperes = truth.assign(solar_current=("time", truth["solar_current"].values / 1000, {"units": "A"}))
    assert_allclose(added(entry, truth), added(entry, in_amperes), rtol=1e-12)


def test_degrees_of_a_coefficient_are_differences():
    entry = {"effect": "channel_field", "channel": "coil_temperature"}
    field = [
        added({**entry, "coefficient": {"unit": unit, "value": [1, 1, 1]}})
        for unit in ("nT/K", "nT/degC", "nT")
    ]
    assert_allclose(field[0], field[2])
    assert_allclose(field[1], field[2])


def test_a_unit_that_does_not_fit_the_channel_is_refused_with_one_that_does():
    entry = {**SOLAR, "coefficient": {"unit": "nT/K", "value": [1, 1, 1]}}
    with pytest.raises(ModelError, match=r"nT/K times mA is not nT; give it in nT/mA"):
        make_effect(entry, SENSORS, mission=MISSION)
    with pytest.raises(SamplesError, match=r"solar_current.*nT/K times mA is not nT"):
        added(entry)


def test_lag_and_width_name_the_derived_channel():
    lagged = make_effect({**SOLAR, "lag": "10 min"}, SENSORS).effect
    assert lagged.channels == ("solar_current@lag=600s",)
    assert lagged.given == {"channel": "solar_current", "lag": "10 min"}
    play = make_effect({"effect": "hysteresis", "channel": "coil_temperature", "width": 2}, SENSORS).effect
    assert play.channels == ("coil_temperature", "coil_temperature@width=2")


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ({"effect": "channel_feild"}, "did you mean 'channel_field'"),
        ({**SOLAR, "coeficient": [1, 2, 3]}, "did you mean 'coefficient'"),
        ({**SOLAR, "lagg": "10 s"}, "did you mean 'lag'"),
        ({**SOLAR, "lag": "soon"}, "lag: 'soon' is no duration"),
        ({"effect": "channel_field"}, "needs the option 'channel'"),
        ({"effect": "hysteresis", "width": 2}, "needs the option 'channel'"),
        ({"effect": "remanent", "channel": "coil_temperature"}, "no option and no parameter 'channel'"),
        ({"effect": "tone", "period": "0 s"}, "above 0"),
        ({"effect": "offset_step"}, "needs the option 'at'"),
        ({"effect": "offset_step", "at": "one day"}, "'offset_step': at"),
        ({"effect": "offset_episode", "from": "2004-02-01", "to": "2004-01-01"}, "ends before it begins"),
        ({"effect": "orbit_periodic", "order": 0}, "whole number from 1"),
        ({"effect": "function_of_channel", "channel": "coil_temperature", "knots": [3, 1]}, "rising numbers"),
        ({"effect": "solar_array"}, "needs the option 'since'"),
        ({"effect": "solar_array", "since": "2004-01-01", "areas": [1, 2]}, "areas and no normals"),
        ({"effect": "solar_array", "normals": [[1, 0, 0], [0, 1, 0]], "areas": [1]}, "for 2 panels"),
        ({"effect": "solar_array", "normals": [[1, 0, 0], [0, 1, 0]], "areas": [1, -2]}, "0 or more"),
        ({"effect": "solar_array", "normals": [[1, 0, 0], [0, 1, 0]], "areas": "large"}, "one number"),
        ({"effect": "time_shift", "sensor": "fgm"}, "acts on a scalar sensor, 'fgm' is a vector one"),
        ({"effect": "temperature", "sensor": "ovm"}, "'ovm' is a scalar one"),
        ({"effect": "heading", "sensor": "ovn"}, "did you mean 'ovm'"),
    ],
)
def test_what_is_misspelt_or_missing_is_told_with_a_remedy(entry, told):
    with pytest.raises(ModelError, match=told) as caught:
        make_effect(entry, SENSORS, mission=MISSION)
    assert caught.value.remedy


def test_an_effect_that_acts_on_one_kind_of_sensor_finds_it():
    assert make_effect({"effect": "time_shift"}, SENSORS).sensor.name == "ovm"
    assert make_effect({"effect": "offset_step", "at": "2004-01-01"}, SENSORS).sensor.name == "fgm"


def test_a_hysteresis_without_width_may_be_searched_for_but_not_modelled():
    entry = {"effect": "hysteresis", "sensor": "fgm", "channel": "coil_temperature"}
    assert make_effect(entry, SENSORS).effect.channels == ("coil_temperature",)
    with pytest.raises(ModelError, match="needs the option 'width'"):
        added(entry)
    text = "model: m\neffects:\n  - {effect: hysteresis, sensor: fgm, channel: coil_temperature}\n"
    with pytest.raises(ModelError, match=r"effect 1: effect 'hysteresis' needs the option 'width'"):
        Model.parse(text, MISSION)


def at_times(*utc):
    stamps = to_tt2000(np.array(utc, dtype="datetime64[ns]"))
    truth = true_samples(0, len(utc))
    return truth.assign(tt2000=("time", stamps))


def test_the_solar_panels_take_turns_as_the_thesis_says():
    """Quarters of 65.125 days from local time 9 h: A2, mix with rising angle, A1, mix with falling."""
    first, second = np.array([0.02, 0.01, -0.01]), np.array([-0.01, 0.01, 0.02])
    days = [10.0, 65.125 * 1.5, 65.125 * 2.5, 65.125 * 3.25, 260.5 + 10.0]
    start = np.datetime64("2004-01-01T00:00:00", "ns")
    samples = at_times(*[start + np.timedelta64(round(86_400e3 * day), "ms") for day in days])
    samples["solar_current"] = ("time", np.full(len(days), 10.5), {"units": "A"})
    entry = {"effect": "solar_array", "since": "2004-01-01", "panels": [*first, *second]}
    th = np.deg2rad(90 - 22.5)
    mix = (first * np.sin(th) + second * np.cos(th)) / (np.sin(th) + np.cos(th))
    expected = [second, (first + second) / 2, first, mix, second]
    assert_allclose(added(entry, samples), 10.5 * np.array(expected), atol=1e-9)


def test_panels_that_the_sun_does_not_reach_make_no_field():
    truth = true_samples(0)
    entry = {"effect": "solar_array", "normals": [[0, 0, -1], [0, -1, -1]], "panels": [1, 1, 1, 2, 2, 2]}
    up = np.tile([0.0, 0.0, 1.0], (truth.sizes["time"], 1))
    dark = added(entry, truth.assign(sun_direction=(("time", "axis"), up, {"units": "1"})))
    lit = added(entry, truth.assign(sun_direction=(("time", "axis"), -up, {"units": "1"})))
    assert (dark == 0).all()
    assert np.isfinite(lit).all()
    assert np.abs(lit).max() > 1


def test_panels_share_the_current_by_area_times_cosine():
    truth = true_samples(0)
    count = truth.sizes["time"]
    sun = np.tile(np.array([0.6, 0.0, -0.8]), (count, 1))
    samples = truth.assign(
        sun_direction=(("time", "axis"), sun, {"units": "1"}),
        solar_current=("time", np.full(count, 2.0), {"units": "A"}),
    )
    entry = {"effect": "solar_array", "normals": [[0, 0, -1], [1, 0, 0], [0, 1, 0]]}
    panels = [1, 0, 0, 0, 1, 0, 0, 0, 1]
    alike, unlike, equal = (
        added(entry | areas | {"panels": panels}, samples)[0]
        for areas in ({}, {"areas": [1, 4, 9]}, {"areas": [7.0, 7.0, 7.0]})
    )
    assert_allclose(alike, [2 * 0.8 / 1.4, 2 * 0.6 / 1.4, 0], atol=1e-9)
    assert_allclose(unlike, [2 * 0.8 / 3.2, 2 * 2.4 / 3.2, 0], atol=1e-9)
    assert_allclose(equal, alike, atol=1e-12)


def test_a_step_begins_at_its_moment_and_an_episode_ends_before_its_end():
    samples = at_times(*(f"2004-05-01T00:0{minute}:00" for minute in range(5)))
    span = {"from": "2004-05-01T00:01:00Z", "to": "2004-05-01T00:03:00Z"}
    step = added({"effect": "offset_step", "at": "2004-05-01T00:02:00Z", "vector": [1, 2, 3]}, samples)
    episode = added({"effect": "offset_episode", **span, "vector": [1, 2, 3]}, samples)
    assert step[:, 0].tolist() == [0, 0, 1, 1, 1]
    assert episode[:, 2].tolist() == [0, 3, 3, 0, 0]


def test_a_clock_episode_shifts_within_its_span_only():
    truth = true_samples(0)
    span = {"from": "2004-05-01T00:01:00Z", "to": "2004-05-01T00:03:00Z"}
    model = model_of({"effect": "clock_episode", "sensor": "ovm", "seconds": 0.012, **span})
    whole = model_of({"effect": "time_shift", "sensor": "ovm", "seconds": 0.012})
    moved, everywhere = (one.disturb(truth)["scalar"].values for one in (model, whole))
    inside = (np.arange(400) >= 60) & (np.arange(400) < 180)
    assert (moved[~inside] == truth["scalar"].values[~inside]).all()
    assert (moved[inside] == everywhere[inside]).all()


@pytest.mark.parametrize(
    ("kind", "name", "change"), [("angle", "misalignment", 0.002), ("scale", "scale_factor", 2e-5)]
)
def test_a_step_of_the_sensors_own_parameters_is_the_equation_with_others_from_then(kind, name, change):
    truth = true_samples(0)
    nine = {
        "misalignment": [90.0, 90.0, 90.0],
        "scale_factor": [1.0, 1.0, 1.0],
        "offset": [20.0, -30.0, 10.0],
    }
    moved = {**nine, name: [value + change * (1 + axis) for axis, value in enumerate(nine[name])]}
    step = {"sensor": "fgm", "change": [change, 2 * change, 3 * change], "about": nine["offset"]}
    span = {"from": "2004-05-01T00:03:20Z", "to": "2004-05-01T00:05:00Z"}
    before, after, stepped, passing = (
        model_of(*entries).disturb(truth)["vector"].values
        for entries in (
            [{"effect": "vector_sensor", "sensor": "fgm", **nine}],
            [{"effect": "vector_sensor", "sensor": "fgm", **moved}],
            [
                {"effect": f"{kind}_step", "at": span["from"], **step},
                {"effect": "vector_sensor", "sensor": "fgm", **nine},
            ],
            [
                {"effect": f"{kind}_episode", **span, **step},
                {"effect": "vector_sensor", "sensor": "fgm", **nine},
            ],
        )
    )
    assert np.abs(after - before).max() > 0.5
    assert (stepped[:200] == before[:200]).all()
    assert np.abs(stepped[200:] - after[200:]).max() < 1e-3
    assert (passing[:300] == stepped[:300]).all()
    assert (passing[300:] == before[300:]).all()


def test_a_tone_runs_on_over_years():
    period = 37.3
    late = true_samples(0).assign(tt2000=true_samples(0)["tt2000"] + 373 * 10**6 * SECOND)
    entry = {"effect": "tone", "period": "37.3 s", "amplitude": [1, 2, 3, 4, 5, 6]}
    assert_allclose(added(entry, late), added(entry), atol=1e-6)
    t = true_samples(0)["tt2000"].values / SECOND % period * 2 * np.pi / period
    assert_allclose(added(entry)[:, 0], np.cos(t) + 4 * np.sin(t), atol=1e-6)


def test_a_series_names_its_amplitudes_by_part_axis_and_order():
    made = make_effect({"effect": "sun_periodic", "order": 1}, SENSORS)
    assert made.effect.parameters()["amplitude"].axes == ("cx1", "cy1", "cz1", "sx1", "sy1", "sz1")
    truth = true_samples(0)
    phase = np.deg2rad(truth["sun_phase"].values)
    field = added({"effect": "sun_periodic", "order": 1, "amplitude": [1, 0, 0, 0, 0, 2]})
    assert_allclose(field, np.stack([np.cos(phase), 0 * phase, 2 * np.sin(phase)], axis=1), atol=1e-12)


def test_a_function_of_a_channel_goes_through_its_knots_and_is_held_beyond():
    truth = true_samples(0, 4).assign(solar_current=("time", [-5.0, 0.0, 10.0, 99.0], {"units": "mA"}))
    entry = {"effect": "function_of_channel", "channel": "solar_current", "knots": [0, 5, 10]}
    field = added({**entry, "value": [1, 0, 0, 2, 0, 0, 7, 0, 3]}, truth)
    assert_allclose(field, [[1, 0, 0], [1, 0, 0], [7, 0, 3], [7, 0, 3]], atol=1e-12)


def test_a_response_curve_deviates_between_its_outer_knots_and_nowhere_else():
    made = make_effect(
        {"effect": "response_curve", "knots": [-30e3, 0, 10e3, 30e3], "value": [1, 2, 3, 4, 5, 6]}, SENSORS
    )
    reading = np.array([[0.0, -15e3, 20e3], [10e3, -40e3, 99e3]])
    truth = true_samples(0, 2)
    values = made.values(truth["tt2000"].values)
    linear = made.effect.correct(reading, truth, values, made.sensor)
    assert_allclose(linear - reading, [[1, 1, 3], [4, 0, 0]], atol=1e-9)
    assert_allclose(made.effect.disturb(linear, truth, values, made.sensor), reading, atol=1e-9)
    with pytest.raises(ModelError, match="no inner one"):
        make_effect({"effect": "response_curve", "knots": [0, 1]}, SENSORS)


def test_the_sun_makes_no_thermo_electric_field_in_the_shadow():
    truth = true_samples(0)
    field = added({"effect": "sun_direction_field", "degree": 2, "amplitude": list(range(1, 25))})
    lit = truth["sunlit"].values > 0
    assert (field[~lit] == 0).all()
    assert (np.abs(field[lit]) > 0).any()


def test_every_effect_belongs_to_a_known_family():
    for label, kind in known_effects().items():
        assert kind.family in FAMILIES, label


@pytest.mark.parametrize(
    ("channel", "family"),
    [
        ("solar_current", "solar"),
        ("coil_temperature", "temperature"),
        ("coil_temperature@lag=600s", "temperature"),
        ("coil_temperature@width=2", "hysteresis"),
        ("sunlit", "day_night"),
        ("nobody_knows", "current"),
    ],
)
def test_the_kind_of_a_channel_decides_the_family(channel, family):
    made = make_effect({"effect": "channel_field", "channel": channel}, SENSORS, mission=MISSION)
    assert made.effect.family == family_of(made.effect, MISSION) == family


NAMELESS = Mission.parse(
    """\
mission: nameless
periods: {orbit: 5580 s}
instruments:
  v:
    role: vector
    cadence: 1 s
    files: {pattern: "v_{day:%Y%m%d}.nc", reader: netcdf, time: t}
    channels: {field: {variable: b, unit: nT, axes: [x, y, z]}}
  f:
    role: scalar
    cadence: 1 s
    files: {same_as: v}
    channels: {field: {variable: f, unit: nT}}
  h:
    role: housekeeping
    cadence: 10 s
    files: {same_as: v}
    channels:
      hk_001: {variable: a, unit: mA, range: [0, 10]}
      hk_002: {variable: b, unit: degC, kind: temperature}
      coils: {variables: [p, q, r], unit: mA, kind: torquer_current}
      hk_003: {variables: [p, q, r], unit: V}
comparisons: {main: {kind: scalar, vector: v, scalar: f}}
events: [{at: 2004-05-01T10:00:00Z, name: one, kind: reset}]
"""
)


def test_candidates_come_from_what_the_mission_has():
    found = {label: kind.candidates(NAMELESS) for label, kind in known_effects().items()}
    assert found["channel_field"] == [{"channel": "hk_001"}, {"channel": "hk_002"}]
    assert found["temperature"] == [{"channel": "hk_002"}]
    assert found["torquer"] == [{"channel": "coils"}]
    assert found["channel_matrix"] == [{"channel": "hk_003"}]
    assert found["tone"] == [{"period": "5580 s"}]
    assert found["offset_step"] == [{"at": "2004-05-01T10:00:00.000000000Z"}]
    assert found["function_of_channel"] == [{"channel": "hk_001", "knots": [0.0, 2.5, 5.0, 7.5, 10.0]}]
    assert found["orbit_periodic"] == found["day_night"] == found["sun_direction_field"] == []
    assert found["eddy"] == [{}]


@pytest.mark.parametrize("label", sorted(known_effects()))
def test_every_candidate_can_be_made(label):
    """Without a width, too, which a search adds: it depends on the data."""
    for options in known_effects()[label].candidates(MISSION):
        made = make_effect({"effect": label, **options}, SENSORS, mission=MISSION)
        assert made.effect.family in FAMILIES


def test_options_decide_how_many_numbers_an_effect_has():
    """The class tells those of its default options, so that a search knows what it gets."""
    kind = known_effects()["day_night_series"]
    assert kind.parameters()["amplitude"].size == kind().parameters()["amplitude"].size == 12
    assert kind(order=1).parameters()["amplitude"].size == 3
    assert kind.parameters()["amplitude"].size == 12


class Own(Effect):
    """An effect of a notebook."""

    gain = Parameter("nT", ("x",))

    def field(self, samples, values, sensor):
        return np.zeros((samples.sizes["time"], 3))


def test_an_effect_without_channels_takes_no_channel():
    with pytest.raises(ModelError, match="no option and no parameter 'channel'"):
        Own(channel="solar_current")
