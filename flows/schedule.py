"""What a team's Prefect server runs of a workspace by itself: each deployment, its next run and its last one.

Asks the server that ``PREFECT_API_URL`` names over HTTP; Prefect itself is not imported, which takes seconds.
"""

from __future__ import annotations

import json
import os
import urllib.error
import urllib.request
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from inflight.errors import WorkerError
from inflight.flows.server import is_own

#: Seconds to wait for an answer of the server.
_PATIENCE_S = 5.0


@dataclass(frozen=True)
class ScheduledFlow:
    """A deployment of a workspace.

    Attributes
    ----------
    name : str
        Flow and deployment, ``reprocess/full-mission``.
    schedule : str
        When it runs, as the server has it; empty on request.
    paused : bool
        Switched off.
    next_run, last_run : str
        UTC, ISO 8601; empty of none.
    last_state : str
        What became of the last run: ``Completed``, ``Failed``, ``Running``; empty of none.
    """

    name: str
    schedule: str
    paused: bool
    next_run: str
    last_run: str
    last_state: str


def scheduled_flows(workspace: Path) -> list[ScheduledFlow]:
    """Return the deployments of a workspace; none where ``PREFECT_API_URL`` names no server of a team.

    Raises
    ------
    WorkerError
        When the server does not answer.
    """
    url = os.environ.get("PREFECT_API_URL", "")
    if not url or is_own(url):
        return []
    try:
        found = [one for one in _ask(url, "deployments/filter", {}) if _is_of(one, workspace)]
        flows = {"id": {"any_": [one["flow_id"] for one in found]}}
        names = (
            {one["id"]: one["name"] for one in _ask(url, "flows/filter", {"flows": flows})} if found else {}
        )
        return [_scheduled(url, one, str(names.get(one["flow_id"], ""))) for one in found]
    except (urllib.error.URLError, TimeoutError, ConnectionError) as error:
        raise WorkerError(
            f"the Prefect server {url} does not answer: {error}",
            remedy="start it, or unset PREFECT_API_URL",
        ) from None


def _is_of(deployment: Mapping[str, Any], workspace: Path) -> bool:
    named = (deployment.get("parameters") or {}).get("workspace")
    return bool(named) and Path(str(named)).resolve() == workspace.resolve()


def _scheduled(url: str, one: Mapping[str, Any], flow: str) -> ScheduledFlow:
    own = {"deployment_id": {"any_": [one["id"]]}}
    waits = _runs(url, own | {"state": {"type": {"any_": ["SCHEDULED"]}}}, "NEXT_SCHEDULED_START_TIME_ASC")
    begun = _runs(url, own | {"start_time": {"is_null_": False}}, "START_TIME_DESC")
    active = [made["schedule"] for made in one.get("schedules") or () if made.get("active", True)]
    coming = waits[0].get("next_scheduled_start_time") or waits[0]["expected_start_time"] if waits else ""
    return ScheduledFlow(
        f"{flow}/{one['name']}",
        ", ".join(_when(schedule) for schedule in active),
        bool(one.get("paused")) or (bool(one.get("schedules")) and not active),
        str(coming or ""),
        str(begun[0]["start_time"]) if begun else "",
        str(begun[0]["state_name"] or begun[0]["state_type"]).capitalize() if begun else "",
    )


def _runs(url: str, which: Mapping[str, Any], sort: str) -> Sequence[Mapping[str, Any]]:
    return _ask(url, "flow_runs/filter", {"flow_runs": which, "sort": sort, "limit": 1})


def _when(schedule: Mapping[str, Any]) -> str:
    """Return when a schedule runs: its cron line, its interval in seconds, or its rule."""
    if "cron" in schedule:
        return str(schedule["cron"])
    return f"every {schedule['interval']:g} s" if "interval" in schedule else str(schedule.get("rrule", ""))


def _ask(url: str, path: str, question: Mapping[str, Any]) -> list[dict[str, Any]]:
    asked = urllib.request.Request(
        f"{url.rstrip('/')}/{path}",
        json.dumps(question).encode(),
        {"Content-Type": "application/json"},
    )
    with urllib.request.urlopen(asked, timeout=_PATIENCE_S) as answer:
        return list(json.load(answer))
