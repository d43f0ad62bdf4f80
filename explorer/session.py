"""What the page can do with a workspace: compare, diagnose, revise the model, show tables.

Takes an opened workspace and days; makes sections (text and figures) and JSON fields. Every method calls the
function behind the verb of the same name. Results are cached until the data they were made from change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.catalog import Catalog, Day, Workspace
from inflight.diagnosis import BeforeAfter
from inflight.explorer.background import Background
from inflight.figures import LazySection, Section
from inflight.flags import UNUSABLE, Flag
from inflight.flows import lazy_client
from inflight.mission import Mission
from inflight.model import parse_tree
from inflight.tasks import ModelHistory, Progress
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
from inflight.tasks.pipelines import (
    CompareResult,
    ReprocessSettings,
    last_run,
    product_of,
    reprocess,
    table_sections,
)
from inflight.time import Int64, day_of, parse_utc

Texts = npt.NDArray[np.str_]

#: Comparisons cached: the aggregates of 3000 days are some hundred megabytes.
_CACHED = 3
#: Days whose samples are kept, and effects whose contributions are drawn, at most.
_DAYS_KEPT, _EFFECTS = 12, 6


@dataclass(frozen=True)
class Days:
    """A span of days, both ends included."""

    first: np.datetime64
    last: np.datetime64

    def bounds(self) -> tuple[str, str]:
        """Return the half-open span: first day, and the day after the last."""
        return str(self.first), str(self.last + np.timedelta64(1, "D"))


@dataclass(frozen=True)
class Samples:
    """Samples of products: TT2000, the residual (nT), and names of the flags of each, empty where good."""

    tt2000: Int64
    residual: Floats
    flags: Texts


@dataclass(frozen=True)
class TimeEvent:
    """Something that happened, from when until when (the same of an instant), ms of UTC, and what."""

    ms: float
    end_ms: float
    text: str


@dataclass(frozen=True)
class Contributions:
    """What each effect of the model makes of the residual: nT by effect, (sample,), the largest first."""

    tt2000: Int64
    effects: Mapping[str, Floats]


class ExplorerSession:
    """One workspace being explored, by any number of pages at a time.

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
        #: Makes figures while `background` does what takes long.
        self.figure_background = Background()
        self._measured: dict[tuple[Any, ...], CompareResult[Any]] = {}
        self._bench: tuple[tuple[Any, ...], Workbench] | None = None
        self._read: dict[str, tuple[Any, ...]] = {}
        self._history: tuple[tuple[Any, ...], ModelHistory] | None = None

    def close(self) -> None:
        """Cancel jobs that have not begun."""
        self.background.close()
        self.figure_background.close()

    def mission(self) -> Mission:
        """Return the mission as its file is now."""
        return self.workspace.mission()

    def history(self, comparison: str) -> ModelHistory:
        """Return the models of the workspace as they are now; cached until a file or the catalog changes.

        Raises
        ------
        MissionError, ModelError
            When the mission's model files are wrong.
        """
        mission = self.mission()
        named = (mission.preflight, mission.comparisons[comparison].preflight, *mission.effects)
        files = [self.workspace.root / name for name in named if name]
        stamps = [path.stat().st_mtime_ns if path.is_file() else 0 for path in files]
        versions = [(one.name, one.version, one.sha256) for one in self.cat.models()]
        key = (comparison, mission.text, *stamps, *versions)
        if self._history is None or self._history[0] != key:
            self._history = key, ModelHistory(self.cat, mission, comparison)
        return self._history[1]

    # Model against measurement.

    def compare(self, comparison: str, days: Days, progress: Progress) -> Sequence[LazySection]:
        """Return what `inflight compare` shows of a span; figures are made when their tab is opened.

        Raises
        ------
        CatalogError, SettingsError
            As `inflight.tasks.analysis.comparing.compare`.
        """
        return self.measure(comparison, days, progress).parts

    def measure(self, comparison: str, days: Days, progress: Progress) -> CompareResult[Any]:
        """Return the residual of a span, as `inflight compare` measures it; cached.

        Raises
        ------
        CatalogError, SettingsError
            As `inflight.tasks.analysis.comparing.compare`.
        """
        span = days.bounds()
        published = self.cat.days(product_of(comparison), slice(*span), states=("published",))
        key = (comparison, *span, *(day.id for day in published))
        if key not in self._measured:
            with lazy_client() as client:
                self._measured[key] = measure_comparison(
                    self.cat, self.mission(), *span, comparison, progress, client
                )
            for old in list(self._measured)[:-_CACHED]:
                del self._measured[old]
        return self._measured[key]

    def samples(self, comparison: str, first: int, last: int, most: int) -> Samples | None:
        """Return the samples of products between two times, TT2000; None where there are more than `most`.

        Raises
        ------
        CatalogError, IntegrityError
            When a product is damaged.
        """
        product = product_of(comparison)
        ends = day_of(np.array([first, last]))
        days = self.cat.days(product, slice(str(ends[0]), str(ends[1] + 1)), states=("published",))
        if not days or sum(day.count for day in days) > most:
            return None
        parts = [self._samples_of_day(day) for day in days]
        tt2000, residual, flag = (np.concatenate(one) for one in zip(*parts, strict=True))
        part = slice(*np.searchsorted(tt2000, [first, last]))
        tt2000, residual, flag = tt2000[part], residual[part], flag[part]
        values, place = np.unique(flag, return_inverse=True)
        names = np.array([_flag_names(int(one)) for one in values] or [""])
        bad = (flag & np.uint32(UNUSABLE)) != 0
        return Samples(tt2000, np.where(bad, np.nan, residual), names[place])

    def _samples_of_day(self, day: Day) -> tuple[Int64, Floats, npt.NDArray[np.uint32]]:
        """Return stamps, residual and flags of a product; those looked at last are kept."""
        if day.id not in self._read:
            data = self.cat.read(day, ("residual", "flag"), with_time=False)
            parts = (data[name].values for name in ("tt2000", "residual", "flag"))
            self._read[day.id] = tuple(parts)
            for old in list(self._read)[:-_DAYS_KEPT]:
                del self._read[old]
        return self._read[day.id]

    def events(self, comparison: str) -> list[TimeEvent]:
        """Return what happened: the mission's events, the model's steps and episodes, models of products."""
        mission, history = self.mission(), self.history(comparison)
        found = [(str(one.at), str(one.at), one.name) for one in mission.events]
        for entry in parse_tree(history.used.text)["effects"]:
            begin, name = entry.get("at", entry.get("from")), entry.get("name", entry["effect"])
            if begin is not None:
                found.append((str(begin), str(entry.get("to", begin)), str(name)))
        days = self.cat.days(product_of(comparison), states=("published",))
        contexts = {day.context for day in days if day.context}
        made = {name: self.cat.context(name).model_version for name in contexts}
        for before, day in pairwise(day for day in days if day.context):
            if made[str(before.context)] != made[str(day.context)]:
                text = f"products of model version {made[str(day.context)]}"
                found.append((str(day.day), str(day.day), text))
        return [TimeEvent(_milliseconds(one), _milliseconds(other), text) for one, other, text in found]

    def open_contributions(self, comparison: str, progress: Progress) -> Contributions | None:
        """Open the workbench of the last diagnosis, and return what each effect of the model in use makes."""
        self.open_equations(comparison, progress)
        return self.contributions()

    def contributions(self) -> Contributions | None:
        """Return what each effect of the model in use makes; asked for within a job that has a workbench."""
        if self._bench is None:
            return None
        tt2000, made = self._bench[1].contributions()
        sizes = {name: float(np.nanstd(values)) for name, values in made.items()}
        order = sorted((name for name in made if sizes[name] > 0), key=lambda name: -sizes[name])
        return Contributions(tt2000, {name: made[name] for name in order[:_EFFECTS]})

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
        """Return the last diagnosis, whoever made it; None without any.

        One of another model than the one in use has ``stale``: the name of that one.
        """
        found = last_diagnosis(self.workspace, comparison)
        if found is None:
            return None
        history = self.history(comparison)
        if history.same(found["model"].get("version"), history.used.version):
            return found
        return found | {"stale": history.used.label}

    def diagnose(self, comparison: str, days: Days, progress: Progress) -> dict[str, Any]:
        """Do what `inflight diagnose` does; settings are those of the last diagnosis.

        Raises
        ------
        SettingsError, InflightError
            As `inflight.tasks.analysis.revise.diagnose_span`.
        """
        settings, span = _settings(self._last_request(comparison), comparison), days.bounds()
        self._bench = None
        with lazy_client(self.workers) as client:
            found = diagnose_span(self.workspace, *span, settings, client=client, progress=progress)
        return found | {"asked": {"start": span[0], "end": span[1], "settings": settings.model_dump()}}

    def figures_of_diagnosis(self, comparison: str, progress: Progress) -> list[Section]:
        """Return everything `inflight report` shows of the last diagnosis, for the model in use."""
        request = self._last_request(comparison)
        with lazy_client(self.workers) as client:
            examined = examine(
                self.cat,
                self.mission(),
                request.get("start"),
                request.get("end"),
                _settings(request, comparison),
                client=client,
                progress=progress,
            )
        return diagnosis_sections(*examined)

    def _last_request(self, comparison: str) -> Mapping[str, Any]:
        """Return span and settings of the last diagnosis; empty without one."""
        return (last_diagnosis(self.workspace, comparison) or {}).get("asked") or {}

    # The model, revised.

    def versions(self, comparison: str) -> tuple[list[dict[str, Any]], list[str]]:
        """Return the versions of the workspace's models, as `Versions.items`, and the effects in use."""
        known = self.history(comparison)
        entries = parse_tree(known.used.text)["effects"]
        return known.items(), [str(entry.get("name", entry["effect"])) for entry in entries]

    def stale_products(self, comparison: str) -> int:
        """Return how many published days were made with another model than the one in use."""
        history = self.history(comparison)
        days = self.cat.days(product_of(comparison), states=("published",))
        contexts = {name: self.cat.context(name) for name in {day.context for day in days} if name}
        stale = {
            name
            for name, made in contexts.items()
            if made.model_name != history.used.name
            or not history.same(made.model_version, history.used.version)
        }
        return sum(day.context in stale for day in days)

    def reprocess(self, comparison: str, progress: Progress) -> dict[str, Any]:
        """Make products and tables anew, as the last `inflight reprocess` of the comparison was asked to.

        Returns
        -------
        dict
            As `RunReport.as_json`.

        Raises
        ------
        MissionError, ModelError, CatalogError
            As `inflight.tasks.pipelines.reprocess`.
        """
        run = last_run(self.cat, comparison)
        known = ReprocessSettings.model_fields.keys() - {"use_table", "context"}
        last = {name: value for name, value in (run.settings if run else {}).items() if name in known}
        settings = ReprocessSettings.model_validate(last | {"comparison": comparison})
        with lazy_client(self.workers) as client:
            made: dict[str, Any] = reprocess(
                self.cat, self.mission(), settings=settings, client=client, progress=progress
            ).as_json()
        return made

    def open_equations(self, comparison: str, progress: Progress) -> None:
        """Open the workbench of the last diagnosis, so that the next change need not wait for it."""
        with lazy_client(self.workers) as client:
            self._workbench(comparison, client, progress)

    def preview(self, comparison: str, effect: str, progress: Progress) -> dict[str, Any]:
        """Return what adding an effect would do, as `Revision.as_json`; nothing is saved.

        Raises
        ------
        ModelError, InflightError
            As `inflight.tasks.analysis.revise.Workbench.preview`.
        """
        with lazy_client(self.workers) as client:
            bench = self._workbench(comparison, client, progress)
            found: dict[str, Any] = bench.preview(effect).as_json()
        return found

    def before_after(self) -> BeforeAfter | None:
        """Return the residual before and after what was tried or changed last; asked for within its job."""
        return None if self._bench is None else self._bench[1].before_after()

    def change(
        self, comparison: str, verb: str, effect: str, progress: Progress, *, empirical: bool = False
    ) -> dict[str, Any]:
        """Do what `inflight add`, `drop` or `undo` does, on Gram blocks that stay in memory.

        Parameters
        ----------
        verb : str
            ``add``, ``drop`` or ``undo``.
        effect : str
            As the verbs take it; ``undo`` takes none.
        empirical : bool
            What is added is there for what it looks like: its cause is not known.

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
                if verb == "add":
                    revision = bench.add(effect, empirical=empirical)
                else:
                    revision = bench.undo() if verb == "undo" else bench.drop(effect)
            except Exception:
                # The workbench may hold half a change.
                self._bench = None
                raise
        change: dict[str, Any] = revision.as_json()
        self._bench = (self._workbench_key(comparison), bench)
        return change

    def _workbench(self, comparison: str, client: Any, progress: Progress) -> Workbench:
        """Return the cached workbench, or a new one when mission, model or last diagnosis changed since."""
        key = self._workbench_key(comparison)
        if self._bench is None or self._bench[0] != key:
            self._bench = None
            opened = open_workbench(self.workspace, comparison, client=client, progress=progress)
            self._bench = (key, opened)
        bench = self._bench[1]
        bench.client, bench.progress = client, progress
        return bench

    def _workbench_key(self, comparison: str) -> tuple[Any, ...]:
        """Return what a workbench was made from: mission, model in use, request of the last diagnosis."""
        used = self.history(comparison).used
        request = str(self._last_request(comparison))
        return comparison, self.mission().text, used.version, used.text, request


def _flag_names(flag: int) -> str:
    """Return the names of a sample's flags in words; empty of a good one."""
    return ", ".join(str(one.name).lower().replace("_", " ") for one in Flag if one and flag & one)


def _milliseconds(utc: str) -> float:
    return float(parse_utc(utc).astype("datetime64[us]").astype(np.int64) / 1e3)


def _settings(request: Mapping[str, Any], comparison: str) -> DiagnoseSettings:
    return DiagnoseSettings.model_validate(request.get("settings") or {"comparison": comparison})
