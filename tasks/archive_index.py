"""Which days of the archive some needs are made from: read once, and sent to workers without the database."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from inflight.alignment import FIELD_ROLES
from inflight.catalog import Catalog, Day
from inflight.tasks.needs import Need

_DAY = np.timedelta64(1, "D")
#: A channel's typical value comes from its own day when this part of it is known, else from other days.
_ENOUGH = 0.1
#: Other days are looked for this far on both sides.
STAND_IN_DAYS = 15


@dataclass(frozen=True)
class ArchiveIndex:
    """The published days of the archive that some needs are made from; no database behind it.

    Attributes
    ----------
    days : mapping of (dataset, day) to Day
        What is there.
    before : int
        Days before its own that a day's samples are made from.
    replaceable : tuple of Need
        Those whose typical value is taken where they are missing.
    """

    days: Mapping[tuple[str, np.datetime64], Day]
    before: int = 1
    replaceable: tuple[Need, ...] = ()

    @classmethod
    def of(cls, cat: Catalog, needs: Sequence[Need], time: slice | None = None) -> ArchiveIndex:
        """Read the index from the catalog, one query a dataset."""
        return cls(
            {
                (name, day.day): day
                for name in sorted({need.dataset for need in needs})
                for day in cat.days(name, time, states=("published",))
            },
            max((need.days_before for need in needs), default=1),
            tuple(need for need in needs if need.replaceable),
        )

    def get(self, need: Need, day: np.datetime64) -> Day | None:
        """Return the published day a need is read from."""
        return self.days.get((need.dataset, day))

    def around(self, days: Sequence[np.datetime64]) -> ArchiveIndex:
        """Return the part some days need, their neighbours included: what a worker is sent."""
        wanted = {day + step * _DAY for day in days for step in range(-self.before, 2)}
        others = {
            (one.dataset, one.day)
            for need in self.replaceable
            for day in days
            for one in self.typical_days(need, day)
        }
        return ArchiveIndex(
            {key: day for key, day in self.days.items() if key[1] in wanted or key in others},
            self.before,
            self.replaceable,
        )

    def typical_days(self, need: Need, day: np.datetime64) -> list[Day]:
        """Return the days that tell what a channel usually reads on a day: its own, else the nearest two.

        One before and one after, at most `STAND_IN_DAYS` away; none when there is none. A day that
        hardly has the channel counts only when no other does.
        """
        far = STAND_IN_DAYS + 1
        for least in (_ENOUGH, np.finfo(float).tiny):
            for sides in ((range(1),), (range(-1, -far, -1), range(1, far))):
                near = [self._first(need, [day + step * _DAY for step in side], least) for side in sides]
                if found := [one for one in near if one is not None]:
                    return found
        return []

    def _first(self, need: Need, days: Sequence[np.datetime64], least: float) -> Day | None:
        """Return the first of some days of which at least a part has the channel."""
        there = (self.get(need, day) for day in days)
        return next((one for one in there if one is not None and _known_part(one, need) >= least), None)

    def with_all(self, needs: Sequence[Need]) -> list[np.datetime64]:
        """Return the days on which every field is there."""
        sets = [
            {day for name, day in self.days if name == need.dataset}
            for need in needs
            if need.name in FIELD_ROLES
        ]
        return sorted(set.intersection(*sets)) if sets else []

    def sources(self, needs: Sequence[Need], day: np.datetime64, base: Need) -> list[Day]:
        """Return the archive days one day's samples are made from, in a fixed order."""
        found = []
        for need in needs:
            steps = range(1) if self.stands_alone(need, base, day) else range(-need.days_before, 2)
            found += [self.get(need, day + step * _DAY) for step in steps]
            if need.replaceable:
                found += self.typical_days(need, day)
        unique = {source.id: source for source in found if source is not None}
        return [unique[key] for key in sorted(unique)]

    def stands_alone(self, need: Need, base: Need, day: np.datetime64) -> bool:
        """Return True when a series has the base's stamps, so that nothing is interpolated."""
        own, other = self.get(need, day), self.get(base, day)
        if own is None or other is None:
            return True
        if need.lag_ns or need.part or need.smooth_ns or need.cadence_ns != base.cadence_ns:
            return False
        return (own.first_tt2000 - other.first_tt2000) % need.cadence_ns == 0


def _known_part(day: Day, need: Need) -> float:
    """Return the part of a day on which a channel has values; 1 where the archive does not tell."""
    told = day.report.get("channels", {}).get(need.channel, {})
    return float(told.get("coverage", 1.0))
