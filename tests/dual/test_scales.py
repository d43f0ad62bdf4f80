"""Contrasts on time scales hold all the variance of a series, and white noise is alike on all."""

import numpy as np
import pytest

from inflight.dual.readings import cells_of, contrasts, running_sums, scales_of


def power_by_scale(series, longest):
    sums = running_sums(series)
    return [np.mean(contrasts(sums, one)[0] ** 2) / (2.0 * one) for one in scales_of(len(series), longest)]


def test_white_noise_has_the_same_contrasts_on_every_scale():
    cells = cells_of(np.random.default_rng(1).normal(size=(20_000, 3)))
    for scale in np.unique(cells.scale):
        here = cells.select(cells.scale == scale)
        found = np.einsum("c,cii->", here.count, here.covariance) / 3.0 / here.count.sum()
        assert found == pytest.approx(1.0, abs=5.0 / np.sqrt(here.count.sum()))


@pytest.mark.parametrize("kind", ["line", "walk", "steps", "noise"])
def test_powers_of_all_scales_up_to_half_the_record_are_its_variance(kind):
    count, random = 8192, np.random.default_rng(2)
    series = {
        "line": np.linspace(-1.0, 1.0, count)[:, None] * np.ones(50),
        "walk": np.cumsum(random.normal(size=(count, 50)), axis=0),
        "steps": (np.searchsorted(np.cumsum(random.exponential(900, 40)), np.arange(count)) % 2)[:, None]
        * 1.0,
        "noise": random.normal(size=(count, 50)),
    }[kind]
    assert sum(power_by_scale(series, 2)) == pytest.approx(np.mean(np.var(series, axis=0)), rel=0.1)


def test_a_constant_and_an_empty_series_have_no_contrasts():
    assert cells_of(np.full((1000, 3), 5e4)).covariance == pytest.approx(0.0, abs=1e-12)
    assert len(cells_of(np.zeros((0, 3)))) == 0


def test_scales_are_powers_of_two_up_to_a_part_of_the_record_and_half_of_it():
    assert scales_of(1000, 16) == [1, 2, 4, 8, 16, 32]
    assert scales_of(1000, 2) == [1, 2, 4, 8, 16, 32, 64, 128, 256, 500]
    assert scales_of(1024, 2)[-2:] == [256, 512]
    assert scales_of(3, 16) == [1]
    assert scales_of(1, 2) == []
