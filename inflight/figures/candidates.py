"""The table of candidates, with bars that need no script, and how their gains fall when effects are taken."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource
from bokeh.plotting import figure

from inflight.diagnosis.tradeoffs import Trial
from inflight.figures.naming import bare_parameter, distinct, short_name, short_parameter
from inflight.figures.style import AFTER, NEW, REFERENCE, place_legend, plain_figure

#: Rows of the table and of the drop plot; width of a bar, pixels; values and rivals printed of one candidate.
_ROWS, _DROPS, _BAR, _VALUES, _CHIPS = 16, 24, 150, 3, 4
_GHOST = "#c9c9c4"


def candidate_table(
    candidates: Sequence[Mapping[str, Any]],
    trials: Mapping[str, Trial],
    found: Mapping[str, Sequence[str]],
) -> str:
    """Return the ranked table as HTML.

    Parameters
    ----------
    candidates : sequence of mapping
        As `Diagnosis.candidates`.
    trials : mapping of str to Trial
        Values of candidates, each alone; without any, the columns of them are left out.
    found : mapping of str to sequence of str
        Names of the effects that were taken, with their rivals.
    """
    real = [one for one in candidates if not one["placebo"]][:_ROWS]
    if not real:
        return "<p>No candidate could be scored.</p>"
    ghost = max([float(one["gain"]) for one in candidates if one["placebo"]], default=0.0)
    wide = max(*(float(one["gain"]) + 2.0 * _sigma(one) for one in real), ghost, 0.02)
    head = (
        "",
        "candidate",
        "held-out gain, 95 %",
        "t",
        "p",
        "over placebo, t",
        *(("retained", "W/k", "values, alone") if trials else ()),
    )
    aligned = ["text-align:left" if cell in ("candidate", "values, alone") else "" for cell in head]
    top = "".join(
        f'<th style="{style}">{escape(cell)}</th>' for style, cell in zip(aligned, head, strict=True)
    )
    lines = [
        _row(place + 1, one, _alone(trials, one["name"]), found, ghost, wide)
        for place, one in enumerate(real)
    ]
    return f'<div style="overflow-x:auto"><table class="wide"><tr>{top}</tr>{"".join(lines)}</table></div>'


def _sigma(one: Mapping[str, Any]) -> float:
    """Standard error of a gain, from its t."""
    t, gain = one["t"], one["gain"]
    return abs(float(gain) / float(t)) if t else 0.0


def _row(
    rank: int,
    one: Mapping[str, Any],
    alone: Sequence[str],
    found: Mapping[str, Sequence[str]],
    ghost: float,
    wide: float,
) -> str:
    name = one["name"]
    taken = name in found
    own = [short_parameter(rival) if "." in rival else short_name(rival) for rival in found.get(name, ())]
    chips = "".join(_chip(f"or {rival}", NEW) for rival in own[:_CHIPS])
    chips += _chip(f"or {len(own) - _CHIPS} more", NEW) if len(own) > _CHIPS else ""
    rival_of = [other for other, rivals in found.items() if _is_among(name, rivals)]
    chips += "".join(_chip(f"rival of {short_name(other)}", NEW) for other in rival_of)
    weight = "font-weight:600" if taken else ""
    mark = " " + _chip("taken", AFTER) if taken else ""
    cells = [
        f'<td style="text-align:right">{rank}</td>',
        f'<td style="text-align:left;max-width:17rem;overflow-wrap:anywhere" title="{escape(name)}">'
        f'<span style="{weight}">{escape(short_name(name))}</span>{mark}'
        f'<div class="quiet">{escape(str(one["family"]).replace("_", " "))}</div>{chips}</td>',
        f"<td>{_bar(one, ghost, wide)}</td>",
        f"<td>{_number(one['t'], '.1f')}</td>",
        f"<td>{_number(one['p'], '.2g')}</td>",
        f"<td>{_number(one['placebo_t'], '.1f')}</td>",
        *alone,
    ]
    return f"<tr>{''.join(cells)}</tr>"


def _alone(trials: Mapping[str, Trial], name: str) -> list[str]:
    """Return the cells of a candidate's own values; none when no candidate has any."""
    if not trials:
        return []
    trial = trials.get(name)
    return [
        f"<td>{_number(trial.retained, '.2g') if trial else ''}</td>",
        f"<td>{_number(trial.consistency, '.1f') if trial else ''}</td>",
        f'<td style="text-align:left;white-space:nowrap">{_values(trial)}</td>',
    ]


def _is_among(name: str, rivals: Sequence[str]) -> bool:
    """Rivals are named by mechanism: the candidate's name without its lag or width."""
    return any(name == rival or name.startswith(f"{rival}@") for rival in rivals)


def _number(value: float | None, how: str) -> str:
    return format(value, how) if value is not None and np.isfinite(value) else ""


def _chip(text: str, colour: str) -> str:
    return (
        f'<span style="border:1px solid {colour};color:{colour};border-radius:8px;padding:0 .4rem;'
        f'margin-right:.2rem;font-size:.8rem;white-space:nowrap">{escape(text)}</span>'
    )


def _values(trial: Trial | None) -> str:
    """Return the most significant values; a field of many coefficients has too many to print."""
    if trial is None:
        return ""
    order = sorted(trial.values, key=lambda one: -abs(one[1]) / max(one[2], 1e-300))
    shown = [one for one in trial.values if one in order[:_VALUES]]
    lines = [f"{bare_parameter(name)} {value:.3g} ± {sigma:.1g} {unit}" for name, value, sigma, unit in shown]
    hidden = len(trial.values) - len(shown)
    more = f'<div class="quiet">and {hidden} more</div>' if hidden else ""
    return "<br>".join(map(escape, lines)) + more


def _bar(one: Mapping[str, Any], ghost: float, wide: float) -> str:
    """Return an SVG bar: gain with its interval over the ghost bar of the best placebo."""
    gain, sigma = float(one["gain"]), 2.0 * _sigma(one)
    scale = _BAR / wide
    length = max(gain, 0.0) * scale
    low, high = max(gain - sigma, 0.0) * scale, max(gain + sigma, 0.0) * scale
    return (
        f'<svg width="{_BAR + 52}" height="20" role="img" aria-label="gain {gain:.3f}">'
        f'<rect x="0" y="2" width="{max(ghost, 0.0) * scale:.1f}" height="16" fill="{_GHOST}"/>'
        f'<rect x="0" y="6" width="{length:.1f}" height="8" fill="{AFTER}"/>'
        f'<line x1="{low:.1f}" x2="{high:.1f}" y1="10" y2="10" stroke="#111" stroke-width="1.5"/>'
        f'<text x="{max(high, ghost * scale) + 5:.1f}" y="14" font-size="11">{gain:.1%}</text></svg>'
    )


def unscorable_list(unscorable: Sequence[Mapping[str, Any]]) -> str:
    """Return what could not be scored, greyed, grouped by the reason."""
    if not unscorable:
        return ""
    reasons: dict[str, list[str]] = {}
    for one in unscorable:
        reasons.setdefault(str(one["reason"]), []).append(short_name(str(one["name"])))
    items = "".join(
        f"<li>{escape(', '.join(names))}: {escape(reason)}</li>" for reason, names in reasons.items()
    )
    return (
        '<div class="quiet">Not scored, and so neither found nor excluded:'
        f'<ul style="margin:.2rem 0">{items}</ul></div>'
    )


def drop_figure(candidates: Sequence[Mapping[str, Any]]) -> figure:
    """Draw each candidate's held-out gain before and after the found effects were taken.

    Gains after are parts of what was left then; an effect that was taken ends at nothing.
    """
    real = [one for one in candidates if not one["placebo"]][:_DROPS]
    names = [short_name(str(one["name"])) for one in real]
    labels = distinct(names)
    before = np.array([float(one["gain"]) for one in real])
    after = np.array([float(one["gain_now"]) for one in real])
    plot = plain_figure(
        "Gain before and after the found effects",
        "held-out gain (part of the mean square)",
        "",
        y_range=labels[::-1] or ["none"],
        height=110 + 19 * max(len(real), 1),
        width=620,
    )
    up = after > before
    for mask, colour, label in ((~up, AFTER, "falls"), (up, NEW, "rises")):
        if not mask.any():
            continue
        source = ColumnDataSource(
            {
                "name": [label_ for label_, chosen in zip(labels, mask, strict=True) if chosen],
                "before": before[mask],
                "after": after[mask],
            }
        )
        plot.segment("before", "name", "after", "name", source=source, color=colour, line_width=2, alpha=0.6)
        plot.scatter(
            "before",
            "name",
            source=source,
            size=8,
            fill_color="white",
            line_color=colour,
            legend_label="before",
        )
        plot.scatter("after", "name", source=source, size=8, color=colour, legend_label=f"after ({label})")
    ghost = max([float(one["gain"]) for one in candidates if one["placebo"]], default=np.nan)
    if np.isfinite(ghost) and labels:
        plot.line(
            [ghost, ghost],
            [labels[-1], labels[0]],
            color=REFERENCE,
            line_dash="dashed",
            legend_label="best placebo",
        )
    plot.hover.tooltips = [("", "@name"), ("before", "@before{0.0000}"), ("after", "@after{0.0000}")]
    place_legend(plot, "bottom_right")
    return plot
