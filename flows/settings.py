"""Prefect as this project runs it: embedded and quiet by default, or the server a team already has.

Nothing here imports Prefect, because its settings are read from the environment once, on import.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from inflight.errors import SettingsError

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
#: Set in both modes: no telemetry, no log traffic.
_QUIET = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_CLIENT_METRICS_ENABLED": "false",
    "PREFECT_LOGGING_TO_API_ENABLED": "false",
}
#: Set for the embedded server only. Logs are silenced: the command line tells failures itself, and the
#: server, stopped hard at the end of a command, would print the cancellation of its own housekeeping.
_EMBEDDED = {
    "PREFECT_LOGGING_LEVEL": "CRITICAL",
    "PREFECT_SERVER_ALLOW_EPHEMERAL_MODE": "true",
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "120",
    "PREFECT_SERVER_UI_ENABLED": "false",
    "PREFECT_SERVER_LOGGING_LEVEL": "CRITICAL",
    **{f"PREFECT_SERVER_SERVICES_{name}_ENABLED": "false" for name in _IDLE_SERVICES},
}


def prefect_environment(home: Path) -> dict[str, str]:
    """Return the environment a command's flows run in; what the user has set already wins.

    Parameters
    ----------
    home : Path
        Private Prefect home, used by the embedded server. With ``PREFECT_API_URL`` set, flows go to
        that server and the home is the user's own.
    """
    wanted = dict(_QUIET)
    if not os.environ.get("PREFECT_API_URL"):
        wanted |= _EMBEDDED | {"PREFECT_HOME": str(home.resolve())}
    return wanted | {name: os.environ[name] for name in wanted if name in os.environ}


@contextmanager
def prefect_settings(home: Path) -> Iterator[None]:
    """Run what is inside with the project's Prefect settings.

    The heartbeat of flow runs is off: its thread costs every flow a second at its end.

    Raises
    ------
    SettingsError
        When Prefect was imported before with another home; its settings cannot change any more.
    """
    environment = prefect_environment(home)
    _refuse_late_start(environment)
    os.environ.update(environment)
    from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings

    with temporary_settings({PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}):
        yield


def _refuse_late_start(environment: dict[str, str]) -> None:
    if "prefect" not in sys.modules or "PREFECT_HOME" not in environment:
        return
    from prefect.settings import get_current_settings

    present = str(get_current_settings().home)
    if present != environment["PREFECT_HOME"] and not get_current_settings().api.url:
        raise SettingsError(
            f"Prefect is already imported with home {present}",
            remedy="start a new process for another workspace, or set PREFECT_HOME or PREFECT_API_URL first",
        )
