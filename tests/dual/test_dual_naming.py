"""Units get the names of the channels that switch with them, and of no other."""

import numpy as np
import pytest

from inflight.dual import match_channels_to_units


def scene(seed, switchings=60, units=3):
    random = np.random.default_rng(seed)
    which = random.integers(0, units, switchings)
    on = np.zeros(units, dtype=bool)
    signs = np.zeros((switchings, units))
    for row, unit in enumerate(which):
        signs[row, unit] = -1.0 if on[unit] else 1.0
        on[unit] = not on[unit]
    return random, signs


def test_a_unit_is_named_by_the_current_that_switches_with_it():
    random, signs = scene(1)
    noise = random.normal(0.0, 3.0, (2, len(signs)))
    changes = {"heater": -200.0 * signs[:, 1] + noise[0], "temperature": noise[1]}
    named = match_channels_to_units(signs, changes)
    assert [one.channels for one in named] == [(), ("heater",), ()]
    assert named[1].per_unit[0] == pytest.approx(-200.0, abs=5.0)
    assert "no channel" in named[0].reason


def test_channels_that_switch_together_are_both_told():
    _, signs = scene(2)
    changes = {"one": 200.0 * signs[:, 0], "two": 10.0 * signs[:, 0]}
    assert set(match_channels_to_units(signs, changes)[0].channels) == {"one", "two"}


def test_too_few_switchings_name_nothing():
    _, signs = scene(3)
    few = signs[:, :1] * (np.cumsum(np.abs(signs[:, :1]), axis=0) <= 3)
    named = match_channels_to_units(few, {"one": few[:, 0]})[0]
    assert named.channels == ()
    assert "3 times" in named.reason


def test_unrelated_channels_are_seldom_named():
    wrong = 0
    for seed in range(100):
        random, signs = scene(seed, switchings=12)
        # Channels that switch as well, each at its own times.
        changes = {str(one): 100.0 * random.choice([-1.0, 0.0, 1.0], len(signs)) for one in range(5)}
        wrong += sum(bool(one.channels) for one in match_channels_to_units(signs, changes, seed=seed))
    assert wrong <= 3
