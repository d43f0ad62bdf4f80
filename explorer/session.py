"""What one running page works with: a workspace, its catalog, and what was worked out from it so far.

Every step is the function behind the verb of the same name; nothing is computed here in a second way.
Results are kept for as long as what they were made from stays as it is.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from inflight.catalog import Catalog, Workspace
from inflight.explorer.background import Background
from inflight.figures import LazySection, Section
from inflight.flows import lazy_client
from inflight.mission import Mission
from inflight.model import parse_tree
from inflight.tasks import ModelHistory, Progress, find_model
from inflight.tasks.analysis import (
    DiagnoseSettings,
    Workbench,
    diagnose_span,
    diagnosis_sections,
    examine,
    last_diagnosis,
    measure_comparison,
    open_workbench,
)
from inflight.tasks.pipelines import CompareResult, product_of, table_sections

#: Comparisons kept in memory: the aggregates of 3000 days are some hundred megabytes.
_KEPT = 3


@dataclass(frozen=True)
class Days:
    """A span as a person says it: its first and its last day."""

    first: np.datetime64
    last: np.datetime64

    def bounds(self) -> tuple[str, str]:
        """Return the half-open span that the steps take: first day, and the day after the last."""
        return str(self.first), str(self.last + np.timedelta64(1, "D"))


class ExplorerSession:
    """One workspace being explored; several pages may look at it at a time.

    Parameters
    ----------
    workspace : Workspace
        Opened.
    workers : int, optional
        Dask processes of a pass; the cores when absent.
    """

    def __init__(self, workspace: Workspace, workers: int | None = None) -> None:
        self.workspace, self.workers = workspace, workers
        self.cat = Catalog(workspace.root)
        self.background = Background()
        #: Makes figures, beside what takes long.
        self.drawing = Background()
        #: What the page's changes of each comparison's model did, as `Revision.as_json`, in their order.
        self.changes: dict[str, list[dict[str, Any]]] = defaultdict(list)
        self._measured: dict[tuple[Any, ...], CompareResult[Any]] = {}
        self._bench: tuple[tuple[Any, ...], Workbench] | None = None

    def close(self) -> None:
        """Drop what has not begun."""
        self.background.close()
        self.drawing.close()

    def mission(self) -> Mission:
        """Return the mission as its file is now."""
        return self.workspace.mission()

    # Model against measurement.

    def compare(self, comparison: str, days: Days, progress: Progress) -> Sequence[LazySection]:
        """Return what `inflight compare` shows of a span; figures are made when they are looked at.

        Raises
        ------
        CatalogError, SettingsError
            As `inflight.tasks.analysis.comparing.compare`.
        """
        span = days.bounds()
        published = self.cat.days(product_of(comparison), slice(*span), states=("published",))
        key = (comparison, *span, *(day.id for day in published))
        if key not in self._measured:
            self._measured[key] = measure_comparison(self.cat, self.mission(), *span, comparison, progress)
            for old in list(self._measured)[:-_KEPT]:
                del self._measured[old]
        return self._measured[key].parts

    def tables(self, comparison: str, progress: Progress) -> list[Section]:
        """Return what the newest published tables of a comparison show; none when there are no tables.

        Raises
        ------
        CatalogError
            When a table is damaged.
        """
        progress("tables", 0, 1)
        return table_sections(self.cat, self.mission(), comparison)

    # The missing effect.

    def last_diagnosis(self, comparison: str) -> dict[str, Any] | None:
        """Return the last diagnosis, whoever made it; None without any."""
        return last_diagnosis(self.workspace, comparison)

    def diagnose(self, comparison: str, days: Days, progress: Progress) -> dict[str, Any]:
        """Do what `inflight diagnose` does; settings are those of the last diagnosis.

        Raises
        ------
        SettingsError, InflightError
            As `inflight.tasks.analysis.revise.diagnose_span`.
        """
        settings, span = _settings(self._asked(comparison), comparison), days.bounds()
        self._bench = None
        with lazy_client(self.workers) as client:
            found = diagnose_span(self.workspace, *span, settings, client=client, progress=progress)
        return found | {"asked": {"start": span[0], "end": span[1], "settings": settings.model_dump()}}

    def figures_of_diagnosis(self, comparison: str, progress: Progress) -> list[Section]:
        """Return everything `inflight report` shows of the last diagnosis, for the model in use."""
        asked = self._asked(comparison)
        with lazy_client(self.workers) as client:
            examined = examine(
                self.cat,
                self.mission(),
                asked.get("start"),
                asked.get("end"),
                _settings(asked, comparison),
                client=client,
                progress=progress,
            )
        return diagnosis_sections(*examined)

    def _asked(self, comparison: str) -> Mapping[str, Any]:
        """Return span and settings of the last diagnosis; nothing without one."""
        return (self.last_diagnosis(comparison) or {}).get("asked") or {}

    # The model, revised.

    def versions(self, comparison: str) -> tuple[list[dict[str, Any]], list[str]]:
        """Return the versions of the workspace's models, as `Versions.items`, and the effects in use."""
        known = ModelHistory(self.cat, self.mission(), comparison)
        effects = [str(one.get("name", one["effect"])) for one in parse_tree(known.used.text)["effects"]]
        return known.items(), effects

    def change(self, comparison: str, verb: str, effect: str, progress: Progress) -> dict[str, Any]:
        """Do what `inflight add`, `drop` or `undo` does, on evidence that stays in memory.

        Parameters
        ----------
        verb : str
            ``add``, ``drop`` or ``undo``.
        effect : str
            As the verbs take it; ``undo`` takes none.

        Returns
        -------
        dict
            As `Revision.as_json`.

        Raises
        ------
        ModelError, InflightError
            As `inflight.tasks.analysis.revise.Workbench`.
        """
        with lazy_client(self.workers) as client:
            bench = self._workbench(comparison, client, progress)
            try:
                revision = bench.undo() if verb == "undo" else getattr(bench, verb)(effect)
            except Exception:
                # Half a change may be in it.
                self._bench = None
                raise
        told: dict[str, Any] = revision.as_json()
        self.changes[comparison].append(told)
        self._bench = (self._ground(comparison), bench)
        return told

    def _workbench(self, comparison: str, client: Any, progress: Progress) -> Workbench:
        """Return the workbench of before, when nobody changed anything beside it."""
        ground = self._ground(comparison)
        if self._bench is None or self._bench[0] != ground:
            self._bench = None
            return open_workbench(self.workspace, comparison, client=client, progress=progress)
        bench = self._bench[1]
        bench.client, bench.progress = client, progress
        return bench

    def _ground(self, comparison: str) -> tuple[Any, ...]:
        """Return what a workbench stands on: mission, model in use, and what the last diagnosis asked for."""
        mission = self.mission()
        used = find_model(self.cat, mission, comparison)
        return comparison, mission.text, used.version, used.text, str(self._asked(comparison))


def _settings(asked: Mapping[str, Any], comparison: str) -> DiagnoseSettings:
    return DiagnoseSettings.model_validate(asked.get("settings") or {"comparison": comparison})
