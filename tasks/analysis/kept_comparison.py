"""The last comparison of a workspace: kept, and given again while nothing it was made from has changed.

Takes the report that `compare` wrote a page of; writes what was told into the workspace's reports. A page is
a function of the products, what they were made from, the models and the software: `comparison_made_from` is a
hash of all of these. `compare_if_unchanged` reads no samples and draws nothing.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from inflight.catalog import Catalog
from inflight.errors import InflightError
from inflight.mission import Mission
from inflight.tasks.analysis.kept_diagnosis import hash_of_software, hashes_of_companions
from inflight.tasks.analysis.kept_page import KeptPage
from inflight.tasks.pipelines import Report, pipeline_of
from inflight.tasks.pipelines.base import TextLine
from inflight.tasks.report import to_json
from inflight.time import DayLike

#: What a comparison is computed and drawn by, beside the package of its pipeline.
_SOFTWARE = (
    "inflight",
    "inflight.calibration",
    "inflight.catalog",
    "inflight.design",
    "inflight.dual",
    "inflight.effects",
    "inflight.figures",
    "inflight.lsq",
    "inflight.mission_fit",
    "inflight.model",
    "inflight.plumbing",
    "inflight.residual",
    "inflight.samples",
    "inflight.spin",
    "inflight.tasks",
    "inflight.tasks.analysis",
    "inflight.tasks.archive",
    "inflight.tasks.pipelines",
    "inflight.tasks.pipelines.base",
    "inflight.zero_level",
)

#: Datasets that no comparison reads: what comparisons and searches keep for themselves.
_NOT_READ = re.compile(r"comparison/.*|equations/.*/(library|own|native)")


class _Kept(KeptPage):
    """What is kept of a comparison; `summary` has text and style of each line a person reads."""

    report: dict[str, Any]
    summary: list[tuple[str, str]]


@dataclass
class KeptComparison:
    """The report of a comparison that was made before; its `fields` are those of `as_json`."""

    fields: dict[str, Any]
    lines: list[TextLine] = field(default_factory=list)
    path: Path | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON, with ``unchanged`` true."""
        return {**self.fields, "path": str(self.path) if self.path else "", "unchanged": True}

    def summary(self) -> list[TextLine]:
        """Return what a person reads, the page excepted."""
        told = "archive, products, tables, models, mission and software are those of the last comparison"
        return [TextLine(told), *self.lines]


def compare_if_unchanged(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None = None,
    end: DayLike | None = None,
    comparison: str = "main",
    output: Path | None = None,
    against: int | None = None,
) -> Report | None:
    """Return the last comparison when the same was asked and nothing it was made from has changed, else None.

    Parameters
    ----------
    cat, mission, start, end, comparison, output, against
        As of `compare`. The page of the last comparison is copied to `output`, where that is another place.

    Returns
    -------
    Report or None
        None, too, when the page has gone, or was changed by hand.
    """
    if output is None:
        return None
    kept = _Kept.read(_path(cat, comparison))
    if kept is None or kept.made_from != comparison_made_from(cat, mission, start, end, comparison, against):
        return None
    kept.copy_to(output)
    return KeptComparison(kept.report, [TextLine(*line) for line in kept.summary], output)


def keep_comparison(cat: Catalog, report: Report, page: str, comparison: str, made_from: str) -> None:
    """Keep what was told of a comparison, and which page shows it; a read-only workspace keeps nothing.

    Parameters
    ----------
    page : str
        The text of the page at `report.path`.
    made_from : str
        Of `comparison_made_from`; nothing is kept where it is empty.
    """
    if report.path is None or not made_from:
        return
    fields = json.loads(to_json(report.as_json()))
    lines = [tuple(line) for line in report.summary()]
    kept = _Kept.of(report.path, page, made_from, report=fields, summary=lines)
    kept.save(_path(cat, comparison))


def comparison_made_from(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None,
    end: DayLike | None,
    comparison: str,
    against: int | None,
) -> str:
    """Return a hash of what was asked, and of all that a comparison is made from; empty where none is known.

    That is the catalog's days, tables and models, the mission with the files it names, and the software.
    """
    names = [one for one in cat.dataset_names() if not _NOT_READ.fullmatch(one)]
    try:
        pipeline = pipeline_of(mission, comparison)
        state = [cat.hash_of_days(names), *map(str, cat.tables()), *map(str, cat.models())]
        own = hashes_of_companions(cat, mission)
    except (InflightError, OSError):
        # A folder of products alone has no database; what else is wrong, the comparison itself tells.
        return ""
    module = type(pipeline).__module__
    software = hash_of_software((*_SOFTWARE, module.rpartition(".")[0] or module))
    asked = [str(start) if start is not None else None, str(end) if end is not None else None, against]
    text = json.dumps([asked, comparison, mission.text, own, state, software])
    return hashlib.sha256(text.encode()).hexdigest()


def _path(cat: Catalog, comparison: str) -> Path:
    return Path(cat.workspace) / "reports" / f"comparison-{comparison}.json"
