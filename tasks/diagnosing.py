"""A diagnosis as the command line and the flow run it, and where its last result is kept."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

from inflight.catalog import Catalog
from inflight.catalog.workspace import Workspace
from inflight.comparison import folding_of
from inflight.effects.naming import did_you_mean
from inflight.errors import SettingsError
from inflight.mission import Mission
from inflight.tasks.diagnose import DiagnoseSettings
from inflight.tasks.report import Progress, to_json
from inflight.tasks.revise import Workbench
from inflight.tasks.states_units import named_units

#: Kinds of comparisons that have a residual at every sample.
SAMPLED_KINDS = ("scalar", "dual", "platform")


def diagnose_span(
    workspace: Workspace,
    start: str | None = None,
    end: str | None = None,
    settings: DiagnoseSettings | None = None,
    *,
    save: bool = False,
    client: Any = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Diagnose a span, and keep the result in the workspace's reports.

    Parameters
    ----------
    start, end : UTC date, optional
        Half-open span of days; the whole archive when absent.
    save : bool
        Save one version of the model for every effect that was found, in the order they were taken.

    Returns
    -------
    dict
        `Diagnosis.as_json`; when versions are saved, ``command`` is ``auto`` and ``versions`` has what
        `Revision.as_json` tells of each.

    Raises
    ------
    SettingsError
        When the mission has no such comparison, or one without a residual at every sample.
    InflightError
        As `inflight.tasks.diagnose.diagnose`.
    """
    settings = settings or DiagnoseSettings()
    mission = workspace.mission()
    require_sampled(mission, settings.comparison)
    bench = Workbench(
        Catalog(workspace.root), mission, settings, start, end, fresh=True, client=client, progress=progress
    )
    if save:
        found, steps = bench.auto()
        fields = found.as_json() | {"command": "auto", "versions": [one.as_json() for one in steps]}
    else:
        fields = bench.diagnose().as_json()
    units = named_units(bench.cat, mission, settings.comparison, start, end)
    if units is not None:
        fields["units"] = units
    keep(workspace, fields, {"start": start, "end": end, "settings": settings.model_dump()})
    return fields


def require_sampled(mission: Mission, comparison: str) -> None:
    """Refuse a comparison that the mission has not, or whose residual is not one a sample.

    Raises
    ------
    SettingsError
        Naming those that can be diagnosed.
    """
    usable = [name for name in mission.comparisons if _has_rows(mission, name)]
    choice = f"choose one of {', '.join(usable)}" if usable else "the mission has none that can be diagnosed"
    if comparison not in mission.comparisons:
        raise SettingsError(
            f"--comparison: mission {mission.mission!r} has no comparison {comparison!r}"
            f"{did_you_mean(comparison, mission.comparisons)}",
            remedy=choice,
        )
    if comparison not in usable:
        kind = mission.comparisons[comparison].kind
        raise SettingsError(
            f"--comparison: {comparison!r} is of kind '{kind}', and nothing tells how it is turned",
            remedy="state 'spin' under periods and a channel of kind 'sun_pulse' or 'spin_phase'"
            + (f", or {choice}" if usable else ""),
        )


def _has_rows(mission: Mission, comparison: str) -> bool:
    """Return True when a comparison has a residual: of a spin comparison, when its turns are known."""
    if mission.comparisons[comparison].kind in SAMPLED_KINDS:
        return True
    kinds = {channel.kind for _, _, channel in mission.channel_instruments()}
    return folding_of(mission, comparison) is not None and bool({"sun_pulse", "spin_phase"} & kinds)


def keep(workspace: Workspace, fields: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """Write a diagnosis whole or not at all, with what was asked for; a read-only workspace keeps none."""
    path = workspace.reports / f"diagnosis-{fields['comparison']}.json"
    part = path.with_suffix(f".{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(to_json({**fields, "asked": asked}), encoding="utf-8")
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)


def last_diagnosis(workspace: Workspace, comparison: str = "main") -> dict[str, Any] | None:
    """Return the last diagnosis of a comparison, with ``asked`` (span, settings); None without any."""
    path = workspace.reports / f"diagnosis-{comparison}.json"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def open_workbench(
    workspace: Workspace,
    comparison: str = "main",
    *,
    client: Any = None,
    progress: Progress | None = None,
) -> Workbench:
    """Return a workbench on the evidence of the last diagnosis; without one, evidence is made of all days.

    Raises
    ------
    SettingsError, InflightError
        As `diagnose_span`.
    """
    mission = workspace.mission()
    require_sampled(mission, comparison)
    asked = (last_diagnosis(workspace, comparison) or {}).get("asked") or {}
    settings = DiagnoseSettings.model_validate(asked.get("settings") or {"comparison": comparison})
    span = asked.get("start"), asked.get("end")
    return Workbench(Catalog(workspace.root), mission, settings, *span, client=client, progress=progress)
