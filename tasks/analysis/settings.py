"""What a user may choose of a diagnosis, apart from what carries it out."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


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
