"""Changes of a model one after the other: what each did to the error, its numbers, what else moved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource
from bokeh.plotting import figure

from inflight.figures.naming import short_name, short_parameter
from inflight.figures.page import html_table
from inflight.figures.style import AFTER, BEFORE, legend_below, plain_figure

Fields = Mapping[str, Any]
#: Parameters that moved, shown at most.
_MOVED = 10


def error_figure(changes: Sequence[Fields]) -> figure:
    """Draw how the residual falls from version to version, held out and in sample; nT rms.

    Each change is drawn from the error before it to the error after it: two changes stand on one ground
    only when the second begins where the first ended, which a search in between need not leave so.

    Parameters
    ----------
    changes : sequence of mapping
        As `inflight.tasks.revision.Revision.as_json`, in the order they were made.
    """
    names = [f"{one['model']['version']}: {short_name(_what(one))}" for one in changes]
    plot = plain_figure(
        "The error, change by change",
        "",
        "rms (nT)",
        x_range=names or ["none"],
        width=max(376, min(1130, 200 + 90 * len(names))),
        height=320,
    )
    plot.xaxis.major_label_orientation = 0.45
    for key, label, shift, colour in (
        ("held_out_nT", "held out", -0.12, AFTER),
        ("in_sample_nT", "in sample", 0.12, BEFORE),
    ):
        before, after = (np.array([one["error"][key][end] for one in changes]) for end in (0, 1))
        place = [(name, shift) for name in names]
        source = ColumnDataSource({"change": place, "before": before, "after": after})
        plot.segment("change", "before", "change", "after", source=source, color=colour, line_width=3)
        plot.scatter("change", "before", source=source, size=8, fill_color="white", line_color=colour)
        plot.scatter("change", "after", source=source, size=9, color=colour, legend_label=label)
    plot.hover.tooltips = [("before", "@before{0.00000} nT"), ("after", "@after{0.00000} nT")]
    legend_below(plot)
    return plot


def _what(change: Fields) -> str:
    """Return what was done, without the words that the version says already."""
    if change["command"] == "undo":
        return "undo"
    return str(change["effect"]).removeprefix("auto: ").removeprefix("add ")


def change_tables(change: Fields) -> list[str]:
    """Return what a change did as HTML: the error, the effect's own numbers, what else moved."""
    model, error = change["model"], change["error"]
    said = "; ".join(
        f"{label} {error[key][0]:.4g} to {error[key][1]:.4g} nT"
        for key, label in (("held_out_nT", "held out"), ("in_sample_nT", "in sample"))
    )
    out = [
        f"<p><b>{escape(model['name'])} version {model['version']}</b>, from version {model['parent']}: "
        f"{escape(str(change['effect']))}. Residual {said}.</p>"
    ]
    if change["coefficients"]:
        rows = [
            (short_parameter(one["name"]), f"{one['value']:.5g} ± {one['sigma']:.2g}", one["unit"])
            for one in change["coefficients"]
        ]
        out.append(html_table(("its numbers", "value ± sigma", "unit"), rows))
    if change["moved"]:
        others = [
            (
                short_parameter(one["parameter"]),
                f"{one['by']:+.3g}",
                f"{one['sigma_before']:.2g}",
                f"{one['sigma']:.2g}",
                one["unit"],
                one["why"],
            )
            for one in change["moved"][:_MOVED]
        ]
        out.append(html_table(("what else moved", "by", "sigma before", "sigma", "unit", ""), others))
    if len(change["moved"]) > _MOVED:
        out.append(f'<p class="quiet">and {len(change["moved"]) - _MOVED} more</p>')
    return out
