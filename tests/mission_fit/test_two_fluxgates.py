"""Two fluxgates and a scalar sensor: the turn between the two, and whose fault a disagreement is."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from inflight.calibration import ParameterPrior, fit_block
from inflight.effects import VectorSensor
from inflight.errors import CalibrationError
from inflight.figures import relation_figure, sensor_variance_figure
from inflight.mission_fit import (
    relation_covariance,
    relation_grams,
    relation_of,
    three_cornered_hat,
    three_cornered_hat_sums,
)
from inflight.mission_fit.two_fluxgates import NAMES, corners, fit_relation
from inflight.simulate import Parameters, SimulationSettings, simulate_day
from inflight.time import SECOND

DAYS = ["2005-01-01", "2005-01-02"]
#: What the pre-flight model would take out, and what it would not: here the sensors' equations alone count.
PLAIN = ("torquer", "solar_array", "battery", "star_camera", "heater", "remanent", "temperature")
PLAIN += (
    "temperature_lag",
    "nonlinearity",
    "oscillator",
    "heading",
    "induced",
    "scalar_filter",
    "time_shift",
)
#: Nominal values and what is known of them: scale factors, angles (deg), offsets (nT).
PRIOR = ParameterPrior(
    np.array([1.0025, 1.0025, 1.0025, 90, 90, 90, 0, 0, 0], dtype=float),
    np.array([3e-3] * 3 + [0.2] * 3 + [60.0] * 3),
)


def orbit(count=20_000, seed=0):
    """A field that turns as on an orbit; (time, 3) nT, and stamps every 10 s."""
    g = np.random.default_rng(seed)
    turn, day = np.arange(count) * 10 * 2 * np.pi / 5580, np.arange(count) * 10 * 2 * np.pi / 86400
    field = np.stack([25e3 * np.cos(turn), 6e3 * np.sin(turn + day), -45e3 * np.sin(turn)], axis=1)
    return field + g.normal(0, 500, field.shape), 10 * SECOND * np.arange(count, dtype=np.int64)


def test_turn_stretch_and_shift_are_recovered_with_honest_uncertainties():
    field, stamps = orbit()
    rotation, shift = np.array([0.04, -0.025, 0.06]), np.array([0.3, -0.7, 0.1])
    stretch = np.array([[2e-5, 1e-6, 0], [1e-6, -1e-5, 3e-6], [0, 3e-6, 4e-6]])
    truth = [*rotation, 2e-5, -1e-5, 4e-6, 1e-6, 0, 3e-6, *shift]
    inside = []
    for seed in range(12):
        g = np.random.default_rng(seed)
        second = Rotation.from_rotvec(rotation, degrees=True).inv().apply(field)
        first = field + field @ stretch + shift + g.normal(0, 0.1, field.shape)
        second = second + g.normal(0, 0.1, field.shape)
        first[100:110] += 50.0
        first[500] = np.nan
        table = fit_relation(first, second, stamps).table()
        inside.append((table["value"].values - truth) / table["sigma"].values)
        assert table.attrs["rms_nT"] == pytest.approx(0.1 * np.sqrt(2), rel=0.05)
    assert 0.6 < np.mean(np.abs(inside) < 1) < 0.76
    assert list(table["parameter"].values) == list(NAMES)


def test_too_short_a_record_is_refused_with_what_to_do():
    field, stamps = orbit(1000)
    with pytest.raises(CalibrationError, match="clusters with data"):
        fit_relation(field, field, stamps)
    with pytest.raises(CalibrationError, match="clusters with data"):
        corners(field[:, 0], field[:, 1], stamps)


@pytest.mark.parametrize(
    ("sizes", "guilty"), [((1.0, 0.1, 0.1), 0), ((0.1, 1.0, 0.1), 1), ((0.1, 0.1, 1.0), 2)]
)
def test_a_disagreement_is_told_of_the_sensor_it_belongs_to(sizes, guilty):
    inside = []
    for seed in range(60):
        g = np.random.default_rng(seed)
        stamps = 60 * SECOND * np.arange(12_000, dtype=np.int64)
        f1, f2, s = (g.normal(0, size, stamps.size) for size in sizes)
        found = corners(f1 - s, f2 - s, stamps, f1 - f2)
        assert np.argmax(found.value) == guilty
        assert found.closure < 1e-12
        inside.append((found.value - np.square(sizes)) / found.sigma)
    assert 0.6 < np.mean(np.abs(inside) < 1) < 0.76


def two(include=(), defects=(), **overrides):
    return SimulationSettings(
        cadence=10, second_fluxgate=True, without=PLAIN, include=include, defects=defects, overrides=overrides
    )


def calibrated(settings):
    """Both fluxgates after a calibration of their own against the scalar sensor, and the scalar; all days."""
    days = [simulate_day(settings, day) for day in DAYS]
    scalar = np.concatenate([day.instruments["ovm"]["F"].values for day in days])
    stamps = np.concatenate([day.instruments["ovm"]["Epoch"].values for day in days])
    fields, fits = [], []
    for name in ("fgm", "fgm2"):
        reading = np.concatenate([day.instruments[name]["FGM_RAW"].values for day in days])
        fit = fit_block(reading, np.zeros((1, 3)), scalar, np.ones(scalar.size, dtype=bool), PRIOR)
        fields.append(correction(fit.value, reading))
        fits.append(fit)
    truths = [
        np.concatenate([np.ravel(v) for v in json.loads(days[0].truth.attrs[key]).values()])
        for key in ("nine_parameters", "nine_parameters_second")
    ]
    return fields, scalar, stamps, fits, truths


def correction(value, reading):
    k = np.diag(value[:3])
    k[0, 1], k[0, 2], k[1, 2] = np.cos(np.deg2rad(value[3:6]))
    return (reading - value[6:]) @ k.T


@pytest.fixture(scope="module")
def plain():
    return calibrated(two())


def test_each_fluxgate_gets_its_own_nine_parameters(plain):
    _, _, _, fits, truths = plain
    for fit, truth in zip(fits, truths, strict=True):
        assert (np.abs(fit.value - truth) < 4 * fit.sigma).all()
        assert fit.solution.determined[[0, 1, 2, 6, 8]].all()
        assert fit.after == pytest.approx(np.hypot(0.08, 0.04), rel=0.05)
    assert np.abs(truths[0] - truths[1])[6:].min() > 5


def test_only_the_two_together_tell_how_one_is_turned_against_the_other(plain):
    (first, second), _, stamps, fits, _ = plain
    table = fit_relation(first, second, stamps).table()
    value, sigma = table["value"].values, table["sigma"].values
    # Angles of either sensor, which its own fit knows to some arcseconds, are in the turn as well.
    known = np.hypot(*(fit.sigma[3:6].max() for fit in fits))
    assert np.abs(value[:3] - Parameters().second_rotation).max() < 4 * np.hypot(known, sigma[:3].max())
    shift = np.hypot(*(fit.sigma[6:] for fit in fits))
    assert (np.abs(value[9:]) < 4 * np.hypot(shift, sigma[9:])).all()
    assert table.attrs["rms_nT"] == pytest.approx(0.08 * np.sqrt(2), rel=0.05)


@pytest.mark.parametrize(
    ("include", "overrides", "guilty"),
    [
        (("unrecorded_heater",), {"unrecorded_heater_field": (0.0, 0.0, 0.65)}, 0),
        (("clock_fault",), {"clock_fault": 0.02, "clock_fault_days": (1827.0, 1829.0)}, 2),
    ],
)
def test_the_three_comparisons_together_name_the_sensor(plain, include, overrides, guilty):
    def parts(made):
        (first, second), scalar, stamps, _, _ = made
        main, other = (np.linalg.norm(field, axis=1) - scalar for field in (first, second))
        turned = fit_relation(first, second, stamps)
        along = np.linalg.norm(first, axis=1) - np.linalg.norm(second, axis=1)
        return corners(main, other, stamps, along), turned

    quiet, _ = parts(plain)
    found, turned = parts(calibrated(two(include, **overrides)))
    excess = found.value - quiet.value
    assert np.argmax(excess) == guilty
    assert excess[guilty] > 5 * found.sigma[guilty]
    assert (np.delete(excess, guilty) < 0.1 * excess[guilty]).all()
    assert found.closure < 1e-9
    seen_between = turned.rms > 1.2 * 0.08 * np.sqrt(2)
    assert seen_between == (guilty != 2)


def test_statistics_of_days_tell_what_all_samples_do():
    field, stamps = orbit(40_000)
    g = np.random.default_rng(5)
    first = field * (1 + 1e-5) + np.array([0.2, -0.1, 0.0]) + g.normal(0, 0.1, field.shape)
    second = field + g.normal(0, 0.1, field.shape)
    # Parts end where clusters do.
    halves = [slice(0, 21_600), slice(21_600, None)]
    grams = [relation_grams(first[one], second[one], stamps[one]) for one in halves]
    parts = relation_of(np.concatenate([one for one, _ in grams]), np.concatenate([one for _, one in grams]))
    whole = fit_relation(first, second, stamps)
    np.testing.assert_allclose(parts.fit.value, whole.fit.value, atol=0.05 * whole.fit.sigma.max())
    assert parts.rms == pytest.approx(whole.rms, rel=1e-3)
    scalar = g.normal(0, 0.05, len(field))
    main, other = (g.normal(0, size, len(field)) - scalar for size in (0.02, 0.03))
    moments = np.concatenate([three_cornered_hat_sums(main[one], other[one], stamps[one]) for one in halves])
    together = corners(main, other, stamps)
    np.testing.assert_allclose(three_cornered_hat(moments).value, together.value, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(three_cornered_hat(moments).sigma, together.sigma, rtol=1e-9)
    with pytest.raises(CalibrationError, match="clusters"):
        three_cornered_hat(moments[:3])


def test_figures_of_relation_and_corners_show_every_number():
    field, stamps = orbit()
    g = np.random.default_rng(6)
    table = fit_relation(field + g.normal(0, 0.1, field.shape), field, stamps).table()
    for part, count in (("rotation", 3), ("stretch", 6), ("shift", 3)):
        drawn = relation_figure(table, part)
        assert len(drawn.xaxis[0].major_label_overrides) == count
    made = corners(g.normal(0, 0.1, len(field)), g.normal(0, 0.1, len(field)), stamps)
    assert sensor_variance_figure(made.table()).xaxis[0].major_label_overrides[2] == "scalar sensor"


def test_what_an_error_of_a_calibration_does_to_the_relation_is_what_it_does():
    field, stamps = orbit(8000)
    value = np.array([1.001, 0.998, 1.002, 90.03, 89.95, 90.04, 27.0, -19.0, 21.0])
    # A sensor that is mounted on its side.
    mounted = Rotation.from_euler("xyz", [90.0, 20.0, -40.0], degrees=True)
    axes = mounted.inv().apply(field)
    reading = VectorSensor().disturb(axes, None, nine(value), None)
    exact = fit_relation(field, field, stamps).table()["value"].values
    for place, step in enumerate([1e-5] * 3 + [1e-3] * 3 + [0.1] * 3):
        wrong = value + step * (np.arange(9) == place)
        seen = mounted.apply(VectorSensor().correct(reading, None, nine(wrong), None))
        moved = fit_relation(seen, field, stamps).table()["value"].values - exact
        alone = relation_covariance(value, np.diag(step**2 * (np.arange(9) == place)), mounted)
        np.testing.assert_allclose(np.sqrt(np.diag(alone)), np.abs(moved), rtol=0.02, atol=1e-3 * step)


def nine(value):
    return dict(zip(("scale_factor", "misalignment", "offset"), value.reshape(3, 3), strict=True))
