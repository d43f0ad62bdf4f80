"""Figures: pure functions from arrays and Datasets to Bokeh figures, shared by reports and pages.

They draw aggregates, never raw samples.
"""

from inflight.figures.page import html_page
from inflight.figures.parameters import parameter_figures
from inflight.figures.residual import (
    daily_figure,
    dependence_figure,
    histogram_figure,
    series_figure,
    spectrum_figure,
)

__all__ = [
    "daily_figure",
    "dependence_figure",
    "histogram_figure",
    "html_page",
    "parameter_figures",
    "series_figure",
    "spectrum_figure",
]
