"""Numbers that a calibration holds: what their errors do to the nine parameters is in the covariance."""

from dataclasses import replace

import numpy as np
import xarray as xr
from calibration_cases import TRUTH, measure, polar_orbit

from inflight.calibration import (
    Interval,
    NormalEquations,
    calibration_table,
    concat_equations,
    day_parameters,
    fit_block,
    level2,
    reference_of,
    remove_other_effects,
)
from inflight.mission import Mission
from inflight.mission_fit import (
    held_numbers_of,
    held_products,
    held_shifts,
    held_shifts_of_each,
    with_held_numbers,
)
from inflight.model import Model
from inflight.time import DAY, SECOND

TEXT = """
mission: held
instruments:
  hk:
    role: housekeeping
    cadence: 40 s
    files: {pattern: "c", reader: table, time: t}
    channels: {load: {variable: i, unit: A}}
  fgm:
    role: vector
    cadence: 40 s
    delay: {value: 0 s, sigma: DELAY}
    files: {pattern: "a", reader: table, time: t}
    channels: {field: {variables: [x, y, z], unit: nT}}
  ovm:
    role: scalar
    cadence: 40 s
    files: {pattern: "b", reader: table, time: t}
    channels: {field: {variable: f, unit: nT}}
comparisons: {main: {kind: scalar, vector: fgm, scalar: ovm}}
"""
MISSION = Mission.parse(TEXT.replace("DELAY", "0 s"))
MODEL = """
model: held
mission: held
comparison: main
effects:
  - effect: vector_sensor
    sensor: fgm
    scale_factor: {time: block, unit: "1", value: [1, 1, 1], sigma: [0.005, 0.005, 0.005]}
    misalignment: {time: block, unit: deg, value: [90, 90, 90], sigma: [0.5, 0.5, 0.5]}
    offset: {time: block, unit: nT, value: [0, 0, 0], sigma: [100, 100, 100]}
  - {effect: time_shift, sensor: ovm, seconds: {unit: s, value: 0.0, sigma: 0.002}}
  - {effect: heading, sensor: ovm, vector: {unit: nT, value: [0, 0, 0], sigma: [0, 0, 0.3], free: false}}
  - {effect: scalar_bias, sensor: ovm, bias: {unit: nT, value: 0.0, sigma: 0.2}}
"""
#: One sigma of each: clock (s), fields along x, y, z and bias (nT).
SIGMA = np.array([0.002, 0.0, 0.0, 0.3, 0.2])
ORBIT = polar_orbit(2160, 40.0)


def fitted(errors, seed=0):
    """Return model, samples, the fit and its equations where the held numbers are off by so much."""
    model = Model.parse(MODEL, MISSION)
    strength = np.linalg.norm(ORBIT, axis=1)
    noise = np.random.default_rng(seed).normal(0.0, 0.1, strength.size)
    made = measure(ORBIT, TRUTH, noise)
    # The scalar sensor reads earlier, and too high, by what the model does not know.
    along = ORBIT / strength[:, None]
    scalar = made.scalar - errors[0] * np.gradient(strength, 40.0) + along @ errors[1:4] + errors[4]
    stamps = 40 * SECOND * np.arange(strength.size) + 700_000_000 * SECOND
    samples = xr.Dataset(
        {
            "vector": (("time", "axis"), made.reading, {"units": "nT"}),
            "scalar": ("time", scalar, {"units": "nT"}),
            "flag": ("time", np.zeros(strength.size, dtype=np.uint32)),
            "tt2000": ("time", stamps),
        }
    )
    prior = reference_of(model, int(stamps[0]))
    fit = fit_block(*remove_other_effects(model, samples), np.ones(strength.size, dtype=bool), prior)
    span = int(stamps[0]), int(stamps[-1]) + 1
    return model, samples, fit, NormalEquations.from_fit(fit, prior, span, {"comparison": "main"}), prior


def test_what_one_sigma_of_each_number_does_is_what_it_does():
    model, samples, fit, equations, prior = fitted(np.zeros(5))
    products = held_products(model, samples, fit.value, fit.count)
    shifts = held_shifts(equations, products[None], prior.sigma, fit.after)
    assert shifts.shape == (5, 9)
    assert np.all(shifts[1:3] == 0.0)
    for number in (0, 3, 4):
        moved = fitted(SIGMA * (np.arange(5) == number))[2].value - fit.value
        size = np.abs(shifts[number])
        clear = size > 0.3 * fit.sigma
        assert clear.any()
        # Of either sign: only squares are used. The fit weighs rows robustly, the products do not.
        np.testing.assert_allclose(np.abs(moved)[clear], size[clear], rtol=0.15)


def test_blocks_by_themselves_are_moved_as_one_that_is_fitted_alone():
    random = np.random.default_rng(3)
    _, _, fit, _, prior = fitted(np.zeros(5))
    blocks = [
        NormalEquations.from_fit(
            replace(fit, gram=fit.gram * random.uniform(0.5, 2.0)), prior, (k * DAY, (k + 1) * DAY), {}
        )
        for k in range(6)
    ]
    products, noise = random.normal(size=(6, 5, 9)), random.uniform(0.1, 1.0, 6)
    sigma = 10.0 ** random.uniform(-4, 1, (6, 9))
    sigma[1, 2], sigma[4, :3] = 0.0, 0.0  # fixed ones, others in each block
    each = held_shifts_of_each(concat_equations(blocks), products, sigma, noise)
    assert np.all(each[1, :, 2] == 0.0)
    assert np.all(each[0] != 0.0)
    for k, block in enumerate(blocks):
        np.testing.assert_array_equal(each[k], held_shifts(block, products[k : k + 1], sigma[k], noise[k]))


def test_the_errors_of_twelve_seeds_are_covered_with_them_and_not_without():
    model, samples, fit, equations, prior = fitted(np.zeros(5))
    shifts = held_shifts(
        equations, held_products(model, samples, fit.value, fit.count)[None], prior.sigma, fit.after
    )
    whole = np.sqrt(fit.sigma**2 + np.sum(shifts**2, axis=0))
    off = []
    for seed in range(12):
        errors = SIGMA * np.random.default_rng([1, seed]).normal(size=5)
        off.append(fitted(errors, seed)[2].value - TRUTH)
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    # Chi-square of twelve: 0.55 to 1.5 hold 99 of 100.
    assert np.all((rms / whole > 0.45) & (rms / whole < 1.6))
    assert (rms / fit.sigma).max() > 5.0


#: Of the vector sensor: fields of a current along x, y, z (nT/A), and its clock (s).
VECTOR_SIGMA = np.array([0.3, 0.3, 0.3, 0.004])
CURRENT = f"""
  - effect: channel_field
    channel: load
    sensor: fgm
    coefficient: {{unit: nT/A, value: [0, 0, 0], sigma: {VECTOR_SIGMA[:3].tolist()}}}
"""


def test_a_number_without_a_stated_sigma_is_taken_as_exact():
    text = CURRENT.replace(f", sigma: {VECTOR_SIGMA[:3].tolist()}", "")
    model = Model.parse(MODEL[: MODEL.index("  - {effect: time_shift")] + text, MISSION)
    assert held_numbers_of(model) == ()


def product_errors(errors, seed):
    """Return true errors of a product whose current and clock are off by so much, and the stated ones.

    (time, axis) nT; the last as if the nine and the numbers had nothing in common.
    """
    mission = Mission.parse(TEXT.replace("DELAY", f"{VECTOR_SIGMA[3]} s"))
    model = Model.parse(MODEL[: MODEL.index("  - {effect: time_shift")] + CURRENT, mission)
    stamps = 40 * SECOND * np.arange(len(ORBIT)) + 700_000_000 * SECOND
    # Most of a constant current, and what comes and goes with the orbit.
    load = 1.0 + np.sin(2 * np.pi * 40.0 * np.arange(len(ORBIT)) / 5580.0)
    noise = np.random.default_rng(seed).normal(0.0, 0.1, ORBIT.shape)
    added = load[:, None] * errors[:3] + errors[3] * np.gradient(ORBIT, 40.0, axis=0)
    made = measure(ORBIT + added + noise, TRUTH)
    samples = xr.Dataset(
        {
            "vector": (("time", "axis"), made.reading, {"units": "nT"}),
            "scalar": ("time", np.linalg.norm(ORBIT, axis=1), {"units": "nT"}),
            "load": ("time", load, {"units": "A"}),
            "flag": ("time", np.zeros(len(ORBIT), dtype=np.uint32)),
            "tt2000": ("time", stamps),
        }
    )
    prior, span = reference_of(model, int(stamps[0])), (int(stamps[0]), int(stamps[-1]) + 1)
    fit = fit_block(*remove_other_effects(model, samples), np.ones(len(ORBIT), dtype=bool), prior)
    equations = NormalEquations.from_fit(fit, prior, span, {"comparison": "main"})
    held = held_shifts(
        equations, held_products(model, samples, fit.value, fit.count)[None], prior.sigma, fit.after
    )
    row = Interval(*span, span, fit.value, fit.covariance, fit.solution, 1.0, fit.before, fit.after, 1, held)
    table = with_held_numbers(calibration_table([row], prior, {}), [held], held_numbers_of(model))
    product, apart = (
        level2(model.bind(one), samples, day_parameters(one, span[0], prior, span), model)
        for one in (table, table.assign(number_shift=0.0 * table["number_shift"]))
    )
    off = product["field_sensor"].values - ORBIT
    return off, product["uncertainty"].values, apart["uncertainty"].values


def test_a_number_of_the_vector_sensor_and_what_the_nine_make_of_it_are_one_error():
    pulls, wider = [], []
    for seed in range(12):
        off, sigma, apart = product_errors(
            VECTOR_SIGMA * np.random.default_rng([2, seed]).normal(size=4), seed
        )
        pulls.append((off / sigma)[::50])
        wider.append(apart / sigma)
    rms = np.sqrt(np.mean(np.square(pulls), axis=(0, 1)))
    assert np.all((rms > 0.55) & (rms < 1.5))
    # The offsets make good most of what the current is off by.
    assert np.mean(wider) > 2.0
