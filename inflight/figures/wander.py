"""Figure of how far the daily parameters wander."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.plotting import figure

from inflight.figures.style import AFTER, NEW, REFERENCE, error_bars, plain_figure
from inflight.wander import Wander

#: A ratio this many sigmas above 1 is drawn in red.
_TELLING = 3.0


def wander_figure(found: Sequence[Wander]) -> figure:
    """Draw each parameter's scatter from day to day over its own stated uncertainty; 1 is a complete model.

    Parameters that the days do not determine have no mark.
    """
    names = [one.name.split(".", 1)[-1] for one in found]
    plot = plain_figure(
        "Daily scatter / stated uncertainty", "", "ratio", x_range=names, y_axis_type="log", width=560
    )
    plot.xaxis.major_label_orientation = 0.6
    plot.line([names[0], names[-1]] if names else [], [1.0, 1.0] if names else [], color=REFERENCE)
    known = [index for index, one in enumerate(found) if np.isfinite(one.ratio) and one.ratio > 0]
    ratio = np.array([found[index].ratio for index in known])
    sigma = np.array([found[index].sigma_ratio * found[index].ratio for index in known])
    far = [found[index].ratio > 1 + _TELLING * found[index].sigma_ratio for index in known]
    shown = [names[index] for index in known]
    error_bars(plot, shown, ratio, np.minimum(sigma, 0.9 * ratio), AFTER, 0.5)
    plot.scatter(shown, ratio, size=8, color=[NEW if one else AFTER for one in far])
    return plot
