"""Overview of a comparison: which days, products and tables there are, and what to do when there are none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.catalog import Catalog, Workspace
from inflight.mission import Mission
from inflight.tasks import ModelHistory
from inflight.tasks.pipelines import find_pipeline, product_of

#: Days of the span shown by default: reading more takes longer than one cares to wait.
DEFAULT_DAYS = 30


@dataclass(frozen=True)
class ComparisonOverview:
    """What there is to show of one comparison of a workspace.

    Attributes
    ----------
    comparison, kind : str
    first, last : datetime64[D] or None
        First and last day that can be shown: of the products, else of the archive.
    products, archived : int
        Published days of the comparison's product; days of its instruments that the archive has.
    model : str
        Name and version of the model in use.
    tables : tuple of str
        Names of the comparison's certified tables.
    note : str
        Shown in place of products, of a comparison that makes tables and no product.
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
        """Whether there are no measurements, products and tables."""
        return not self.archived and not self.products and not self.tables

    def span(self) -> tuple[np.datetime64, np.datetime64] | None:
        """Return first and last day of the default span: the newest days of a long mission."""
        if self.first is None or self.last is None:
            return None
        return max(self.first, self.last - np.timedelta64(DEFAULT_DAYS - 1, "D")), self.last


def list_comparisons(mission: Mission) -> list[str]:
    """Return the mission's comparisons, ``main`` first."""
    return sorted(mission.comparisons, key=lambda name: (name != "main", name))


def summarise_comparison(
    cat: Catalog, mission: Mission, comparison: str, history: ModelHistory | None = None
) -> ComparisonOverview:
    """Return the overview of a comparison; only the catalog's records are read.

    Parameters
    ----------
    history : ModelHistory, optional
        Of the comparison as it is now, where it is known.

    Raises
    ------
    MissionError, ModelError
        When the mission's model files are wrong.
    """
    entry, pipeline = mission.comparisons[comparison], find_pipeline(mission, comparison)
    products = [day for day, _ in cat.published(product_of(comparison))]
    archived = {day for name in set(entry.instruments().values()) for day, _ in cat.published(f"l1/{name}")}
    days = products or sorted(archived)
    names = {one.name for one in cat.tables() if one.certified and not one.damaged}
    return ComparisonOverview(
        comparison,
        entry.kind,
        days[0] if days else None,
        days[-1] if days else None,
        len(products),
        len(archived),
        (history or ModelHistory(cat, mission, comparison)).used.label,
        tuple(sorted(name for name in names if owner_of_table(name, mission) == comparison)),
        pipeline.note if pipeline else "",
    )


def owner_of_table(table: str, mission: Mission) -> str:
    """Return the comparison a table is of: the longest name it begins with, empty if there is none."""
    owners = [name for name in mission.comparisons if table.startswith(f"{name}-")]
    return max(owners, key=len, default="")


def next_step(workspace: Workspace, overview: ComparisonOverview) -> str:
    """Return what to do before there is more to see; empty when there are products.

    Parameters
    ----------
    overview : ComparisonOverview
        Of the comparison shown.
    """
    workspace_option = f" --workspace {workspace.root}"
    comparison_option = "" if overview.comparison == "main" else f" --comparison {overview.comparison}"
    if overview.is_empty:
        return (
            f"This workspace holds no measurements yet. Put the delivered files into {workspace.data} (or "
            f"name their folder), and type: inflight ingest{workspace_option}"
        )
    if overview.products or (overview.tables and overview.note):
        return ""
    return (
        f"The archive has {overview.archived} days, and nothing is calibrated yet. Type: "
        f"inflight reprocess{comparison_option}{workspace_option}"
    )
