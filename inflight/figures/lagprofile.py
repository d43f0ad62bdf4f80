"""How well each lag of a response explains the residual."""

from __future__ import annotations

import numpy as np
from bokeh.models import BoxAnnotation, Span
from bokeh.plotting import figure

from inflight.diagnosis.lags import LagProfile
from inflight.figures.naming import short_name
from inflight.figures.style import AFTER, NEW, place_legend, plain_figure


def lag_figure(name: str, found: LagProfile, rows: float) -> figure:
    """Draw the rms that each lag leaves (in-sample) and the best one with its error.

    Parameters
    ----------
    name : str
        Of the effect.
    rows : float
        Rows of the evidence, which turn sums of squares into an rms.
    """
    size = np.sqrt(np.maximum(found.left, 0.0) / max(rows, 1.0))
    drawn = found.lags > 0
    said = f"lag {found.best:.3g} ± {found.sigma:.2g} s" if found.best > 0 else "no lag is best"
    plot = plain_figure(
        f"{short_name(name).split(', lag')[0]}: {said}",
        "lag (s)",
        "rms left, in-sample (nT)",
        x_axis_type="log",
        width=560,
    )
    plot.line(found.lags[drawn], size[drawn], color=AFTER, line_width=2, legend_label="this lag")
    # No lag at all has no place on a logarithmic axis: it is a level.
    plot.line(
        found.lags[drawn][[0, -1]], [size[0], size[0]], color=AFTER, line_dash="dotted", legend_label="no lag"
    )
    if found.best > 0:
        height = float(np.interp(found.best, found.lags, size))
        plot.scatter([found.best], [height], color=NEW, size=8, legend_label="best")
        plot.add_layout(Span(location=found.best, dimension="height", line_color=NEW, line_width=1.5))
        # The axis is logarithmic: an interval that reaches nothing is open to the left.
        low = found.best - found.sigma
        left = low if low > 0 else None
        plot.add_layout(
            BoxAnnotation(left=left, right=found.best + found.sigma, fill_color=NEW, fill_alpha=0.12)
        )
    place_legend(plot, "top_left")
    return plot
