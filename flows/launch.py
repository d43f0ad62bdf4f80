"""Starting a flow, or the plain functions it chains, from the command line and from Python."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from inflight.catalog import Workspace
from inflight.errors import SettingsError
from inflight.flows.progress import told_to
from inflight.flows.settings import prefect_settings
from inflight.tasks import Progress, RunReport

#: Flows there are; each lives in the module of its name.
FLOWS = ("ingest", "reprocess", "backfill", "monthly", "diagnose", "release")


def run_embedded(
    name: str,
    workspace: Workspace,
    parameters: Mapping[str, Any],
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> RunReport:
    """Run a flow in this process, recorded by the embedded Prefect server or by ``PREFECT_API_URL``'s.

    Parameters
    ----------
    name : str
        One of `FLOWS`.
    workspace : Workspace
        Where; the embedded server keeps its home there, too.
    parameters : mapping
        Parameters of the flow, the workspace excepted; Prefect validates them with pydantic.
    workers : int, optional
        Dask processes; the cores when absent.
    progress : callable, optional
        Told ``(stage, done, total)``.

    Raises
    ------
    SettingsError
        When a parameter is wrong.
    InflightError
        What the step itself raised; the catalog has it, too.
    """
    with prefect_settings(workspace.prefect_home), told_to(progress):
        from prefect.exceptions import ParameterBindError, ParameterTypeError

        flow: Callable[..., dict[str, Any]] = getattr(import_module(f"inflight.flows.{name}"), name)
        given = dict(parameters) | ({} if workers is None else {"workers": workers})
        try:
            return RunReport.from_json(flow(workspace=workspace.root.resolve(), **given))
        except (ParameterBindError, ParameterTypeError) as error:
            raise SettingsError(
                f"parameters of {name}: {error}", remedy=f"inflight {name} --help lists the options"
            ) from None


def run_plain(
    name: str,
    workspace: Workspace,
    parameters: Mapping[str, Any],
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> RunReport:
    """Do what the flow of this name does, on the same Dask processes, without Prefect.

    Parameters and errors are those of `run_embedded`.
    """
    from inflight.flows import plain

    return plain.STEPS[name](workspace, parameters, workers, progress)
