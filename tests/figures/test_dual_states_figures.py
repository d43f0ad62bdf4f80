"""The figures of two sensors show what the results hold."""

import numpy as np
from bokeh.embed import file_html
from bokeh.models import MultiLine, Quad, Text
from bokeh.resources import INLINE

from inflight.figures import (
    PLANES,
    before_after_figure,
    difference_figure,
    switching_steps_figure,
    timeline_figure,
)


def glyphs(plot, kind):
    return [one for one in plot.renderers if isinstance(one.glyph, kind)]


def test_each_known_state_has_an_ellipse_and_its_number():
    points = np.random.default_rng(1).normal(size=(50, 3))
    state = np.repeat([0, 1, -1, 3, 0], 10)
    centre = np.array([[0.0, 0, 0], [1, 1, 1], [np.nan] * 3, [2, 0, 2]])
    # In the order of a table, which need not be that of the numbers.
    known = {number: (centre[number], 0.1 * np.eye(3)) for number in (3, 0, 2, 1)}
    for plane in PLANES:
        plot = difference_figure(points, state, known, plane)
        (numbers,), (rings,) = glyphs(plot, Text), glyphs(plot, MultiLine)
        data = numbers.data_source.data
        assert sorted(data[numbers.glyph.text]) == ["0", "1", "3"]
        assert rings.data_source is numbers.data_source
        for number, x, y, xs, ys in zip(
            *(data[name] for name in ("number", "x", "y", "xs", "ys")), strict=True
        ):
            middle = centre[int(number)][list(plane)]
            assert (x, y) == tuple(middle)
            assert np.allclose(np.hypot(xs - middle[0], ys - middle[1]), 2.0 * np.sqrt(0.1))


def test_the_timeline_has_one_bar_a_stretch():
    begin = np.datetime64("2006-05-14T00:00") + np.arange(4) * np.timedelta64(1, "h")
    plot = timeline_figure(
        begin, begin + np.timedelta64(1, "h"), np.array([0, -2, -1, 5]), np.array([1.0, np.nan, 0.2, 0.9])
    )
    (bars,) = glyphs(plot, Quad)
    data = bars.data_source.data
    assert len(data["left"]) == 4
    assert data["bottom"][1] == data["bottom"][2] == -1.4


def test_curves_and_steps_are_drawn_before_and_after():
    time = np.datetime64("2006-05-14") + np.arange(10) * np.timedelta64(1, "m")
    values = np.random.default_rng(2).normal(size=(10, 3))
    drawn = [
        before_after_figure(time, values, values, 1),
        switching_steps_figure(values, values, 0.0 * values, 2),
    ]
    text = "".join(file_html(one, INLINE, "dual") for one in drawn)
    for part in ("as measured", "corrected", "along y", "along z"):
        assert part in text
