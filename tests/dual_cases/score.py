"""What a correction does to the outboard reading, with the truth known."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from inflight.arrays import Floats
from inflight.dual import Candidates, Correction, HeldOutDecision, choose_correction

from .scenarios import Case, make_case


@dataclass(frozen=True)
class Score:
    """Errors of one case, nT a component, over the samples that both sensors have.

    `raw`, `corrected`: without their constants; `raw_rms`, `corrected_rms`: with them.
    `error_over_sigma`: rms error of the correction over the rms of its sigma, without the constant.
    """

    seed: int
    family: str
    ambient: str
    exceeds: bool
    chosen: str
    raw: float
    corrected: float
    raw_rms: float
    corrected_rms: float
    error_over_sigma: float
    seconds: float
    reason: str

    @property
    def ratio(self) -> float:
        return self.corrected / self.raw

    @property
    def ratio_rms(self) -> float:
        return self.corrected_rms / self.raw_rms

    @property
    def applied(self) -> bool:
        return self.chosen != "none"


def score_seed(seed: int, body_size: float = 1.0) -> Score:
    """Make a case, correct it, and return its errors."""
    case = make_case(seed)
    started = time.perf_counter()
    decision = corrected(case, body_size)
    return score(case, decision, time.perf_counter() - started)


def corrected(case: Case, body_size: float = 1.0) -> HeldOutDecision:
    """Return the decision on all candidates; the truth is not given.

    Parameters
    ----------
    body_size : float
        Size of the stated body over that of the true one; 0 when no positions are stated.
    """
    body = replace(case.body, half_size=body_size * case.body.half_size) if body_size else None
    candidates = Candidates(case.readings, body)
    return choose_correction(case.readings, candidates.fit, candidates.priors)


def score(case: Case, decision: HeldOutDecision, seconds: float = 0.0) -> Score:
    good = case.readings.good
    found = decision.correction
    before = (case.readings.outboard - case.ambient)[good]
    after = (found.corrected(case.readings.outboard) - case.ambient)[good]
    return Score(
        case.seed,
        case.family,
        case.ambient_kind,
        case.exceeds,
        decision.chosen,
        changes(before),
        changes(after),
        float(np.sqrt(np.mean(before**2))),
        float(np.sqrt(np.mean(after**2))),
        error_over_sigma(case, found),
        seconds,
        found.reason,
    )


def changes(values: Floats) -> float:
    """Return the size of what changes, a component."""
    return float(np.sqrt(np.mean(np.var(values, axis=0))))


def error_over_sigma(case: Case, found: Correction) -> float:
    """Return the rms error of a correction over its rms sigma; NaN where none is applied."""
    known = found.known & case.readings.good
    if not found.applied or not known.any():
        return float("nan")
    error = (found.field - case.stray)[known]
    error -= error.mean(axis=0)
    return float(np.sqrt(np.sum(error**2) / np.sum(found.sigma[known] ** 2)))
