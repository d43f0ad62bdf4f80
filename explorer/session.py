"""What the page can do with a workspace: compare, diagnose, revise the model, show tables.

Takes an opened workspace and days; makes sections (text and figures) and JSON fields. Every method calls the
function behind the verb of the same name. Results are cached until the data they were made from change.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.calibration import TableChanges, table_changes
from inflight.catalog import Catalog, Day, Workspace
from inflight.diagnosis import BeforeAfter
from inflight.errors import SettingsError
from inflight.explorer.background import Background, BackgroundJob
from inflight.explorer.product_day import product_day_sections
from inflight.explorer.work import InOwnProcess, WorkPlan, WorkRequest, plan_work
from inflight.figures import LazySection, Section
from inflight.flags import UNUSABLE, Flag
from inflight.flows import ScheduledFlow, lazy_client, scheduled_flows
from inflight.mission import Mission
from inflight.model import parse_tree
from inflight.progress import Progress
from inflight.tasks import CoverageDay, ModelHistory, RunProgress, coverage_days, run_log, runs_progress
from inflight.tasks.analysis import (
    DiagnoseSettings,
    Examined,
    Workbench,
    asked_of,
    diagnose_span,
    diagnosis_sections,
    last_diagnosis,
    measure_comparison,
    open_workbench,
    page_of_diagnosis,
    report_if_unchanged,
    require_sampled,
    write_report,
)
from inflight.tasks.pipelines import (
    CompareResult,
    ReprocessSettings,
    last_run,
    product_of,
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
    allow_code : bool
        Run the files of Python that the mission names (`effects`).
    """

    def __init__(self, workspace: Workspace, workers: int | None = None, *, allow_code: bool = False) -> None:
        self.workspace, self.workers, self.allow_code = workspace, workers, allow_code
        self.cat = Catalog(workspace.root)
        self.background = Background()
        #: Makes figures while `background` does what takes long.
        self.figure_background = Background()
        #: What was begun by `begin_work` from any page.
        self.begun: list[tuple[InOwnProcess, BackgroundJob]] = []
        self._measured: dict[tuple[Any, ...], CompareResult[Any]] = {}
        self._bench: tuple[tuple[Any, ...], Workbench] | None = None
        self._searched: tuple[Examined, Mapping[str, Any]] | None = None
        self._read: dict[str, tuple[Any, ...]] = {}
        self._history: tuple[tuple[Any, ...], ModelHistory] | None = None

    def close(self) -> None:
        """Cancel jobs that have not begun, and stop the work of other processes."""
        for work, _ in self.begun:
            work.stop()
        self.background.close()
        self.figure_background.close()

    def mission(self) -> Mission:
        """Return the mission as its file is now.

        Raises
        ------
        MissionError, WorkspaceError
            As `Workspace.mission`.
        SettingsError
            When it names files of Python, and the page may run none.
        """
        mission = self.workspace.mission()
        if mission.effects and not self.allow_code:
            raise SettingsError(
                f"the mission names effects in Python: {', '.join(mission.effects)}; this page runs none",
                remedy="look into these files, then start 'inflight explore --allow-code'",
                file=str(self.workspace.mission_file),
            )
        return mission

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
        span, key = days.bounds(), self._measured_key(comparison, days)
        if key not in self._measured:
            with lazy_client() as client:
                self._measured[key] = measure_comparison(
                    self.cat, self.mission(), *span, comparison, progress, client
                )
            for old in list(self._measured)[:-_CACHED]:
                del self._measured[old]
        return self._measured[key]

    def measured(self, comparison: str, days: Days) -> CompareResult[Any] | None:
        """Return what `measure` returns when it is measured already, else None."""
        return self._measured.get(self._measured_key(comparison, days))

    def _measured_key(self, comparison: str, days: Days) -> tuple[Any, ...]:
        span = days.bounds()
        published = self.cat.days(product_of(comparison), slice(*span), states=("published",))
        return (comparison, *span, *(day.id for day in published))

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
        days = [(day, name) for day, name in self.cat.published(product_of(comparison)) if name]
        made = {name: self.cat.context(name).model_version for name in {name for _, name in days}}
        for (_, before), (day, after) in pairwise(days):
            if made[before] != made[after]:
                found.append((str(day), str(day), f"products of model version {made[after]}"))
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

    def table_changes(self, before: str, after: str, progress: Progress) -> TableChanges:
        """Return what changed from one table to another, named as ``main-window:4``.

        Raises
        ------
        CatalogError
            When there is no such table, or it is damaged.
        """
        progress("tables", 0, 2)
        old, new = (self.cat.table_by_id(int(name.rpartition(":")[2])) for name in (before, after))
        return table_changes(old, new)

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

    def instead_of_diagnosis(self, comparison: str) -> str:
        """Return what to do of a comparison that cannot be diagnosed; empty where it can.

        Raises
        ------
        MissionError, SettingsError
            As `mission`.
        """
        mission = self.mission()
        try:
            require_sampled(mission, comparison)
        except SettingsError as error:
            if mission.comparisons[comparison].kind == "spin":
                return (
                    "look in Model against measurement at what still goes with the spin, and in Tables at "
                    f"the parameters. For candidates to be ranked, {error.remedy} in the mission file."
                )
            return "look in Tables at what was found; it is no residual in which an effect could be missing."
        return ""

    def diagnose(self, comparison: str, days: Days, progress: Progress) -> dict[str, Any]:
        """Do what `inflight diagnose` does; settings are those of the last diagnosis.

        Raises
        ------
        SettingsError, InflightError
            As `inflight.tasks.analysis.revise.diagnose_span`.
        """
        # Before any of its files of Python are run.
        self.mission()
        settings, span = _settings(self._last_request(comparison), comparison), days.bounds()
        self._bench = self._searched = None
        with lazy_client(self.workers) as client:
            how: Any = {"client": client, "progress": progress, "finished": self._keep_search}
            found = diagnose_span(self.workspace, *span, settings, **how)
        return found | {"asked": {"start": span[0], "end": span[1], "settings": settings.model_dump()}}

    def figures_of_diagnosis(self, comparison: str, progress: Progress) -> list[Section]:
        """Return everything `inflight report` shows of the last diagnosis, for the model in use."""
        found, _ = self._last_search(comparison, progress)
        return diagnosis_sections(*found, progress)

    def _last_search(self, comparison: str, progress: Progress) -> tuple[Examined, Mapping[str, Any]]:
        """Return the search of the last diagnosis for the model in use, and what was asked.

        It is done anew unless it was done here, and would find the same.
        """
        # Before any of its files of Python are run.
        mission, request = self.mission(), self._last_request(comparison)
        span, settings = (request.get("start"), request.get("end")), _settings(request, comparison)
        asked = asked_of(self.cat, mission, *span, settings)
        if self._searched is None or self._searched[1] != asked:
            # Gram blocks of a search and of a workbench are not held together.
            self._bench = self._searched = None
            with lazy_client(self.workers) as client:
                how: Any = {"client": client, "progress": progress, "finished": self._keep_search}
                diagnose_span(self.workspace, *span, settings, search=True, **how)
        assert self._searched is not None
        return self._searched

    def _keep_search(self, found: Examined, asked: Mapping[str, Any]) -> None:
        """Keep a search, some hundred megabytes, and what was asked."""
        self._searched = found, asked

    def write_report(self, comparison: str, progress: Progress) -> Path:
        """Write the page that `inflight report` writes, of the span of the last diagnosis; return its path.

        Raises
        ------
        SettingsError, CatalogError
            As `inflight.tasks.analysis.report`.
        """
        mission, last = self.mission(), self._last_request(comparison)
        require_sampled(mission, comparison)
        span = last.get("start"), last.get("end")
        page = page_of_diagnosis(self.workspace, comparison, *span)
        if report_if_unchanged(self.workspace, page, *span, _settings(last, comparison)) is None:
            write_report(self.workspace, page, *self._last_search(comparison, progress), progress)
        return page

    def model_file(self, comparison: str) -> tuple[str, str]:
        """Return name and text of the model in use, as its YAML file would hold it."""
        used = ModelHistory(self.cat, self.mission(), comparison).used
        return f"{used.name}-{used.version}.yaml", used.text

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
        made = [context for _, context in self.cat.published(product_of(comparison))]
        stale = self.history(comparison).stale_contexts(made)
        return sum(context in stale for context in made)

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
        request = WorkRequest("reprocess", settings=self.reprocess_settings(comparison))
        return InOwnProcess(self.workspace.root, request, self.workers)(progress)

    def reprocess_settings(self, comparison: str) -> dict[str, Any]:
        """Return the settings of the last `inflight reprocess` of a comparison, or the defaults."""
        run = last_run(self.cat, comparison)
        known = ReprocessSettings.model_fields.keys() - {"use_table", "context"}
        last = {name: value for name, value in (run.settings if run else {}).items() if name in known}
        return last | {"comparison": comparison}

    # Products and runs.

    def datasets(self) -> list[str]:
        """Return the datasets of products and of the archive, products first."""
        names = self.cat.dataset_names()
        return [name for kind in ("l2/", "l1/") for name in names if name.startswith(kind)]

    def coverage(self, dataset: str, progress: Progress) -> list[CoverageDay]:
        """Return what became of each day of a dataset, and why."""
        progress("coverage", 0, 1)
        return coverage_days(self.cat, self.mission(), dataset)

    def product_day(self, dataset: str, day: np.datetime64, progress: Progress) -> list[Section]:
        """Return what there is of a day: its samples, its flags, its versions side by side.

        Raises
        ------
        IntegrityError
            When its store is damaged.
        """
        progress("day", 0, 1)
        return product_day_sections(self.cat, dataset, day)

    def runs(self, last: int) -> list[RunProgress]:
        """Return how far the last runs are, whoever began them, the newest first."""
        found = runs_progress(self.cat, last)
        is_running = any(one.record.state == "running" for one in found)
        return runs_progress(self.cat, last) if is_running and self.cat.close_dead_runs() else found

    def run_log(self, run: str) -> list[str]:
        """Return the log of a run; that of work begun here has the times of its stages, too."""
        record = next((one for one in self.cat.runs() if one.id == run), None)
        if record is None:
            return []
        stages = [work.log for work, job in self.begun if (job.result or {}).get("run") == run]
        return [*run_log(self.cat, record), *(stages[0] if stages else ())]

    def schedule(self, progress: Progress) -> list[ScheduledFlow]:
        """Return what a team's Prefect server runs of this workspace by itself; none without a server.

        Raises
        ------
        WorkerError
            When the server does not answer.
        """
        progress("schedule", 0, 1)
        return scheduled_flows(self.workspace.root)

    def plan(self, request: WorkRequest, progress: Progress) -> WorkPlan:
        """Return what a request would do, and what it costs.

        Raises
        ------
        SettingsError, CatalogError
            As `plan_work`.
        """
        progress("plan", 0, 1)
        return plan_work(self.workspace, request)

    def begin_work(self, request: WorkRequest) -> tuple[InOwnProcess, BackgroundJob]:
        """Begin what was planned, behind the work that was begun before; every page shows its progress."""
        work = InOwnProcess(self.workspace.root, request, self.workers)
        self.begun.append((work, self.background.begin(request.name, work)))
        return self.begun[-1]

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
            found: dict[str, Any] = bench.preview(self._entry(effect)).as_json()
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
                    revision = bench.add(self._entry(effect), empirical=empirical)
                else:
                    revision = bench.undo() if verb == "undo" else bench.drop(effect)
            except Exception:
                # The workbench may hold half a change.
                self._bench = None
                raise
        change: dict[str, Any] = revision.as_json()
        self._bench = (self._workbench_key(comparison), bench)
        if verb == "add" and effect.lstrip().startswith("="):
            self._save_formula(comparison, effect)
        return change

    def _save_formula(self, comparison: str, effect: str) -> None:
        """Save a formula that was added as a file of the workspace, under the name it has in the model."""
        name = self.versions(comparison)[1][-1]
        path = self.workspace.root / "effects" / f"{name}.yaml"
        formula = json.dumps(effect.strip().removeprefix("=").strip(), ensure_ascii=False)
        path.parent.mkdir(exist_ok=True)
        path.write_text(
            f"# A formula of channels: 'inflight add effects/{path.name}', or this path in the explorer.\n"
            f"effect: formula_field\nformula: {formula}\n",
            encoding="utf-8",
        )

    def _entry(self, effect: str) -> str:
        """Return what an effect's name stands for: of a saved formula, what its file holds."""
        if not effect.endswith((".yaml", ".yml")):
            return effect
        path = (self.workspace.root / effect).resolve()
        if path.parent != (self.workspace.root / "effects").resolve() or not path.is_file():
            raise SettingsError(
                f"{effect}: the workspace has no such file of an effect",
                remedy="name one of its folder 'effects', such as effects/NAME.yaml",
            )
        return path.read_text(encoding="utf-8")

    def _workbench(self, comparison: str, client: Any, progress: Progress) -> Workbench:
        """Return the cached workbench, or a new one when mission, model or last diagnosis changed since."""
        key = self._workbench_key(comparison)
        if self._bench is None or self._bench[0] != key:
            # Nor are its Gram blocks held together with those of a search.
            self._bench = self._searched = None
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
