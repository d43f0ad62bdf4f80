"""What is left and has no name: lines, hints, the signature."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.diagnosis import Signature
from inflight.diagnosis.estimates import detectable
from inflight.diagnosis.findings import axis
from inflight.diagnosis.left import Structure
from inflight.diagnosis.material import Material
from inflight.diagnosis.scoring import fit
from inflight.diagnosis.search import Option, Search, Table
from inflight.diagnosis.signature import Periodogram, describe, periodogram, strongest_line
from inflight.time import SECOND

#: A line that explains less than this part of the residual's square is no effect worth a name.
_LEAST_PART = 0.01


@dataclass(frozen=True)
class Unknown:
    """What is left after everything that was taken.

    Attributes
    ----------
    structure : Structure
    has_line : bool
        A line stands out that no known period explains.
    signature : Signature or None
        None when nothing is there.
    noise : float
        Noise floor, nT; of a record without one, the residual's own size.
    """

    structure: Structure
    has_line: bool
    signature: Signature | None
    noise: float

    @property
    def is_there(self) -> bool:
        """True when what is left may be more than noise."""
        return self.has_line or self.structure.is_large(self.noise)

    @property
    def is_sure(self) -> bool:
        """True when what is left is more than noise beyond doubt."""
        return self.has_line or (self.structure.is_sure and self.structure.is_large(self.noise))


def look_at(search: Search, material: Material, last: Table, left: Floats, structure: Structure) -> Unknown:
    """Describe what is left: a line, else what the best rejected candidate hints at, else its size."""
    floor = material.floor.level_nT
    if not floor > 0:
        good = material.series["weight"] > 0
        floor = float(np.sqrt(np.mean(left[good] ** 2))) if good.any() else float("nan")
    line = _line(material, left)
    if line is not None:
        return Unknown(structure, True, line, floor)
    found = Unknown(structure, False, None, floor)
    return replace(found, signature=_hinted(search, last, structure)) if found.is_there else found


def _line(material: Material, left: Floats) -> Signature | None:
    """Return the signature of the strongest line, or None when none stands out and matters."""
    found = spectrum_left(material, left)
    line = strongest_line(found) if found is not None else None
    if found is None or line is None:
        return None
    series = material.series
    told, part = describe(
        series.tt2000, left, series.direction(), series["weight"], line[0], float(found.frequency[1])
    )
    return told if part >= _LEAST_PART else None


def known_periods(material: Material) -> list[float]:
    """Return the periods whose harmonics are no news: orbit, day, and those of the mission; seconds."""
    periods = {name: period / SECOND for name, period in material.mission.periods.items()}
    return [86_400.0, *(period for period in periods.values() if period > 2 * material.series.step_s)]


def spectrum_left(material: Material, left: Floats) -> Periodogram | None:
    """Return the periodogram of what is left, demodulated along each axis."""
    series = material.series
    return periodogram(series.tt2000, left, series.direction(), series["weight"], known_periods(material))


def _hinted(search: Search, last: Table, structure: Structure) -> Signature:
    """Return the signature that the best rejected candidate hints at."""
    hint = _hint(search, last)
    if hint is None:
        return Signature(shape="wander", amplitude_nT=structure.rms_nT)
    option, gain = hint
    along = None
    if option.change is None and len(option.columns) == 3:
        along = axis(option.columns[int(np.argmax(_strength(search, option)))])
    shape = option.mechanism
    if option.change is not None:
        shape = "step" if option.change.at else "drift"
    elif option.channels:
        shape = "follows the channel"
    return Signature(
        channel="*".join(option.channels) or None,
        lag_s=option.lag_s if option.channels else None,
        axis=along,
        shape=shape,
        amplitude_nT=structure.rms_nT,
        gain=gain,
    )


def _strength(search: Search, option: Option) -> Floats:
    """Return how far a rejected candidate's coefficients are from nothing, in units of what is detectable."""
    evidence = search.forms["raw"]
    gamma, _ = fit(evidence, search.present(), [evidence.index(option.columns)], search.y())
    physical = gamma[0] * evidence.scale[evidence.index(option.columns)]
    return np.abs(physical) / np.maximum(detectable(search, option), 1e-300)


def _hint(search: Search, last: Table) -> tuple[Option, float] | None:
    """Return the best option that was not beyond doubt, if it explains anything held out."""
    scores = last.scores["raw"]
    real = [
        place for place, option in enumerate(last.options) if not option.placebo and scores.t[place] > 2.0
    ]
    if not real:
        return None
    best = max(real, key=lambda place: (last.options[place].change is None, float(scores.gain[place])))
    return last.options[best], float(scores.gain[best])
