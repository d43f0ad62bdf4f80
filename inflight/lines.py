"""Lines in the spectrum of a residual, along each axis too: which are known, and which are not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal, stats

from inflight.arrays import Floats
from inflight.spectrum import SERIES, Power, background_of

#: The chance of a false line in one spectrum.
CHANCE = 0.001
#: A line must also stand this far above its background: real backgrounds are not smooth.
_LEAST_RATIO = 4.0
#: Harmonics of the orbit that are drawn, and those that are recognised.
DRAWN_HARMONICS, _KNOWN_HARMONICS = 6, 24
#: Harmonics of a short known period, its sidebands at the orbit, and how far those are split, in steps.
_SHORT_HARMONICS, _SIDES, _SPLIT = 12, range(-6, 7), 3.5
#: Times a day that the Earth's turn splits lines of the orbit by.
_TURNS = 5
#: A Hann window spreads a line over this many frequencies on either side.
_SPREAD = 2
_DAY_S = 86_400.0


@dataclass(frozen=True)
class Line:
    """One line: its period, what it is, and its amplitude in each series.

    `amplitude` and `sigma` have shape (series,): nT in the residual, then of a field along x, y and
    z that would make the line (NaN where it is not seen). `label` names a known period; `follows` says
    of which stronger unknown line it is a multiple or a sideband. Both are empty for a line of its own.
    """

    period_s: float
    label: str
    follows: str
    ratio: float
    amplitude: Floats
    sigma: Floats

    @property
    def is_known(self) -> bool:
        """True when the period is one the mission states, or of the orbit or the day."""
        return bool(self.label)

    @property
    def is_new(self) -> bool:
        """True when nothing explains the period: neither what is known nor a stronger line."""
        return not (self.label or self.follows)

    @property
    def axis(self) -> str:
        """Axis along which the line is largest, where it is three sigma; empty on none."""
        with np.errstate(invalid="ignore"):
            seen = self.amplitude[1:] > 3.0 * self.sigma[1:]
        along = np.where(seen, self.amplitude[1:], 0.0)
        return SERIES[1 + int(np.argmax(along))] if along.any() else ""

    @property
    def strength(self) -> float:
        """Largest amplitude that is seen, nT: in the residual where it shows there, else along an axis."""
        return float(self.amplitude[0] if np.isfinite(self.amplitude[0]) else np.nanmax(self.amplitude))

    def as_json(self) -> dict[str, object]:
        """Return the fields of the command line's JSON."""
        seen = zip(SERIES, self.amplitude, self.sigma, strict=True)
        return {
            "period_s": self.period_s,
            "label": self.label,
            "follows": self.follows,
            "known": self.is_known,
            "times_background": self.ratio,
            "amplitude_nT": {name: a for name, a, _ in seen if np.isfinite(a)},
            "sigma_nT": {
                name: s
                for name, a, s in zip(SERIES, self.amplitude, self.sigma, strict=True)
                if np.isfinite(a)
            },
            "axis": self.axis,
        }


def told_period(seconds: float) -> str:
    """Return a period as a person says it: seconds, minutes, hours or days, three figures."""
    for name, size in (("d", 86_400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.3g} {name}"
    return f"{seconds:.3g} s"


def known_periods(periods: Mapping[str, float], orbit: float | None) -> dict[str, float]:
    """Return the periods that need no explanation, s: the mission's, harmonics of the orbit, the day.

    Parameters
    ----------
    periods : mapping of str to float
        The mission's own, s.
    orbit : float, optional
        The orbit's as the positions tell it, which counts more than a stated ``orbit``.
    """
    found = {name: seconds for name, seconds in periods.items() if name != "orbit"}
    whole = orbit or periods.get("orbit")
    if whole:
        found["orbit"] = whole
        found |= {f"orbit/{k}": whole / k for k in range(2, _KNOWN_HARMONICS + 1)}
    return found | {"day": _DAY_S, "day/2": _DAY_S / 2, "day/3": _DAY_S / 3}


def drawn_periods(known: Mapping[str, float]) -> dict[str, float]:
    """Return the known periods that a figure marks: of the orbit's harmonics, the first six."""
    late = {f"orbit/{k}" for k in range(DRAWN_HARMONICS + 1, _KNOWN_HARMONICS + 1)} | {"day/2", "day/3"}
    return {name: seconds for name, seconds in known.items() if name not in late}


def find_lines(
    power: Power,
    known: Mapping[str, float],
    shortest: float = 0.0,
    longest: float = np.inf,
    most: int = 20,
) -> list[Line]:
    """Return the lines of a mean spectrum: new ones, those that follow from them, known ones.

    Parameters
    ----------
    power : Power
        Sums of stretches.
    known : mapping of str to float
        Periods by name, s.
    shortest, longest : float
        Periods looked at, s.
    most : int
        Lines returned at most of each sort, largest first.

    Returns
    -------
    list of Line
        Lines that stand above the median of the frequencies around them by more than chance allows.
        Sidebands and multiples of a stronger unknown line are labelled as such.
    """
    density = power.density
    step = float(power.frequency[0])
    background = np.array([background_of(row) for row in density])
    ratio = density / background
    inside = (power.frequency * longest >= 1.0) & (power.frequency * shortest <= 1.0)
    # Near zero and near Nyquist a window holds half as many independent numbers.
    inside[: _SPREAD + 1] = inside[-_SPREAD - 1 :] = False
    ratio = np.where(inside, ratio, 0.0)
    peaks = sorted(_peaks(ratio, power.stretches), key=lambda peak: -float(ratio[:, peak].max()))
    orbit = 1.0 / known["orbit"] if "orbit" in known else 0.0
    explained = _Known.of(known, step)
    lines: list[Line] = []
    for peak in peaks:
        frequency = _centre(power.frequency, density[int(np.argmax(ratio[:, peak])), :], peak)
        label = explained.name_of(frequency, step)
        follows = "" if label else _relation(frequency, step, orbit, lines)
        if any(abs(1.0 / line.period_s - frequency) <= 2 * step for line in lines):
            continue
        amplitude, sigma = _amplitudes(power, density, background, peak)
        lines.append(Line(1.0 / frequency, label, follows, float(ratio[:, peak].max()), amplitude, sigma))
    new = [line for line in lines if line.is_new][:most]
    following = [line for line in lines if line.follows][:most]
    return new + following + [line for line in lines if line.is_known][:most]


def _peaks(ratio: Floats, stretches: int) -> list[int]:
    """Return local maxima that noise would reach in one spectrum of a thousand."""
    chance = CHANCE / ratio.shape[1]
    # A median lies below the mean of such a spectrum by its own ratio.
    shape = max(stretches, 1)
    limit = stats.gamma.isf(chance, shape) / stats.gamma.ppf(0.5, shape)
    found: set[int] = set()
    for row in ratio:
        found |= set(signal.find_peaks(row, height=max(limit, _LEAST_RATIO), distance=_SPREAD)[0].tolist())
    return sorted(found)


def _centre(frequency: Floats, density: Floats, peak: int) -> float:
    """Return the frequency of a line between the grid's: the top of a parabola through three logarithms."""
    if not 0 < peak < density.size - 1:
        return float(frequency[peak])
    low, mid, high = np.log(np.maximum(density[peak - 1 : peak + 2], 1e-300))
    bend = low - 2 * mid + high
    shift = 0.5 * (low - high) / bend if bend < 0 else 0.0
    return float(frequency[peak] + np.clip(shift, -0.5, 0.5) * frequency[0])


@dataclass(frozen=True)
class _Known:
    """Frequencies that need no explanation, Hz, with their names and how near a line must be, in steps."""

    frequency: Floats
    names: list[str]
    width: Floats

    @classmethod
    def of(cls, known: Mapping[str, float], step: float) -> _Known:
        """Return the frequencies of known periods and what follows from them, on a grid of `step` Hz.

        Harmonics of the orbit are split by the Earth's turn; on a grid too coarse to tell these apart
        only the nearest count. Short periods have harmonics, split by the orbit.
        """
        most = _TURNS if step < 0.5 / _DAY_S else 1
        turns = sorted(range(-most, most + 1), key=abs)
        orbit = 1.0 / known["orbit"] if "orbit" in known else 0.0
        found: dict[str, float] = {}
        for name, seconds in known.items():
            base = 1.0 / seconds
            if name.startswith("orbit"):
                found |= {_sided(name, turn, "/day"): base + turn / _DAY_S for turn in turns}
            elif orbit and base > 3.0 * orbit:
                for times in range(1, _SHORT_HARMONICS + 1):
                    multiple = name if times == 1 else f"{name}/{times}"
                    sides = {
                        _sided(multiple, side, "/orbit"): times * base + side * orbit
                        for side in sorted(_SIDES, key=abs)
                    }
                    found |= sides
            else:
                found[name] = base
        frequency = np.array(list(found.values()))
        wide = orbit > 0 and step >= 0.5 / _DAY_S
        return cls(frequency, list(found), np.where(wide & (frequency > 30 * orbit), _SPLIT, 1.5))

    def name_of(self, frequency: float, step: float) -> str:
        """Return the name of the nearest one that is near enough; empty when there is none."""
        away = np.abs(self.frequency - frequency)
        best = int(np.argmin(away)) if away.size else 0
        return self.names[best] if away.size and away[best] <= self.width[best] * step else ""


def _sided(name: str, side: int, unit: str) -> str:
    return name if side == 0 else f"{name} {'+' if side > 0 else '-'} {abs(side)}{unit}"


def _relation(frequency: float, step: float, orbit: float, lines: Sequence[Line]) -> str:
    """Say how a line follows from a stronger unknown one: a multiple of it, or a sideband at the orbit."""
    for line in lines:
        if not line.is_new:
            continue
        base = 1.0 / line.period_s
        for times in range(1, 6):
            for side in range(-2, 3) if orbit else (0,):
                # An error of the base counts as often as it is multiplied.
                if abs(abs(times * base + side * orbit) - frequency) <= (1.0 + 0.5 * times) * step:
                    return _told_relation(line.period_s, times, side)
    return ""


def _told_relation(period: float, times: int, side: int) -> str:
    base = told_period(period)
    whole = base if times == 1 else f"({base})/{times}"
    if side == 0:
        return f"multiple: {whole}"
    return f"sideband: {_sided(whole, side, '/orbit')}"


def _amplitudes(power: Power, density: Floats, background: Floats, peak: int) -> tuple[Floats, Floats]:
    """Return a line's amplitude in each series and its standard deviation; NaN below three sigma."""
    step = float(power.frequency[0])
    around = slice(max(peak - _SPREAD, 0), peak + _SPREAD + 1)
    width = around.stop - around.start
    excess = (density[:, around] - background[:, around]).sum(axis=1) * step
    noise = background[:, peak] * step * np.sqrt(width / max(power.stretches, 1))
    amplitude = np.sqrt(2.0 * np.maximum(excess, 0.0))
    seen = excess > 3.0 * noise
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = noise / amplitude
        # The direction multiplies a field once in the residual and once more in the demodulation.
        scale = np.append(1.0, 1.0 / power.direction_square[1:])
        return np.where(seen, amplitude * scale, np.nan), np.where(seen, sigma * scale, np.nan)
