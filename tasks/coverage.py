"""Coverage of a dataset: what became of each day, and why a day is missing, from what the catalog knows.

In go a dataset's name and the mission; out comes a `CoverageDay` for each day from the first to the last that
anything of the mission is known of.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from inflight.catalog import Catalog, Day
from inflight.mission import Mission
from inflight.tasks.models import ModelHistory
from inflight.tasks.pipelines import product_of
from inflight.tasks.report import in_plain_words
from inflight.tasks.run_progress import failure_lines
from inflight.time import as_day, day_of, day_range

#: What can become of a day, the worst first; the page and its figure show them in this order.
COVERAGE: Final = (
    "failed",
    "missing",
    "excluded",
    "partial",
    "old model",
    "quick-look",
    "preliminary",
    "definitive",
    "archived",
)


@dataclass(frozen=True)
class CoverageDay:
    """What became of a day of a dataset.

    Attributes
    ----------
    day : datetime64[D]
    kind : str
        One of `COVERAGE`.
    why : str
        Cause of what is missing, with what to do; version and coverage of what is there.
    """

    day: np.datetime64
    kind: str
    why: str


def coverage_days(cat: Catalog, mission: Mission, dataset: str) -> list[CoverageDay]:
    """Return what became of each day of a dataset, in order; none when nothing is known of the mission.

    Raises
    ------
    ModelError
        When the comparison's model cannot be read.
    """
    known = {day.day: day for day in cat.days(dataset)}
    every = [cat.published(name) for name in cat.dataset_names() if name.startswith(("l1/", "l2/"))]
    ends = [as_day(days[end][0]) for days in every if days for end in (0, -1)]
    ends += known
    if not ends:
        return []
    comparison = comparison_of_product(mission, dataset)
    instruments = (
        set(mission.comparisons[comparison].instruments().values())
        if comparison
        else {dataset.partition("/")[2]}
    )
    facts = _Facts(
        stale=ModelHistory(cat, mission, comparison).stale_contexts(day.context for day in known.values())
        if comparison
        else set(),
        maturities=cat.maturities(dataset),
        excluded=_excluded(mission, instruments),
        is_product=dataset.startswith("l2/"),
    )
    return [
        facts.told(day, known[day]) if day in known else _absent(dataset, day, facts.is_product)
        for day in day_range(min(ends), max(ends) + 1)
    ]


def comparison_of_product(mission: Mission, dataset: str) -> str:
    """Return the comparison that makes a product; empty of a dataset that none makes."""
    return next((name for name in mission.comparisons if product_of(name) == dataset), "")


@dataclass(frozen=True)
class _Facts:
    """What the kind of a day follows from, besides its own record."""

    stale: set[str]
    maturities: Mapping[str, str]
    excluded: Mapping[np.datetime64, Sequence[str]]
    is_product: bool

    def told(self, date: np.datetime64, day: Day) -> CoverageDay:
        if day.state == "failed":
            return CoverageDay(date, "failed", " ".join(line.strip() for line in failure_lines(day)))
        if day.state != "published":
            why = ": ".join(filter(None, (in_plain_words(day.cause or day.state), day.message)))
            return CoverageDay(date, "missing", why)
        parts = [day.version, "" if day.coverage is None else f"{day.coverage:.1%} of the samples are there"]
        kind = self.maturities.get(day.id, "quick-look") if self.is_product else "archived"
        if day.context in self.stale:
            kind = "old model"
            parts.append("made with another model than the one in use: reprocess")
        if day.cause == "partial":
            kind = "partial"
            parts.append(day.message)
        if date in self.excluded:
            kind = "excluded"
            parts += [f"excluded: {words}" for words in self.excluded[date]]
        return CoverageDay(date, kind, "; ".join(filter(None, parts)))


def _absent(dataset: str, date: np.datetime64, is_product: bool) -> CoverageDay:
    if is_product:
        return CoverageDay(date, "missing", "not calibrated yet: reprocess makes it, if its files are there")
    return CoverageDay(
        date, "missing", f"no file of {dataset.removeprefix('l1/')} was delivered for this day"
    )


def _excluded(mission: Mission, instruments: set[str]) -> dict[np.datetime64, list[str]]:
    """Return who excluded what of each day, and why."""
    found: dict[np.datetime64, list[str]] = {}
    for one in mission.exclusions:
        if one.instrument in instruments:
            # Half-open: the last instant lies before its end.
            first, last = day_of(np.array([one.start, one.end - 1]))
            for day in day_range(first, last + 1):
                found.setdefault(day, []).append(one.words)
    return found
