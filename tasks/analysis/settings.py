"""What a user may choose of a diagnosis, and of which comparisons one can be made."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from inflight.errors import SettingsError, did_you_mean
from inflight.mission import Mission
from inflight.model import folding_of

#: Kinds of comparisons that have a residual at every sample.
SAMPLED_KINDS = ("scalar", "dual", "platform", "field_model")


class DiagnoseSettings(BaseModel):
    """What a user may choose of a diagnosis.

    Attributes
    ----------
    comparison : str
        Entry of the mission's `comparisons`.
    cadence_s : float, optional
        Of the search; chosen from the span's length when absent.
    interval_days : int
        Days of a calibration interval: what the nine parameters are fitted to anew.
    rounds : int
        Additions at most; 0 only ranks.
    draws, seed : int
        Sign flips.
    batch_blocks : int
        Blocks a worker makes at once; it bounds the memory.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    comparison: str = "main"
    cadence_s: float | None = Field(None, gt=0)
    interval_days: int = Field(15, ge=1)
    rounds: int = Field(8, ge=0, le=40)
    draws: int = Field(2000, ge=100, le=100_000)
    seed: int = Field(0, ge=0)
    batch_blocks: int = Field(10, ge=1)


def sampled_comparisons(mission: Mission) -> list[str]:
    """Return the comparisons that can be diagnosed: those whose residual is one a sample."""
    channels = {channel.kind for _, _, channel in mission.channel_instruments()}
    has_turns = bool({"sun_pulse", "spin_phase"} & channels)
    return [
        name
        for name, entry in mission.comparisons.items()
        if entry.kind in SAMPLED_KINDS or (has_turns and folding_of(mission, name) is not None)
    ]


def require_sampled(mission: Mission, comparison: str) -> None:
    """Refuse a comparison that the mission has not, or whose residual is not one a sample.

    Raises
    ------
    SettingsError
        Naming those that can be diagnosed.
    """
    usable = sampled_comparisons(mission)
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
