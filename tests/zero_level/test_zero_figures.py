"""Figures of zero levels draw every result."""

import numpy as np
from bokeh.models import GlyphRenderer
from nature import solar_wind

from docs.figures.zero_level import kinds_figure, methods_figure, scatter_figure, sets_figure
from inflight.scorecard.zero_level_studies import scatter_with_hours
from inflight.zero_level import Intervals, combine_methods, correlation_sets, minimum_correlation


def drawn(plot) -> int:
    sources = [one.data_source.data for one in plot.renderers if isinstance(one, GlyphRenderer)]
    return sum(len(next(iter(data.values()), [])) for data in sources)


def test_methods_kinds_scatter_and_sets_are_drawn():
    times, field = solar_wind(np.random.default_rng(20), hours=40.0)
    intervals = Intervals.of(times, field, 1800.0)
    found = combine_methods(intervals)
    assert "agree" in methods_figure(found).title.text
    assert drawn(kinds_figure(found.kinds)) == len(intervals)
    hours = np.array([10.0, 30.0])
    scatter = scatter_with_hours(
        intervals, minimum_correlation, None, hours, np.random.default_rng(1), draws=12
    )
    size = np.sqrt(np.mean(scatter.scatter**2, axis=1))
    assert size[1] < size[0]
    assert drawn(scatter_figure([scatter])) >= 4
    assert drawn(sets_figure(correlation_sets(times, field))) >= 18
