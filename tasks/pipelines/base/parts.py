"""Parts of a report: a section as fields, text and figures, and lines for the command line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from inflight.errors import InflightError
from inflight.figures import Section, paragraph
from inflight.plumbing import Finding
from inflight.units import with_error


class TextLine(NamedTuple):
    """A line as the command line prints it; `style` is ``bold``, ``dim`` or nothing."""

    text: str
    style: str = ""


def plumbing_lines(found: Sequence[Finding]) -> list[TextLine]:
    """Return a line for each fault of plumbing, which stands before everything else."""
    return [TextLine(f"mend the data first: {one.sentence}", "bold") for one in found]


@dataclass
class Part:
    """One section of a report: plain fields, HTML paragraphs and figures.

    Attributes
    ----------
    key : str
        Its name in the JSON.
    absent : dict of str to str
        What the span does not suffice for, and why.
    """

    key: str
    heading: str
    fields: dict[str, Any] = field(default_factory=dict)
    text: list[str] = field(default_factory=list)
    plots: list[Any] = field(default_factory=list)
    absent: dict[str, str] = field(default_factory=dict)

    def add_text(self, text: str, quiet: bool = False) -> None:
        """Add a paragraph of plain text."""
        self.text.append(paragraph(text, kind="quiet" if quiet else ""))

    def add_absent(self, what: str, why: str) -> None:
        """List what is absent, with its reason, in `absent` and in the text."""
        self.absent[what] = why
        sentence = why[:1].upper() + why[1:].removesuffix(".") + "."
        self.text.append(paragraph(f": not told. {sentence}", kind="absent", bold=what))

    @contextmanager
    def optional(self, what: str) -> Iterator[None]:
        """Make a piece of the section; when the span does not suffice for it, list it as absent."""
        try:
            yield
        except InflightError as error:
            remedy = f"; {error.remedy}" if error.remedy else ""
            self.add_absent(what, f"{error.message}{remedy}")


def page_sections(parts: Sequence[Part]) -> list[Section]:
    """Return the sections of a page that show anything."""
    return [(part.heading, part.text, part.plots) for part in parts if part.text or part.plots]


@dataclass
class TablesReport:
    """A report of published tables: fields for programs, and lines for a person.

    Attributes
    ----------
    fields : dict
        Of the command line's JSON.
    lines : list of TextLine
        What a person reads first.
    path : Path, optional
        Of the page, when one was written.
    """

    fields: dict[str, Any]
    lines: list[TextLine]
    path: Path | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""
        return self.fields

    def summary(self) -> list[TextLine]:
        """Return what a person reads."""
        return self.lines


def with_unit(value: float, sigma: float, unit: str) -> str:
    """Return a value with its error and its unit; one without a unit ends with the error."""
    return f"{with_error(value, sigma)} {'' if unit == '1' else unit}".rstrip()
