"""Figures of the currents' estimators hold what was estimated."""

import numpy as np
import pytest
from bokeh.embed import file_html
from bokeh.models import Legend, Segment
from bokeh.resources import CDN
from epoch_cases import epochs_of_days, stored_epochs

from inflight.effects import panel_weights_at
from inflight.figures import coefficient_figures, local_time_figure, stack_figures, torquer_mean_figures
from inflight.mission_fit import (
    filled_running_mean,
    fit_by_local_time,
    remanent_field,
    select_panel_model,
    stack_epochs,
)
from inflight.mission_fit.torquers import COLUMNS


def labels(plot):
    return [item.label["value"] for legend in plot.select(Legend) for item in legend.items]


def test_the_stack_has_its_band_and_the_current():
    found = stack_epochs(epochs_of_days(3))
    upper, lower = stack_figures(found)
    assert "on 3 days" in upper.title.text
    assert upper.x_range is lower.x_range
    assert file_html(upper, CDN)


def test_local_time_falls_and_models_are_lines():
    hours = np.repeat((9.0 - 24.0 * 10 * np.arange(60) / 260.5) % 24.0, 15)
    epochs = stored_epochs(
        1, days=60, value=[[0.02, 0.01, -0.01], [-0.01, 0.01, 0.02]], share=panel_weights_at(hours)
    )
    choice = select_panel_model(epochs, hours)
    plot = local_time_figure(fit_by_local_time(epochs, hours), choice.chosen)
    assert (plot.x_range.start, plot.x_range.end) == (24.0, 0.0)
    assert len(list(plot.select(Segment))) == 3


@pytest.fixture
def daily():
    import xarray as xr

    random = np.random.default_rng(0)
    dims, shape = ("day", "axis", "coil"), (4, 3, 3)
    times = np.arange(4) * 86_400_000_000_000
    return xr.Dataset(
        {
            "value": (dims, random.standard_normal(shape)),
            "sigma": (dims, np.ones(shape)),
            "start": ("day", times),
            "end": ("day", times + 10),
        },
        coords={"axis": list("xyz"), "coil": list("xyz")},
    )


def test_coefficients_have_a_figure_an_axis(daily):
    plots = coefficient_figures(daily, daily.mean("day"))
    assert len(plots) == 3 == len(COLUMNS) // 3
    assert labels(plots[0]) == ["coil x", "coil y", "coil z"]


def test_what_was_held_is_dashed():
    day = 11323 + np.arange(400)
    mean = filled_running_mean(day, np.full((400, 3), 0.04), np.ones(400))
    plots = torquer_mean_figures(mean, remanent_field(mean))
    dashed = [one for one in plots[1].renderers if getattr(one.glyph, "line_dash", []) not in ([], "solid")]
    assert len(dashed) == 3
    assert np.isfinite(dashed[0].data_source.data["y"]).sum() == (mean.state > 1).sum() > 0
