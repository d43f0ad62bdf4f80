"""Starting a flow, or the plain functions it chains, from the command line and from Python.

`run_with_prefect` runs a flow with Prefect, quiet and on an embedded server unless the environment names
another; `run_without_prefect` does the same without Prefect; `plan_span` shows what a backfill would do.
Prefect is imported inside functions only: it reads its settings from the environment once, on import.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from pydantic import ValidationError, validate_call

from inflight.catalog import Catalog, Workspace
from inflight.errors import InflightError, SettingsError
from inflight.flows.cluster import start_early
from inflight.flows.runner import PlainRunner, progress_to, using_runner
from inflight.flows.server import embedded_server, is_own
from inflight.flows.span import DaySpan
from inflight.progress import Progress
from inflight.tasks import RunReport, as_settings_error
from inflight.tasks.pipelines import ReprocessSettings, pipeline_of

#: Services of the server that an embedded one does not need: nothing is scheduled or paused in it.
_IDLE_SERVICES = (
    "SCHEDULER",
    "LATE_RUNS",
    "TRIGGERS",
    "CANCELLATION_CLEANUP",
    "FOREMAN",
    "PAUSE_EXPIRATIONS",
    "REPOSSESSOR",
)
#: What flows need, imported while the embedded server starts.
_NEEDED = ("inflight.flows.prefect_flows", "dask.array", "pint", "zarr", "numba")
#: What those need that search a residual.
_NEEDED_TO_SEARCH = ("inflight.tasks.analysis.revise", "inflight.tasks.analysis.later_days")
_SEARCHES = ("update", "diagnose")
#: Flows that begin with the days of the archive.
_BEGIN_WITH_DAYS = (*_SEARCHES, "reprocess", "backfill", "monthly")
#: Flows with work for several processes, more often than not: a new day changes the products of its window.
_IN_PROCESSES = ("ingest", *_BEGIN_WITH_DAYS)
#: Set in both modes: no telemetry, no log traffic.
_QUIET = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_CLIENT_METRICS_ENABLED": "false",
    "PREFECT_LOGGING_TO_API_ENABLED": "false",
}
#: Set for the embedded server only. Logs are silenced: the command line reports failures itself, and the
#: server, stopped hard at the end of a command, would print the cancellation of its own housekeeping.
_EMBEDDED = {
    "PREFECT_LOGGING_LEVEL": "CRITICAL",
    "PREFECT_SERVER_UI_ENABLED": "false",
    # No flow of ours has blocks.
    "PREFECT_SERVER_REGISTER_BLOCKS_ON_START": "false",
    "PREFECT_SERVER_LOGGING_LEVEL": "CRITICAL",
    **{f"PREFECT_SERVER_SERVICES_{name}_ENABLED": "false" for name in _IDLE_SERVICES},
}


def run_with_prefect(
    name: str,
    workspace: Workspace,
    parameters: Mapping[str, Any],
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> RunReport:
    """Run a flow in this process, recorded by the embedded Prefect server or by ``PREFECT_API_URL``'s.

    A flow that has nothing to do is not started: its report is that of `report_if_idle`.

    Parameters
    ----------
    name : str
        One of `inflight.flows.steps.STEPS`.
    workspace : Workspace
        Where; the embedded server keeps its home there, too.
    parameters : mapping
        Parameters of the flow, the workspace excepted; Prefect validates them with pydantic.
    workers : int, optional
        Dask processes; the cores when absent.
    progress : callable, optional
        Called with ``(stage, done, total)``.

    Raises
    ------
    SettingsError
        When a parameter is wrong.
    InflightError
        What the step itself raised; the catalog has it, too.
    """
    from inflight.flows.steps import report_if_idle

    given = _given(workspace, parameters, workers)
    try:
        idle = report_if_idle(name, given)
    except ValidationError as error:
        raise as_settings_error(error) from None
    if idle is not None:
        return idle
    ready = partial(_get_ready, name, workspace)
    with prefect_settings(workspace.prefect_home, ready), progress_to(progress):
        from prefect.exceptions import ParameterBindError, ParameterTypeError

        from inflight.flows import prefect_flows

        try:
            return RunReport.from_json(getattr(prefect_flows, name)(**given))
        except (ParameterBindError, ParameterTypeError) as error:
            raise SettingsError(
                f"parameters of {name}: {error}", remedy=f"inflight {name} --help lists the options"
            ) from None


def run_without_prefect(
    name: str,
    workspace: Workspace,
    parameters: Mapping[str, Any],
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> RunReport:
    """Do what the flow of this name does, on the same Dask processes, without Prefect.

    Parameters and errors are those of `run_with_prefect`.
    """
    from inflight.flows.steps import STEPS

    step = validate_call(STEPS[name])
    with using_runner(PlainRunner(progress)):
        try:
            return RunReport.from_json(step(**_given(workspace, parameters, workers)))
        except ValidationError as error:
            raise as_settings_error(error) from None


def plan_span(
    workspace: Workspace, start: str | None, end: str | None, settings: Mapping[str, Any]
) -> dict[str, Any]:
    """Return which days of a span a reprocessing would make, from the archive as it is.

    Parameters
    ----------
    workspace : Workspace
        Where.
    start, end : str or None
        UTC days, half-open.
    settings : mapping
        Of `ReprocessSettings`.

    Returns
    -------
    dict
        ``context``; ``days`` with the counts ``planned``, ``unchanged`` and ``no_work``; ``batches`` with
        first day, last day and number of days of each; ``cost`` with ``seconds`` and ``bytes`` at the rate of
        the largest of the last runs, and that ``run``; None when none was made yet.
    """
    span = DaySpan.model_validate({"start": start, "end": end}).as_text()
    checked = ReprocessSettings.model_validate(settings)
    catalog, mission = Catalog(workspace.root), workspace.mission()
    pipeline = pipeline_of(mission, checked.comparison, checked)
    planned = pipeline.make_plan(catalog, mission, checked, span)
    days, unchanged = pipeline.days_to_do(catalog, planned)
    rate = catalog.rate("reprocess")
    cost = {"run": rate.run, **rate.cost(len(days))} if rate else None
    return {
        "context": planned.context,
        "cost": cost,
        "days": {"planned": len(days), "unchanged": len(unchanged), "no_work": len(planned.no_work)},
        "batches": [[str(batch[0]), str(batch[-1]), len(batch)] for batch in planned.product_batches(days)],
    }


def plan_lines(verb: str, start: str | None, end: str | None, fields: Mapping[str, Any]) -> Iterator[str]:
    """Yield what a verb has to do in a span, and what that costs at a measured rate.

    Parameters
    ----------
    fields : mapping
        As `plan_span`.
    """
    days, cost = fields["days"], fields["cost"]
    span = (
        f"{start} to {end}" if start and end else f"from {start}" if start else f"up to {end}" if end else ""
    )
    yield (
        f"{verb} {span or 'all days'}: {days['planned']} days to do in {len(fields['batches'])} batches, "
        f"{days['unchanged']} unchanged, {days['no_work']} without measurements"
    )
    if cost and days["planned"]:
        yield (
            f"  some {cost['seconds']:.0f} s and {cost['bytes'] / 1e6:.0f} MB, at the rate of run "
            f"{cost['run']}; files that have to be taken in first are not counted"
        )


def prefect_environment(home: Path) -> dict[str, str]:
    """Return the environment a command's flows run in; what the user has set already wins.

    Parameters
    ----------
    home : Path
        Private Prefect home, used by the embedded server. With ``PREFECT_API_URL`` set, flows go to
        that server and the home is the user's own.
    """
    environment = dict(_QUIET)
    if _is_embedded():
        environment |= _EMBEDDED | {"PREFECT_HOME": str(home.resolve())}
    return environment | {name: os.environ[name] for name in environment if name in os.environ}


def start_server_early(workspace: Workspace) -> None:
    """Start the embedded server for the flows to come, if they have no other; nothing waits for it here."""
    if _is_embedded():
        environment = prefect_environment(workspace.prefect_home)
        embedded_server(Path(environment["PREFECT_HOME"]), environment)


@contextmanager
def prefect_settings(home: Path, get_ready: Callable[[], None] | None = None) -> Iterator[None]:
    """Run what is inside with the project's Prefect settings.

    The heartbeat of flow runs is off: its thread costs every flow a second at its end.

    Parameters
    ----------
    get_ready : callable, optional
        Called while the embedded server starts.

    Raises
    ------
    WorkerError
        When the embedded server does not answer.
    """
    environment, before = prefect_environment(home), os.environ.get("PREFECT_API_URL")
    server = None
    if not _is_embedded():
        os.environ.update(environment)
    else:
        server = embedded_server(Path(environment["PREFECT_HOME"]), environment)
        # Prefect's own threads know the environment only.
        os.environ.update(environment | {"PREFECT_API_URL": server.url})
        if "prefect" in sys.modules:
            from prefect.context import refresh_global_settings_context

            refresh_global_settings_context()
    from prefect.settings import PREFECT_API_URL, PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings

    changed: dict[Any, Any] = {PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}
    if server is not None:
        if get_ready is not None:
            get_ready()
        server.wait()
        changed[PREFECT_API_URL] = server.url
    try:
        with temporary_settings(changed):
            yield
    finally:
        # A process that is started from here later names its own server.
        if before is None:
            os.environ.pop("PREFECT_API_URL", None)
        else:
            os.environ["PREFECT_API_URL"] = before


def _get_ready(name: str, workspace: Workspace) -> None:
    """Do what a flow begins with, while it would wait for its server."""
    for module in (*_NEEDED, *(_NEEDED_TO_SEARCH if name in _SEARCHES else ())):
        import_module(module)
    if name in _BEGIN_WITH_DAYS:
        # The flow itself tells what is wrong with a catalog.
        with suppress(InflightError):
            catalog = Catalog(workspace.root)
            for dataset in catalog.dataset_names():
                catalog.days(dataset, states=["published"])
    if name in _IN_PROCESSES:
        # Last: what is above keeps one core busy, and the server another one.
        start_early()
        import_module("distributed")


def _is_embedded() -> bool:
    """Return True when the environment names no server but one of this process."""
    url = os.environ.get("PREFECT_API_URL", "")
    return not url or is_own(url)


def _given(workspace: Workspace, parameters: Mapping[str, Any], workers: int | None) -> dict[str, Any]:
    given = {"workspace": workspace.root.resolve()} | dict(parameters)
    return given if workers is None else given | {"workers": workers}
