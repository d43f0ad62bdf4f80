"""What an ignored cause does to the calibration: the table says what a calibration really does."""

import numpy as np
import pytest
from day_night_cases import MIDNIGHT, NOON, PRIOR_SIGMA, orbit_day
from hypothesis import given
from hypothesis import strategies as st

from inflight.calibration import (
    NINE_PARAMETER_NAMES,
    BlockFit,
    NormalEquations,
    ParameterPrior,
    block_equations,
    concat_equations,
    fit_block,
    nine_columns,
)
from inflight.calibration.normal_equations import IDEAL_SENSOR
from inflight.errors import CalibrationError, SamplesError
from inflight.frames import direction_of
from inflight.lsq import marginalise, regression_coefficients
from inflight.mission_fit import SWITCHED, IgnoredCause, correlation, cross_talk, switched_columns

DAYS = (300, 1450, 2000, NOON, MIDNIGHT)


def equations(*days: int) -> NormalEquations:
    blocks = []
    for mjd in days:
        day = orbit_day(mjd)
        columns = nine_columns(day.field) | {"time_shift": day.rate, "bias": np.ones_like(day.strength)}
        columns |= switched_columns(day.direction, day.sunlit)
        blocks.append(block_equations(columns, np.zeros_like(day.strength), day.span, robust=False))
    return concat_equations(blocks)


@pytest.fixture(scope="module")
def all_days() -> NormalEquations:
    return equations(*DAYS)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_scalar_bias_becomes_scale_factors(all_days, sign):
    found = cross_talk(all_days, [IgnoredCause("bias", sign * 0.4, "nT")])
    expected = [(15, 1), (29, 3), (8, 0.5)]
    for axis, (ppm, tolerance) in zip("xyz", expected, strict=True):
        assert sign * found.of("bias", f"scale_factor[{axis}]") == pytest.approx(ppm, abs=tolerance)
    assert found.before[0] == pytest.approx(0.4)
    assert found.after[0] == pytest.approx(0.05, abs=0.005)


@pytest.mark.parametrize("mjd", DAYS)
def test_ten_milliseconds_become_three_arcseconds_of_xz(mjd):
    found = cross_talk(equations(mjd), [IgnoredCause("time_shift", 0.010, "s")])
    assert -3.28 <= found.of("time_shift", "misalignment[xz]") <= -3.16
    assert found.before[0] == pytest.approx(0.20, abs=0.01)
    assert found.after[0] == pytest.approx(0.08, abs=0.01)


def test_a_day_night_field_turns_angles_at_noon_and_midnight_the_other_way():
    causes = [IgnoredCause(f"{SWITCHED}[{axis}]", 0.65, "nT", axis) for axis in "xz"]
    noon, midnight = cross_talk(equations(NOON), causes), cross_talk(equations(MIDNIGHT), causes)
    assert noon.of("z", "misalignment[xz]") == pytest.approx(3.4, abs=0.2)
    assert midnight.of("z", "misalignment[xz]") == pytest.approx(-3.4, abs=0.2)
    assert noon.of("x", "scale_factor[x]") == pytest.approx(-12, abs=1)
    assert midnight.of("x", "scale_factor[x]") == pytest.approx(12, abs=1)


def calibrated(reading: np.ndarray, scalar: np.ndarray) -> BlockFit:
    good = np.ones(scalar.size, dtype=bool)
    return fit_block(reading, np.zeros((1, 3)), scalar, good, ParameterPrior(IDEAL_SENSOR, PRIOR_SIGMA))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("cause", ["bias", "time_shift", f"{SWITCHED}[z]"])
def test_the_table_says_what_a_calibration_does(cause, sign):
    """The cause is put into readings, and the product's own fit is made with and without it."""
    day = orbit_day(NOON)
    size = sign * {"bias": 0.4, "time_shift": 0.010}.get(cause, 0.65)
    scalar = day.strength + np.random.default_rng(3).normal(0, 0.3, day.strength.size)
    reading, told = day.field.copy(), scalar.copy()
    if cause == "bias":
        told = scalar + size
    elif cause == "time_shift":
        told = scalar + day.rate * size
    else:
        reading[:, 2] += day.sunlit * size
    shown = np.array([1e6] * 3 + [3600.0] * 3 + [1.0] * 3)
    without, having = calibrated(day.field, scalar), calibrated(reading, told)
    moved, sigma = (having.value - without.value) * shown, without.sigma * shown
    found = cross_talk(equations(NOON), [IgnoredCause(cause, size)]).shift[0]
    # Robust weights take noise and cause together for a little less than each: far below the noise.
    assert np.all(np.abs(moved - found) < 0.5 * sigma)
    assert np.abs(found / sigma).max() > 5.0


def test_effects_add_up_and_are_straight_in_size(all_days):
    one = cross_talk(all_days, [IgnoredCause("bias", 1.0)])
    two = cross_talk(all_days, [IgnoredCause("bias", -2.5)])
    np.testing.assert_allclose(two.shift, -2.5 * one.shift)
    np.testing.assert_allclose(two.after, 2.5 * one.after)
    np.testing.assert_allclose(two.retained, one.retained)


def test_the_table_has_units_and_the_scatter_of_single_days(all_days):
    found = cross_talk(
        all_days, [IgnoredCause("bias", 0.4, "nT", "bias"), IgnoredCause("time_shift", 0.01, "s", "lag")]
    )
    table = found.table()
    assert table["value"].dims == ("ignored", "parameter")
    assert table["units"].values.tolist() == ["ppm"] * 3 + ["arcsec"] * 3 + ["nT"] * 3
    assert table["ignored"].values.tolist() == ["bias", "lag"]
    each = [cross_talk(equations(mjd), [IgnoredCause("bias", 0.4)]).shift[0] for mjd in DAYS]
    np.testing.assert_allclose(table["scatter"].values[0], np.std(each, axis=0, ddof=1), rtol=1e-6)
    assert np.isnan(cross_talk(equations(NOON), [IgnoredCause("bias")]).scatter).all()


def test_columns_that_do_not_fit_are_refused(all_days):
    with pytest.raises(CalibrationError, match="fitted and ignored"):
        cross_talk(all_days, [IgnoredCause(NINE_PARAMETER_NAMES[0])])
    with pytest.raises(CalibrationError, match="no columns"):
        cross_talk(all_days, [IgnoredCause("heater")])


def test_nine_columns_are_derivatives_of_the_residual():
    value = np.array([1.002, 0.998, 1.003, 90.05, 89.95, 90.03, 20.0, -30.0, 10.0])
    field = orbit_day(NOON).field[:200]
    c = np.cos(np.deg2rad(value[3:6]))
    k = np.array([[value[0], c[0], c[1]], [0, value[1], c[2]], [0, 0, value[2]]])
    reading = np.linalg.solve(k, field.T).T + value[6:]

    def strength(at):
        c = np.cos(np.deg2rad(at[3:6]))
        k = np.array([[at[0], c[0], c[1]], [0, at[1], c[2]], [0, 0, at[2]]])
        return np.linalg.norm((reading - at[6:]) @ k.T, axis=1)

    for index, (column, step) in enumerate(
        zip(nine_columns(field, value).values(), [1e-6] * 3 + [1e-4] * 3 + [1e-2] * 3, strict=True)
    ):
        up, down = (strength(value + sign * step * np.eye(9)[index]) for sign in (1, -1))
        np.testing.assert_allclose(
            (up - down) / (2 * step), column, rtol=1e-4, atol=1e-3 * np.abs(column).max()
        )


def test_the_correlation_of_bxbz_with_the_rate_is_the_published_one():
    for mjd in DAYS:
        day = orbit_day(mjd)
        assert 0.87 <= correlation(day.field[:, 0] * day.field[:, 2], day.rate) <= 0.91


def test_correlation_leaves_out_what_is_missing_and_refuses_what_says_nothing():
    a, b = np.arange(50.0), 3.0 - 2.0 * np.arange(50.0)
    a[7] = b[9] = np.nan
    assert correlation(a, b) == pytest.approx(-1.0)
    with pytest.raises(SamplesError, match="constant"):
        correlation(np.ones(10), np.arange(10.0))
    with pytest.raises(SamplesError, match="pairs"):
        correlation(np.full(10, np.nan), np.arange(10.0))


@given(st.integers(0, 10_000), st.integers(1, 4))
def test_what_is_taken_over_is_least_squares(seed, fitted):
    rows = np.random.default_rng(seed).normal(size=(40, fitted + 2)) * np.logspace(-3, 3, fitted + 2)
    gram, x, z = rows.T @ rows, np.arange(fitted), np.arange(fitted, fitted + 2)
    expected = np.linalg.lstsq(rows[:, x], rows[:, z])[0]
    np.testing.assert_allclose(regression_coefficients(gram, x, z), expected, rtol=1e-6)
    rest = rows[:, z] - rows[:, x] @ expected
    np.testing.assert_allclose(marginalise(gram, x, z), rest.T @ rest, rtol=1e-6, atol=1e-9 * gram[-1, -1])


def test_directions_are_unit_vectors():
    np.testing.assert_allclose(np.linalg.norm(direction_of(orbit_day(NOON).field), axis=1), 1.0)
