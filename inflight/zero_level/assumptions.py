"""What each method assumes of nature, tested on the intervals that it took.

`check_assumptions` takes a `CombinedEstimate` and its `Intervals`; makes an `Assumption` for each: a number,
the limit it is held against, and whether it holds. All are measured with the offset that was found.

- *Rotations* (Davis-Smith, Wang-Pan): the part of the variance that is in the size of the field, of the
  intervals they take, is small.
- *Compressions along the field* (mirror mode): the direction of most variance lies near the mean field.
- *Compression differs from rotation* (minimum correlation): it is blind where both are equal.
- *Enough directions* (all): the field turns far enough, else an offset along it looks like strength.
- *Size and direction independent* (all: the likelihood that refuses other offsets rests on it): what is left
  of the correlation ``sum dB dn`` is no larger than its own scatter in time; a chi-square.
- *Agreement*: two methods on the same intervals differ by no more than their errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from inflight.lsq import long_run_covariance
from inflight.zero_level.combination import COMBINATION_SETTINGS, CombinedEstimate
from inflight.zero_level.estimate import OffsetSearch
from inflight.zero_level.intervals import INTERVAL_SETTINGS, Bools, Intervals
from inflight.zero_level.methods import (
    DAVIS_SMITH,
    KIND_SETTINGS,
    MINIMUM_CORRELATION,
    MIRROR_MODE,
    WANG_PAN,
    compression_over_rotation,
    joint_equations,
)


@dataclass(frozen=True, kw_only=True)
class AssumptionSettings:
    """Limits of the assumptions.

    Attributes
    ----------
    tilt_deg : float
        Mirror modes lie along the field to within this, median. Assumed.
    unequal : float
        Compression over rotation is so many times away from 1, either way. Assumed.
    turning_deg : float
        The field turns by so much, rms about its mean direction. Measured: at 9 degrees no rule tells an
        offset of a day, at 29 all do (docs/science/zero-level.md).
    """

    tilt_deg: float = 20.0
    unequal: float = 2.0
    turning_deg: float = 10.0


ASSUMPTION_SETTINGS = AssumptionSettings()


@dataclass(frozen=True)
class Assumption:
    """One assumption and its test.

    Attributes
    ----------
    methods : str
        Which methods need it.
    text : str
        What is assumed.
    value, limit : float
        What was measured, and what it is held against; NaN where nothing could be measured.
    unit : str
    holds : bool
    used : bool
        Whether a method that needs it has a part in the estimate.
    """

    methods: str
    text: str
    value: float
    limit: float
    unit: str
    holds: bool
    used: bool

    def summary(self) -> str:
        """Return one sentence."""
        verdict = "holds" if self.holds else "FAILS" if self.used else "fails, and is not relied on"
        if not np.isfinite(self.value):
            return f"{self.text} ({self.methods}): not tested, nothing to test it with"
        size = f"{self.value:.3g}{self.unit}, limit {self.limit:.3g}{self.unit}"
        return f"{self.text} ({self.methods}) {verdict}: {size}"


def check_assumptions(
    found: CombinedEstimate, intervals: Intervals, search: OffsetSearch
) -> tuple[Assumption, ...]:
    """Return the assumptions behind an estimate, each with its test.

    Parameters
    ----------
    found : CombinedEstimate
        Of these intervals.
    intervals : Intervals
    search : OffsetSearch
        What the estimate answers: where an axis is not told, the independence is not tested.
    """
    offset, kinds = found.estimate.solution, found.kinds
    turning, limits = ~kinds.compressional, ASSUMPTION_SETTINGS
    taking_part = {one.method for one in found.methods}

    def held(
        methods: Sequence[str], text: str, value: float, limit: float, unit: str = "", *, above: bool = True
    ) -> Assumption:
        holds = bool(value >= limit if above else value <= limit)
        names = ", ".join(methods) or "all"
        used = not methods or not taking_part.isdisjoint(methods)
        return Assumption(names, text, float(value), limit, unit, holds, used)

    part = float(np.median(kinds.compression[kinds.alfvenic])) if _enough(kinds.alfvenic) else np.nan
    ratio = np.nan
    if _enough(turning):
        ratio = float(compression_over_rotation(intervals.select(turning), offset))
    apart = max(ratio, 1.0 / ratio) if ratio > 0.0 else np.nan
    told = bool(found.estimate.determined[np.asarray(search.free)].all())
    chance = _independence(found, intervals, turning) if told else np.nan
    least_chance = COMBINATION_SETTINGS.disagree
    out = [
        held(
            (DAVIS_SMITH, WANG_PAN), "fluctuations are rotations", part, KIND_SETTINGS.alfvenic, above=False
        ),
        held(
            (MIRROR_MODE,),
            "compressions lie along the field",
            _tilt(found, intervals),
            limits.tilt_deg,
            " deg",
            above=False,
        ),
        held((MINIMUM_CORRELATION,), "compression differs from rotation", apart, limits.unequal, " times"),
        held((), "the field turns", _spread(found, intervals), limits.turning_deg, " deg"),
        held((), "size and direction are independent", chance, least_chance, " chance"),
    ]
    if found.agreement:
        least = min(found.agreement, key=lambda one: one.chance)
        pair = (least.first, least.second)
        out.append(held(pair, "methods agree", least.chance, least_chance, " chance"))
    return tuple(out)


def _enough(chosen: Bools) -> bool:
    return int(chosen.sum()) >= INTERVAL_SETTINGS.fewest_intervals


def _tilt(found: CombinedEstimate, intervals: Intervals) -> float:
    """Return the median angle of the most variance from the field in compressional intervals, degrees."""
    chosen = found.kinds.compressional
    if not _enough(chosen):
        return float("nan")
    part = intervals.select(chosen)
    most = np.linalg.eigh(part.covariance)[1][:, :, 2]
    field = part.mean - found.estimate.solution
    cosine = np.abs(np.sum(most * field, axis=1)) / np.linalg.norm(field, axis=1)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, 0.0, 1.0)))))


def _spread(found: CombinedEstimate, intervals: Intervals) -> float:
    """Return the rms angle of all readings from their mean direction, degrees."""
    field = intervals.field.reshape(-1, 3) - found.estimate.solution
    field = field[np.isfinite(field).all(axis=1)]
    unit = field / np.maximum(np.linalg.norm(field, axis=1, keepdims=True), 1e-12)
    mean = unit.mean(axis=0)
    cosine = unit @ (mean / max(float(np.linalg.norm(mean)), 1e-12))
    return float(np.degrees(np.sqrt(np.mean(np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2))))


def _independence(found: CombinedEstimate, intervals: Intervals, chosen: Bools) -> float:
    """Return how often chance gives the correlation of size and direction that is left; a chi-square."""
    if not _enough(chosen):
        return float("nan")
    scores = joint_equations(intervals.select(chosen), found.estimate.solution)[0]
    covariance = long_run_covariance(scores)
    size, vector = np.linalg.eigh(covariance)
    known = size > 1e-9 * max(float(size.max()), 1e-300)
    total = scores.sum(axis=0) @ vector[:, known]
    chi2 = float(np.sum(total**2 / size[known]))
    return float(scipy.stats.chi2.sf(chi2, int(known.sum())))
