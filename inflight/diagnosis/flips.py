"""Honest significance: signs of whole blocks are flipped, and the largest of all candidates counts.

Under the null hypothesis a block's scores could as well have the other sign. The family-wise p-value
of a candidate is the part of flips in which *any* candidate reaches its ratio of statistic to mean
flipped statistic (Westfall and Young's maximum).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.evidence import Evidence
from inflight.diagnosis.scoring import Index, Present, block_scores, projected
from inflight.estimators.absorption import half_inverse

#: Independent spans whose signs are flipped, at most.
MOST_UNITS = 120


def flip_signs(blocks: int, draws: int, seed: int) -> tuple[Floats, list[Index]]:
    """Return random signs (draw, unit) and the blocks of each unit."""
    units: list[Index] = np.array_split(np.arange(blocks, dtype=np.int64), min(blocks, MOST_UNITS))
    signs = np.random.default_rng(seed).integers(0, 2, (draws, len(units))) * 2.0 - 1.0
    return np.asarray(signs, dtype=np.float64), units


def flip_ratios(
    evidence: Evidence,
    present: Present,
    candidates: Sequence[Index],
    y: int,
    signs: Floats,
    units: Sequence[Index],
) -> tuple[Floats, Floats]:
    """Return observed ratios (candidate,) and flipped ones (draw, candidate)."""
    scores = block_scores(evidence, present, y)
    summed = np.stack([scores[unit].sum(axis=0) for unit in units])
    gram = projected(evidence.total, present)
    observed = np.zeros(len(candidates))
    flipped = np.zeros((len(signs), len(candidates)))
    for place, columns in enumerate(candidates):
        half = half_inverse(gram[np.ix_(columns, columns)][None])[0]
        own = summed[:, columns] @ half
        drawn = np.sum((signs @ own) ** 2, axis=1)
        usual = max(float(drawn.mean()), 1e-300)
        observed[place] = float(np.sum(own.sum(axis=0) ** 2)) / usual
        flipped[:, place] = drawn / usual
    return observed, flipped


def family_wise(observed: Floats, flipped: Floats) -> Floats:
    """Return p-values (candidate,): how often the largest flipped ratio reaches the observed one."""
    largest = np.sort(flipped.max(axis=1)) if flipped.size else np.zeros(1)
    above = largest.size - np.searchsorted(largest, observed, side="left")
    return np.asarray((1.0 + above) / (1.0 + largest.size))
