"""Auxiliary columns of days: lag, rivals, day and night, cross-talk; put in and found."""

from types import SimpleNamespace

import numpy as np
import pytest
from auxiliary_cases import LINEAR, MadeUp, model_with, nights, warm_days, with_noise

from inflight.calibration import NormalEquations
from inflight.errors import CalibrationError
from inflight.mission_fit import (
    CoilFit,
    CrossTalkTable,
    DayNightField,
    TemperatureChoice,
    compare_temperatures_jointly,
    daily_parameters,
    fit_coil_lag,
    fit_day_night_jointly,
    free_terms,
    joint_cross_talk,
    nine_parameter_cross_talk,
    with_auxiliary_columns,
)
from inflight.tasks.pipelines.mission_fit.day import StoredDays
from inflight.tasks.pipelines.mission_fit.fit import MissionFitResults
from inflight.tasks.pipelines.mission_fit.parameter_sections import day_night
from inflight.time import DAY

XZ = "vector_sensor.misalignment[xz]"
FIELD = (0.4, 0.0, -0.65)
#: More than four cycles of local time, long enough to tell them from the year, and a month.
CYCLES, MONTH = range(1950, 3083, 9), range(2700, 2730)


@pytest.fixture(scope="module")
def hidden() -> MadeUp:
    """Eleven hundred days with a field by day that the model does not know."""
    return nights(CYCLES, FIELD)


def wander(daily, name: str) -> float:
    """Amplitude of the period of 260.5 days in a daily angle less the continuous one, arcsec."""
    mjd = np.asarray(daily["start"].values) / 86400e9
    left = 3600 * (daily["value"] - daily["continuous"]).sel(parameter=name).values
    waves = np.column_stack(
        [np.cos(2 * np.pi * mjd / 260.5), np.sin(2 * np.pi * mjd / 260.5), np.ones(mjd.size)]
    )
    return float(np.hypot(*np.linalg.lstsq(waves, left)[0][:2]))


def test_a_field_by_day_makes_the_angles_wander_until_it_is_in_the_model(hidden):
    made = fit_day_night_jointly(hidden.equations, hidden.auxiliary, hidden.found, hidden.model)
    ignored = daily_parameters(hidden.equations, hidden.found, ["time_shift.seconds"])
    assert wander(ignored, XZ) > 2.0
    assert wander(made.daily(), XZ) < 0.1
    found = made.field
    assert np.abs((found.value - FIELD) / found.sigma).max() < 4
    assert found.sigma.max() < 0.02
    assert found.after < found.before


def test_the_page_draws_the_wander_without_the_field_and_with_it(hidden):
    made = fit_day_night_jointly(hidden.equations, hidden.auxiliary, hidden.found, hidden.model)
    tables = {
        "day-night": made.field.table(),
        "daily-after": daily_parameters(hidden.equations, hidden.found, ["time_shift.seconds"]),
        "day-night-daily": made.daily(),
    }
    mission = SimpleNamespace(periods={"local_time": round(260.5 * DAY)})
    part = day_night(MissionFitResults(mission, "main", None, None, "", StoredDays(None, []), tables))
    assert list(part.absent) == ["Series along the orbit"]
    ignored, known = part.fields["wander"][XZ]["periods"]["local_time, 260.5 d"]
    assert ignored[0] > 2.0
    assert known[0] < 0.1
    assert len(part.plots) == 3


def test_without_a_field_by_day_none_is_told():
    none = nights(range(2300, 2820, 12), (0.0, 0.0, 0.0), seed=1)
    found = fit_day_night_jointly(none.equations, none.auxiliary, none.found, none.model).field
    assert np.abs(found.value / found.sigma).max() < 4


def test_a_model_with_its_own_field_by_day_has_none_beside_it(hidden):
    own = model_with("  - {effect: day_night, sensor: fgm, vector: {unit: nT, value: [0, 0, 0], sigma: 1}}")
    with pytest.raises(CalibrationError, match="itself"):
        fit_day_night_jointly(hidden.equations, hidden.auxiliary, hidden.found, own)


def test_days_that_do_not_know_a_column_are_left_out(hidden):
    blind = [
        part.assign(known=part["known"] & (place % 2 == 0)) for place, part in enumerate(hidden.auxiliary)
    ]
    names = ["day_night.vector[z]"]
    assert len(with_auxiliary_columns(hidden.equations, [None, *blind[1:]], names)) == (len(blind) - 1) // 2
    with pytest.raises(CalibrationError, match="no day knows"):
        with_auxiliary_columns(hidden.equations, [None] * len(blind), names)


@pytest.mark.parametrize("lag", [25.0, -15.0])
def test_the_lag_is_found_with_its_sign(lag):
    made = warm_days(MONTH, lag, seed=0)
    fit = fit_coil_lag(made.equations, made.auxiliary, made.found, made.model, 100.0)
    value, sigma = fit.lag
    assert value == pytest.approx(100.0 + lag, abs=max(4 * sigma, 0.01 * abs(lag)))
    assert sigma < 1.5
    assert bool(fit.fit.determined[-1])
    np.testing.assert_allclose(fit.linear, LINEAR, atol=5 * fit.fit.sigma[:3].max())


def test_a_field_by_day_is_no_lag():
    made = warm_days(MONTH, 25.0, seed=0, by_day=FIELD)
    value, sigma = fit_coil_lag(made.equations, made.auxiliary, made.found, made.model, 100.0).lag
    assert value == pytest.approx(125.0, abs=4 * sigma)
    assert sigma < 0.3
    assert _judged(made).rivals[0].channel == "coil_temperature"


def test_stated_errors_of_coefficients_and_lag_hold():
    quiet, pulls = warm_days(CYCLES, 10.0, seed=0, scale=1e-3), []
    for seed in range(40):
        made = with_noise(quiet, seed, 0.2)
        fit = fit_coil_lag(made.equations, made.auxiliary, made.found, made.model, 100.0)
        value, sigma = fit.lag
        away = ((fit.linear - LINEAR) / fit.fit.sigma[:3])[[0, 2]]
        pulls += [(value - 110.0) / sigma, *away]
    assert 0.6 < np.mean(np.abs(pulls) < 1.0) < 0.76
    assert np.abs(pulls).max() < 4.0


def test_stated_errors_of_a_field_by_day_hold():
    quiet, pulls = nights(CYCLES, FIELD, noise=1e-3), []
    for seed in range(40):
        made = with_noise(quiet, seed, 0.2)
        found = fit_day_night_jointly(made.equations, made.auxiliary, made.found, made.model).field
        pulls += list((found.value - FIELD) / found.sigma)
    assert 0.6 < np.mean(np.abs(pulls) < 1.0) < 0.76
    assert np.abs(pulls).max() < 4.0


@pytest.mark.parametrize(
    ("follows", "best"), [("coil", "coil_temperature"), ("electronics", "electronics_temperature")]
)
def test_the_temperature_that_is_followed_wins_on_days_held_out(follows, best):
    made = warm_days(MONTH, 0.0, seed=2, follows=follows)
    choice = _judged(made)
    assert choice.rivals[0].channel == best
    assert not any(one.ties for one in choice.rivals[1:])


def test_with_no_temperature_to_follow_none_is_beaten():
    choice = _judged(warm_days(MONTH, 0.0, seed=3, follows="none"))
    none = next(one for one in choice.rivals if one.channel == "none")
    assert none.ties or choice.rivals[0] is none


def _judged(made: MadeUp) -> TemperatureChoice:
    names = ["coil_temperature", "electronics_temperature"]
    return compare_temperatures_jointly(made.equations, made.auxiliary, made.found, made.model, names)


def test_without_an_effect_of_temperature_the_reason_is_told(hidden):
    with pytest.raises(CalibrationError, match="no effect 'temperature'"):
        fit_coil_lag(hidden.equations, hidden.auxiliary, hidden.found, hidden.model, 100.0)


def test_ignored_causes_shift_the_nine_as_the_thesis_says(hidden):
    wide = with_auxiliary_columns(hidden.equations, hidden.auxiliary, ["day_night.vector[z]"])
    found = nine_parameter_cross_talk(wide, {"time_shift.seconds": "s"}, hidden.model)
    # The column is that of a reading taken late: 10 ms of it answer with minus 3.2 arcsec.
    assert found.of("time_shift.seconds", "misalignment[xz]") == pytest.approx(-3.2, abs=0.15)
    assert np.isfinite(found.sigma).all()


def test_what_one_parameter_does_to_all_others_is_what_a_fit_without_it_gives(hidden):
    equations, model = hidden.equations, hidden.model
    units = {"time_shift.seconds": "s"} | dict.fromkeys(equations.columns[6:9], "nT")
    table = joint_cross_talk(equations, units, model)
    sigma = np.array([one for term in free_terms(model) for one in term.sigma])
    rest = [name for name in equations.columns if name != "time_shift.seconds"]
    kept = np.array([name in rest for name in equations.columns])
    away = equations.first_reference.copy()
    away[~kept] += 0.01
    fixed, base = (one.select(rest) for one in (equations.at(away), equations.at(equations.first_reference)))
    pair = [one.physical(one.solve(sigma[kept]))[0] for one in (fixed, base)]
    # Held 10 ms too high is the same as ignored when it is 10 ms too low.
    moved = pair[1] - pair[0]
    told = table.sel(ignored="time_shift.seconds", parameter=rest)
    factor = np.where(table["units"].sel(parameter=rest).values == "ppm", 1e6, 1.0)
    np.testing.assert_allclose(
        told["value"].values / factor, moved, rtol=0.02, atol=1e-4 * np.abs(moved[6:]).max()
    )
    assert np.isnan(table["value"].sel(ignored=XZ, parameter=XZ).item())


def test_tables_give_back_what_they_were_made_of(hidden):
    wide = with_auxiliary_columns(hidden.equations, hidden.auxiliary, ["day_night.vector[z]"])
    shifts = nine_parameter_cross_talk(wide, {}, hidden.model)
    again = CrossTalkTable.of_table(shifts.table(), ["day_night.vector[z]"])
    np.testing.assert_array_equal(again.shift, shifts.shift[1:])
    field = fit_day_night_jointly(hidden.equations, hidden.auxiliary, hidden.found, hidden.model).field
    np.testing.assert_array_equal(DayNightField.of_table(field.table()).value, field.value)
    made = warm_days(MONTH[:12], 0.0, seed=4)
    fit = fit_coil_lag(made.equations, made.auxiliary, made.found, made.model, 100.0)
    assert CoilFit.of_table(fit.table()).summary() == fit.summary()
    choice = _judged(warm_days(MONTH, 0.0, seed=5))
    assert TemperatureChoice.of_table(choice.table()).summary() == choice.summary()


def test_no_day_tells_no_cross_talk(hidden):
    data = hidden.equations.dataset
    empty = NormalEquations(data.assign(count=data["count"] * 0.0))
    with pytest.raises(CalibrationError, match="no day"):
        joint_cross_talk(empty, {}, hidden.model)
