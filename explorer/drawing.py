"""Sections, errors and progress as parts of the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import panel as pn

from inflight.explorer.background import Job
from inflight.figures import TEXT_STYLE, Section
from inflight.tasks import place_of

#: Panes stand apart from the page's own style, so each brings that of the text.
_STYLES = [f":host {{ font: 15px/1.5 system-ui, sans-serif; color: #222 }} {TEXT_STYLE}"]
_ALERT = "border-left:8px solid {colour};padding:.6rem 1rem;background:#f6f6f4;max-width:70rem"
_COLOURS = {"error": "#a01830", "hint": "#8a5a00"}


def text(*paragraphs: str) -> pn.viewable.Viewable:
    """Return paragraphs, which are HTML that is escaped already."""
    inside = "".join(f"<div>{one}</div>" for one in paragraphs)
    return pn.pane.HTML(inside, stylesheets=_STYLES, sizing_mode="stretch_width", margin=(5, 10))


def section(paragraphs: Sequence[str], figures: Sequence[Any] = ()) -> pn.viewable.Viewable:
    """Return the inside of a section: its text, then its figures side by side."""
    parts = [text(*paragraphs)] if paragraphs else []
    if figures:
        panes = [pn.pane.Bokeh(figure, margin=4) for figure in figures]
        parts.append(pn.FlexBox(*panes, sizing_mode="stretch_width"))
    return pn.Column(*parts, sizing_mode="stretch_width")


def sections(shown: Sequence[Section]) -> pn.viewable.Viewable:
    """Return sections behind tabs: the browser draws the figures of the one that is looked at."""
    tabs = [(heading, section(paragraphs, figures)) for heading, paragraphs, figures in shown]
    return pn.Tabs(*tabs, dynamic=True, sizing_mode="stretch_width", css_classes=["sections"])


def error(fields: Mapping[str, str]) -> pn.viewable.Viewable:
    """Return an error as the verbs tell it: where, what, and what to do.

    Parameters
    ----------
    fields : mapping
        As `told_error`.
    """
    place = place_of(fields)
    remedy = f"<div><b>What to do:</b> {escape(fields['remedy'])}</div>" if fields.get("remedy") else ""
    said = f"{escape(place)}: " if place else ""
    return _alert(f"<div>{said}{escape(fields['message'])}</div>{remedy}", "error")


def hint(said: str) -> pn.viewable.Viewable:
    """Return plain text that asks for something to be done first."""
    return _alert(f"<div>{escape(said)}</div>", "hint")


def _alert(inside: str, kind: str) -> pn.viewable.Viewable:
    style = _ALERT.format(colour=_COLOURS[kind])
    return text(f'<div class="{kind}" role="status" style="{style}">{inside}</div>')


def progress(job: Job) -> str:
    """Return how far a job is as HTML; before it begins, that it waits."""
    if not job.stage:
        return f"{escape(job.name)}: waiting for what was asked for before"
    if job.total:
        bar = f'<progress max="{job.total}" value="{job.done}"></progress> {job.done} of {job.total}'
    else:
        bar = "<progress></progress>"
    return f'<span role="status">{escape(job.name)}: {escape(job.stage)} {bar}</span>'


def facts(listed: Mapping[str, Any]) -> str:
    """Return names and values as a table without a head; empty values are left out."""
    rows = "".join(
        f'<tr><td class="quiet">{escape(name)}</td>'
        f'<td style="text-align:left;overflow-wrap:anywhere">{escape(str(value))}</td></tr>'
        for name, value in listed.items()
        if value not in ("", None)
    )
    return f"<table>{rows}</table>"
