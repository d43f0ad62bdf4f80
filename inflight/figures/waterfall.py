"""How the held-out error falls, effect by effect, down to the noise floor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import BoxAnnotation, ColumnDataSource, Span
from bokeh.plotting import figure

from inflight.diagnosis.tradeoffs import Step
from inflight.figures.naming import distinct, short_name
from inflight.figures.style import AFTER, BEFORE, REFERENCE, legend_below, place_legend, plain_figure


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
        width=max(430, min(1130, 170 + 66 * (len(names) + 2))),
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
    source = ColumnDataSource(
        {
            "name": list(names),
            "before": before,
            "after": after,
            "text": [f"-{(b - a) * 1000:.3g} pT" for b, a in zip(before, after, strict=True)],
        }
    )
    plot.vbar("name", width=0.7, top="before", bottom="after", source=source, color="#5b8c5a", alpha=0.9)
    plot.text(
        "name", "before", text="text", source=source, text_align="center", text_font_size="11px", y_offset=-4
    )


def order_figure(steps: Sequence[Step], start: float) -> figure:
    """Draw what each effect takes off the mean square when it is taken first, in its turn, and last.

    Effects that share what they explain lie far apart; what an effect takes off last is its own.

    Parameters
    ----------
    start : float
        Held-out rms before, nT.
    """
    names = distinct([short_name(step.name) for step in steps])
    plot = plain_figure(
        "Taken first, in its turn, or last",
        "part of the mean square as found (%)",
        "",
        y_range=names[::-1] or ["none"],
        width=450,
        height=max(200, 130 + 34 * len(names)),
    )
    part = 100.0 / max(start**2, 1e-30)
    first, turn, last = (
        part * np.array([getattr(step, kind) for step in steps])
        for kind in ("first_in", "removed", "last_in")
    )
    source = ColumnDataSource({"name": names, "first": first, "turn": turn, "last": last})
    plot.segment("first", "name", "last", "name", source=source, color=REFERENCE, line_width=3, alpha=0.5)
    marks = (("first", "triangle", BEFORE), ("turn", "circle", "#111111"), ("last", "square", AFTER))
    for kind, marker, colour in marks:
        said = "in its turn" if kind == "turn" else kind
        plot.scatter(kind, "name", source=source, marker=marker, color=colour, size=9, legend_label=said)
    plot.hover.tooltips = [
        ("", "@name"),
        *((kind, f"@{kind}{{0.00}} %") for kind in ("first", "turn", "last")),
    ]
    legend_below(plot)
    return plot
