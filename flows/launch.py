"""Starting a flow, or the plain functions it chains, from the command line and from Python."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError, validate_call

from inflight.catalog import Workspace
from inflight.errors import SettingsError
from inflight.flows.runner import PlainRunner, progress_shown_by, using_runner
from inflight.flows.settings import prefect_settings
from inflight.tasks import Progress, RunReport, as_settings_error


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
    with prefect_settings(workspace.prefect_home), progress_shown_by(progress):
        from prefect.exceptions import ParameterBindError, ParameterTypeError

        from inflight.flows import prefect_flows

        try:
            return RunReport.from_json(getattr(prefect_flows, name)(**_given(workspace, parameters, workers)))
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
    from inflight.flows.steps import STEPS

    step = validate_call(STEPS[name])
    with using_runner(PlainRunner(progress)):
        try:
            return RunReport.from_json(step(**_given(workspace, parameters, workers)))
        except ValidationError as error:
            raise as_settings_error(error) from None


def _given(workspace: Workspace, parameters: Mapping[str, Any], workers: int | None) -> dict[str, Any]:
    given = {"workspace": workspace.root.resolve()} | dict(parameters)
    return given if workers is None else given | {"workers": workers}
