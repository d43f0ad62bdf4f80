"""Parameters that change with time: irregular ones are told with their size, constant ones never."""

from functools import lru_cache

import numpy as np
import pytest
import scipy
from diagnosis_cases import NOISE_NT, POLAR, STEP_S, case_of, flight_of, read

from inflight.diagnosis.verdict import run_rounds
from inflight.diagnosis.wander import BlockScores, fit_walk, parameters_in_time, walk_covariance, with_wander

DAYS, BLOCK_DAYS = 16, 0.125
SCALE, OFFSET_NT, STEP, DRIFT = 1.5e-6, 0.1, 6e-6, 1.5e-6
#: Of a residual of the case.
WALKING_SCALE, WALKING_OFFSET, STEPPED, DRIFTING, NULL = range(5)


def walk(flight, seed, rate):
    """A random walk that changes by `rate` (rms) in a day; (time, 1)."""
    steps = np.random.default_rng([5, seed]).normal(0, rate * np.sqrt(STEP_S / 86_400), flight.tt2000.size)
    return np.cumsum(steps)[:, None]


@lru_cache(maxsize=1)
def changed():
    """Residuals of a scale factor and of an offset that wander, of a step, of a drift, and of noise."""
    flight = flight_of(POLAR, DAYS)
    days = STEP_S * np.arange(flight.tt2000.size)[:, None] / 86_400
    x, z = np.eye(3)[0], np.eye(3)[2]
    hidden = [
        read(flight, 1, walk(flight, 1, SCALE) * flight["field"] * z),
        read(flight, 2, walk(flight, 2, OFFSET_NT) * x),
        read(flight, 3, STEP * (days >= 9) * flight["field"] * z),
        read(flight, 4, DRIFT * days * flight["field"] * z),
        read(flight, 5),
    ]
    return case_of(flight, hidden, block_days=BLOCK_DAYS, channels=("heater_current",))


def forms_of(residual):
    found, _ = parameters_in_time(changed().search(residual))
    return {one.parameter: one for one in found}


@lru_cache(maxsize=1)
def information():
    """What the model leaves of a scale factor block by block, and a walk's covariance there."""
    search = changed().search(NULL)
    matrix, _ = BlockScores(search).of("vector_sensor.scale_factor[z]")
    return matrix, walk_covariance(search.raw.start, search.raw.end)


def drawn(generator, covariance):
    own, vectors = np.linalg.eigh(covariance)
    return vectors @ (np.sqrt(np.clip(own, 0.0, None)) * generator.standard_normal(own.size))


def test_a_constant_parameter_is_called_irregular_as_often_as_is_stated():
    matrix, covariance = information()
    generator = np.random.default_rng(3)
    p = np.array([fit_walk(matrix, drawn(generator, 0.01 * matrix), covariance).p for _ in range(200)])
    for chance in (0.05, 0.2):
        low, high = scipy.stats.binom(p.size, chance).interval(0.99)
        assert low <= np.sum(p <= chance) <= high


def test_the_size_of_a_walk_is_right_within_its_error():
    matrix, covariance = information()
    variance, day = 0.01, 0.01 / float(np.median(np.diagonal(matrix))) * 40.0
    whole = variance * matrix + day * matrix @ covariance @ matrix
    generator = np.random.default_rng(4)
    walks = [fit_walk(matrix, drawn(generator, whole), covariance) for _ in range(100)]
    pull = np.array([(one.day - day) / one.day_sigma for one in walks])
    within = [int(np.sum(np.abs(pull) < sigmas)) for sigmas in (1.0, 2.0)]
    for count, part in zip(within, (0.683, 0.954), strict=True):
        low, high = scipy.stats.binom(pull.size, part).interval(0.999)
        assert low <= count <= high
    assert np.median([one.day for one in walks]) == pytest.approx(day, rel=0.15)
    assert np.median([one.row for one in walks]) == pytest.approx(variance, rel=0.15)


@pytest.mark.parametrize(
    ("residual", "parameter", "rate"),
    [(WALKING_SCALE, "scale_factor[z]", SCALE), (WALKING_OFFSET, "offset[x]", OFFSET_NT)],
)
def test_a_parameter_that_wanders_is_named_with_size_and_windows(residual, parameter, rate):
    found = forms_of(residual)
    one = found.pop(parameter)
    assert one.form == "irregular"
    assert abs(one.size - rate) < 3 * one.sigma < rate
    assert one.gain > one.contiguous_gain
    assert one.window_s >= 2 * BLOCK_DAYS * 86_400
    assert f"{parameter} wanders by {one.size:.2g} +- {one.sigma:.1g} nT in 1 d: windows" in one.words("nT")
    # The field turns: no other parameter does as well.
    assert one.alike == ()
    assert {other.form for other in found.values()} == {"constant"}


@pytest.mark.parametrize(("residual", "form"), [(STEPPED, "steps"), (DRIFTING, "drift"), (NULL, "constant")])
def test_what_steps_or_drifts_or_stays_does_not_wander(residual, form):
    assert forms_of(residual)["scale_factor[z]"].form == form
    search = changed().search(residual)
    assert with_wander(search, [])[0] is search


def test_steps_that_stood_in_for_what_wanders_give_way_and_its_cause_stays_unknown():
    taken = run_rounds(changed().search(WALKING_SCALE, draws=500), changed().material(WALKING_SCALE))[0]
    assert any(one.change is not None and one.change.at for one in taken.accepted)
    told = changed().diagnose(WALKING_SCALE, draws=500)
    (entry, *_) = told.entries
    assert told.verdict == "UNKNOWN_EFFECT", told.sentence
    assert entry.status == "unknown"
    assert entry.name.startswith("wander(scale_factor[z], ")
    assert entry.command == f'inflight add "{entry.name}"'
    assert "scale_factor[z] wanders by" in entry.words.lower()
    assert not [one for one in told.entries if "step" in one.name]
    assert told.residual["held_out_before_nT"] > 1.15 * NOISE_NT
    assert told.residual["held_out_after_nT"] < 1.05 * NOISE_NT
    by_parameter = {one["parameter"]: one["form"] for one in told.as_json()["in_time"]}
    assert [name for name, form in by_parameter.items() if form != "constant"] == ["scale_factor[z]"]


def test_a_record_of_constant_parameters_names_nothing():
    told = changed().diagnose(NULL, draws=500)
    assert (told.verdict, told.entries) == ("NOTHING_LEFT", ())
    assert {one["form"] for one in told.as_json()["in_time"]} == {"constant"}


@pytest.mark.parametrize(("residual", "form"), [(STEPPED, "steps"), (DRIFTING, "drift")])
def test_a_change_that_was_taken_is_how_its_parameters_depend_on_time(residual, form):
    told = changed().diagnose(residual, draws=500)
    assert told.verdict == "FOUND", told.sentence
    (effect,) = told.effects
    assert effect.name.startswith("scale_step@" if form == "steps" else "scale_drift")
    found = {one["parameter"]: one["form"] for one in told.in_time}
    assert {found.pop(f"scale_factor[{axis}]") for axis in "xyz"} == {form}
    assert set(found.values()) == {"constant"}
