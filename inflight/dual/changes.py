"""Vectors by which the difference changes, up to their sign, and which of them are sums of others."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
import numpy.typing as npt
from scipy import stats

from inflight.arrays import Floats

Occupancy = npt.NDArray[np.int64]

#: Chance that a change is not recognised as a unit's, or a sum's, by its noise.
_MISSED = 1e-3
#: A sum is believed when fewer than this many agree by accident.
_ACCIDENTS = 0.05
#: Most units that are taken to switch at once.
_TOGETHER = 3


@dataclass(frozen=True)
class Change:
    """A vector by which states change, up to its sign."""

    vector: Floats
    covariance: Floats
    count: int


def limit_of(tests: int) -> float:
    """Return the squared distance that one of so many right changes exceeds once in a thousand times."""
    return float(stats.chi2.isf(_MISSED / max(tests, 1), 3))


def _squared(vector: Floats, covariance: Floats) -> float:
    return float(vector @ np.linalg.solve(covariance, vector))


def joined(changes: list[Change], new: Change, limit: float) -> tuple[int, int]:
    """Return place and sign of the known change that a new one is; it is added where it is none.

    Parameters
    ----------
    changes : list of Change
        Known so far; the one that the new one is becomes surer by it.
    new : Change
    limit : float
        Squared distance, in errors, up to which both are one.
    """
    best = (np.inf, 0, 1)
    for index, known in enumerate(changes):
        for sign in (1, -1):
            far = _squared(new.vector - sign * known.vector, new.covariance + known.covariance)
            best = min(best, (far, index, sign))
    far, index, sign = best
    if far > limit:
        changes.append(new)
        return len(changes) - 1, 1
    known = changes[index]
    gain = known.covariance @ np.linalg.inv(new.covariance + known.covariance)
    changes[index] = Change(
        known.vector + gain @ (sign * new.vector - known.vector),
        known.covariance - gain @ known.covariance,
        known.count + new.count,
    )
    return index, sign


def reduced(changes: list[Change]) -> tuple[list[int], dict[int, dict[int, int]]]:
    """Return which changes are units, and each change as signed units (by place among the units)."""
    # Rare and large changes are the sums; frequent and small ones the units.
    order = sorted(
        range(len(changes)), key=lambda one: (changes[one].count, -float(np.linalg.norm(changes[one].vector)))
    )
    kept = set(order)
    made: dict[int, dict[int, int]] = {}
    for one in order:
        sum_of = _as_sum(changes, one, sorted(kept - {one}))
        if sum_of is not None:
            kept.discard(one)
            made[one] = sum_of
    units = sorted(kept)
    place = {one: index for index, one in enumerate(units)}
    parts: dict[int, dict[int, int]] = {one: {place[one]: 1} for one in units}
    for one in reversed([one for one in order if one in made]):
        total: dict[int, int] = {}
        for part, sign in made[one].items():
            for unit, value in parts[part].items():
                total[unit] = total.get(unit, 0) + sign * value
        parts[one] = {unit: value for unit, value in total.items() if value}
    return units, parts


def _as_sum(changes: list[Change], one: int, others: list[int]) -> dict[int, int] | None:
    """Return a change as a signed sum of two or three others; None when it is none."""
    wanted = changes[one]
    size = float(np.sqrt(np.mean([np.sum(change.vector**2) for change in changes])))
    for number in range(2, min(_TOGETHER, len(others)) + 1):
        choices = list(combinations(others, number))
        signs = list(product((1, -1), repeat=number))
        limit = limit_of(1)
        best: tuple[float, dict[int, int]] | None = None
        for choice in choices:
            spread = wanted.covariance + sum(changes[part].covariance for part in choice)
            # The sphere that sums of so many vectors fill, beside what one would accept.
            volume = (
                limit**1.5
                * np.sqrt(max(float(np.linalg.det(spread)), 0.0))
                / (size**2 * number / 3.0 * limit) ** 1.5
            )
            if len(choices) * len(signs) * volume > _ACCIDENTS:
                continue
            for sign in signs:
                total = sum(s * changes[part].vector for s, part in zip(sign, choice, strict=True))
                far = _squared(wanted.vector - total, spread)
                if far < limit and (best is None or far < best[0]):
                    best = far, dict(zip(choice, sign, strict=True))
        if best is not None:
            return best[1]
    return None


def simplest(table: Occupancy) -> Occupancy:
    """Return occupancies of units combined anew, so that as many as possible are on or off and no more.

    Two that often switch together may have been taken for one unit: with the sum ``a + b`` and ``a`` as units
    b alone is "minus one" of them.
    """
    while True:
        span = np.ptp(table, axis=0)
        best: tuple[int, int, int, int] | None = None
        for one, other, sign in product(range(table.shape[1]), range(table.shape[1]), (1, -1)):
            if one == other:
                continue
            gain = int(span[other] - np.ptp(table[:, other] - sign * table[:, one]))
            if gain > 0 and (best is None or gain > best[0]):
                best = gain, one, other, sign
        if best is None:
            return np.asarray(table - table.min(axis=0))
        _, one, other, sign = best
        table[:, other] -= sign * table[:, one]
