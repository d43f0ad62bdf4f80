"""Figures are built from minimal and awkward data, and a page needs nothing but itself."""

import html
import json
from html.parser import HTMLParser

import numpy as np
import pytest
import xarray as xr
from bokeh.document import Document
from bokeh.embed import json_item
from bokeh.models import ColumnDataSource, Legend, Range1d, Segment

from inflight.figures import (
    axis_figure,
    contribution_figure,
    daily_figure,
    dependence_figure,
    excess_scatter_figure,
    histogram_figure,
    html_page,
    html_table,
    parameter_figures,
    series_figure,
    spectrum_figure,
    stack_rows,
)
from inflight.figures.page import figure_parts
from inflight.residual import AxisResponse, Dependence, Line, ParameterScatter, daily_scatter
from inflight.residual.dependence import Branch, Loop
from inflight.time import day_bounds

NAN = float("nan")


def written(plot):
    """Return a figure as a browser gets it; it fails where something cannot be written."""
    return json.dumps(json_item(plot))


def days(count):
    return np.datetime64("2024-03-01", "ns") + np.arange(count) * np.timedelta64(1, "D")


@pytest.mark.parametrize(
    ("before", "after", "floor"),
    [([3.0], [0.1], 0.05), ([NAN], [NAN], NAN), ([3.0, NAN, 1.0], [0.1, 0.2, NAN], 0.0), ([0.0], [0.0], NAN)],
)
def test_daily(before, after, floor):
    plot = daily_figure(days(len(before)), np.array(before), np.array(after), floor)
    assert written(plot)
    assert plot.x_range.end - plot.x_range.start >= 86_400_000


def test_the_axis_of_less_than_two_decades_has_few_ticks():
    plot = daily_figure(days(2), np.array([3.0, 2.0]), np.array([0.1, 0.2]), 0.05)
    assert [tick for tick in plot.yaxis.ticker.ticks if 0.1 <= tick <= 3.0] == pytest.approx([0.1, 0.3, 1, 3])


@pytest.mark.parametrize("count", [0, 1, 100])
def test_series(count):
    values = np.full(count, NAN if count == 1 else 0.5)
    assert written(series_figure(days(count), values, values - 1, values + 1))


def test_histogram_of_nothing_and_of_something():
    edges = np.linspace(-1, 1, 161)
    for counts in (np.zeros(160), np.full(160, 1e9)):
        assert written(histogram_figure(edges, counts, np.zeros(160)))


def test_spectrum_without_the_one_before_and_with_periods_outside():
    frequency = np.linspace(1e-4, 0.5, 2048)
    power = np.ones(2048)
    plot = spectrum_figure(frequency, None, power, {"torquer": 20.0, "year": 3e7})
    text = written(plot)
    assert "torquer" in text
    assert "year" not in text
    assert "pre-flight" not in text


def followed(name, unit, centre, mean, sigma, loop=None):
    """Return a dependence with an amplitude of 0.1 +- 0.01 nT."""
    return Dependence(
        coordinate=name,
        unit=unit,
        centre=centre,
        mean=mean,
        sigma=sigma,
        amplitude=0.1,
        sigma_amplitude=0.01,
        loop=loop,
    )


def test_a_spectrum_marks_unknown_lines_where_they_are_seen():
    frequency = np.linspace(1e-4, 0.5, 43_200)
    seen = np.array([NAN, NAN, NAN, 0.2])
    lines = [
        Line(period_s=period, label=label, follows="", ratio=ratio, amplitude=seen, sigma=seen / 10)
        for period, label, ratio in ((2460.0, "", 40.0), (5550.0, "orbit", 90.0))
    ]
    along = written(
        spectrum_figure(frequency, np.ones(43_200), np.ones(43_200), {"orbit": 5550.0}, lines, "z")
    )
    assert "41 min" in along
    assert "unknown period" in along
    assert len(along) < 300_000, "a browser is given few points"
    residual = written(spectrum_figure(frequency, None, np.ones(43_200), {}, lines))
    assert "41 min" not in residual


def test_branches_are_drawn_where_they_differ():
    centre, mean, sigma = np.arange(3.0), np.array([0.1, NAN, 0.2]), np.array([0.01, NAN, 0.01])
    branch = Branch(mean, sigma)
    for opening, drawn in ((0.5, True), (0.01, False)):
        loop = Loop(branch, branch, opening, 0.01)
        text = written(dependence_figure(followed("t", "K", centre, mean, sigma, loop)))
        assert ("rising" in text) == drawn


def test_axes_and_wander_are_drawn_from_little():
    ones = np.ones((4, 3))
    response = AxisResponse(
        coordinate="current",
        unit="A",
        centre=np.arange(4.0),
        field=ones,
        sigma=ones,
        amplitude=np.ones(3),
        sigma_amplitude=np.ones(3),
    )
    assert written(axis_figure(response))
    found = [
        ParameterScatter(
            name="fgm.offset[x]", unit="nT", std=3.0, sigma=1.0, ratio=3.0, sigma_ratio=0.2, days=12
        ),
        ParameterScatter(
            name="fgm.offset[y]", unit="nT", std=NAN, sigma=NAN, ratio=NAN, sigma_ratio=NAN, days=0
        ),
    ]
    assert "offset[y]" in written(excess_scatter_figure(found))
    assert written(excess_scatter_figure([]))


def test_the_wander_of_daily_parameters_is_their_scatter_over_their_sigma():
    generator = np.random.default_rng(0)
    daily = table(200)
    shape = daily["value"].shape
    daily["value"] = daily["value"] + generator.normal(0, 0.1, shape) * np.array([1.0, 1.0, 3.0, 1.0])
    daily["determined"] = daily["determined"] & (np.arange(shape[1]) != 3)
    found = daily_scatter(daily)
    assert [one.ratio for one in found[:3]] == pytest.approx([1.0, 1.0, 3.0], rel=0.15)
    assert found[0].sigma_ratio == pytest.approx(1 / np.sqrt(2 * 199))
    assert np.isnan(found[3].ratio)
    start, end = int(daily["start"].values[50]), int(daily["start"].values[60])
    assert {one.days for one in daily_scatter(daily, start, end)[:3]} == {10}


def test_dependence_takes_its_error_bars_into_the_range():
    centre, mean = np.array([1.0, 2.0]), np.array([0.0, NAN])
    plot = dependence_figure(followed("current", "A", centre, mean, np.array([5.0, NAN])))
    assert written(plot)
    (bars,) = [one for one in plot.renderers if isinstance(one.glyph, Segment)]
    # A range that nobody stated takes in all that is drawn.
    assert plot.y_range.renderers == []
    ends = [bars.data_source.data[getattr(bars.glyph, end)] for end in ("y0", "y1")]
    assert np.nanmax(np.concatenate(ends)) == 5.0
    assert np.nanmin(np.concatenate(ends)) == -5.0


def table(intervals, known=True):
    names = [f"fgm.{part}" for part in ("scale_factor[x]", "misalignment[xy]", "offset[x]", "offset[y]")]
    bounds = [day_bounds(np.datetime64("2024-03-01", "D") + index) for index in range(intervals)]
    shape = (intervals, len(names))
    return xr.Dataset(
        {
            "value": (("interval", "parameter"), np.ones(shape)),
            "sigma": (("interval", "parameter"), np.full(shape, 0.1 if known else np.inf)),
            "determined": (("interval", "parameter"), np.full(shape, known)),
            "prior": (("parameter",), np.zeros(len(names))),
            "units": (("parameter",), ["1", "deg", "nT", "nT"]),
            "start": (("interval",), np.array([start for start, _ in bounds], dtype=np.int64)),
            "end": (("interval",), np.array([end for _, end in bounds], dtype=np.int64)),
        },
        coords={"parameter": names},
    )


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("intervals", [1, 3])
def test_parameters_of_one_day_and_of_none_determined(intervals, known):
    for plot in parameter_figures(table(intervals, known), table(1, known)):
        assert written(plot)
        assert any(isinstance(item, Legend) for item in plot.below), "a legend hides data"


def test_parameters_are_drawn_in_the_unit_of_their_table_unless_they_never_moved():
    names = ["turning.azimuth", "turning.gain_ratio", "turning.spin_plane_gain", "turning.offset[1]"]
    given = table(2).assign_coords(parameter=names)
    given["units"] = (("parameter",), ["rad", "1", "1", "nT"])
    given["prior"] = (("parameter",), np.array([0.0, 0.0, 1.0, 0.0]))
    drawn = parameter_figures(given, given)
    assert [plot.title.text for plot in drawn] == [
        "Azimuth less prior",
        "Gain ratio less prior",
        "Offsets less prior",
    ]
    assert [plot.yaxis[0].axis_label for plot in drawn] == ["arcsec", "ppm", "nT"]
    circles = [one for one in drawn[0].renderers if "Scatter" in type(one.glyph).__name__ and one.glyph.size]
    assert circles[0].data_source.data["y"] == pytest.approx(np.degrees(1.0) * 3600)


class _Loads(HTMLParser):
    """Collects what the tags of a page make a browser load."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        self.found += [value for name, value in attrs if name in {"src", "href", "srcset", "data"}]


def loaded(page):
    parser = _Loads()
    parser.feed(page)
    return parser.found


def test_a_page_loads_nothing_from_elsewhere_and_escapes_what_it_is_told():
    plot = series_figure(days(3), np.zeros(3), np.zeros(3), np.zeros(3))
    page = html_page("A < B", [("<i>", [html_table(["<b>"], [["&"]])], [plot])], "thanks & more")
    assert loaded(page) == []
    assert "@import" not in page
    assert "<h1>A &lt; B</h1>" in page
    assert "<h2>&lt;i&gt;</h2>" in page
    assert "<th>&lt;b&gt;</th>" in page
    assert "thanks &amp; more" in page


def test_a_page_without_figures_is_a_page():
    assert "<h2>Nothing</h2>" in html_page("Title", [("Nothing", ["no data"], [])])


def test_a_figure_is_written_as_bokeh_writes_it():
    """Only what was set is looked at; what is written are the same models with the same attributes."""
    plot = dependence_figure(followed("current", "A", np.array([1.0, 2.0]), np.array([0.0, 3.0]), np.ones(2)))
    parts = figure_parts(plot, "place")
    document = Document()
    document.add_root(plot)
    text = html.unescape(parts["document"].replace("\\\\", "\\"))
    bokehs = json.loads(json.dumps(document.to_json(deferred=False)))
    # Models that other libraries, once imported, define for pages of their own: no figure has one.
    bokehs.pop("defs", None)
    written = json.loads(text)["place"]
    # Each document numbers what is not the figure's by itself.
    for one in (written, bokehs):
        assert one["config"].pop("id")
        assert one["config"]["attributes"]["notifications"].pop("id")
    assert written == bokehs
    assert json.loads(parts["drawn"]) == [
        {"docid": "place", "roots": {plot.id: "place"}, "root_ids": [plot.id]}
    ]


def test_small_curves_of_a_stack_are_enlarged_and_say_so():
    wave = np.sin(np.arange(1000.0))
    rows = stack_rows({"residual": 0.02 * wave, "heater": 1.3 * wave, "offset": 40.0 + 1.1 * wave})
    assert [row.place for row in rows] == [0.0, -1.0, -2.0]
    # Drawn, no curve reaches into the next row, and none is lost.
    sizes = [size * row.scale for size, row in zip((0.02, 1.3, 1.1), rows, strict=True)]
    assert all(0.02 < size < 0.5 for size in sizes)
    assert "(×10)" in rows[0].text
    assert "×" not in rows[1].text
    assert rows[2].text.endswith("about 40 nT")
    sources = {row.name: ColumnDataSource({}) for row in rows}
    labels = contribution_figure(sources, rows, Range1d(0, 1)).yaxis[0].major_label_overrides
    # Ticks are in nT, whatever a row is enlarged by.
    assert {labels[row.place] for row in rows} == {"0"}
    (above,) = (float(text) for at, text in labels.items() if 0 < at < 0.5)
    assert above == pytest.approx(0.3 / rows[0].scale, rel=0.5)
