"""Units that switch separately: vectors whose sums make the spacecraft's states.

Every change from one state to the next is a sum of switched units (Venus Express paper, section 2: linear
superposition). A change seen often is taken for one unit; one that is the sum or difference of two or three
others, within its uncertainty and not by chance, is taken for several that switched together. So states
that were never seen can be predicted. What two sensors cannot tell: which of a unit's two states is "on",
and whether a vector is one unit or several that always switch together.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dual.changes import Change, Occupancy, joined, limit_of, reduced, simplest
from inflight.dual.states import States

#: With more units than this only states near to one that was seen are predicted.
_MOST_ALL, _NEAR = 8, 2


@dataclass(frozen=True)
class Units:
    """Units and which of them are switched in each state.

    Attributes
    ----------
    vector : ndarray, shape (unit, axis)
        What switching adds to the difference, nT.
    base : ndarray, shape (axis,)
        Difference with no unit switched, nT.
    covariance : ndarray, shape (unit + 1, axis, unit + 1, axis)
        Of the vectors and, last, of the base, nT^2.
    occupancy : ndarray of int64, shape (state, unit)
        0 or 1; more for units that cannot be told from several alike.
    consistent : bool
        All states are sums of the units within their uncertainties, and fewer units than changes make them.
    reason : str
    """

    vector: Floats
    base: Floats
    covariance: Floats
    occupancy: Occupancy
    consistent: bool
    reason: str

    def __len__(self) -> int:
        return len(self.vector)

    def centre(self, occupancy: Occupancy) -> tuple[Floats, Floats]:
        """Return difference (state, axis) and covariance (state, axis, axis) of any combination of units."""
        design = np.column_stack([occupancy, np.ones(len(occupancy))])
        values = design @ np.vstack([self.vector, self.base])
        return values, np.einsum("sp,piqj,sq->sij", design, self.covariance, design)

    def unseen(self) -> Occupancy:
        """Return the combinations (state, unit) that no state has: those near to one when units are many."""
        count = len(self)
        seen = {tuple(row) for row in self.occupancy.tolist()}
        if count <= _MOST_ALL:
            every = set(product((0, 1), repeat=count))
        else:
            every = set()
            for row in seen:
                for number in range(1, _NEAR + 1):
                    for flipped in combinations(range(count), number):
                        every.add(tuple(1 - min(v, 1) if i in flipped else v for i, v in enumerate(row)))
        rows = sorted(every - seen)
        return np.array(rows, dtype=np.int64).reshape(len(rows), count)


def find_units(states: States) -> Units:
    """Return the units that make the states, from the changes between states that follow each other."""
    label = states.label[states.label >= 0]
    edges = _edges(label)
    if len(states) < 2 or not edges:
        return _no_units(states, "one state only")
    if states.occupancy is not None:
        return _fitted(states, states.occupancy)
    changes, which = _distinct(states, edges)
    kept, parts = reduced(changes)
    occupancy = _occupancy(len(states), edges, which, parts, len(kept))
    if occupancy is None:
        return _no_units(states, "the changes between states contradict each other as sums of units")
    return _fitted(states, occupancy)


def _edges(label: npt.NDArray[np.int64]) -> dict[tuple[int, int], int]:
    """Return how often two states, the lower number first, follow each other."""
    found: dict[tuple[int, int], int] = {}
    for one, other in zip(label[:-1].tolist(), label[1:].tolist(), strict=True):
        if one != other:
            pair = (min(one, other), max(one, other))
            found[pair] = found.get(pair, 0) + 1
    return found


def _distinct(
    states: States, edges: dict[tuple[int, int], int]
) -> tuple[list[Change], dict[tuple[int, int], tuple[int, int]]]:
    """Return the distinct changes, and for each pair of states its change and sign."""
    changes: list[Change] = []
    which = {}
    limit = limit_of(len(edges))
    scatter = 2.0 * states.scatter**2 * np.eye(3)
    for (one, other), count in sorted(edges.items(), key=lambda item: -item[1]):
        vector = states.centre[other] - states.centre[one]
        spread = states.covariance[other] + states.covariance[one] + scatter
        which[one, other] = joined(changes, Change(vector, spread, count), limit)
    return changes, which


def _occupancy(
    states: int,
    edges: dict[tuple[int, int], int],
    which: dict[tuple[int, int], tuple[int, int]],
    parts: dict[int, dict[int, int]],
    units: int,
) -> Occupancy | None:
    """Return how often each unit is switched in each state, 0 at least; None for a contradiction."""
    near: dict[int, list[tuple[int, npt.NDArray[np.int64]]]] = {state: [] for state in range(states)}
    for one, other in edges:
        change, sign = which[one, other]
        step = np.zeros(units, dtype=np.int64)
        for unit, value in parts[change].items():
            step[unit] = sign * value
        near[one].append((other, step))
        near[other].append((one, -step))
    found: dict[int, npt.NDArray[np.int64]] = {0: np.zeros(units, dtype=np.int64)}
    waiting = deque([0])
    while waiting:
        state = waiting.popleft()
        for other, step in near[state]:
            expected = found[state] + step
            if other not in found:
                found[other] = expected
                waiting.append(other)
            elif not np.array_equal(found[other], expected):
                return None
    if len(found) < states:
        return None
    return simplest(np.array([found[state] for state in range(states)]))


def _fitted(states: States, occupancy: Occupancy) -> Units:
    """Return the vectors that fit all states best, and whether all fit."""
    count, units = occupancy.shape
    design = np.column_stack([occupancy, np.ones(count)])
    if np.linalg.matrix_rank(design) < units + 1:
        return _no_units(states, "some units never switch without others: they cannot be separated")
    spread = states.covariance + states.scatter**2 * np.eye(3) / np.maximum(states.count, 1)[:, None, None]
    weight = np.linalg.inv(spread)
    width = 3 * (units + 1)
    normal = np.einsum("sp,sij,sq->piqj", design, weight, design).reshape(width, width)
    right = np.einsum("sp,sij,sj->pi", design, weight, states.centre).ravel()
    covariance = np.linalg.inv(normal)
    value = (covariance @ right).reshape(units + 1, 3)
    left = states.centre - design @ value
    far = np.einsum("si,sij,sj->s", left, weight, left)
    freedom = 3 * (count - units - 1)
    proven = states.occupancy is not None
    if proven and freedom > 0:
        # What is proven does not become doubtful by levels that wandered farther than they say.
        covariance = covariance * max(1.0, float(far.sum()) / freedom)
    consistent = proven or (bool(far.max() < limit_of(count)) and freedom > 0)
    if consistent:
        reason = f"{count} states are sums of {units} units"
    elif freedom <= 0:
        reason = f"{count} states show no sum that would prove separate units"
    else:
        reason = f"state {int(far.argmax())} is no sum of the units that make the others"
    return Units(
        value[:-1],
        value[-1],
        covariance.reshape(units + 1, 3, units + 1, 3),
        occupancy,
        consistent,
        reason,
    )


def _no_units(states: States, reason: str) -> Units:
    nothing = np.zeros((len(states), 0), dtype=np.int64)
    base = states.centre[0] if len(states) else np.full(3, np.nan)
    return Units(np.empty((0, 3)), base, np.zeros((1, 3, 1, 3)), nothing, False, reason)
