"""Figures of the estimators draw every result, from numbers alone."""

import numpy as np
import pytest
from bokeh.models import GlyphRenderer
from estimator_cases import LA, LB, NINE, PRIOR_SIGMA, SCALES, nine_at, table_of, wandering
from test_estimators_z_offset import days

from docs.figures import distribution
from inflight.calibration import distribute_residual, table_boundary_steps, trend_jumps
from inflight.figures import causes as z_offset
from inflight.figures import parameters as behaviour
from inflight.figures import parameters as trends
from inflight.mission_fit import (
    find_clock_faults,
    fit_spread_law,
    fit_trends,
    hysteresis_loop,
    make_trend,
    measure_event_steps,
    offsets_from_spread,
    parameter_spectrum,
    running_mean,
)
from inflight.mission_fit.trend_selection import compare_trends
from inflight.mission_fit.trends import equations_of_table
from inflight.time import from_mjd2000

SIZES = np.array([2e-6] * 3 + [5e-4] * 3 + [0.02] * 3)
MJD = np.arange(200.0, 2200.0) + 0.5


def drawn(plot) -> int:
    """How many numbers the glyphs hold."""
    return sum(
        len(next(iter(one.data_source.data.values()), []))
        for one in plot.renderers
        if isinstance(one, GlyphRenderer)
    )


def trend_figures():
    edges = np.arange(200.0, 3200.0, 15.0)
    noise = np.random.default_rng(1).normal(size=(edges.size, 9)) * SIZES
    table = table_of(edges, np.array([nine_at(day + 7.5) for day in edges]) + noise, SIZES, NINE, width=15.0)
    equations = equations_of_table(table)
    origin = int(from_mjd2000(150.0))
    log = make_trend("log", equations.middle, origin)
    fit = fit_trends(equations, dict.fromkeys(SCALES, log), PRIOR_SIGMA)
    found = compare_trends(equations, SCALES, PRIOR_SIGMA, t0=origin)
    steps = table_boundary_steps(table)
    smooth = trend_jumps(lambda times: fit.at(times)[0], steps.at)
    return [
        trends.comparison_figure(found),
        trends.boundary_steps_figure(steps, smooth),
    ]


def offset_figures():
    offsets = np.random.default_rng(2).normal(0, 0.5, 40)
    statistics = days(offsets)
    law = fit_spread_law(statistics, offsets, np.full(40, 0.01))
    found = offsets_from_spread(statistics, law.noise, float(np.sqrt(law.covariance[1, 1])))
    return [z_offset.offsets_figure(found)]


def distribution_figures():
    seconds = np.arange(43_200)
    residual = 0.3 * np.sin(2 * np.pi * seconds / 5580) + 0.1 * np.random.default_rng(3).normal(size=43_200)
    residual[20_000:21_000] = np.nan
    found = distribute_residual(np.tile([2e4, 1e3, 3e4], (43_200, 1)), residual, seconds * 10**9)
    return [distribution.distribution_figure(found, seconds / 3600), distribution.left_spectrum_figure(found)]


def behaviour_figures():
    generator = np.random.default_rng(4)
    value = 0.05 * wandering(MJD.size, 20, generator) + 0.2 * np.cos(2 * np.pi * MJD / 260.5)
    value[generator.random(MJD.size) < 0.1] = np.nan
    sigma = np.full(MJD.size, 0.03)
    warm = 10 + 5 * np.sin(2 * np.pi * MJD / 130)
    shift = 0.015 + 5e-4 * generator.normal(size=MJD.size)
    shift[1000:1004] += 0.012
    means = [running_mean(MJD, value, window, unit="nT") for window in (60.0, 260.0)]
    events = MJD[10::40] - 0.1
    spectrum = parameter_spectrum(MJD, value, sigma, trials=10, unit="nT")
    loop = hysteresis_loop(MJD, warm, value + 0.03 * np.cos(2 * np.pi * MJD / 130), "nT")
    steps = measure_event_steps(MJD, value + 0.5 * (events[20] < MJD), sigma, events, unit="nT")
    return [
        behaviour.parameter_spectrum_figure(spectrum, "offset z"),
        behaviour.running_means_figure(MJD, value, means, "offset z"),
        behaviour.hysteresis_figure(loop, "offset z"),
        behaviour.event_steps_figure(steps, "offset z"),
        behaviour.clock_figure(find_clock_faults(MJD, shift, np.full(MJD.size, 4e-4)), shift),
    ]


@pytest.mark.parametrize("make", [trend_figures, offset_figures, distribution_figures, behaviour_figures])
def test_every_figure_draws_its_numbers(make):
    for plot in make():
        assert drawn(plot) >= 5
        assert plot.title.text


def test_the_published_law_is_what_the_cases_are_made_of():
    assert nine_at(151.0)[:3] == pytest.approx(LA)
    assert nine_at(150.0 + np.e)[:3] == pytest.approx(LA + LB)
