"""What other blocks, folds and wider bins turn over is told fragile; what they merely show less of is not."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from diagnosis_cases import NOISE_NT, POLAR, STEP_S, case_of, flight_of, read, slow_noise

from inflight.diagnosis.choices import turned_over
from inflight.samples import slow_response

DAYS, SIZE, SEEDS = 40, np.array([0.15, -0.1, 0.12]), 4
NOISY, UNLIKE = 0.09, 0.062


def with_channels(flight, **channels):
    """Return a flight some of whose channels have other values."""
    made = {name: ("time", values, flight.samples[name].attrs) for name, values in channels.items()}
    return replace(flight, samples=flight.samples.assign(made))


@lru_cache(maxsize=1)
def noisy():
    """A battery current is the cause, and is recorded with much noise; the load's is nearly the same."""
    flight = flight_of(POLAR, DAYS)
    generator = np.random.default_rng(3)
    count = flight.tt2000.size
    cause = slow_noise(generator, count, 12_000.0, 1.0)
    flight = with_channels(
        flight,
        battery_current=cause + generator.normal(0.0, NOISY, count),
        payload_current=cause + slow_noise(generator, count, 12_000.0, UNLIKE),
    )
    readings = [read(flight, seed, field=cause[:, None] * SIZE) for seed in range(SEEDS)]
    return case_of(flight, readings, channels=("battery_current", "payload_current"))


@pytest.mark.parametrize("seed", range(SEEDS))
def test_what_wider_bins_explain_otherwise_is_fragile(seed):
    found = noisy().diagnose(seed)
    first = found.effects[0]
    print(found.sentence, [(one.name, one.status, one.turned_over_by) for one in found.effects])
