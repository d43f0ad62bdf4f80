"""How the held-out error falls, effect by effect, down to the noise floor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import BoxAnnotation, ColumnDataSource, Span, Whisker
from bokeh.plotting import figure

from inflight.diagnosis.tradeoffs import Step
from inflight.figures.naming import short_name
from inflight.figures.style import AFTER, BEFORE, REFERENCE, place_legend, plain_figure


def waterfall_figure(
    steps: Sequence[Step], start: float, end: float, floor: tuple[float, float, float]
) -> figure:
    """Draw the held-out rms before, one bar for each effect, the rms after, and the noise floor.

    Parameters
    ----------
    steps : sequence of Step
        In the order the effects were taken.
    start, end : float
        Held-out rms before and after, nT.
    floor : tuple of float
        Noise floor and its 95 % interval, nT.
    """
    names = [f"{place}. {short_name(step.name)}" for place, step in enumerate(steps, 1)]
    plot = plain_figure(
        "Held-out error, effect by effect",
        "",
        "rms, held out (nT)",
        x_range=["as found", *names, "now left"],
        width=max(430, min(1130, 190 + 110 * (len(names) + 1))),
        height=360,
    )
    plot.xaxis.major_label_orientation = 0.45
    plot.y_range.start = 0.0
    plot.y_range.end = 1.12 * max([start, end, floor[2] if np.isfinite(floor[2]) else 0.0])
    plot.vbar(["as found"], width=0.7, top=[start], color=BEFORE)
    plot.vbar(["now left"], width=0.7, top=[end], color=AFTER)
    if steps:
        _bars(plot, steps, names)
    level, low, high = floor
    if np.isfinite(level):
        plot.add_layout(BoxAnnotation(bottom=low, top=high, fill_color=REFERENCE, fill_alpha=0.4))
        plot.add_layout(Span(location=level, dimension="width", line_color="#222222", line_dash="dashed"))
        plot.line(["as found"], [level], color="#222222", line_dash="dashed", legend_label="noise floor")
    plot.hover.tooltips = [("", "@name"), ("from", "@before{0.0000} nT"), ("to", "@after{0.0000} nT")]
    place_legend(plot, "top_right")
    return plot


def _bars(plot: figure, steps: Sequence[Step], names: Sequence[str]) -> None:
    before = np.array([step.before for step in steps])
    after = np.array([step.after for step in steps])
    ends = np.array([[step.first_in, step.last_in] for step in steps])
    square = before[:, None] ** 2 - ends
    reached = np.sqrt(np.maximum(square, 0.0))
    source = ColumnDataSource(
        {
            "name": list(names),
            "before": before,
            "after": after,
            "upper": reached.max(axis=1),
            "lower": reached.min(axis=1),
            "text": [f"-{(b - a) * 1000:.3g} pT" for b, a in zip(before, after, strict=True)],
        }
    )
    plot.vbar("name", width=0.7, top="before", bottom="after", source=source, color="#5b8c5a", alpha=0.9)
    plot.text(
        "name", "before", text="text", source=source, text_align="center", text_font_size="11px", y_offset=-4
    )
    bars = Whisker(base="name", upper="upper", lower="lower", source=source, line_color="#222222")
    bars.upper_head.size = bars.lower_head.size = 12
    plot.add_layout(bars)
