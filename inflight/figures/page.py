"""A self-contained static page: text and figures in one HTML file that needs no network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any, TypeAlias

from bokeh.embed import components
from bokeh.resources import Resources

#: Heading; paragraphs, which are HTML that is escaped already; figures, which are Bokeh models.
Section: TypeAlias = tuple[str, Sequence[str], Sequence[Any]]

#: A section without its heading; a heading, and what makes the rest when somebody looks at it.
Inside: TypeAlias = tuple[Sequence[str], Sequence[Any]]

Later: TypeAlias = tuple[str, Callable[[], Inside]]

#: What figures alone need: widgets, tables of Bokeh's own and formulas would triple the page.
_RESOURCES = Resources(mode="inline", components=["bokeh"])

_BODY = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 1180px; color: #222 }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin-top: 2rem }
"""

#: How the text of sections looks, wherever it is shown.
TEXT_STYLE = """
.row { display: flex; flex-wrap: wrap; gap: 8px }
table { border-collapse: collapse; margin: .5rem 0 }
td, th { padding: .15rem .8rem .15rem 0; text-align: right }
td:first-child, th:first-child { text-align: left } th { border-bottom: 1px solid #999; font-weight: 600 }
.quiet { color: #666; font-size: .9rem }
.wide { font-size: .88rem } .wide th { white-space: normal; max-width: 6rem }
.told td, .told th { text-align: left } .told td:not(:last-child) { white-space: nowrap }
.wide td { border-bottom: 1px solid #e4e4e0; vertical-align: top }
"""


def html_page(title: str, sections: Sequence[Section], footer: str = "") -> str:
    """Return a page.

    Parameters
    ----------
    title : str
        Heading.
    sections : sequence of Section
    footer : str
        Plain text, such as an acknowledgement of the data.
    """
    scripts, body = [], []
    for heading, paragraphs, plots in sections:
        body.append(f"<h2>{escape(heading)}</h2>")
        body += [f"<div>{paragraph}</div>" for paragraph in paragraphs]
        # One document a figure: the time Bokeh takes grows with the square of what a document holds.
        parts = [components(plot) for plot in plots]
        scripts += [script for script, _ in parts]
        body.append('<div class="row">' + "".join(place for _, place in parts) + "</div>")
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{_BODY}{TEXT_STYLE}</style>{_scripts_of_figures()}</head><body><h1>{escape(title)}</h1>"
        "<noscript><p>Figures need scripts; text and tables do not.</p></noscript>"
        f'{"".join(body)}<p class="quiet">{escape(footer)}</p>{"".join(scripts)}</body></html>\n'
    )


def _scripts_of_figures() -> str:
    """Return what draws figures. Other libraries' extensions, which `render` would name, stay out."""
    return "".join(f"<script>{one}</script>" for one in _RESOURCES.js_raw)


def html_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table; cells are escaped."""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    lines = ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows]
    return f"<table><tr>{top}</tr>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def write_page(output: Path, page: str) -> None:
    """Write a page whole, by one rename."""
    output.parent.mkdir(parents=True, exist_ok=True)
    unfinished = output.with_name(f".{output.name}.part")
    unfinished.write_text(page, encoding="utf-8")
    unfinished.replace(output)
