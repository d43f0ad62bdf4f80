"""What is left and has no name: lines, hints, the signature."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.diagnosis import Signature
from inflight.diagnosis.estimates import detectable
from inflight.diagnosis.fast import Fast, fast_part
from inflight.diagnosis.findings import axis
from inflight.diagnosis.left import Structure, floor_left
from inflight.diagnosis.material import Material, native_rms
from inflight.diagnosis.scoring import fit
from inflight.diagnosis.search import Option, Search, Table
from inflight.diagnosis.signature import Periodogram, describe, periodogram, strongest_line
from inflight.noise import NoiseFloor
from inflight.time import SECOND

#: A line that explains less than this part of the residual's square is no effect worth a name.
_LEAST_PART = 0.01
#: Lines beside a harmonic at so many turns of the Earth; resolutions within which they are the same; what a
#: nominal period may be off by; and by how much the field must turn to have a period of its own.
_SPLITS, _APART, _SHARP, _TURNING = 2, 1.5, 2e-4, 0.3
#: Harmonics of a known period that are no news: beyond, any period is near one of a day's.
_HARMONICS = 30
#: Structure below this part of the noise does not make a residual coloured, however sure it is.
_WHITE = 0.1
#: A known period explains a band when it is within it or so many times beside it.
_AROUND = 1.1


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
    floor : NoiseFloor
        Of what is left, with its interval.
    has_band : bool
        Most of what is missing is too fast for the search and stands in one band no known period explains.
    has_unit : bool
        Two sensors show that something switches without housekeeping.
    """

    structure: Structure
    has_line: bool
    signature: Signature | None
    noise: float
    floor: NoiseFloor
    has_band: bool = False
    has_unit: bool = False

    @property
    def is_there(self) -> bool:
        """True when what is left may be more than noise: large, or not white beyond doubt."""
        coloured = self.structure.is_sure and self.structure.rms_nT > _WHITE * self.noise
        certain = self.has_line or self.has_band or self.has_unit
        return certain or self.structure.is_large(self.noise) or coloured

    @property
    def is_sure(self) -> bool:
        """True when what is left is more than noise beyond doubt."""
        certain = self.has_line or self.has_band or self.has_unit
        return certain or (self.structure.is_sure and self.structure.is_large(self.noise))


def look_at(search: Search, material: Material, last: Table, left: Floats, structure: Structure) -> Unknown:
    """Describe what is left: a line, else what the best rejected candidate hints at, else its size."""
    known = 1.0 - material.gaps.part if material.gaps else 1.0
    floor = floor_left(material.series, left, known * material.sums.get("count", 0.0), material.floor)
    noise = floor.level_nT
    if not noise > 0:
        good = material.series["weight"] > 0
        noise = float(np.sqrt(np.mean(left[good] ** 2))) if good.any() else float("nan")
    unit = unit_unseen(material)
    if unit is not None:
        return Unknown(structure, False, unit, noise, floor, has_unit=True)
    line = _line(material, left)
    found = Unknown(structure, line is not None, line, noise, floor)
    if line is not None:
        return found
    size = native_rms(material, search)
    fast = fast_part(material.series, left, size, floor.level_nT, structure)
    found = replace(found, has_band=fast is not None and _is_news(material, fast))
    if not found.is_there:
        return found
    told = _hinted(search, last, structure)
    return replace(found, signature=told if fast is None else _fast(told, fast))


def unit_unseen(material: Material) -> Signature | None:
    """Return the signature of the unit without housekeeping that switches most often, of two sensors."""
    if material.switched is None or not material.switched.unexplained:
        return None
    step, sigma, count = material.switched.units[0]
    return Signature(
        shape="unit without housekeeping",
        axis="xyz"[int(np.argmax(np.abs(step)))],
        amplitude_nT=float(np.abs(step).max()),
        steps={name: (float(a), float(b)) for name, a, b in zip("xyz", step, sigma, strict=True)},
        switchings=count,
    )


def _is_news(material: Material, fast: Fast) -> bool:
    """Return True when a band of periods was found and no known period lies in it."""
    if fast.periods_s is None:
        return False
    short, long = fast.periods_s
    return not any(short / _AROUND <= period <= long * _AROUND for period in known_periods(material))


def _fast(hint: Signature, fast: Fast) -> Signature:
    """Return the signature of what is fast; a channel that the slow part hints at stays beside it."""
    return replace(
        hint if hint.channel else Signature(),
        shape="fast",
        amplitude_nT=fast.rms_nT,
        faster_than_s=fast.faster_than_s,
        periods_s=fast.periods_s,
    )


def _line(material: Material, left: Floats) -> Signature | None:
    """Return the signature of the strongest line, or None when none stands out and matters."""
    found = spectrum_left(material, left) if material.series.turn_rows == 1 else None
    line = strongest_line(found) if found is not None else None
    if found is None or line is None:
        return None
    series = material.series
    told, part = describe(
        series.tt2000, left, series.direction(), series["weight"], line[0], float(found.frequency[1])
    )
    if part < _LEAST_PART or _is_known(material, float(told.period_s or 0.0)):
        return None
    return told


def _is_known(material: Material, period: float) -> bool:
    """Return True for a harmonic of a known period, or one that the turning Earth splits from it.

    Judged at the resolution of the whole span, which is finer than that of the periodogram's segments.
    """
    series = material.series
    span = float(series.tt2000[-1] - series.tt2000[0]) / SECOND
    frequency = 1.0 / period if period > 0 else 0.0
    for known in known_periods(material):
        for split in range(-_SPLITS, _SPLITS + 1):
            offset = frequency - split / 86_400.0
            harmonic = round(offset * known)
            if 1 <= harmonic <= _HARMONICS and abs(offset - harmonic / known) < _APART * max(
                1.0 / span, _SHARP * frequency
            ):
                return True
    return False


def _own_period(material: Material) -> list[float]:
    """Return the period with which the field turns in the sensor, s: the orbit's, or the spin's."""
    series = material.series
    direction = series.direction()[:, 0]
    good = (series["weight"] > 0) & np.isfinite(direction).all(axis=1)
    if good.sum() < 64 or float(np.ptp(direction[good], axis=0).max()) < _TURNING:
        return []
    even = np.where(good[:, None], direction - direction[good].mean(axis=0), 0.0)
    power = (np.abs(np.fft.rfft(even, 4 * len(even), axis=0)) ** 2).sum(axis=1)
    at = int(np.argmax(power[8:])) + 8
    return [4 * len(even) * series.step_s / at]


def known_periods(material: Material) -> list[float]:
    """Return the periods whose harmonics are no news: orbit, day, and those of the mission; seconds."""
    periods = {name: period / SECOND for name, period in material.mission.periods.items()}
    known = [86_400.0, *(period for period in periods.values() if period > 2 * material.series.step_s)]
    return known + _own_period(material)


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
