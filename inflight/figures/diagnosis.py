"""Figures and tables of a diagnosis: verdict, candidates, found effects, ledger, and how the error falls.

Takes the fields that a diagnosis keeps (`Diagnosis.as_json`) and the numbers of
`inflight.diagnosis.figure_data`; makes HTML that needs no script (the verdict with a scale from nothing to
the residual as it was, the ranked candidates, found effects with their values and rivals, the ledger,
changes of a model) and Bokeh figures (gains before and after, the held-out error effect by effect and
version by version). A diagnosis that was kept is shown like a new one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from bokeh.models import BoxAnnotation, ColumnDataSource, Range1d, Span
from bokeh.plotting import figure

from inflight.diagnosis import HEADING, MEANING, WHY_MOVED, ErrorContribution, Trial, quantity
from inflight.figures.style import (
    AFTER,
    BEFORE,
    BETWEEN,
    HIGHLIGHT,
    REFERENCE,
    bare_parameter,
    draw_line,
    draw_points,
    draw_segments,
    legend_below,
    place_legend,
    plain_figure,
    short_name,
    short_parameter,
    unique_labels,
)
from inflight.figures.text import bullet_list, facts_table, html_table, paragraph, render
from inflight.residual import format_period
from inflight.units import with_error

_HEADINGS = {str(name): text for name, text in HEADING.items()}
_MEANINGS = {str(name): text for name, text in MEANING.items()}
_COLOURS = {
    "FOUND": "#1b6e4b",
    "CONFOUNDED": "#8a5a00",
    "NOT_IDENTIFIABLE": "#555555",
    "UNKNOWN_EFFECT": "#a01830",
    "NOTHING_LEFT": AFTER,
}

_WIDTH, _LEFT, _RIGHT = 1080, 10, 1070

#: Heading of the part of an effect that no other parameter explains; where a coefficient acts, in words.
NOT_ABSORBED = "share not absorbed by the calibration"
AT_WORDS = {"difference": "difference of both sensors"}


def explained(residual: Mapping[str, Any]) -> float:
    """Return which part of the held-out mean square above the noise floor the found effects explain."""
    before, after, floor = _sizes(residual)
    above = before**2 - floor**2
    return (before**2 - after**2) / above if above > 0.05 * floor**2 else np.nan


def verdict_strip(verdict: str, sentence: str, residual: Mapping[str, Any], remaining: str) -> str:
    """Return HTML that needs no script: verdict, sentence, sizes, and a scale of them.

    Parameters
    ----------
    residual : mapping
        As `Diagnosis.residual`; nT.
    remaining : str
        Verdict on what is left.
    """
    part = explained(residual)
    low, high = (residual.get(f"noise_floor_{end}_nT") for end in ("low", "high"))
    interval = "no interval"
    if low is not None and high is not None and np.isfinite([low, high]).all():
        interval = f"{low:.4g} to {high:.4g}, 95 %"
    sizes = [
        ("residual now", _size_text(residual["held_out_before_nT"])),
        ("with what was found", _size_text(residual["held_out_after_nT"])),
        (f"noise floor ({interval})", _size_text(residual["noise_floor_nT"])),
        ("explained of what is above it", "too little to share out" if np.isnan(part) else f"{part:.0%}"),
        (
            "what is left",
            "only noise" if remaining == "NOTHING_LEFT" else _HEADINGS.get(remaining, remaining),
        ),
    ]
    return render(
        "verdict.html",
        verdict=_HEADINGS.get(verdict, verdict),
        meaning="" if verdict in ("NOT_IDENTIFIABLE", "NOTHING_LEFT") else _MEANINGS.get(verdict, ""),
        colour=_COLOURS.get(verdict, REFERENCE),
        # Each of several findings on a line of its own.
        lines=sentence.replace("; ", ";\n").split("\n"),
        sizes=sizes,
        scale=_scale(residual),
    )


def _sizes(residual: Mapping[str, Any]) -> list[float]:
    """Return the size before, after, and of the noise floor; NaN for none."""
    names = ("held_out_before_nT", "held_out_after_nT", "noise_floor_nT")
    return [np.nan if residual[name] is None else float(residual[name]) for name in names]


def _size_text(value: float | None) -> str:
    return f"{value:.4g} nT" if value is not None and np.isfinite(value) else "unknown"


def _scale(residual: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return places on a horizontal scale from 0: residual before and after, noise floor and its interval."""
    before, after, floor = _sizes(residual)
    most = float(np.nanmax([before, after, floor, 0.0]))
    if not np.isfinite(most) or most <= 0:
        return None

    def at(value: float) -> float:
        return _LEFT + (_RIGHT - _LEFT) * value / (1.05 * most)

    places = {"width": _WIDTH, "left": _LEFT, "before_colour": BEFORE, "after_colour": AFTER}
    places |= {"before": at(before), "after": at(after)}
    if np.isfinite(floor):
        low, high = (float(residual.get(f"noise_floor_{end}_nT") or floor) for end in ("low", "high"))
        places |= {"floor": at(floor), "low": at(low), "high": at(high)}
    return places


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
        return paragraph("No candidate could be scored.")
    ghost = max([float(one["gain"]) for one in candidates if one["placebo"]], default=0.0)
    wide = max(*(float(one["gain"]) + 2.0 * _sigma(one) for one in real), ghost, 0.02)
    head = (
        "",
        "candidate",
        "gain on days not used in the fit, 95 %",
        "t",
        "p",
        "over placebo, t",
        *((NOT_ABSORBED, "raw to within-day", "values, alone") if trials else ()),
    )
    rows = [_row(one, trials, found, ghost, _BAR / wide) for one in real]
    colours = {"taken": AFTER, "rival": HIGHLIGHT, "ghost": _GHOST}
    return render("candidates.html", head=head, rows=rows, colours=colours, bar_width=_BAR)


def _sigma(one: Mapping[str, Any]) -> float:
    """Standard error of a gain, from its t."""
    t, gain = one["t"], one["gain"]
    return abs(float(gain) / float(t)) if t else 0.0


def _row(
    one: Mapping[str, Any],
    trials: Mapping[str, Trial],
    found: Mapping[str, Sequence[str]],
    ghost: float,
    scale: float,
) -> dict[str, Any]:
    """Return what the table shows of a candidate; `scale` is pixels of the bar a unit of gain."""
    name = str(one["name"])
    own = [short_parameter(rival) if "." in rival else short_name(rival) for rival in found.get(name, ())]
    rivals = [f"or {rival}" for rival in own[:_CHIPS]]
    rivals += [f"or {len(own) - _CHIPS} more"] if len(own) > _CHIPS else []
    # Rivals are named by mechanism: the candidate's name without its lag or width.
    rivals += [
        f"rival of {short_name(other)}"
        for other, mechanisms in found.items()
        if any(name == one or name.startswith(f"{one}@") for one in mechanisms)
    ]
    gain, sigma = float(one["gain"]), 2.0 * _sigma(one)
    trial = trials.get(name)
    numbers = [_number(one["t"], ".1f"), _number(one["p"], ".2g"), _number(one["placebo_t"], ".1f")]
    if trials:
        numbers.append(_number(trial.retained, ".2g") if trial else "")
        numbers.append(_number(trial.consistency, ".1f") if trial else "")
    values, hidden = _values(trial)
    return {
        "name": name,
        "short_name": short_name(name),
        "family": str(one["family"]).replace("_", " "),
        "taken": name in found,
        "rivals": rivals,
        "bar": {
            "gain": gain,
            "length": max(gain, 0.0) * scale,
            "low": max(gain - sigma, 0.0) * scale,
            "high": max(gain + sigma, 0.0) * scale,
            "ghost": max(ghost, 0.0) * scale,
        },
        "numbers": numbers,
        "alone": values if trials else None,
        "hidden": hidden,
    }


def _number(value: float | None, how: str) -> str:
    return format(value, how) if value is not None and np.isfinite(value) else ""


def _values(trial: Trial | None) -> tuple[list[str], int]:
    """Return the most significant values, and how many are not printed: a field may have very many."""
    if trial is None:
        return [], 0
    order = sorted(trial.values, key=lambda one: -abs(one[1]) / max(one[2], 1e-300))
    shown = [one for one in trial.values if one in order[:_VALUES]]
    lines = [f"{bare_parameter(name)} {quantity(value, sigma, unit)}" for name, value, sigma, unit in shown]
    return lines, len(trial.values) - len(shown)


def unscorable_list(unscorable: Sequence[Mapping[str, Any]]) -> str:
    """Return what could not be scored, greyed, grouped by the reason."""
    if not unscorable:
        return ""
    reasons: dict[str, list[str]] = {}
    for one in unscorable:
        reasons.setdefault(str(one["reason"]), []).append(short_name(str(one["name"])))
    items = [f"{', '.join(names)}: {reason}" for reason, names in reasons.items()]
    return bullet_list(items, kind="quiet", before="Not scored, and so neither found nor excluded:")


def gain_change_figure(candidates: Sequence[Mapping[str, Any]]) -> figure:
    """Draw each candidate's held-out gain before and after the found effects were taken.

    Gains after are parts of what was left then; an effect that was taken ends at nothing.
    """
    real = [one for one in candidates if not one["placebo"]][:_DROPS]
    names = [short_name(str(one["name"])) for one in real]
    labels = unique_labels(names)
    before = np.array([float(one["gain"]) for one in real])
    after = np.array([float(one["gain_now"]) for one in real])
    plot = plain_figure(
        "Gain before and after the found effects",
        "part of the mean square it takes off days not used in the fit",
        "",
        y_range=labels[::-1] or ["none"],
        height=110 + 19 * max(len(real), 1),
        width=620,
    )
    up = after > before
    for mask, colour, label in ((~up, AFTER, "falls"), (up, HIGHLIGHT, "rises")):
        if not mask.any():
            continue
        source = ColumnDataSource(
            {
                "name": [label_ for label_, chosen in zip(labels, mask, strict=True) if chosen],
                "before": before[mask],
                "after": after[mask],
            }
        )
        draw_segments(
            plot, "before", "name", "after", "name", source=source, color=colour, line_width=2, alpha=0.6
        )
        draw_points(
            plot,
            "before",
            "name",
            source=source,
            size=8,
            fill_color="white",
            line_color=colour,
            legend_label="before",
        )
        draw_points(
            plot, "after", "name", source=source, size=8, color=colour, legend_label=f"after ({label})"
        )
    ghost = max([float(one["gain"]) for one in candidates if one["placebo"]], default=np.nan)
    if np.isfinite(ghost) and labels:
        draw_line(
            plot,
            [ghost, ghost],
            [labels[-1], labels[0]],
            color=REFERENCE,
            line_dash="dashed",
            legend_label="best placebo",
        )
    plot.hover.tooltips = [("", "@name"), ("before", "@before{0.0000}"), ("after", "@after{0.0000}")]
    place_legend(plot, "bottom_right")
    return plot


Fields = Mapping[str, Any]

#: Coefficients of an effect that are printed.
_COEFFICIENTS = 6


def entries_html(fields: Fields) -> list[str]:
    """Return everything that is in the residual as a table, the largest first; nothing of an older record.

    Parameters
    ----------
    fields : mapping
        As `Diagnosis.as_json`.
    """
    entries = fields.get("entries") or []
    if not entries:
        return []
    head = ("in the residual", "takes off, nT", "alone, nT", "how sure", "type")
    rows = [
        (
            one["name"],
            f"{one['takes_off_nT']:.2g}",
            "" if one["first_in_nT"] is None else f"{one['first_in_nT']:.2g}",
            one["how_sure"],
            one["command"],
        )
        for one in entries
    ]
    return [html_table(head, rows)]


def found_effects_html(fields: Fields) -> list[str]:
    """Return the found effects with all their values as a table, and the signature of what is left.

    Parameters
    ----------
    fields : mapping
        As `Diagnosis.as_json`.
    """
    signature = _signature(fields["remaining"]["signature"])
    if not fields["effects"]:
        return [paragraph(f"No effect was added: {fields['stopped']}."), *signature]
    head = ["found", "family", "value +- sigma", "at", "rms, nT", "t", "p", NOT_ABSORBED]
    head += ["raw to within-day"]
    rows = [row for one in fields["effects"] for row in _rows(one, len(head))]
    note = (
        "t and p (over all that was tried) are of days not used in the fit, against the model without the "
        "effect. The last column compares values of whole days and within them, in their errors: large "
        "ones hint at a wrong form."
    )
    stopped = f"The rounds ended: {fields['stopped']}."
    return [
        html_table(head, rows),
        paragraph(f"{note} {stopped}", kind="quiet"),
        *signature,
    ]


def _rows(one: Fields, width: int) -> list[tuple[str, ...]]:
    """Return one row a value; effect, family and how it stands in the first of them."""
    shown = most_significant(one["coefficients"])
    rows: list[tuple[str, ...]] = []
    numbers: tuple[str, ...] = (
        _formatted(one["rms_nT"], ".3g"),
        _formatted(one["t"], ".1f"),
        _formatted(one["flip_p"], ".2g"),
        _formatted(one["retained"], ".2g"),
        _formatted(one["consistency"], ".1f"),
    )
    own = (short_name(one["name"]), str(one["family"]).replace("_", " "))
    for value in shown:
        size = quantity(value["value"] or 0.0, value["sigma"] or 0.0, value["unit"])
        at = str(AT_WORDS.get(value["at"], value["at"]))
        rows.append((*own, f"{bare_parameter(value['name'])} {size}", at, *numbers))
        own, numbers = ("", ""), ("",) * len(numbers)
    if len(shown) < len(one["coefficients"]):
        hidden = len(one["coefficients"]) - len(shown)
        rows.append(("", "", f"and {hidden} less significant ones", *[""] * (width - 3)))
    return rows


def _formatted(value: float | None, how: str) -> str:
    return "" if value is None else format(value, how)


def most_significant(coefficients: Sequence[Fields]) -> list[Fields]:
    """Return the most significant coefficients in their own order; a field of many has too many to print."""
    ordered = sorted(
        coefficients, key=lambda one: -abs(one["value"] or 0.0) / max(one["sigma"] or 0.0, 1e-300)
    )
    kept = {one["name"] for one in ordered[:_COEFFICIENTS]}
    return [one for one in coefficients if one["name"] in kept]


def _signature(signature: Fields | None) -> list[str]:
    if signature is None:
        return []
    text = ", ".join(f"{name} {value}" for name, value in signature_facts(signature))
    return [paragraph(f" {text}", bold="Signature of what is left:")]


def signature_facts(signature: Fields) -> list[tuple[str, str]]:
    """Return what is known of what is left, as names and values; what is not known is left out.

    Parameters
    ----------
    signature : mapping
        As `inflight.diagnosis.Signature.as_json`.
    """
    period, lag, duty = signature["period_s"], signature["lag_s"], signature["duty"]
    amplitude = signature["amplitude_nT"]
    parts = [
        ("period", format_period(period) if period else ""),
        ("axis", signature["axis"] or ""),
        ("shape", signature["shape"] or ""),
        ("half of peak to peak" if period else "amplitude", f"{amplitude:.3g} nT" if amplitude else ""),
        *(
            (f"on {name}", f"{with_error(size, sigma or 0.0)} nT")
            for name, (size, sigma) in signature["amplitudes"].items()
            if size is not None
        ),
        *(
            (f"step on {name}", f"{with_error(size, sigma or 0.0)} nT")
            for name, (size, sigma) in signature["steps"].items()
            if size is not None
        ),
        ("periods", " to ".join(format_period(one) for one in signature["periods_s"] or ())),
        ("channel", signature["channel"] or ""),
        ("lag", format_period(lag) if lag else ""),
        ("duty", f"{duty:.2f}" if duty is not None else ""),
    ]
    return [(name, value) for name, value in parts if value]


def separating_blocks_html(fields: Fields) -> list[str]:
    """Return the blocks in which rivals differ most, as a table; nothing without rivals."""
    if not fields["confusion_set"] or not fields["separating"]:
        return []
    pairs: dict[str, list[Fields]] = {}
    for one in fields["separating"]:
        pairs.setdefault(" / ".join(short_name(name) for name in one["rivals"]), []).append(one)
    rows = [
        (
            pair,
            ", ".join(one["start"][:16].replace("T", " ") for one in blocks),
            f"{max(one['difference_nT'] for one in blocks):.2g}",
        )
        for pair, blocks in pairs.items()
    ]
    return [
        paragraph(
            "What would tell the rivals apart: more of such days as these, on which they differ most, or "
            "less noise than they differ by."
        ),
        html_table(("rivals", "times that begin (UTC)", "largest difference, nT rms"), rows),
    ]


def ledger_table(rounds: Sequence[Mapping[str, Any]]) -> str:
    """Return the rounds as HTML; each with the command that takes its effect out again."""
    if not rounds:
        return paragraph("No round took anything.")
    head = (
        "round",
        "what",
        "effect",
        "family",
        "gain",
        "t",
        "p",
        "seen in",
        "in the model",
        "take out again",
    )
    rows = [
        (
            str(one["number"]),
            str(one["action"]),
            short_name(str(one["name"])),
            str(one["family"]).replace("_", " "),
            f"{one['gain']:.3g}",
            f"{one['t']:.1f}",
            f"{one['p']:.2g}",
            str(one["form"]),
            f'inflight add "{one["name"]}"' if one["action"] != "drop" else "",
            "inflight undo" if one["action"] != "drop" else "",
        )
        for one in rounds
    ]
    return html_table(head, rows, kind="scrolled")


def facts_list(facts: Mapping[str, Any]) -> str:
    """Return settings, seed, hashes and versions as a list that can be copied."""
    return facts_table(facts, code=True)


def waterfall_figure(
    steps: Sequence[ErrorContribution], start: float, end: float, floor: tuple[float, float, float]
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
        "The error, effect by effect",
        "",
        "rms on days not used in the fit (nT)",
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
        before = np.array([step.before for step in steps])
        after = np.array([step.after for step in steps])
        text = [f"-{change * 1000:.3g} pT" for change in before - after]
        bars = ColumnDataSource({"name": names, "before": before, "after": after, "text": text})
        plot.vbar("name", width=0.7, top="before", bottom="after", source=bars, color="#5b8c5a", alpha=0.9)
        style = {"text_align": "center", "text_font_size": "11px", "y_offset": -4}
        plot.text("name", "before", text="text", source=bars, **style)
    level, low, high = floor
    if np.isfinite(level):
        plot.add_layout(BoxAnnotation(bottom=low, top=high, fill_color=REFERENCE, fill_alpha=0.4))
        plot.add_layout(Span(location=level, dimension="width", line_color="#222222", line_dash="dashed"))
        draw_line(
            plot, ["as found"], [level], color="#222222", line_dash="dashed", legend_label="noise floor"
        )
    plot.hover.tooltips = [("", "@name"), ("from", "@before{0.0000} nT"), ("to", "@after{0.0000} nT")]
    place_legend(plot, "top_right")
    return plot


def order_figure(steps: Sequence[ErrorContribution]) -> figure:
    """Draw what each effect takes off when it is taken first, in its turn, and last; nT rms.

    Effects that share what they explain lie far apart; what an effect takes off last is its own.
    """
    names = unique_labels([short_name(step.name) for step in steps])
    plot = plain_figure(
        "Taken first, in its turn, or last",
        "rms it takes off (nT)",
        "",
        y_range=names[::-1] or ["none"],
        width=450,
        height=max(200, 130 + 34 * len(names)),
    )
    # Of mean squares, what each takes off, as an rms: parts of the whole would sum to more than it.
    first, turn, last = (
        np.sign(square) * np.sqrt(np.abs(square))
        for kind in ("first_in", "removed", "last_in")
        for square in [np.array([getattr(step, kind) for step in steps])]
    )
    source = ColumnDataSource({"name": names, "first": first, "turn": turn, "last": last})
    draw_segments(
        plot, "first", "name", "last", "name", source=source, color=REFERENCE, line_width=3, alpha=0.5
    )
    marks = (("first", "triangle", BEFORE), ("turn", "circle", "#111111"), ("last", "square", AFTER))
    for kind, marker, colour in marks:
        label = "in its turn" if kind == "turn" else kind
        draw_points(
            plot, kind, "name", source=source, marker=marker, color=colour, size=9, legend_label=label
        )
    plot.hover.tooltips = [
        ("", "@name"),
        *((kind, f"@{kind}{{0.0000}} nT") for kind in ("first", "turn", "last")),
    ]
    legend_below(plot)
    return plot


#: Parameters that moved, shown at most.
_MOVED = 10


def error_figure(
    changes: Sequence[Fields], trial: Fields | None = None, floor: float = float("nan"), **size: Any
) -> figure:
    """Draw how the residual of days not used in the fit falls from version to version to the noise; nT rms.

    A bar goes from the error before a change to the error after it, both measured on one ground; two changes
    stand on one ground only when the second begins where the first ended, which a search in between need not
    leave so. Marks are the residual of all days.

    Parameters
    ----------
    changes : sequence of mapping
        As `inflight.tasks.analysis.revise.Revision.as_json`, in the order they were made.
    trial : mapping, optional
        One more that is not saved.
    floor : float
        Noise floor, nT; that of the last change where there is none.
    size : int
        ``width`` and ``height``, pixels.
    """
    shown = [*changes, *([] if trial is None else [trial])]
    # What was done, without the words that the version says already.
    done = [
        "undo" if "undo" in (one["command"], one["effect"].partition(" ")[0]) else _bare_change(one["effect"])
        for one in shown
    ]
    names = [f"{one['model']['version']}: {_clipped(what)}" for one, what in zip(changes, done, strict=False)]
    names += [] if trial is None else [f"try: {_clipped(done[-1])}"]
    begin = [f"{changes[0]['model'].get('parent') or 'before'}: as found"] if changes else ["in use"]
    if shown and not np.isfinite(floor):
        floor = float(shown[-1]["error"].get("noise_floor_nT") or np.nan)
    plot = plain_figure(
        "The error, change by change",
        "",
        "rms on days not used in the fit (nT)",
        x_range=[*begin, *names],
        width=size.get("width", max(376, min(1130, 200 + 90 * len(names)))),
        height=size.get("height", 320),
    )
    plot.xaxis.major_label_orientation = 0.45
    held = np.array([one["error"]["held_out_nT"] for one in shown], dtype=float).reshape(-1, 2)
    whole = np.array([one["error"]["in_sample_nT"][1] for one in shown], dtype=float)
    most = float(np.nanmax(np.append(held, [floor if np.isfinite(floor) else 0.0, 0.0])))
    plot.y_range = Range1d(0.0, 1.15 * most or 1.0)
    if len(held):
        plot.vbar(begin, width=0.7, top=[held[0, 0]], color=REFERENCE, alpha=0.45)
    kinds = [
        (held[:, 1] <= held[:, 0], AFTER, "falls"),
        (held[:, 1] > held[:, 0], BEFORE, "rises"),
    ]
    tried = np.arange(len(shown)) == (len(changes) if trial is not None else -1)
    kinds = [(mask & ~tried, colour, label) for mask, colour, label in kinds] + [
        (tried, BETWEEN, "tried, not saved")
    ]
    for mask, colour, label in kinds:
        if not mask.any():
            continue
        at = [name for name, chosen in zip(names, mask, strict=True) if chosen]
        # Of many changes only those that can be seen are told: texts would run into each other.
        told = 0.0 if len(shown) <= _TOLD else 0.02 * most
        text = [
            f"{1000.0 * (after - before):+.3g} pT" if abs(after - before) >= told else ""
            for before, after in held[mask]
        ]
        columns = {"change": at, "before": held[mask, 0], "after": held[mask, 1], "text": text}
        source = ColumnDataSource(columns | {"high": held[mask].max(axis=1), "all": whole[mask]})
        bar = plot.vbar(
            "change",
            width=0.7,
            top="before",
            bottom="after",
            source=source,
            fill_color=colour,
            line_color=colour,
            line_width=2,
            fill_alpha=0.85,
            legend_label=label,
        )
        if label.startswith("tried"):
            bar.glyph.hatch_pattern, bar.glyph.hatch_color = "right_diagonal_line", "white"
        plot.text(
            "change",
            "high",
            text="text",
            source=source,
            text_align="center",
            text_font_size="11px",
            y_offset=-4,
        )
        draw_points(plot, "change", "all", source=source, size=7, marker="diamond", color="#111111")
    if np.isfinite(floor) and floor > 0:
        plot.add_layout(Span(location=floor, dimension="width", line_color="#222222", line_dash="dashed"))
        draw_line(
            plot,
            begin,
            [floor],
            color="#222222",
            line_dash="dashed",
            legend_label=f"noise floor {floor:.4g} nT",
        )
    plot.hover.tooltips = [
        ("", "@change"),
        ("before", "@before{0.00000} nT"),
        ("after", "@after{0.00000} nT"),
        ("all days, after", "@all{0.00000} nT"),
    ]
    legend_below(plot)
    return plot


#: Changes of which each is told in numbers.
_TOLD = 5
#: Characters of a change under its bar.
_SHOWN = 24


def _bare_change(effect: str) -> str:
    """Return the name of what was added or tried; of another change what was done."""
    for verb in ("auto: add ", "add ", "try "):
        effect = effect.removeprefix(verb)
    return short_name(effect)


def _clipped(text: str) -> str:
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 1]}\u2026"


def change_tables(change: Fields) -> list[str]:
    """Return what a change did as HTML: the error, the effect's own numbers, what else moved."""
    model, error = change["model"], change["error"]
    sizes = "; ".join(
        f"{label} {error[key][0]:.4g} to {error[key][1]:.4g} nT"
        for key, label in (("held_out_nT", "on days not used in the fit"), ("in_sample_nT", "on all days"))
    )
    out: list[str] = [
        paragraph(
            f", from version {model['parent']}: {change['effect']}. Residual {sizes}.",
            bold=f"{model['name']} version {model['version']}",
        )
    ]
    if change["coefficients"]:
        rows = [
            (short_parameter(one["name"]), quantity(one["value"], one["sigma"], one["unit"]))
            for one in change["coefficients"]
        ]
        out.append(html_table(("its numbers", "value +- sigma"), rows))
    if change["moved"]:
        others = [
            (
                short_parameter(one["parameter"]),
                quantity(one["by"], one["sigma"], one["unit"]),
                WHY_MOVED.get(one["why"], one["why"]),
            )
            for one in change["moved"][:_MOVED]
        ]
        out.append(html_table(("what else moved", "by", ""), others))
    if len(change["moved"]) > _MOVED:
        out.append(paragraph(f"and {len(change['moved']) - _MOVED} more", kind="quiet"))
    return out
