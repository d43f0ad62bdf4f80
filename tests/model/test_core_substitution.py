"""Stand-ins for missing channels: the field is there, wrong by what its uncertainty says, and flagged."""

import numpy as np
import pytest
import xarray as xr
from effect_cases import entry_of, model_of, true_samples

from inflight.calibration import level2
from inflight.calibration.product import DayParameters
from inflight.effects import Effect, Parameter
from inflight.flags import Flag
from inflight.model import Model, SubstitutedSamples, TypicalValue, substitute
from inflight.time import SECOND

#: Nothing but the stand-ins makes these products uncertain.
SURE = DayParameters(np.array([1.0, 1, 1, 90, 90, 90, 0, 0, 0]), np.zeros((9, 9)), True, 0.0)
MISSING = slice(100, 180)


def model_with(*names: str, seed: int = 0) -> Model:
    entries = [entry_of(name, np.random.default_rng([seed, place])) for place, name in enumerate(names)]
    nine = {"effect": "vector_sensor", "sensor": "fgm", "offset": {"time": "block", "value": [0.0, 0, 0]}}
    changing = [entry for entry in entries if entry["effect"] in ("temperature", "channel_scale")]
    return model_of(*changing, nine, *[entry for entry in entries if entry not in changing])


def without(samples: xr.Dataset, *channels: str, rows: slice = MISSING) -> xr.Dataset:
    out = samples
    for name in channels:
        values = samples[name].values.copy()
        values[rows] = np.nan
        out = out.assign({name: samples[name].copy(data=values)})
    return out


def typical_of(samples: xr.Dataset, *channels: str) -> dict[str, TypicalValue]:
    values = {name: samples[name].values for name in channels}
    return TypicalValue.of(values, samples["tt2000"].values, "the day")


def product_of(model: Model, stand: SubstitutedSamples | None, samples: xr.Dataset) -> xr.Dataset:
    if stand is None:
        return level2(model, samples, SURE, model)
    used = stand.model(model)
    return level2(used, stand.samples, SURE, used, stand.variance(model)[0])


@pytest.mark.parametrize(
    ("name", "channel"),
    [
        ("torquer", "torquer_current"),
        ("temperature", "coil_temperature"),
        ("channel_field", "solar_current"),
        ("channel_power", "coil_temperature"),
        ("channel_scale", "coil_temperature"),
        ("function_of_channel", "coil_temperature"),
    ],
)
def test_the_error_of_a_stand_in_is_of_the_stated_size(name, channel):
    squares = []
    for seed in range(12):
        truth = true_samples(seed)
        model = model_with(name, seed=seed)
        holed = without(model.disturb(truth), channel)
        product = product_of(model, substitute(model, holed, typical_of(holed, channel)), holed)
        error = product["field_sensor"].values - truth["vector"].values
        sigma = product["uncertainty"].values
        assert np.abs(np.delete(error, np.arange(400)[MISSING], axis=0)).max() < 1e-7
        assert (np.delete(sigma, np.arange(400)[MISSING], axis=0) == 0).all()
        assert (sigma[MISSING] > 0).all()
        squares.append(np.mean(error[MISSING] ** 2) / np.mean(sigma[MISSING] ** 2))
    assert 0.5 < np.sqrt(np.mean(squares)) < 1.5


def test_an_effect_of_a_rate_is_uncertain_by_how_fast_its_channel_changes():
    truth = true_samples(0)
    wave = 15 + 8 * np.sin(np.arange(400) / 20.0)
    truth = truth.assign(coil_temperature=truth["coil_temperature"].copy(data=wave))
    model = model_with("channel_rate")
    holed = without(model.disturb(truth), "coil_temperature", rows=slice(100, 226))
    product = product_of(model, substitute(model, holed, typical_of(holed, "coil_temperature")), holed)
    error = (product["field_sensor"].values - truth["vector"].values)[105:220]
    sigma = product["uncertainty"].values[105:220]
    assert np.sqrt(np.mean(error**2, axis=0) / np.mean(sigma**2, axis=0)) == pytest.approx(1.0, abs=0.15)


def test_what_was_not_missing_is_not_touched_and_what_was_is_flagged():
    model = model_with("temperature", "torquer", "time_shift", "oscillator")
    samples = model.disturb(true_samples(1))
    whole = product_of(model, None, samples)
    holed = without(samples, "torquer_current")
    product = product_of(model, substitute(model, holed, typical_of(holed, "torquer_current")), holed)
    rows = np.zeros(400, dtype=bool)
    rows[MISSING] = True
    assert ((product["flag"].values & np.uint32(Flag.CHANNEL_MISSING) != 0) == rows).all()
    # The rate of the field, which moves the scalar reading, is made from neighbours.
    far = np.convolve(rows, np.ones(5), mode="same") == 0
    for name in set(whole.data_vars) - {"flag"}:
        assert np.array_equal(product[name].values[far], whole[name].values[far], equal_nan=True), name
    assert np.isfinite(product["field_sensor"].values).all()
    assert np.isfinite(product["scalar"].values).all()


def test_nothing_missing_means_nothing_is_done():
    model = model_with("torquer")
    samples = model.disturb(true_samples(0))
    assert substitute(model, samples, typical_of(samples, "torquer_current")) is None
    assert substitute(model, without(samples, "solar_current"), {}) is None, "no effect uses it"


def test_a_channel_is_not_missed_where_there_is_no_reading():
    model = model_with("torquer", "oscillator")
    samples = without(model.disturb(true_samples(0)), "frequency_ratio", "scalar")
    assert substitute(model, samples, {}) is None
    also = without(samples, "torquer_current")
    stand = substitute(model, also, typical_of(also, "torquer_current"))
    assert stand is not None
    assert set(stand.rows) == {"torquer_current"}


def test_only_the_missing_component_of_a_channel_is_replaced():
    model = model_with("torquer")
    samples = model.disturb(true_samples(0))
    values = samples["torquer_current"].values.copy()
    values[MISSING, 2] = np.nan
    holed = samples.assign(torquer_current=samples["torquer_current"].copy(data=values))
    stand = substitute(model, holed, typical_of(holed, "torquer_current"))
    assert stand is not None
    filled = stand.samples["torquer_current"].values
    assert np.array_equal(filled[:, :2], values[:, :2])
    assert np.allclose(filled[MISSING, 2], np.nanmean(values[:, 2]), rtol=0.2, atol=20)
    matrix = np.reshape(next(e for e in model.effects if e.name == "torquer").values(0)["matrix"], (3, 3))
    expected = np.abs(matrix[:, 2]) * np.nanstd(values[:, 2]) / 1000
    assert np.sqrt(stand.variance(model)[0][140]) == pytest.approx(expected, rel=0.15)


def test_an_effect_of_which_nothing_is_known_is_left_out_and_its_size_said_to_be_unknown():
    model = model_with("channel_field")
    truth = true_samples(0)
    holed = without(model.disturb(truth), "solar_current", rows=slice(0, 400))
    stand = substitute(model, holed, {})
    assert stand is not None
    product = product_of(model, stand, holed)
    assert (product["correction_channel_field"].values == 0).all()
    assert np.isfinite(product["field_sensor"].values).all()
    assert np.isnan(product["uncertainty"].values).all()
    told = stand.by_effect(model)["channel_field"]
    assert (told.samples, told.channels, told.instead) == (400, ("solar_current",), "left out")


def test_a_possible_range_bounds_an_effect_that_is_left_out():
    model = model_with("channel_field")
    truth = true_samples(0)
    holed = without(model.disturb(truth), "solar_current", rows=slice(0, 400))
    stand = substitute(model, holed, {}, {"solar_current": (0.0, 10_000.0)})
    product = product_of(model, stand, holed)
    error = product["field_sensor"].values - truth["vector"].values
    ratio = np.sqrt(np.mean(error**2, axis=0)) / product["uncertainty"].values[0]
    assert ratio == pytest.approx(1.0, abs=0.1), "the channel was spread evenly over its range"


@pytest.mark.parametrize(
    ("name", "channel"),
    [("day_night", "sunlit"), ("orbit_periodic", "orbit_phase"), ("sun_direction_field", "sun_direction")],
)
def test_without_a_position_what_the_orbit_tells_is_left_out_within_its_possible_size(name, channel):
    model = model_with(name)
    truth = true_samples(0)
    holed = without(model.disturb(truth), channel, rows=slice(0, 400))
    product = product_of(model, substitute(model, holed, {}), holed)
    error = product["field_sensor"].values - truth["vector"].values
    assert (np.sqrt(np.mean(error**2, axis=0)) < 1.3 * product["uncertainty"].values[0]).all()
    assert (np.sqrt(np.mean(error**2, axis=0)) > 0.4 * product["uncertainty"].values[0]).all()


def test_a_channel_of_the_scalar_sensor_does_not_make_the_vector_uncertain():
    model = model_with("oscillator", "channel_matrix")
    truth = true_samples(0)
    holed = without(model.disturb(truth), "frequency_ratio", "torquer_current")
    for typical in (typical_of(holed, "frequency_ratio", "torquer_current"), {}):
        stand = substitute(model, holed, typical)
        assert stand is not None
        vector, scalar = stand.variance(model)
        assert (vector == 0).all()
        assert np.isnan(scalar[MISSING]).all() if not typical else (scalar[MISSING] > 0).all()
        product = product_of(model, stand, holed)
        assert np.abs(product["field_sensor"].values - truth["vector"].values).max() < 1e-7
    error = (stand.model(model).correct(stand.samples)["scalar"] - truth["scalar"]).values
    assert np.abs(error[MISSING]).max() > 1e-3


class Stray(Effect):
    """A field that is the product of two channels."""

    channels = ("solar_current*coil_temperature",)
    coefficient = Parameter("nT", ("x", "y", "z"), per_channel=1)

    def field(self, samples, values, sensor):
        return samples[self.channels[0]].values[:, None] * values["coefficient"]


def test_of_a_product_only_the_missing_factor_is_replaced():
    truth = true_samples(0)
    whole = truth["solar_current"] * truth["coil_temperature"]
    name = "solar_current*coil_temperature"
    truth = truth.assign({name: ("time", whole.values, {"units": "mA*degC"})})
    model = model_with("channel_field")
    entry = next(one for one in model.effects if one.name == "channel_field")
    timed = {"coefficient": entry.parameters["coefficient"]}
    object.__setattr__(entry, "effect", Stray("stray"))
    object.__setattr__(entry, "parameters", timed)
    disturbed = model.disturb(truth)
    holed = without(disturbed, "coil_temperature", name)
    stand = substitute(model, holed, typical_of(holed, "coil_temperature"))
    assert stand is not None
    assert set(stand.rows) == {"coil_temperature"}
    mean = stand.typical["coil_temperature"].mean[0]
    expected = truth["solar_current"].values[MISSING] * mean
    assert np.allclose(stand.samples[name].values[MISSING], expected)
    error = (stand.model(model).correct(stand.samples)["field"] - truth["vector"]).values
    sigma = np.sqrt(stand.variance(model)[0])
    assert np.sqrt(np.mean((error[MISSING] / sigma[MISSING]) ** 2)) == pytest.approx(1.0, abs=0.25)


def test_a_typical_value_needs_two_readings_and_keeps_components_together():
    stamps = SECOND * np.arange(500, dtype=np.int64)
    assert TypicalValue.of({"one": np.array([1.0, np.nan])}, stamps[:2], "") == {}
    wave = np.sin(0.1 * np.arange(500))
    found = TypicalValue.of({"one": np.stack([wave, -2 * wave, 0 * wave], axis=1)}, stamps, "the day")["one"]
    assert found.modes.shape == (1, 3)
    assert np.abs(found.modes[0]) == pytest.approx([wave.std(), 2 * wave.std(), 0.0], abs=1e-9)
    assert found.rates == pytest.approx([0.1], rel=0.01)


def test_channels_of_one_delivery_deviate_together_in_value_and_in_rate():
    """Their modes sum to the covariances of the readings, and with their rates to those of the changes."""
    stamps, time = SECOND * np.arange(5000, dtype=np.int64), np.arange(5000.0)
    slow, fast = np.sin(0.01 * time), np.sin(0.1 * time)
    series = {"bus": 3 * slow + fast, "heater": 50 * fast, "load": np.stack([slow, slow - fast], axis=1)}
    found = TypicalValue.of(series, stamps, "the day")
    modes = np.concatenate([found[name].modes for name in series], axis=1)
    together = np.column_stack(list(series.values()))
    assert modes.T @ modes == pytest.approx(np.cov(together, rowvar=False, bias=True), rel=1e-6, abs=1e-9)
    change = np.diff(together, axis=0)
    squares = modes.T @ (found["bus"].rates[:, None] ** 2 * modes)
    assert squares == pytest.approx(change.T @ change / len(change), rel=1e-6, abs=1e-9)
    # Never known at once: independent.
    series["bus"][:2500], series["heater"][2500:] = np.nan, np.nan
    apart = TypicalValue.of({name: series[name] for name in ("bus", "heater")}, stamps, "the day")
    assert apart["bus"].modes.T @ apart["heater"].modes == pytest.approx(0, abs=1e-9)


def test_currents_that_are_missing_together_make_a_field_uncertain_by_their_sum():
    """Two currents of one bus that take half of each other off: as independent it would be twice too much."""
    truth = true_samples(0)
    solar = truth["solar_current"]
    truth = truth.assign(battery_current=solar.copy(data=5000.0 - 0.5 * solar.values))
    entries = [
        entry_of("channel_field", np.random.default_rng(0)) | {"name": name} for name in ("solar", "battery")
    ]
    entries[1]["channel"] = "battery_current"
    entries[1]["coefficient"] = entries[0]["coefficient"]
    nine = {"effect": "vector_sensor", "sensor": "fgm", "offset": {"time": "block", "value": [0.0, 0, 0]}}
    model = model_of(nine, *entries)
    holed = without(model.disturb(truth), "solar_current", "battery_current")
    product = product_of(
        model, substitute(model, holed, typical_of(holed, "solar_current", "battery_current")), holed
    )
    error = (product["field_sensor"].values - truth["vector"].values)[MISSING]
    sigma = product["uncertainty"].values[MISSING]
    assert np.sqrt(np.mean(error**2, axis=0) / np.mean(sigma**2, axis=0)) == pytest.approx(1.0, abs=0.1)
