"""How often a search names something in noise: 200 noises on each of three orbits, one pass each."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_cases import (
    CHANNELS,
    DAWN_DUSK,
    ELLIPTIC,
    NOISE_NT,
    POLAR,
    STEP_S,
    case_of,
    flight_of,
    read,
)
from scipy.signal import lfilter

from benchmarks.null_cases import additions, replace_residual, suspects
from inflight.diagnosis import Search

ORBITS = {"polar": POLAR, "elliptic at 45 degrees": ELLIPTIC, "dawn to dusk": DAWN_DUSK}
NOISES = 200


def noises(count):
    """White noise, and noise that remembers ten minutes, half an hour and two hours; (time, noise) nT."""
    g = np.random.default_rng(4)
    white = g.normal(0, NOISE_NT, (count, NOISES))
    for part, memory_s in enumerate((600.0, 1800.0, 7200.0), start=1):
        phi = np.exp(-STEP_S / memory_s)
        drive = g.normal(0, 0.2, (count, NOISES // 4))
        held = slice(part * NOISES // 4, (part + 1) * NOISES // 4)
        white[:, held] += lfilter([np.sqrt(1 - phi**2)], [1.0, -phi], drive, axis=0)
    return white


def searched(orbit, field=0.0, some=NOISES):
    flight = flight_of(orbit, 10)
    residuals = noises(flight.tt2000.size)[:, :some]
    if np.any(field):
        residuals = residuals + flight.along(flight["heater_current"][:, None] * field)[:, None]
    case = case_of(flight, [read(flight)], residuals, block_days=0.4, channels=CHANNELS[2:5])
    one = case.search()
    return Search.begin(
        case.raw, case.white, one.library, one.intervals, one.shared.days, time_variable=one.time_variable
    )


@pytest.mark.parametrize("orbit", ORBITS)
def test_in_noise_nothing_is_found(orbit):
    wrong = additions(searched(ORBITS[orbit]))
    assert len(wrong) <= 0.05 * NOISES + 3 * np.sqrt(0.05 * 0.95 * NOISES), wrong


def test_what_is_there_is_found_in_every_noise():
    search = searched(POLAR, np.array([0.3, 0.0, -0.3]), some=8)
    found = additions(search, range(1, 9))
    assert list(found) == list(range(1, 9))
    assert all("channel_field(heater_current)" in names for names in found.values())


def test_the_quick_look_lets_nothing_pass_that_a_table_would_add():
    """With rules that noise often meets: all that the whole tables would add is looked at."""
    search = searched(POLAR, some=8)
    search = replace(search, rules=replace(search.rules, t=0.5, gain=0.0005, draws=10))
    quick = suspects(search, range(1, 9))
    for residual in range(1, 9):
        table = replace_residual(search, residual).table()
        real = np.array([not option.placebo for option in table.options])
        reached = [
            real & (scores.t > search.rules.t) & (scores.gain > search.rules.gain)
            for scores in table.scores.values()
        ]
        assert (residual in quick) == bool(np.any(reached))
