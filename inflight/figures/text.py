"""Text of pages: HTML from the templates beside this file (`templates/`, Jinja2 with automatic escaping).

Functions here and in the other modules choose what is shown and hand it to `render`. Nothing in here needs
Bokeh: who only reads tables waits for no figures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, TypeAlias

from markupsafe import Markup

if TYPE_CHECKING:
    from jinja2 import Environment

#: Heading; paragraphs, plain text or `Markup`; figures, which are Bokeh models.
Section: TypeAlias = tuple[str, Sequence[str], Sequence[Any]]

#: A section without its heading; a heading, and what makes the rest when somebody looks at it.
SectionBody: TypeAlias = tuple[Sequence[str], Sequence[Any]]

LazySection: TypeAlias = tuple[str, Callable[[], SectionBody]]


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("inflight.figures", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render(template: str, **values: Any) -> Markup:
    """Return a template of this folder filled with values, as HTML; values that are not HTML are escaped."""
    return Markup(_environment().get_template(template).render(**values).strip())


def text_style() -> str:
    """Return the style sheet of the text of sections, wherever it is shown."""
    return str(render("text.css"))


def html_table(
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    kind: str = "",
    folded: str = "",
    opened: bool = False,
    one_line: bool = False,
) -> Markup:
    """Return a table.

    Parameters
    ----------
    head : sequence of str
        Names of the columns.
    rows : iterable of sequence of str
        Cells.
    kind : str
        Classes of the style sheet: ``wide``, ``told``, ``scrolled``.
    folded : str
        Title behind which the table is folded away, unless `opened`.
    one_line : bool
        Keep cells on one line.
    """
    return render(
        "table.html", head=head, rows=rows, kind=kind, folded=folded, opened=opened, one_line=one_line
    )


def paragraph(text: str, *, kind: str = "", bold: str = "") -> Markup:
    """Return a paragraph; `kind` is a class of the style sheet (``quiet``), `bold` begins it."""
    return render("paragraph.html", text=text, kind=kind, bold=bold)


def bullet_list(items: Iterable[str], *, kind: str = "", before: str = "", ordered: bool = False) -> Markup:
    """Return a list of items, numbered when `ordered`, with a line `before` it."""
    return render("list.html", items=items, kind=kind, before=before, ordered=ordered)


def facts_table(facts: Mapping[str, Any], *, code: bool = False) -> Markup:
    """Return names and values as a table without a head; empty values are left out."""
    return render("facts.html", facts=facts, code=code)
