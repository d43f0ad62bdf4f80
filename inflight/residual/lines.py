"""Known periods and spectral lines.

Lines in the spectrum of a residual, along each axis too: which are known, and which are not.

Which lines of a spectrum stand for themselves: all of them fitted together to the record.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import signal, stats

from inflight.arrays import Floats
from inflight.residual.spectrum import LEAST_SAMPLES, SERIES, Power, background_of

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


#: Lines that are fitted together, and the rows of one step of that.
_RESOLVED, _CHUNK = 40, 20_000

#: Lines this many times a day from one of the orbit's need company: one nearer to it, of this strength.
_FAR, _FAMILY = 2, 0.3


def resolve_lines(
    seconds: Floats, residual: Floats, direction: Floats, lines: Sequence[Line], power: Power
) -> list[Line]:
    """Keep those of the lines that stand for themselves: fields along the axes at their periods.

    A field with a period shows in every series, with sidebands. All lines are fitted to the record
    as ``u_k cos`` and ``u_k sin`` (six columns each); the one that explains most is taken, then the
    one that explains most of what is left, until none is left that chance could not explain.

    Parameters
    ----------
    seconds, residual, direction : ndarray, shape (row,), (row,), (row, 3)
        The record the lines were found in.
    lines : sequence of Line
        Candidates.
    power : Power
        Their spectrum: its background is the noise.

    Returns
    -------
    list of Line
        In the order they were taken; amplitudes along the axes are those of the common fit, that in
        the residual is its rms times the square root of two.
    """
    lines = sorted(lines, key=lambda line: -line.ratio)[:_RESOLVED]
    known = np.isfinite(residual) & np.isfinite(direction).all(axis=1)
    if not lines or known.sum() < LEAST_SAMPLES:
        return []
    # A constant field is no line, but the orbit's would have to stand for it.
    constant = np.column_stack([np.ones(int(known.sum())), direction[known]])
    y = residual[known] - constant @ np.linalg.lstsq(constant, residual[known])[0]
    frequency = np.array([1.0 / line.period_s for line in lines])
    gram, right = _line_equations(seconds[known] - seconds[known][0], y, direction[known], frequency)
    background = background_of(power.density[0])
    at = np.clip(np.round(frequency / power.frequency[0]).astype(np.int64) - 1, 0, background.size - 1)
    # White noise of this variance a row has the background's density.
    noise = background[at] * power.frequency[-1]
    taken = _taken(gram, right, noise)
    found = [_resolved(lines, gram, right, noise, taken, place) for place in range(len(taken))]
    found = [_unless_alone(line, found) for line in found]
    return [_as_multiple(line, found[:place], power) for place, line in enumerate(found)]


def _unless_alone(line: Line, found: Sequence[Line]) -> Line:
    """Take off a name that is due to the Earth's turn where lines nearer to the orbit's own are too weak.

    The field's harmonics make lines of the orbit split by once, twice, ... a day, and the first ones
    are the strong ones: a line at four times a day without them is something else.
    """
    family, side = _turns(line)
    if abs(side) < _FAR:
        return line
    nearer = [one.strength for one in found if _turns(one)[0] == family and abs(_turns(one)[1]) < abs(side)]
    return line if max(nearer, default=0.0) > _FAMILY * line.strength else replace(line, label="")


def _turns(line: Line) -> tuple[str, int]:
    """Return which of the orbit's lines a line is beside, and by how many times a day."""
    parts = line.label.split(" ")
    if len(parts) != 3 or not parts[2].endswith("/day"):
        return line.label, 0
    return parts[0], int(parts[1] + parts[2].removesuffix("/day"))


def _as_multiple(line: Line, stronger: Sequence[Line], power: Power) -> Line:
    """Say of a line that it is a multiple of a stronger new one, as the parts of a square wave are."""
    if line.is_known:
        return line
    for base in stronger:
        ratio = base.period_s / line.period_s
        times = round(ratio)
        if (
            base.is_new
            and 2 <= times <= 12
            and abs(ratio - times) <= 1.5 * float(power.frequency[0]) * base.period_s
        ):
            return replace(line, follows=f"multiple: ({told_period(base.period_s)})/{times}")
    return line


def _line_equations(
    seconds: Floats, residual: Floats, direction: Floats, frequency: Floats
) -> tuple[Floats, Floats]:
    """Return the products of all lines' columns with each other and with the residual."""
    width = 6 * frequency.size
    gram, right = np.zeros((width, width)), np.zeros(width)
    for start in range(0, seconds.size, _CHUNK):
        rows = slice(start, start + _CHUNK)
        angle = 2.0 * np.pi * seconds[rows, None] * frequency
        waves = np.stack([np.cos(angle), np.sin(angle)], axis=2)
        columns = (waves[:, :, None, :] * direction[rows, None, :, None]).reshape(len(angle), width)
        gram += columns.T @ columns
        right += columns.T @ residual[rows]
    return gram, right


def _taken(gram: Floats, right: Floats, noise: Floats) -> list[int]:
    """Return the lines that are taken one after the other."""
    count = noise.size
    limit = float(stats.chi2.isf(CHANCE / count, 6))
    own = [gram[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(count)]
    taken: list[int] = []
    while len(taken) < count:
        columns = [6 * i + j for i in taken for j in range(6)]
        left = right - gram[:, columns] @ _solved(gram[np.ix_(columns, columns)], right[columns])
        gain = np.array(
            [
                -1.0 if i in taken else left[6 * i : 6 * i + 6] @ _solved(own[i], left[6 * i : 6 * i + 6])
                for i in range(count)
            ]
        )
        # The noise counts where a line could be chance; among the others the largest is taken.
        gain[gain < limit * noise] = -1.0
        if gain.max() <= 0:
            break
        taken.append(int(np.argmax(gain)))
    return taken


def _solved(gram: Floats, right: Floats) -> Floats:
    ridge = 1e-9 * np.trace(gram) / max(len(gram), 1)
    return np.asarray(np.linalg.solve(gram + ridge * np.eye(len(gram)), right))


def _resolved(
    lines: Sequence[Line], gram: Floats, right: Floats, noise: Floats, taken: list[int], place: int
) -> Line:
    """Return one taken line with the amplitudes of the common fit."""
    columns = [6 * i + j for i in taken for j in range(6)]
    whole = gram[np.ix_(columns, columns)]
    mine = slice(6 * place, 6 * place + 6)
    value = _solved(whole, right[columns])[mine]
    spread = np.sqrt(noise[taken[place]] * np.diag(np.linalg.pinv(whole, hermitian=True))[mine])
    along, sigma = np.hypot(value[0::2], value[1::2]), np.hypot(spread[0::2], spread[1::2]) / np.sqrt(2.0)
    own = whole[mine, mine]
    rows = float(np.trace(own))  # The six columns' squares sum to the number of rows.
    seen = np.sqrt(2.0 * max(float(value @ own @ value), 0.0) / rows)
    line = lines[taken[place]]
    amplitude = np.append(seen, along)
    deviation = np.append(np.sqrt(2.0 * noise[taken[place]] / rows), sigma)
    return replace(line, follows="", amplitude=amplitude, sigma=deviation)
