"""Level 2: uncertainties that a Monte Carlo confirms, axes an independent rotation confirms, honest flags."""

import numpy as np
import pytest
import xarray as xr
from effect_cases import MISSION, true_samples
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from inflight.calibration import day_parameters, level2, reference_of, rows_within
from inflight.calibration.product import DayParameters
from inflight.errors import ModelError
from inflight.flags import Flag
from inflight.frames import itrf_to_nec, to_nec
from inflight.mission import Mission
from inflight.model import Model
from inflight.time import DAY

VALUE = np.array([1.0013, 0.9988, 1.0021, 90.03, 89.94, 90.04, 27.0, -20.0, 21.0])


def model_with(value: np.ndarray) -> Model:
    parts = {"scale_factor": value[:3], "misalignment": value[3:6], "offset": value[6:]}
    lines = "\n".join(f"    {name}: {{time: block, value: {part.tolist()}}}" for name, part in parts.items())
    text = f"model: m\nmission: champ\neffects:\n  - effect: vector_sensor\n    sensor: fgm\n{lines}\n"
    return Model.parse(text, MISSION)


def covariance(seed: int) -> np.ndarray:
    """Correlated errors of realistic size."""
    mix = np.random.default_rng(seed).normal(0, 1, (9, 9)) + np.eye(9)
    mix /= np.linalg.norm(mix, axis=1, keepdims=True)
    size = np.array([1e-5] * 3 + [1e-3] * 3 + [0.5] * 3)
    return (mix @ mix.T) * np.outer(size, size)


def samples_of(value: np.ndarray, count: int = 60) -> xr.Dataset:
    return model_with(value).disturb(true_samples(0, count))


@pytest.mark.parametrize("seed", range(3))
def test_the_uncertainty_is_the_spread_of_fields_over_likely_parameters(seed):
    known = DayParameters(VALUE, covariance(seed), True, 0.0)
    samples = samples_of(VALUE)
    stated = level2(model_with(VALUE), samples, known, model_with(VALUE))["uncertainty"].values
    draws = np.random.default_rng(seed).multivariate_normal(VALUE, known.covariance, 1500, method="cholesky")
    fields = np.array([model_with(draw).correct(samples)["field"].values for draw in draws])
    assert_allclose(stated, fields.std(axis=0), rtol=0.09)


def test_the_residuals_noise_adds_to_the_uncertainty_in_squares():
    samples = samples_of(VALUE)
    quiet, loud = (
        level2(
            model_with(VALUE), samples, DayParameters(VALUE, covariance(0), True, noise), model_with(VALUE)
        )
        for noise in (0.0, 0.3)
    )
    difference = loud["uncertainty"].values ** 2 - quiet["uncertainty"].values ** 2
    assert_allclose(difference, 0.09, rtol=1e-9)


def test_what_mounting_and_clock_are_known_to_is_the_spread_over_them():
    """Thirty nanotesla of a turn by 0.05 degrees; and a field that changes by 1500 nT/s, 2 ms off."""
    samples = samples_of(VALUE)
    plain = "orientation: [0, 0, 0, 1]"
    text = MISSION.text.replace(
        plain, "orientation: {value: [0, 0, 0, 1], sigma: 0.05}\n    delay: {value: 0 s, sigma: 2 ms}", 1
    )
    assert plain in MISSION.text
    known = Model.parse(model_with(VALUE).text, Mission.parse(text))
    sure = DayParameters(VALUE, np.zeros((9, 9)), True, 0.0)
    product = level2(known, samples, sure, known)
    g, field = np.random.default_rng(8), product["field_spacecraft"].values
    seconds = (samples["tt2000"].values - samples["tt2000"].values[0]) / 1e9
    off = []
    for turn, late in zip(
        np.deg2rad(0.05) * g.normal(size=(1500, 3)), 0.002 * g.normal(size=1500), strict=True
    ):
        moved = np.stack([np.interp(seconds + late, seconds, one) for one in field.T], axis=1)
        off.append(Rotation.from_rotvec(turn).apply(moved) - field)
    spread = np.sqrt(np.mean(np.square(off), axis=0))
    stated = product["uncertainty"].values
    inner = slice(1, -1)  # at the ends the interpolation has no further sample
    assert np.median(stated[inner] / spread[inner]) == pytest.approx(1.0, abs=0.05)
    assert (stated[inner] > 0.8 * spread[inner]).all()
    assert not level2(model_with(VALUE), samples, sure, known)["uncertainty"].values.any()


def nec_axes(position: np.ndarray) -> np.ndarray:
    """North, east and centre at a place, from cross products with the Earth's axis."""
    up = position / np.linalg.norm(position)
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    return np.stack([np.cross(up, east), east, -up])


def test_north_east_centre_are_those_of_an_independent_construction():
    g = np.random.default_rng(2)
    position, field = g.normal(0, 4000, (200, 3)), g.normal(0, 30_000, (200, 3))
    expected = np.stack([nec_axes(p) @ b for p, b in zip(position, field, strict=True)])
    assert_allclose(itrf_to_nec(field, position), expected, rtol=0, atol=1e-9)
    at_equator = itrf_to_nec(np.array([[1.0, 2.0, 3.0]]), np.array([[7000.0, 0.0, 0.0]]))
    assert_allclose(at_equator, [[3.0, 2.0, -1.0]], atol=1e-12)


def test_an_attitude_turns_spacecraft_axes_into_the_frame_it_names():
    quarter = np.array([[0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]])
    turned = to_nec(np.array([[1.0, 0.0, 0.0]]), quarter, None, "nec")
    assert_allclose(turned, [[0.0, 1.0, 0.0]], atol=1e-15)


def test_flags_say_what_is_missing_and_nothing_else():
    samples = samples_of(VALUE)
    vector = samples["vector"].values.copy()
    vector[10] = np.nan
    flag = samples["flag"].values.copy()
    flag[10] = Flag.VECTOR_MISSING
    holed = samples.assign(vector=(("time", "axis"), vector), flag=("time", flag))
    product = level2(
        model_with(VALUE), holed, DayParameters(VALUE, covariance(0), False, 0.1), model_with(VALUE)
    )
    own = product["flag"].values & ~np.uint32(Flag.NO_ATTITUDE)
    assert own[10] == Flag.VECTOR_MISSING | Flag.PRIOR_PARAMETERS
    assert (np.delete(own, 10) == Flag.PRIOR_PARAMETERS).all()
    assert (product["flag"].values & np.uint32(Flag.NO_ATTITUDE) != 0).all()
    assert np.isnan(product["field_sensor"].values[10]).all()
    assert np.isfinite(np.delete(product["field_sensor"].values, 10, axis=0)).all()


def test_one_outlier_is_flagged_and_its_value_kept():
    samples = samples_of(VALUE)
    noise = np.random.default_rng(0).normal(0, 0.1, 60)
    noise[30] = 5.0
    spoiled = samples.assign(scalar=("time", samples["scalar"].values + noise))
    product = level2(
        model_with(VALUE), spoiled, DayParameters(VALUE, covariance(0), True, 0.1), model_with(VALUE)
    )
    assert np.flatnonzero(product["flag"].values & np.uint32(Flag.OUTLIER)).tolist() == [30]
    assert product["residual"].values[30] == pytest.approx(-5.0, abs=1e-6)


def table_of_days(after: list[float]) -> xr.Dataset:
    """Return a table with one interval a day, and so much noise in each."""
    names, count = reference_of(model_with(VALUE), 0).columns, len(after)
    begins = np.arange(count) * DAY
    return xr.Dataset(
        {
            "value": (("interval", "parameter"), VALUE + 1e-4 * np.arange(count)[:, None]),
            "covariance": (("interval", "parameter", "other"), np.repeat(covariance(0)[None], count, 0)),
            "determined": (("interval", "parameter"), np.ones((count, 9), dtype=bool)),
            "after": ("interval", np.array(after)),
            "start": ("interval", begins),
            "end": ("interval", begins + DAY),
        },
        coords={"parameter": names, "other": names},
    )


def test_a_table_is_not_asked_outside_its_intervals():
    reference, table = reference_of(model_with(VALUE), 0), table_of_days([0.1])
    assert np.array_equal(day_parameters(table, DAY - 1, reference).value, VALUE)
    with pytest.raises(ModelError, match="reprocess"):
        day_parameters(table, DAY, reference)


def test_the_rows_of_some_days_say_of_these_what_the_whole_table_says():
    whole = table_of_days([0.1, 0.2, np.nan, 0.7, 0.8])
    reference, model = reference_of(model_with(VALUE), 0), model_with(VALUE)
    # A second of the neighbour on either side; an interval that only touches the span is not in it.
    some = rows_within(whole, 2 * DAY - 10**9, 3 * DAY + 10**9)
    assert some["start"].values.tolist() == [DAY, 2 * DAY, 3 * DAY]
    assert rows_within(whole, DAY, 2 * DAY)["start"].values.tolist() == [DAY]
    for at in (2 * DAY - 10**9, 2 * DAY, 3 * DAY + 10**9 - 1):
        of_whole, of_some = (day_parameters(table, at, reference) for table in (whole, some))
        assert np.array_equal(of_whole.value, of_some.value)
        assert of_whole.noise == of_some.noise
    # Of a day that does not tell its noise it is the median of all others, not of its neighbours.
    assert day_parameters(some, 2 * DAY, reference).noise == pytest.approx(0.45)
    stamps = np.arange(2 * DAY - 10**9, 3 * DAY + 10**9, 10**11)
    timed = [model.bind(table).effects[0].parameters["offset"].at(stamps) for table in (whole, some)]
    assert np.array_equal(timed[0], timed[1])


@pytest.mark.parametrize("told", ["time: constant, free: true", "time: linear, t0: 2004-01-01, free: true"])
def test_a_block_leaves_parameters_alone_that_are_refined_over_the_whole_span(told):
    entry = f"{{effect: vector_sensor, sensor: fgm, offset: {{{told}}}}}"
    text = f"model: m\nmission: champ\neffects:\n  - {entry}\n"
    sigma = reference_of(Model.parse(text, MISSION), 0).sigma
    assert (sigma[6:] == 0).all()


def test_a_parameter_fitted_once_a_block_needs_a_finite_sigma():
    entry = "{effect: vector_sensor, sensor: fgm, offset: {time: block, sigma: .inf}}"
    text = f"model: m\nmission: champ\neffects:\n  - {entry}\n"
    with pytest.raises(ModelError, match=r"vector_sensor\.offset.*finite sigma"):
        reference_of(Model.parse(text, MISSION), 0)


def test_a_fixed_parameter_may_follow_a_trend():
    text = (
        "model: m\nmission: champ\neffects:\n  - {effect: vector_sensor, sensor: fgm,"
        " offset: {time: linear, t0: 2000-01-01, value: [[1, 1], [1, 1], [1, 1]], free: false}}\n"
    )
    reference = reference_of(Model.parse(text, MISSION), DAY)
    assert (reference.sigma[6:] == 0).all()
    assert (reference.value[6:] > 1.5).all()
