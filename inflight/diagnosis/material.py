"""What a verdict is made from beside the search, and the sizes of the residual."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.bursts import Outliers
from inflight.diagnosis.columns import turns_of
from inflight.diagnosis.evidence import Evidence
from inflight.diagnosis.left import residual_left
from inflight.diagnosis.library import Term
from inflight.diagnosis.scoring import Present, folds_of, score
from inflight.diagnosis.search import Search
from inflight.diagnosis.series import Series
from inflight.diagnosis.uncorrected import Uncorrected, known_evidence, uncorrected
from inflight.dual.unexplained import Switched
from inflight.mission import Mission
from inflight.model import Model
from inflight.noise import NoiseFloor
from inflight.time import SECOND, utc_text

#: Part of the residual's square that a few blocks may hold between them, and how many are few.
_NEARLY_ALL, _FEW = 0.9, 12


@dataclass(frozen=True)
class Material:
    """What a verdict needs beside the search.

    Attributes
    ----------
    model : Model
        The model diagnosed.
    linearised : Model
        The same at the values the evidence was linearised at.
    terms : mapping of str to Term
    series : Series
    sums : mapping of str to float
        Over native samples: count, square, inside, spikes, and of the noise floor.
    cadence_s : float
        Of the search.
    memory_s : float
        Correlation time the prewhitened form assumes, s.
    outliers : Outliers
        What the pass left out.
    gaps : Uncorrected, optional
        Rows that count in no size, and weigh nothing in the series (see `of_known_rows`).
    switched : Switched, optional
        Switchings that two sensors show; residuals are relative to the stretches between those that no
        channel follows.
    """

    mission: Mission
    model: Model
    linearised: Model
    terms: MutableMapping[str, Term]
    series: Series
    sums: Mapping[str, float]
    cadence_s: float
    floor: NoiseFloor
    context: str = ""
    run: str = ""
    memory_s: float = 600.0
    outliers: Outliers = field(default_factory=Outliers)
    gaps: Uncorrected | None = None
    switched: Switched | None = None

    @property
    def turn(self) -> dict[str, Floats]:
        """K of every vector sensor, row by row; (9,) each."""
        return turns_of(self.linearised, int(self.series.tt2000[len(self.series.tt2000) // 2]))


def of_known_rows(search: Search, material: Material) -> Material:
    """Return the material of the rows in which the channels of all that was taken are known.

    A comparison in a band of frequencies has no such rows: its filter mixes them.
    """
    if material.mission.comparisons[material.model.comparison].kind == "platform":
        return material
    whole = material.series if material.gaps is None else material.gaps.series
    gaps = uncorrected(search, whole, material.terms)
    if gaps is None:
        return replace(material, series=whole, gaps=None)
    return replace(material, series=whole.without(gaps.rows), gaps=gaps)


def _evidence(search: Search, material: Material) -> tuple[Evidence, Present, int]:
    """Return the raw form that sizes are told of, the model's columns in it, and the residual's index."""
    if material.gaps is None:
        return search.forms["raw"], search.present(), search.y()
    evidence = known_evidence(search, material.gaps, material.terms, material.turn)
    return evidence, search.present_in(evidence), evidence.residuals[0]


def held_out(search: Search, material: Material) -> float:
    """Return the held-out rms at the cadence of the comparison, nT: of bins, and of what is inside them."""
    evidence, present, y = _evidence(search, material)
    interleaved = any(option.interleaved for option in search.accepted)
    empty: list[Any] = []
    found = score(evidence, present, empty, y, folds_of(len(evidence), interleaved))
    mean = float(found.loss0.sum() / max(evidence.count.sum(), 1.0))
    return float(np.sqrt(max(mean, 0.0) + _inside(material)))


def _inside(material: Material) -> float:
    return material.sums.get("inside", 0.0) / max(material.sums.get("count", 1.0), 1.0)


def native_rms(material: Material, search: Search) -> float:
    """Return the in-sample rms at the cadence of the comparison, nT, after all that was taken."""
    evidence, present, y = _evidence(search, material)
    total = evidence.total
    left = total[y, y] - (
        total[y, present.columns] @ present.solve(total)[:, y] if present.columns.size else 0.0
    )
    return float(np.sqrt(max(left, 0.0) / max(evidence.count.sum(), 1.0) + _inside(material)))


def effective_blocks(search: Search, material: Material, left: Floats) -> dict[str, Any]:
    """Return number and length of the blocks, and how many independent ones there really are.

    Neighbours that the residual's correlation ties together count once, and blocks that hold hardly any of
    the residual's square hardly count: of four days, a storm of some hours may be all that tells.
    """
    raw, evidence, y = search.raw, search.forms["raw"], search.y()
    length = float(np.median(raw.end - raw.start)) / SECOND
    memory = correlation_s(material.series, left)
    used = int(np.sum(raw.count > 0))
    span = float(raw.end[-1] - raw.start[0]) / SECOND
    square = np.clip(evidence.gram[:, y, y], 0.0, None)
    telling = float(square.sum() ** 2 / max(float(np.sum(square**2)), 1e-300))
    by_length = min(float(used), span / max(2.0 * memory, 1e-9))
    return {
        "count": used,
        "length_s": length,
        "correlation_s": memory,
        "by_length": by_length,
        "telling": telling,
        "independent": min(by_length, telling),
        "holding": holding(raw, square),
    }


def holding(evidence: Evidence, square: Floats) -> list[dict[str, Any]]:
    """Return the blocks that hold nearly all of the residual's square, in order of time, if they are few."""
    order = np.argsort(-square)
    whole = max(float(square.sum()), 1e-300)
    most = int(np.searchsorted(np.cumsum(square[order]), _NEARLY_ALL * whole)) + 1
    if most > _FEW:
        return []
    return [
        {
            "start": utc_text(int(evidence.start[place])),
            "end": utc_text(int(evidence.end[place])),
            "part": float(square[place] / whole),
        }
        for place in sorted(order[:most].tolist())
    ]


def correlation_s(series: Series, residual: Floats) -> float:
    """Return the residual's integrated correlation time, s, summed up to its first zero."""
    good = series["weight"] > 0
    y = np.where(good[:, None], residual, 0.0)
    size = float(np.sum(y**2)) / max(good.sum(), 1)
    if size <= 0:
        return series.step_s
    total, lag = 0.5, 1
    while lag < min(len(y) // 4, 5000):
        both = good[lag:] & good[:-lag]
        value = float(np.sum(y[lag:] * y[:-lag])) / max(both.sum(), 1) / size
        if value <= 0.02:
            break
        step = max(1, lag // 8)
        total += value * step
        lag += step
    return total * series.step_s


def left_of(search: Search, material: Material, accepted: bool = True) -> Floats:
    """Return the residual of the series after calibration, model and what was taken; (sample, row)."""
    return residual_left(search, material.series, material.terms, material.turn, accepted)
