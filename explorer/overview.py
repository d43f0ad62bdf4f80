"""What a workspace has to show: its comparisons, the days of each, and what to do first without any."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.catalog import Catalog, Workspace
from inflight.mission import Mission
from inflight.tasks import ModelHistory
from inflight.tasks.pipelines import find_pipeline, product_of

#: Days shown when nobody asked for a span: reading more takes longer than one cares to wait unasked.
DEFAULT_DAYS = 30


@dataclass(frozen=True)
class ComparisonOverview:
    """What one comparison of a workspace has to show.

    Attributes
    ----------
    comparison, kind : str
    first, last : datetime64[D] or None
        First and last day that can be shown: of the products, else of the archive.
    products, archived : int
        Published days of the comparison's product; days of its instruments that the archive has.
    model : str
        The model in use, as a person calls it.
    tables : tuple of str
        Names of the comparison's certified tables.
    note : str
        What is said where products would be, of a comparison that makes tables and no product.
    """

    comparison: str
    kind: str
    first: np.datetime64 | None
    last: np.datetime64 | None
    products: int
    archived: int
    model: str
    tables: tuple[str, ...]
    note: str = ""

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing at all to look at."""
        return not self.archived and not self.products and not self.tables

    def span(self) -> tuple[np.datetime64, np.datetime64] | None:
        """Return first and last day of what is shown unasked: the newest days of a long mission."""
        if self.first is None or self.last is None:
            return None
        return max(self.first, self.last - np.timedelta64(DEFAULT_DAYS - 1, "D")), self.last


def list_comparisons(mission: Mission) -> list[str]:
    """Return the mission's comparisons, ``main`` first."""
    return sorted(mission.comparisons, key=lambda name: (name != "main", name))


def summarise_comparison(cat: Catalog, mission: Mission, comparison: str) -> ComparisonOverview:
    """Return what a comparison has to show; nothing is read but the catalog's records.

    Raises
    ------
    MissionError, ModelError
        When the mission's model files are wrong.
    """
    entry, pipeline = mission.comparisons[comparison], find_pipeline(mission, comparison)
    products = [day.day for day in cat.days(product_of(comparison), states=("published",))]
    archived = {
        day.day
        for name in set(entry.instruments().values())
        for day in cat.days(f"l1/{name}", states=("published",))
    }
    days = products or sorted(archived)
    names = {one.name for one in cat.tables() if one.certified and not one.damaged}
    return ComparisonOverview(
        comparison,
        entry.kind,
        days[0] if days else None,
        days[-1] if days else None,
        len(products),
        len(archived),
        ModelHistory(cat, mission, comparison).used.label,
        tuple(sorted(name for name in names if _is_of(name, comparison, mission))),
        pipeline.note if pipeline else "",
    )


def _is_of(table: str, comparison: str, mission: Mission) -> bool:
    """Return True for a table of a comparison, though another one's name may begin with the same word."""
    owners = [name for name in mission.comparisons if table.startswith(f"{name}-")]
    return max(owners, key=len, default="") == comparison


def next_step(workspace: Workspace, overview: ComparisonOverview) -> str:
    """Return what is to be done before there is more to see; empty when products are there.

    Parameters
    ----------
    overview : Offer
        Of the comparison that is looked at.
    """
    where = f" --workspace {workspace.root}"
    named = "" if overview.comparison == "main" else f" --comparison {overview.comparison}"
    if overview.is_empty:
        return (
            f"This workspace holds no measurements yet. Put the delivered files into {workspace.data} (or "
            f"name their folder), and type: inflight ingest{where}"
        )
    if overview.products or (overview.tables and overview.note):
        return ""
    return (
        f"The archive has {overview.archived} days, and nothing is calibrated yet. Type: "
        f"inflight reprocess{named}{where}"
    )
