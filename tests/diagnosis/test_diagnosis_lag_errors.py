"""What a lag does not know the coefficients fitted with it do not."""

from functools import lru_cache

import numpy as np
from diagnosis_cases import POLAR, case_of, flight_of, read

from inflight.diagnosis import estimate, run_search
from inflight.diagnosis.refine import error_by_lag
from inflight.samples import slow_response

FIELD, LAG_S, SEEDS = np.array([2.0, -1.5, 1.2]), 1100.0, 6
NAME = "channel_field(solar_current)"


@lru_cache(maxsize=1)
def flown():
    flight = flight_of(POLAR, 15)
    warm = slow_response(flight["solar_current"], 120.0, LAG_S)[:, None] * FIELD
    return case_of(
        flight, [read(flight, seed, field=warm) for seed in range(SEEDS)], channels=("solar_current",)
    )


@lru_cache(maxsize=1)
def found():
    return [flown().diagnose(seed).effects[0] for seed in range(SEEDS)]


def test_coefficients_of_a_lagged_effect_lie_within_their_errors():
    assert all(one.name.startswith(f"{NAME}@lag=") for one in found())
    pulls = [
        (one.value - true) / one.sigma
        for effect in found()
        for one, true in zip(effect.coefficients, FIELD, strict=True)
    ]
    assert np.sqrt(np.mean(np.square(pulls))) < 1.7
    lags = [(effect.lag_s - LAG_S) / effect.lag_sigma_s for effect in found()]
    assert np.sqrt(np.mean(np.square(lags))) < 2.0


def test_the_error_of_the_lag_is_in_those_of_the_coefficients():
    data = flown().material()
    told, search = run_search(flown().search(), data)
    option = search.accepted[0]
    own, by_lag = estimate(search, option).sigma, error_by_lag(search, data, option, option.lag_sigma_s)
    assert (by_lag > 0.1 * own).all()
    sigma = [one.sigma for one in told.effects[0].coefficients]
    np.testing.assert_allclose(sigma, np.hypot(own, by_lag), rtol=1e-6)


def test_the_error_grows_with_that_of_the_lag():
    search, data = flown().search(), flown().material()
    option = next(one for one in search.options if one.name == f"{NAME}@lag=1000s")
    search = search.add(option)
    small, large = (error_by_lag(search, data, option, size) for size in (5.0, 10.0))
    np.testing.assert_allclose(large, 2.0 * small, rtol=0.02)


def test_an_effect_without_a_lag_has_none_of_it():
    search, data = flown().search(), flown().material()
    option = next(one for one in search.options if one.name == NAME)
    assert error_by_lag(search.add(option), data, option, 10.0) is None
