"""The noise floor is that of the white noise, whatever else is in the residual; its interval is honest."""

import numpy as np
import pytest
from scipy.signal import lfilter

from inflight.residual import NO_FLOOR, NoiseFloor, floor_of_parts, floor_of_rows, join_floors, noise_floor
from inflight.time import SECOND

WHITE = 0.1


def white(generator, count=8640):
    return generator.normal(0.0, WHITE, count)


def red(generator, lag, level, count=8640):
    """First-order noise that forgets in `lag` samples."""
    keep = np.exp(-1.0 / lag)
    return lfilter([level * np.sqrt(1 - keep**2)], [1, -keep], generator.normal(size=count))


def with_gaps(generator, residual, part=0.05):
    return np.where(generator.random(residual.size) < part, np.nan, residual)


def with_outliers(generator, residual, part=0.01):
    hit = generator.random(residual.size) < part
    return residual + np.where(hit, generator.normal(0, 20.0, residual.size), 0.0)


def levels(make, cadence=10.0, seeds=20):
    found = []
    for seed in range(seeds):
        floor = noise_floor(make(np.random.default_rng(seed)), cadence)
        assert floor.low_nT <= floor.level_nT <= floor.high_nT
        found.append(floor)
    return found


ORBIT = np.sin(2 * np.pi * np.arange(8640) / 558)
CASES = {
    "white": white,
    "every stretch of a thousand readings broken": lambda g: with_gaps(g, white(g), 0.0015),
    "5 % gaps": lambda g: with_gaps(g, white(g)),
    "5 % gaps in few readings": lambda g: with_gaps(g, white(g, 1440)),
    "red": lambda g: white(g) + red(g, 60, 0.2),
    "faster red": lambda g: white(g) + red(g, 10, 0.1),
    "red and 5 % gaps": lambda g: with_gaps(g, white(g) + red(g, 60, 0.2)),
    "outliers": lambda g: with_outliers(g, white(g) + red(g, 60, 0.2)),
    "outliers, red and 5 % gaps": lambda g: with_gaps(g, with_outliers(g, white(g) + red(g, 60, 0.2))),
    "steps and waves thirty times as large": lambda g: with_gaps(g, white(g) + 3 * ORBIT + np.sign(ORBIT)),
    "a line": lambda g: white(g) + 3.0 * np.sin(2 * np.pi * np.arange(8640) / 20.3),
    "a fast line and 5 % gaps": lambda g: with_gaps(g, white(g) + np.sin(2 * np.pi * np.arange(8640) / 7.3)),
    "a long gap": lambda g: np.concatenate([white(g, 3000), np.full(4000, np.nan), white(g, 1640)]),
}


@pytest.mark.parametrize("name", CASES)
def test_the_floor_is_that_of_the_white_noise(name):
    found = levels(CASES[name])
    assert np.mean([floor.level_nT for floor in found]) == pytest.approx(WHITE, rel=0.04)
    assert np.mean([floor.low_nT <= WHITE <= floor.high_nT for floor in found]) >= 0.8


def test_the_interval_covers_as_often_as_it_says():
    found = levels(white, seeds=200)
    covered = np.mean([floor.low_nT <= WHITE <= floor.high_nT for floor in found])
    assert 0.90 <= covered <= 0.99
    width = np.mean([floor.sigma_nT for floor in found])
    assert width == pytest.approx(np.std([floor.level_nT for floor in found]), rel=0.3)


@pytest.mark.parametrize("step", [0.02, 0.1])
def test_quantised_readings_have_the_noise_of_their_steps(step):
    found = levels(lambda g: np.round(with_gaps(g, white(g) + red(g, 60, 0.2)) / step) * step)
    expected = np.hypot(WHITE, step / np.sqrt(12))
    assert np.mean([floor.level_nT for floor in found]) == pytest.approx(expected, rel=0.03)


def test_readings_too_coarse_to_change_have_a_floor_without_a_crash():
    coarse = np.where(np.arange(8640) > 4000, 5.0, 0.0)
    assert noise_floor(coarse, 1.0).level_nT < 0.1
    assert noise_floor(np.zeros(8640), 1.0).level_nT == 0.0


@pytest.mark.parametrize("cadence", [0.02, 1.0, 60.0])
def test_a_slower_cadence_has_less_white_noise(cadence):
    residual = white(np.random.default_rng(0), 86_400)
    own, slower = noise_floor(residual, cadence), noise_floor(residual, cadence, working=10 * cadence)
    assert own.level_nT == pytest.approx(WHITE, rel=0.02)
    assert slower.level_nT == pytest.approx(own.level_nT / np.sqrt(10))
    means = residual.reshape(-1, 10).mean(axis=1)
    assert slower.level_nT == pytest.approx(means.std(), rel=0.03)


@pytest.mark.parametrize(
    "residual",
    [np.empty(0), np.zeros(63), np.full(5000, np.nan), np.where(np.arange(500) % 12 == 0, np.nan, 1.0)],
)
def test_too_little_has_no_floor(residual):
    assert np.isnan(noise_floor(residual, 1.0).level_nT)


def test_a_hundred_readings_have_a_floor_with_a_wide_interval():
    found = levels(lambda g: white(g, 100), seeds=60)
    assert np.mean([floor.level_nT for floor in found]) == pytest.approx(WHITE, rel=0.1)
    assert np.mean([(floor.high_nT - floor.low_nT) / WHITE for floor in found]) > 0.3


def test_days_together_have_the_mean_variance_and_a_narrower_interval():
    days = levels(white, seeds=30)
    together = join_floors([*days, NO_FLOOR])
    assert together.level_nT == pytest.approx(np.sqrt(np.mean([day.level_nT**2 for day in days])))
    assert together.sigma_nT < 0.4 * days[0].sigma_nT
    assert together.low_nT < WHITE < together.high_nT
    assert join_floors(days[:1]).sigma_nT == pytest.approx(days[0].sigma_nT, rel=0.05)
    assert np.isnan(join_floors([NO_FLOOR]).level_nT)
    noisy = join_floors([NoiseFloor(0.1, 0.1, 0.1, 100), NoiseFloor(0.3, 0.3, 0.3, 100)])
    assert noisy.level_nT == pytest.approx(np.sqrt((0.01 + 0.09) / 2))


def test_the_floor_of_many_days_needs_no_interval_of_each():
    generator = np.random.default_rng(4)
    residual, stamps = generator.normal(0, 0.3, (12 * 1440, 1)), np.arange(12 * 1440) * 60 * SECOND
    good, parts = np.ones(len(stamps), dtype=bool), [slice(day * 1440, (day + 1) * 1440) for day in range(12)]
    many = floor_of_parts(residual, good, stamps, parts)
    each = join_floors([floor_of_rows(residual[at], good[at], stamps[at]) for at in parts])
    assert (many.level_nT, many.low_nT) == pytest.approx((each.level_nT, each.low_nT))
    assert many.low_nT < 0.3 < many.high_nT
    # Of three days each brings its own.
    few = floor_of_parts(residual, good, stamps, parts[:3])
    assert few == join_floors([floor_of_rows(residual[at], good[at], stamps[at]) for at in parts[:3]])
    assert few.low_nT < few.level_nT < few.high_nT
