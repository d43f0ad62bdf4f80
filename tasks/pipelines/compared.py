"""A comparison measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from inflight.figures import Later, Section


class Structure(Protocol):
    """One structure of a residual: of `inflight.residual.dependence` or `inflight.spin.residual`."""

    @property
    def coordinate(self) -> str:
        """What the residual follows."""

    @property
    def amplitude(self) -> float:
        """Rms of the structure, nT."""

    @property
    def sigma(self) -> float:
        """Its standard deviation between blocks, nT."""

    @property
    def sentence(self) -> str:
        """What a physicist would say of it."""


class Told(Protocol):
    """What every kind of comparison tells; `path` is its page, when one was written."""

    path: Path | None

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""


Report_co = TypeVar("Report_co", bound=Told, covariant=True)


@dataclass(frozen=True)
class Compared(Generic[Report_co]):
    """A comparison measured: its numbers, and its figures, drawn when asked for.

    Attributes
    ----------
    report : CompareReport or DualCompareReport
    title : str
        Of the page.
    parts : sequence of Later
        Everything that is shown: the explorer makes what is looked at, the page all of it.
    """

    report: Report_co
    title: str
    parts: Sequence[Later]

    def sections(self) -> list[Section]:
        """Make everything that is shown."""
        return [(heading, *make()) for heading, make in self.parts]
