"""Panel panes of sections, errors and progress."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import panel as pn

from inflight.explorer.background import BackgroundJob
from inflight.explorer.export import with_export
from inflight.figures import Section, render, text_style
from inflight.tasks import location_of

#: The page's style does not reach into panes, so each brings the style of the text.
_STYLES = [f":host {{ font: 15px/1.5 system-ui, sans-serif; color: #222 }} {text_style()}"]
#: How much wider than made a figure may be drawn.
_MOST = 1.7
_COLOURS = {"error": "#a01830", "hint": "#8a5a00"}


def text(*paragraphs: str) -> pn.pane.HTML:
    """Return paragraphs, plain text or `Markup`."""
    return pn.pane.HTML(_inside(paragraphs), stylesheets=_STYLES, sizing_mode="stretch_width", margin=(5, 10))


def retell(pane: pn.pane.HTML, *paragraphs: str) -> pn.pane.HTML:
    """Return a pane of `text` with other paragraphs: a browser shows them sooner than another pane."""
    pane.object = _inside(paragraphs)
    return pane


def _inside(paragraphs: Sequence[str]) -> str:
    return str(render("text.html", paragraphs=paragraphs))


def section(paragraphs: Sequence[str], figures: Sequence[Any] = ()) -> pn.viewable.Viewable:
    """Return the body of a section: its text, then its figures side by side."""
    parts = [text(*paragraphs)] if paragraphs else []
    if figures:
        panes = [_growing(figure) for figure in figures]
        parts.append(pn.FlexBox(*panes, sizing_mode="stretch_width"))
    return pn.Column(*parts, sizing_mode="stretch_width")


def _growing(figure: Any) -> pn.viewable.Viewable:
    """Return a figure that takes its part of the width that a row of figures leaves."""
    own = figure.width
    if own is None:
        return pn.pane.Bokeh(with_export(figure), margin=4)
    figure.sizing_mode = "stretch_width"
    pane = picture(figure)
    pane.styles = {"flex": f"1 1 {own}px", "max-width": f"{round(_MOST * own)}px"}
    return pane


def picture(figure: Any) -> pn.viewable.Viewable:
    """Return a figure in the width there is; it can be saved as PNG, SVG and CSV."""
    return pn.pane.Bokeh(with_export(figure), sizing_mode="stretch_width", margin=4)


def sections(shown: Sequence[Section]) -> pn.viewable.Viewable:
    """Return sections behind tabs: the browser draws only the figures of the active one."""
    tabs = [(heading, section(paragraphs, figures)) for heading, paragraphs, figures in shown]
    return pn.Tabs(*tabs, dynamic=True, sizing_mode="stretch_width", css_classes=["sections"])


def error(fields: Mapping[str, str]) -> pn.viewable.Viewable:
    """Return an error as the verbs print it: where, what, and what to do.

    Parameters
    ----------
    fields : mapping
        As `error_fields`.
    """
    return _alert("error", fields["message"], location_of(fields), fields.get("remedy", ""))


def sentence(state: str, step: str) -> str:
    """Return the state and the next step as HTML."""
    return str(render("state.html", state=state, step=step))


def hint(message: str) -> pn.viewable.Viewable:
    """Return plain text that says what to do first."""
    return _alert("hint", message)


def _alert(kind: str, message: str, place: str = "", remedy: str = "") -> pn.viewable.Viewable:
    colour = _COLOURS[kind]
    return text(render("alert.html", kind=kind, colour=colour, message=message, place=place, remedy=remedy))


def progress(job: BackgroundJob) -> str:
    """Return the progress of a job as HTML; before it begins, that it waits."""
    # Plain text: a pane would escape what is escaped already.
    return str(render("progress.html", job=job))
