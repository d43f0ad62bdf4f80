"""Which housekeeping channel stands behind a unit that switches, or that none does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats

#: Part of a channel's changes and of a unit's switchings that belong to each other in a match.
MATCH = 0.5
#: Rearrangements of a channel's changes that may do as well, by chance.
_CHANCE, _REARRANGED = 0.005, 20_000
#: The fewest switchings of a unit that tell anything.
_FEWEST = 4
#: A rival is told beside the best channel when it explains nearly as much.
_RIVAL = 0.9


@dataclass(frozen=True)
class NamedUnit:
    """A unit and the channels that switch with it.

    Attributes
    ----------
    unit : int
    switchings : int
        How often it was seen to switch.
    channels : tuple of str
        The best first; more than one when these cannot be told apart, none without housekeeping.
    agreement : tuple of float
        Squared correlation of the channel's changes with the unit's switchings, over all switchings.
    per_unit : tuple of float
        Change of the channel when the unit is switched on, in the channel's unit.
    reason : str
        Why none is named; empty when one is.
    """

    unit: int
    switchings: int
    channels: tuple[str, ...]
    agreement: tuple[float, ...]
    per_unit: tuple[float, ...]
    reason: str = ""


def name_units(signs: Floats, changes: Mapping[str, Floats], *, seed: int = 0) -> list[NamedUnit]:
    """Return the channels behind units.

    Parameters
    ----------
    signs : ndarray, shape (switching, unit)
        +1 where a unit is switched on, -1 where off, 0 where it does not take part.
    changes : mapping of str to ndarray, shape (switching,)
        Change of each housekeeping channel across each switching, in its unit; NaN where it is missing.
    seed : int
        Of the rearrangements.

    Returns
    -------
    list of NamedUnit
        A channel is named when it explains at least half of a unit's switchings and hardly any
        rearrangement of its changes among the switchings does as well; the level is shared by all pairs
        of unit and channel (Bonferroni).
    """
    random = np.random.default_rng(seed)
    # Rearrangements tell no smaller level than their number does.
    pairs = min(max(1, signs.shape[1] * len(changes)), round(_CHANCE * _REARRANGED / 2.0))
    return [_named(unit, signs[:, unit], changes, _CHANCE / pairs, random) for unit in range(signs.shape[1])]


def _named(
    unit: int, sign: Floats, changes: Mapping[str, Floats], level: float, random: np.random.Generator
) -> NamedUnit:
    count = int(np.count_nonzero(sign))
    if count < _FEWEST:
        return NamedUnit(
            unit, count, (), (), (), f"it was seen to switch {count} times, at least {_FEWEST} needed"
        )
    if not changes:
        return NamedUnit(unit, count, (), (), (), "there is no housekeeping at its switchings")
    found = []
    for name, change in changes.items():
        known = np.isfinite(change)
        if np.count_nonzero(sign[known]) < _FEWEST:
            continue
        agreement, per_unit = _agreement(sign[known], change[known])
        if agreement >= MATCH and _by_chance(sign[known], change[known], agreement, random) <= level:
            found.append((agreement, name, per_unit))
    if not found:
        return NamedUnit(unit, count, (), (), (), "no channel changes when it switches")
    found.sort(reverse=True)
    near = [one for one in found if one[0] >= _RIVAL * found[0][0]]
    return NamedUnit(
        unit,
        count,
        tuple(one[1] for one in near),
        tuple(one[0] for one in near),
        tuple(one[2] for one in near),
    )


def _agreement(sign: Floats, change: Floats) -> tuple[float, float]:
    """Return the squared correlation through zero, and the change for one switching on."""
    squares = float(change @ change) * float(sign @ sign)
    product = float(sign @ change)
    return (product**2 / squares if squares > 0 else 0.0), product / float(sign @ sign)


def _by_chance(sign: Floats, change: Floats, agreement: float, random: np.random.Generator) -> float:
    """Return how probable it is that the same changes, at the switchings in another order, agree as well."""
    rearranged = random.permuted(np.broadcast_to(change, (_REARRANGED, change.size)), axis=1)
    squares = float(change @ change) * float(sign @ sign)
    better = int(np.count_nonzero((rearranged @ sign) ** 2 / squares >= agreement * (1.0 - 1e-9)))
    return (better + 1) / (_REARRANGED + 1)
