"""Temperature coefficients of the scale factors and the lag of the temperature that is recorded."""

import numpy as np
import pytest
from bokeh.embed import file_html
from bokeh.resources import INLINE
from estimator_cases import polar_field

from inflight.calibration import concat_equations
from inflight.errors import CalibrationError
from inflight.figures import rivals_figure, scale_curves_figure
from inflight.mission_fit import CoilBlock, coil_equations, compare_temperatures, fit_coil, fit_coil_samples
from inflight.mission_fit.temperature import NONE
from inflight.time import SECOND

#: Yin (2010), sections 2.4 and 3.3: 1/K, 1/K^2, s.
LINEAR, QUADRATIC, LAG = np.array([29.6e-6, 30.37e-6, 30.46e-6]), 4e-8, 100.0
ORBIT, CADENCE, COUNT = 5580.0, 30.0, 720


def coil_at(seconds):
    """Coil temperature: by the orbit, by its shadow, and by the day."""
    turn = 2 * np.pi * seconds / ORBIT
    return 8.0 + 5.0 * np.cos(turn + 1.0) + 2.0 * np.sin(2 * turn) + 3.0 * np.sin(seconds / 70_000.0)


def adc_at(seconds):
    """Temperature of the converter: slower, of another phase."""
    turn = 2 * np.pi * seconds / ORBIT
    return 22.0 + 2.0 * np.cos(turn - 1.0) + 2.0 * np.cos(seconds / 50_000.0)


FIELDS = [polar_field(4 * COUNT, day) for day in range(4)]


def block(number, seed=0, *, linear=LINEAR, quadratic=QUADRATIC, lag=LAG, adc=0.0, noise=0.1):
    """A quarter of a day, every 30 s."""
    random = np.random.default_rng([seed, number])
    seconds = (number * COUNT + np.arange(COUNT)) * CADENCE
    field = FIELDS[number // 4][(number % 4) * COUNT :][:COUNT]
    change = (coil_at(seconds - lag) - 20.0)[:, None]
    # The sensor's scale is too large where it is warm: what is not yet corrected reads too much.
    reading = field / (1.0 - change * (linear + quadratic * change) - adc * (adc_at(seconds) - 20.0)[:, None])
    residual = np.linalg.norm(reading, axis=1) - np.linalg.norm(field, axis=1)
    residual += noise * random.standard_normal(COUNT)
    stamps = (seconds * SECOND).astype(np.int64)
    return CoilBlock(stamps, field, residual, {"coil": coil_at(seconds), "adc": adc_at(seconds)})


def plain(parts):
    """Blocks without the converter's temperature: half the columns."""
    return [
        CoilBlock(one.stamps, one.field, one.residual, {"coil": one.temperature["coil"]}) for one in parts
    ]


def blocks(count=14, seed=0, **options):
    return [block(number, seed, **options) for number in range(count)]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("lag", [100.0, -60.0])
def test_coefficients_and_lag_are_recovered_with_their_signs(sign, lag):
    fit = fit_coil_samples(blocks(lag=lag, linear=sign * LINEAR, quadratic=sign * QUADRATIC), "coil")
    truth = np.r_[sign * LINEAR, np.full(3, sign * QUADRATIC), lag]
    assert np.abs((fit.fit.value - truth) / fit.fit.sigma).max() < 3.5
    assert fit.lag[1] < 15.0
    assert fit.fit.sigma[[0, 2]].max() < 2e-6
    assert fit.fit.determined[[0, 2, 6]].all()
    assert f"lag {fit.lag[0]:.1f}" in fit.summary()


def test_without_noise_the_lag_is_exact():
    fit = fit_coil_samples(blocks(12, noise=1e-7), "coil")
    assert fit.lag[0] == pytest.approx(LAG, abs=1.0)
    assert fit.linear[[0, 2]] == pytest.approx(LINEAR[[0, 2]], rel=0.01)


def test_normal_equations_give_the_same_to_first_order_in_the_lag():
    parts = blocks()
    exact = fit_coil_samples(parts, "coil")
    near = concat_equations([coil_equations(one, {"coil": 60.0, "adc": 0.0}, 20.0) for one in parts])
    first = fit_coil(near, "coil", lag=60.0)
    assert first.lag[0] == pytest.approx(exact.lag[0], abs=0.5 * exact.lag[1])
    far = concat_equations([coil_equations(one, {"coil": -400.0, "adc": 0.0}, 20.0) for one in parts])
    # 500 s are a third of the time in which the temperature turns: first order is no longer enough.
    assert abs(fit_coil(far, "coil", lag=-400.0).lag[0] - exact.lag[0]) > 2.0 * exact.lag[1]
    assert fit_coil_samples(parts, "coil", lag=-400.0).lag[0] == pytest.approx(exact.lag[0], abs=2.0)


def test_one_sigma_covers_two_thirds():
    """One formation of the columns, near the lag: what repeats it changes no uncertainty."""
    pulls = []
    for seed in range(24):
        parts = [coil_equations(one, {"coil": 90.0}, 20.0) for one in plain(blocks(10, seed))]
        fit = fit_coil(concat_equations(parts), "coil", lag=90.0)
        truth = np.r_[LINEAR, np.full(3, QUADRATIC), LAG]
        pulls.append((fit.fit.value - truth) / fit.fit.sigma)
    inside = np.abs(pulls) < 1.0
    assert 0.60 <= inside.mean() <= 0.76
    assert 0.45 <= inside[:, 6].mean() <= 0.88


def test_gaps_missing_temperatures_and_outliers_do_no_harm():
    parts = blocks()
    for number, one in enumerate(parts):
        one.residual[number::97] += 40.0
        one.residual[100:130] = np.nan
        one.temperature["coil"][400:420] = np.nan
    fit = fit_coil_samples(parts, "coil")
    assert abs(fit.lag[0] - LAG) < 3.5 * fit.lag[1]
    assert np.abs((fit.linear - LINEAR) / fit.fit.sigma[:3]).max() < 3.5


def test_no_dependence_has_no_lag_and_says_so():
    fit = fit_coil_samples(blocks(linear=0.0 * LINEAR, quadratic=0.0), "coil")
    assert not fit.fit.determined[6]
    assert "NOT DETERMINED" in fit.summary()
    assert np.abs(fit.linear / fit.fit.sigma[:3]).max() < 3.5


def test_the_temperature_that_acts_wins_on_held_out_blocks_and_none_is_a_rival():
    lags = {"coil": LAG, "adc": 0.0}

    def choice(**options):
        parts = blocks(**options)
        return compare_temperatures(
            concat_equations([coil_equations(one, lags, 20.0) for one in parts]), ["coil", "adc"]
        )

    coil = choice()
    assert [one.channel for one in coil.rivals] == ["coil", "adc", NONE]
    assert not coil.rivals[1].ties
    assert "worse: adc" in coil.summary()
    adc = choice(linear=0.0 * LINEAR, quadratic=0.0, adc=3e-5)
    assert adc.rivals[0].channel == "adc"
    nothing = choice(linear=0.0 * LINEAR, quadratic=0.0)
    assert all(one.ties for one in nothing.rivals if one.channel != nothing.rivals[0].channel) or (
        nothing.rivals[0].channel == NONE
    )
    weak = choice(linear=LINEAR / 300.0, quadratic=0.0)
    assert "tied with it" in weak.summary()


def test_too_little_is_refused():
    with pytest.raises(CalibrationError, match="clusters"):
        fit_coil_samples(blocks(3), "coil")
    with pytest.raises(CalibrationError, match="no columns"):
        fit_coil(concat_equations([coil_equations(one, {}, 20.0) for one in blocks(6)]), "oven")
    with pytest.raises(CalibrationError, match="no normal equations"):
        fit_coil_samples([], "coil")


def test_figures_are_drawn_from_what_was_found():
    parts = blocks(8)
    drawn = scale_curves_figure(fit_coil_samples(parts, "coil"), np.linspace(0.0, 16.0, 33))
    equations = concat_equations([coil_equations(one, {"coil": LAG}, 20.0) for one in parts])
    rivals = rivals_figure(compare_temperatures(equations, ["coil", "adc"]))
    assert "lag" in drawn.title.text
    for plot in (drawn, rivals):
        assert len(file_html(plot, INLINE)) > 1000


def test_the_table_has_units_and_the_whole_covariance():
    table = fit_coil_samples(blocks(8), "coil").table()
    assert list(table["parameter"].values)[-1] == "lag"
    assert list(table["units"].values) == ["1/K"] * 3 + ["1/K2"] * 3 + ["s"]
    assert table["sigma"].values == pytest.approx(np.sqrt(np.diag(table["covariance"].values)))
    assert table.attrs["reference_degC"] == 20.0
