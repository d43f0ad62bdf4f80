"""The daily Z offset from the spread of the residual: geometry, size, sign, and where there is none."""

import numpy as np
import pytest
import xarray as xr
from estimator_cases import polar_field, wandering

from inflight.errors import CalibrationError
from inflight.mission_fit import day_statistics, fit_spread_law, offsets_from_spread, residual_noise
from inflight.simulate import SimulationSettings, simulate_day
from inflight.time import from_mjd2000

COUNT = 8640


def direction_of(field):
    return field / np.linalg.norm(field, axis=1, keepdims=True)


DIRECTION = direction_of(polar_field(COUNT))


def day(offset, generator, noise=0.15, mjd=1000.0, memory=0.0, direction=DIRECTION):
    error = wandering(COUNT, memory, generator) if memory else generator.normal(size=COUNT)
    start, end = (int(edge) for edge in from_mjd2000(np.array([mjd, mjd + 1.0])))
    return day_statistics(direction @ np.asarray(offset) + noise * error, direction, start, end)


def days(offsets, seed=0, **options):
    generator = np.random.default_rng(seed)
    parts = [
        day([0.0, 0.0, one], generator, mjd=1000.0 + i, **options) for i, one in enumerate(offsets)
    ]  # fmt: skip
    return xr.concat(parts, "interval")


def test_a_polar_orbit_in_a_dipole_has_two_thirds_exactly():
    latitude = np.linspace(0, 2 * np.pi, 36_001)[:-1]
    field = np.stack([np.cos(latitude), 0 * latitude, 2 * np.sin(latitude)], axis=1)
    found = day_statistics(direction_of(field)[:, 2], direction_of(field), 0, 1)
    assert float(found["geometry"][0]) == pytest.approx(2 / 3, abs=1e-9)
    assert float(found["variance"][0]) == pytest.approx(2 / 3, abs=1e-9)


def test_the_main_field_on_champs_orbit_has_the_published_factor():
    """0.6655 (Yin 2010, eq. 3.6); an offset of x enters with 0.313, one of y with 0.02."""
    settings = SimulationSettings(cadence=10, without=("external_field",), defects=())
    per_day, per_orbit, others = [], [], []
    for date in ("2005-03-01", "2007-10-10"):
        truth = simulate_day(settings, date).truth
        e = direction_of(truth["FIELD"].values)
        per_day.append(np.var(e[:, 2]))
        per_orbit += [np.var(e[at : at + 558, 2]) for at in range(0, 8000, 558)]
        others.append(np.var(e[:, :2], axis=0))
    assert all(0.655 < one < 0.68 for one in per_day)
    assert all(0.62 < one < 0.70 for one in per_orbit)
    assert np.mean(others, axis=0) == pytest.approx([0.313, 0.02], abs=0.01)


@pytest.mark.parametrize("offset", [0.5, -0.5, 2.0, -2.0])
def test_size_and_sign_of_an_offset_are_recovered(offset):
    found = offsets_from_spread(days([offset] * 3), noise=0.15**2)
    assert np.all(np.abs(found.value - offset) < 4 * found.sigma)
    assert np.all(found.wrong_sign < 1e-3)
    assert found.table()["value"].dims == ("interval", "parameter")


def test_one_sigma_covers_two_thirds_of_days_with_noise_that_is_correlated_for_minutes():
    statistics = days(np.tile([0.3, -0.3], 100), memory=12.0)
    found = offsets_from_spread(statistics, noise=0.15**2)
    truth = np.tile([0.3, -0.3], 100)
    assert 0.60 <= np.mean(np.abs(found.value - truth) < found.sigma) <= 0.76
    pulls = (found.slope - truth) / found.sigma_slope
    assert 0.60 <= np.mean(np.abs(pulls) < 1) <= 0.76


def test_nothing_is_told_where_the_spread_is_below_the_noise():
    statistics = days([0.0] * 20)
    found = offsets_from_spread(statistics, noise=0.16**2, sigma_noise=0.001)
    assert not found.seen.any()
    assert np.isnan(found.size).all()
    assert np.all(found.value == 0)
    assert np.all(found.sigma > 0.02), "an offset of sqrt(sigma of the square) would not have been seen"


def test_an_uncertain_sign_widens_the_uncertainty():
    statistics = days([0.2])
    statistics["slope"][:] = 0.0
    found = offsets_from_spread(statistics, noise=0.15**2)
    assert found.wrong_sign[0] == pytest.approx(0.5)
    assert found.sigma[0] > found.size[0]


def test_the_law_of_the_spread_is_recovered_and_its_factor_is_that_of_the_orbit():
    generator = np.random.default_rng(5)
    offsets = generator.normal(0, 0.6, 60)
    statistics = days(offsets, noise=0.2)
    statistics["variance"][10] += 3.0
    law = fit_spread_law(statistics, offsets + 0.02 * generator.normal(size=60), np.full(60, 0.02))
    sigma = np.sqrt(np.diag(law.covariance))
    assert abs(law.factor - law.geometry) < 3 * sigma[0] < 0.05
    assert abs(law.noise - 0.04) < 3 * sigma[1] < 0.01
    assert law.outlying == 1
    # An X offset shows with its own factor, not with that of z.
    assert set(law.table()["parameter"].values) == {"factor", "noise"}


def test_errors_of_the_known_offsets_do_not_raise_the_noise():
    generator = np.random.default_rng(6)
    offsets = generator.normal(0, 0.8, 200)
    law = fit_spread_law(
        days(offsets, noise=0.2), offsets + 0.2 * generator.normal(size=200), np.full(200, 0.2)
    )
    assert law.factor == pytest.approx(law.geometry, rel=0.15)
    assert abs(law.noise - 0.04) < 4 * np.sqrt(law.covariance[1, 1])


def test_days_of_one_spread_follow_no_offset():
    statistics = days(np.linspace(-1, 1, 40), noise=0.2)
    alike = statistics.assign(variance=xr.full_like(statistics["variance"], 1.0))
    law = fit_spread_law(alike, np.linspace(-1, 1, 40) ** 3, np.full(40, 0.02))
    assert law.factor == pytest.approx(0.0, abs=1e-12)
    assert law.noise == pytest.approx(1.0)


def test_the_noise_comes_from_the_days_themselves():
    level, sigma = residual_noise(days(np.linspace(-1, 1, 40), noise=0.2))
    assert abs(level - 0.04) < 4 * sigma
    assert sigma < 0.001


def test_gaps_and_outliers_do_not_make_an_offset():
    generator = np.random.default_rng(8)
    residual = DIRECTION[:, 2] * 0.4 + 0.1 * generator.normal(size=COUNT)
    residual[100:900] = np.nan
    residual[generator.integers(0, COUNT, 20)] = 50.0
    statistics = day_statistics(residual, DIRECTION, 0, 86_400 * 10**9)
    found = offsets_from_spread(statistics, noise=0.01)
    assert abs(found.value[0] - 0.4) < 4 * found.sigma[0]


def test_a_day_with_too_little_is_refused_and_so_is_a_law_of_few_days():
    residual = np.full(COUNT, np.nan)
    residual[:200] = 0.1
    with pytest.raises(CalibrationError, match="200 usable samples"):
        day_statistics(residual, DIRECTION, 0, 1)
    with pytest.raises(CalibrationError, match="3 days"):
        fit_spread_law(days([0.1, 0.2, 0.3]), np.array([0.1, 0.2, 0.3]), np.full(3, 0.01))
