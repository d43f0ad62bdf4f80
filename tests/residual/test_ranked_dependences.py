"""The strongest structures of a residual are told one after the other, each once, in words."""

import numpy as np

from inflight.residual import Coordinate, measure_dependences, rank_dependences, select_successively

COUNT, BLOCKS = 14_400, 60
BLOCK = np.repeat(np.arange(BLOCKS), COUNT // BLOCKS)
TIME = np.arange(COUNT)
TURN, TILT = TIME / 37.0, 0.9 * np.sin(TIME / 1013.0)
DIRECTION = np.stack([np.cos(TURN) * np.cos(TILT), np.sin(TURN) * np.cos(TILT), np.sin(TILT)], axis=1)
CURRENT, WARMTH = np.sin(TIME / 211.0), np.sin(TIME / 509.0)
COORDINATES = {
    one.name: one
    for one in (
        Coordinate("current", "A", "solar_current", CURRENT, np.gradient(CURRENT)),
        Coordinate("copy of current", "mA", "other", 1000 * CURRENT + 3),
        Coordinate("warmth", "degC", "temperature", WARMTH),
        Coordinate("field direction z", "", "field_direction", DIRECTION[:, 2]),
        Coordinate("constant", "", "other", np.ones(COUNT)),
    )
}


def told(residual):
    found = measure_dependences(COORDINATES.values(), residual, BLOCK)
    return rank_dependences(COORDINATES, found, residual, DIRECTION, BLOCK)


def noise(seed=0):
    return np.random.default_rng(seed).normal(0, 0.1, COUNT)


def test_two_structures_are_told_largest_first_and_a_copy_is_not_a_third():
    failures = told(noise() + 0.2 * CURRENT + 0.1 * WARMTH)
    names = [one.coordinate for one in failures]
    assert names[0] in ("current", "copy of current")
    assert names[1:] == ["warmth"]
    first, second = failures
    assert abs(first.amplitude - 0.2 * CURRENT.std()) < 4 * first.sigma
    assert abs(second.amplitude - 0.1 * WARMTH.std()) < 4 * second.sigma
    assert second.sentence.startswith("Beyond that, the residual follows warmth with 0.07")
    assert "degC" in second.sentence
    assert "follows this temperature" in second.sentence


def test_the_axis_is_named_when_one_stands_out():
    (failure, *_) = told(noise() + 0.3 * (CURRENT + 1) * DIRECTION[:, 2])
    assert failure.coordinate == "field direction z"
    (failure, *_) = told(noise() + 0.3 * DIRECTION[:, 2])
    assert failure.axis == "z"
    assert abs(failure.response.amplitude[2] - 0.3) < 3 * failure.response.sigma_amplitude[2]
    assert "as a field along z of 0." in failure.sentence


def test_branches_that_differ_are_told():
    (failure, *_) = told(noise() + 0.2 * np.sin((TIME - 70) / 211.0))
    assert "rising and falling differ by" in failure.sentence


def test_noise_is_told_nothing_of():
    assert sum(len(told(noise(seed))) for seed in range(20)) <= 1


def test_a_residual_that_is_not_there_is_told_nothing_of():
    assert told(np.full(COUNT, np.nan)) == []


def test_what_other_times_explain_as_well_is_no_structure():
    """A structure counts when it exceeds what its coordinate at other times explains of the rest."""
    sizes = {"drift": 3.0, "current": 2.0, "warmth": 1.0}
    chance = {"drift": 3.5, "current": 0.1, "warmth": 0.1}
    found = select_successively(
        dict(sizes),
        list,
        size=lambda name: sizes[name],
        is_clear=lambda _: True,
        remove=lambda left, name: {one: size for one, size in left.items() if one != name},
        chance=lambda _, name: chance[name],
        least=0.5,
        count=3,
    )
    assert [name for name, *_ in found] == ["current", "warmth"]


def test_a_structure_of_one_period_is_told_though_other_times_have_it_too():
    """The phase of a period, shifted, is the same phase: what it explains by that is no chance."""
    phase = (TIME / 288.0) % 1.0
    coordinates = {"phase": Coordinate("phase", "", "orbit_phase", phase)}
    residual = noise() + 0.2 * np.sin(2 * np.pi * phase)
    found = measure_dependences(coordinates.values(), residual, BLOCK)
    (failure,) = rank_dependences(coordinates, found, residual, DIRECTION, BLOCK)
    assert abs(failure.amplitude - 0.2 / np.sqrt(2.0)) < 4 * failure.sigma + 2e-3
