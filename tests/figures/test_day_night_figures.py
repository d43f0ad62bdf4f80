"""Figures of cross-talk and of the day/night field draw what the results say."""

import numpy as np
import pytest
import xarray as xr
from bokeh.embed import components
from bokeh.models import ColumnDataSource

from inflight.figures import day_night_figure, ignored_effects_figure, with_and_without_figure
from inflight.mission_fit import SERIES, CrossTalkTable, DayNightField, IgnoredCause

PARAMETERS = ("vector_sensor.scale_factor[x]", "vector_sensor.misalignment[xz]")


def talk(shift) -> CrossTalkTable:
    causes = (IgnoredCause("bias", 0.4, "nT"), IgnoredCause("time_shift", 0.01, "s", "lag"))
    nan = np.full((2, 2), np.nan)
    return CrossTalkTable(causes, PARAMETERS, ("ppm", "arcsec"), shift, nan, 1, np.ones(2), np.ones(2))


def column(plot, name):
    source = next(one.data_source for one in plot.renderers if name in one.data_source.data)
    assert isinstance(source, ColumnDataSource)
    return source.data[name]


def test_each_unit_has_its_own_scale_of_colours():
    plot = ignored_effects_figure(talk(np.array([[15.0, 0.1], [-0.4, -3.2]])))
    assert components(plot)
    np.testing.assert_allclose(column(plot, "part"), [1.0, 0.1 / 3.2, -0.4 / 15.0, -1.0])
    assert column(plot, "text") == ["+15.0", "+0.10", "-0.40", "-3.2"]
    assert column(plot, "y") == ["bias = 0.4 nT"] * 2 + ["lag = 0.01 s"] * 2


def test_nothing_ignored_is_drawn_without_colours():
    plot = ignored_effects_figure(talk(np.zeros((2, 2))))
    assert components(plot)
    assert set(column(plot, "text")) == {"0"}


def test_the_series_is_drawn_for_the_fitted_axes():
    names = (f"{SERIES}[cz1]", f"{SERIES}[cz2]")
    value, covariance = np.array([0.4, -0.1]), np.diag([0.01, 0.02]) ** 2
    field = DayNightField(
        names,
        value,
        np.sqrt(np.diag(covariance)),
        covariance,
        np.ones(2),
        np.ones(2, dtype=bool),
        9,
        0.4,
        0.1,
    )
    plot = day_night_figure(field)
    assert components(plot)
    curves = list(plot.legend[0].items)
    assert [one.label.value for one in curves] == ["z"]
    drawn = curves[0].renderers[0].data_source.data["y"]
    assert drawn[180] == pytest.approx(0.3)
    assert drawn[0] == pytest.approx(-0.5)


def test_the_wander_is_drawn_twice_with_its_errors():
    def table(value):
        day = np.arange(3, dtype=np.int64) * 86_400_000_000_000
        row = ("block", "parameter")
        return xr.Dataset(
            {
                "value": (row, np.full((3, 2), value)),
                "sigma": (row, np.full((3, 2), 0.1)),
                "units": ("parameter", np.array(["ppm", "arcsec"])),
                "start": ("block", day),
                "end": ("block", day + 86_400_000_000_000),
            },
            coords={"parameter": list(PARAMETERS)},
        )

    plot = with_and_without_figure(table(3.0), table(0.0), PARAMETERS[1], "Angle xz")
    assert components(plot)
    assert plot.yaxis[0].axis_label == "arcsec"
    assert [one.label.value for one in plot.legend[0].items] == ["ignored", "in the model"]
