"""Static pages: text and figures in one HTML file that needs no network.

The HTML stands in the templates beside this file (`templates/`, Jinja2 with automatic escaping); functions
here and in the other modules choose what is shown and hand it to `render`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from html import escape
from typing import Any, TypeAlias

from bokeh import __version__ as bokeh_version
from bokeh.core.json_encoder import serialize_json
from bokeh.core.property.wrappers import PropertyValueContainer
from bokeh.core.serialization import Serializer
from bokeh.document import Document
from bokeh.model import Model
from bokeh.resources import Resources
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

#: Heading; paragraphs, plain text or `Markup`; figures, which are Bokeh models.
Section: TypeAlias = tuple[str, Sequence[str], Sequence[Any]]

#: A section without its heading; a heading, and what makes the rest when somebody looks at it.
SectionBody: TypeAlias = tuple[Sequence[str], Sequence[Any]]

LazySection: TypeAlias = tuple[str, Callable[[], SectionBody]]

#: What figures alone need: widgets, tables of Bokeh's own and formulas would triple the page.
_RESOURCES = Resources(mode="inline", components=["bokeh"])


@cache
def _environment() -> Environment:
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
    figures: list[dict[str, str]] = []
    shown = []
    for heading, paragraphs, plots in sections:
        # One document a figure: the time Bokeh takes grows with the square of what a document holds.
        own = [figure_parts(plot, f"figure-{at}") for at, plot in enumerate(plots, start=len(figures))]
        figures += own
        shown.append({"heading": heading, "paragraphs": paragraphs, "figures": own})
    # Other libraries' extensions, which Bokeh's own `render` would name, stay out.
    libraries = _RESOURCES.js_raw
    page = render(
        "page.html",
        title=title,
        sections=shown,
        footer=footer,
        libraries=libraries,
        figures=figures,
    )
    return f"{page}\n"


def figure_parts(plot: Model, place: str) -> dict[str, str]:
    """Return a figure as a page holds it: its place, its id, its document and where that is drawn.

    As `bokeh.embed.components`, without the checks that are for who writes Bokeh applications.
    """
    document = Document()
    document.add_root(plot)
    serializer = _FigureSerializer(deferred=False)
    fields = {
        "version": bokeh_version,
        "title": document.title,
        "config": serializer.encode(document.config),
        "roots": serializer.encode(document.roots),
    }
    drawn = {"docid": place, "roots": {plot.id: place}, "root_ids": [plot.id]}
    # In a string of the script: Bokeh turns names of characters back into them.
    text = escape(serialize_json({place: fields}), quote=False).replace("'", "&#x27;").replace("\\", "\\\\")
    return {"place": place, "root": plot.id, "document": text, "drawn": serialize_json([drawn])}


class _FigureSerializer(Serializer):  # type: ignore[misc]  # Bokeh is untyped here
    """Bokeh's own, but it looks only at the properties of a model that were set.

    Bokeh makes the default of every other one first, which takes five times as long as all the rest.
    """

    def _encode(self, obj: Any) -> Any:
        if not isinstance(obj, Model):
            return super()._encode(obj)
        self.add_ref(obj, obj.ref)
        made, attributes = obj._unstable_default_values, {}
        given = obj._property_values.keys() | made.keys() | (obj.themed_values() or {}).keys()
        for name in obj.properties(_with_props=True) if given else ():
            property_ = obj.lookup(name) if name in given else None
            if property_ is not None and property_.serialized:
                value = property_.get_value(obj)
                # A container that nobody changed is the default of the browser, too.
                if name not in made or not isinstance(value, PropertyValueContainer):
                    attributes[name] = self.encode(value)
        shown = {"type": "object", "name": obj.__qualified_model__, "id": obj.id}
        return {**shown, "attributes": attributes} if attributes else shown


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
