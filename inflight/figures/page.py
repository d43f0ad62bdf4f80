"""Static pages: text and figures in one HTML file that needs no network."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from typing import Any

from bokeh import __version__ as bokeh_version
from bokeh.core.json_encoder import serialize_json
from bokeh.core.property.wrappers import PropertyValueContainer
from bokeh.core.serialization import Serializer
from bokeh.document import Document
from bokeh.model import Model
from bokeh.resources import Resources

from inflight.figures.text import Section, render

#: What figures alone need: widgets, tables of Bokeh's own and formulas would triple the page.
_RESOURCES = Resources(mode="inline", components=["bokeh"])


def html_page(title: str, sections: Iterable[Section], footer: str = "") -> str:
    """Return a page.

    Parameters
    ----------
    title : str
        Heading.
    sections : iterable of Section
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
    # The figure is not added: the document would look for all its models, which the serializer meets anyway.
    serializer = _FigureSerializer(deferred=False)
    fields = {
        "version": bokeh_version,
        "title": document.title,
        "config": serializer.encode(document.config),
        "roots": serializer.encode([plot]),
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
