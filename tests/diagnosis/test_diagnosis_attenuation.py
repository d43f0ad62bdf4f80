"""Values of effects that follow a noisy channel: noise makes them smaller, and is taken off again."""

from functools import lru_cache

import numpy as np
from diagnosis_cases import POLAR, STEP_S, case_of, flight_of, read, with_channels

from inflight.diagnosis import Native, run_search
from inflight.diagnosis.attenuation import of_samples, without_attenuation
from inflight.diagnosis.stepwise import estimate
from inflight.samples import slow_response

SIZE, LAG_S, NOISE, SEEDS = np.array([0.15, -0.1, 0.12]), 1100.0, 1.0, 6
CHANNELS = ("boom_temperature", "payload_current")


def recorded(values, driven, seed):
    """Return the case of a boom temperature that is recorded so, while another series drives the field."""
    flight = with_channels(flight_of(POLAR, 15), boom_temperature=values)
    return case_of(flight, [read(flight, seed, field=driven[:, None] * SIZE)], channels=CHANNELS)


@lru_cache(maxsize=1)
def lagged():
    """Return what is found of a temperature with noise of 1 K whose response the field follows."""
    true = flight_of(POLAR, 15)["boom_temperature"]
    found = []
    for seed in range(SEEDS):
        noise = np.random.default_rng([4, seed]).normal(0.0, NOISE, true.size)
        case = recorded(true + noise, slow_response(true, STEP_S, LAG_S), seed)
        found.append(case.diagnose().effects[0])
    return found


def test_a_lagged_noisy_temperature_is_recovered_within_its_errors():
    found = lagged()
    assert all(one.name.startswith("channel_field(boom_temperature)@lag=") for one in found)
    pulls = [
        (number.value - true) / number.sigma
        for one in found
        for number, true in zip(one.coefficients, SIZE, strict=True)
    ]
    assert np.sqrt(np.mean(np.square(pulls))) < 1.5
    lags = [(one.lag_s - LAG_S) / one.lag_sigma_s for one in found]
    assert np.sqrt(np.mean(np.square(lags))) < 1.5


def test_what_noise_takes_is_told():
    for one in lagged():
        assert one.noise_of == "boom_temperature"
        assert 0.01 < one.noise_part < 0.05
        # The slower a response the less noise it has: it seems too slow, and the error says by how much.
        assert one.lag_s > LAG_S + 50.0
        assert one.lag_sigma_s < 0.5 * one.lag_s


def test_a_lagged_temperature_in_coarse_steps_is_recovered_within_its_errors():
    true, pulls = flight_of(POLAR, 15)["boom_temperature"], []
    for seed in range(3):
        # Steps of 3 K, of a temperature whose standard deviation is 4.4 K.
        rounded = 3.0 * np.round((true + 0.7 * seed) / 3.0)
        effect = recorded(rounded, slow_response(true, STEP_S, LAG_S), seed).diagnose().effects[0]
        assert effect.name.startswith("channel_field(boom_temperature)@lag=")
        pulls += [
            (number.value - size) / number.sigma
            for number, size in zip(effect.coefficients, SIZE, strict=True)
        ]
    assert np.sqrt(np.mean(np.square(pulls))) < 1.7


def test_a_channel_that_really_steps_is_not_taken_for_a_noisy_one():
    """Its steps look like noise in fourth differences; the residual says that the effect follows them."""
    steps = 5.0 * flight_of(POLAR, 15)["heater_current"]
    for seed in range(3):
        case = recorded(steps, steps, seed)
        search, data = case.search(), case.material()
        option = next(one for one in search.options if one.name == "channel_field(boom_temperature)")
        search = search.add(option)
        freed = without_attenuation(search, data)
        assert all(one.part < 0.01 for one in freed.values())


def test_values_of_a_quiet_channel_stay_as_they_are():
    true = flight_of(POLAR, 15)["coil_temperature"]
    smooth = slow_response(slow_response(true, STEP_S, 1500.0), STEP_S, 1500.0)
    case = recorded(smooth, smooth, 1)
    found, search = run_search(case.search(), case.material())
    assert found.effects[0].name == "channel_field(boom_temperature)"
    assert without_attenuation(search, case.material()) == {}


def test_noise_that_is_white_takes_more_the_faster_the_samples_are():
    true = flight_of(POLAR, 15)["boom_temperature"]
    noise = np.random.default_rng(5).normal(0.0, 0.2 * NOISE, true.size)
    case = recorded(true + noise, slow_response(true, STEP_S, LAG_S), 1)
    search, data = case.search(), case.material()
    option = next(one for one in search.options if one.name == "channel_field(boom_temperature)")
    search = search.add(option)
    same, faster = (
        without_attenuation(search, data, Native(search, cadence))[option.name].at_native
        for cadence in (STEP_S, STEP_S / 4.0)
    )
    assert 3.0 < faster / same < 6.0


def test_errors_of_samples_reach_as_far_as_values_in_wider_bins_do():
    """A field that follows the quick part of a channel twice as strongly has no one value."""
    slow = flight_of(POLAR, 15)["boom_temperature"]
    quick = np.random.default_rng(6).normal(0.0, np.std(slow), slow.size)
    told = []
    for more in (1.0, 2.0):
        case = recorded(slow + quick, slow + more * quick, 1)
        search, data = case.search(), case.material()
        option = next(one for one in search.options if one.name == "channel_field(boom_temperature)")
        search = search.add(option)
        told.append((estimate(search, option), of_samples(search, data, {})[option.name].estimate))
    (plain, same), (between, wider) = told
    np.testing.assert_allclose(same.sigma, plain.sigma)
    # In means of ten rows less is left of the quick part.
    assert np.all(wider.sigma > 5.0 * between.sigma)
    assert np.all(np.abs(wider.value - SIZE) > 10.0 * between.sigma)
    assert np.all(np.abs(wider.value - SIZE) < 3.0 * wider.sigma)
