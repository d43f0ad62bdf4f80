"""How a day's spacecraft was turned, and channels that go with the spin folded like the field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.comparison import folding_of
from inflight.folding import Folding, fold_series
from inflight.mission import Mission
from inflight.tasks.archive_index import ArchiveIndex
from inflight.tasks.channel_series import channel_series
from inflight.tasks.needs import Need, clock_of
from inflight.tasks.spinning import spin_phase
from inflight.time import Int64, day_bounds

#: A channel shows the spin with this many readings a turn.
_READINGS = 4


def shows_spin(mission: Mission, comparison: str, cadence_ns: int) -> bool:
    """Return True when a channel of a cadence shows what goes with a spin comparison's spin."""
    if folding_of(mission, comparison) is None:
        return False
    return _READINGS * cadence_ns <= mission.periods["spin"]


@dataclass(frozen=True)
class Turning:
    """The clock of a spin comparison on one day."""

    cat: Catalog
    mission: Mission
    comparison: str
    index: ArchiveIndex
    day: np.datetime64
    folding: Folding
    clock: Need

    @classmethod
    def of(
        cls, cat: Catalog, mission: Mission, comparison: str, index: ArchiveIndex, day: np.datetime64
    ) -> Turning | None:
        """Return the clock; None of a comparison that folds nothing."""
        folding = folding_of(mission, comparison)
        if folding is None:
            return None
        return cls(cat, mission, comparison, index, day, folding, clock_of(mission, comparison)[0])

    def is_seen_by(self, cadence_ns: int) -> bool:
        """Return True when a channel of a cadence shows what goes with the spin."""
        return shows_spin(self.mission, self.comparison, cadence_ns)

    def phase(self, stamps: Int64) -> Floats:
        """Return the phase at the stamps of an instrument's channels, rad; NaN where nothing tells it."""
        told = channel_series(self.cat, self.clock, self.day, self.index, alone=False)
        found = spin_phase(self.mission, self.comparison, self.clock, told, stamps)
        return np.asarray(found.phase.values, dtype=np.float64)

    def folded(self, values: Floats, stamps: Int64, phase: Floats, edges: Int64) -> Floats:
        """Return a channel on the synthetic turns whose bins have these edges; NaN without a phase."""
        flat = np.asarray(values, dtype=np.float64)
        out = np.full((edges.size - 1, *flat.shape[1:]), np.nan)
        if not np.isfinite(phase).any():
            return out
        found = fold_series(flat, stamps, phase, self.folding, day_bounds(self.day))
        count = min(len(out), len(found))
        out[:count] = found[:count]
        return out
