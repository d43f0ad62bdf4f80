"""Figures: pure functions from arrays and Datasets to Bokeh figures, shared by reports and pages.

They draw aggregates, never raw samples.
"""

from inflight.figures.dependence import axis_figure, dependence_figure
from inflight.figures.page import html_page
from inflight.figures.parameters import parameter_figures, wander_figure
from inflight.figures.residual import daily_figure, histogram_figure, series_figure
from inflight.figures.spectra import spectrum_figure

__all__ = [
    "axis_figure",
    "daily_figure",
    "dependence_figure",
    "histogram_figure",
    "html_page",
    "parameter_figures",
    "series_figure",
    "spectrum_figure",
    "wander_figure",
]
