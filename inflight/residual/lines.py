"""Spectral lines of a residual, and the periods that are known.

Takes the spectra of `inflight.residual.spectrum` and the mission's periods; makes lines: each with its
period, what it is, and the amplitude of a field along each axis that would make it. `find_lines` takes the
peaks of a spectrum, `KnownPeriods` names them, `resolve_lines` fits all of them together to the record, so
that sidebands of one field are not counted as fields of their own. `record_lines` does all three.

A peak counts when noise reaches it in one spectrum of a thousand: the mean of m periodograms of white noise
is Gamma distributed with shape m. A line of a record counts when the sum of squares that its six columns
``u_k cos, u_k sin`` explain exceeds what chi squared with six degrees of freedom reaches by chance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from inflight.arrays import Floats
from inflight.residual.spectrum import (
    SERIES,
    SPECTRUM_SETTINGS,
    SpectrumSettings,
    SpectrumSum,
    background_of,
    record_power,
)

_DAY_S = 86_400.0


@dataclass(frozen=True, kw_only=True)
class LineSettings:
    """When a peak is a line, when its period is known, and how many are fitted.

    Attributes
    ----------
    chance : float
        Chance of a false line in one spectrum, and in one record: a stated level of significance.
    least_ratio : float
        Least power over the background: real backgrounds are not smooth. Assumed.
    spread : int
        Frequencies on either side that a Hann window spreads a line over. Derived: its main lobe.
    drawn_harmonics, known_harmonics : int
        Harmonics of the orbit that are drawn, and those that are recognised. Assumed.
    day_harmonics, daily_harmonics : int
        Harmonics of the day that are recognised: with an orbit, where what follows local time is
        smooth, and where there is no orbit and the day is what all repeats with. Assumed.
    stated_harmonics : int
        Harmonics of a period that the mission states. Assumed.
    sidebands : int
        Sidebands of a short period's harmonics at the orbit. Assumed.
    turns : int
        Times a day that the Earth's turn splits lines of the orbit by: degree and order of the field's
        strong harmonics.
    apart : float
        Frequencies are the same within this many steps of the spectrum. Assumed.
    split : float
        The same for sidebands of a short period, where the spectrum does not resolve the Earth's turn.
    stated_error : float
        What a stated period may be off by, relative: nominal periods have three or four figures.
    resolved : int
        Lines that are fitted together to a record at most, the highest first.
    chunk : int
        Rows of one step of that fit, which bounds its memory.
    far, family : float
        A line this many times a day or more from one of the orbit's needs company: one nearer to it, of
        this part of its strength. Assumed.
    multiples : int
        Multiples of an unknown period that are recognised as parts of one wave. Assumed.
    comparable : float
        Part of the strongest line's amplitude from which a line at a multiple of its period is the
        fundamental. Assumed: of a switch a harmonic can be stronger along one axis.
    slow : float
        A weaker line within so many steps of the spectrum of a known one is a change of that one in an eighth
        of the record or more. Assumed.
    """

    chance: float = 0.001
    least_ratio: float = 4.0
    spread: int = 2
    drawn_harmonics: int = 6
    known_harmonics: int = 24
    day_harmonics: int = 6
    daily_harmonics: int = 24
    stated_harmonics: int = 12
    sidebands: int = 6
    turns: int = 5
    apart: float = 1.5
    split: float = 3.5
    stated_error: float = 2e-4
    resolved: int = 40
    chunk: int = 20_000
    far: int = 2
    family: float = 0.3
    multiples: int = 12
    comparable: float = 0.5
    slow: float = 8.0


LINE_SETTINGS = LineSettings()


@dataclass(frozen=True, kw_only=True)
class Line:
    """One line: its period, what it is, and its amplitude in each series.

    Attributes
    ----------
    period_s : float
        Seconds.
    label : str
        Names a known period; empty for another.
    follows : str
        Of which stronger unknown line it is a multiple or a sideband; empty for a line of its own.
    ratio : float
        Power over the background.
    amplitude, sigma : ndarray, shape (series,)
        nT in the residual, then of a field along x, y and z that would make the line; NaN where it is not
        seen.
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
        seen = [row for row in zip(SERIES, self.amplitude, self.sigma, strict=True) if np.isfinite(row[1])]
        return {
            "period_s": self.period_s,
            "label": self.label,
            "follows": self.follows,
            "known": self.is_known,
            "times_background": self.ratio,
            "amplitude_nT": {name: amplitude for name, amplitude, _ in seen},
            "sigma_nT": {name: sigma for name, _, sigma in seen},
            "axis": self.axis,
        }


def format_period(seconds: float) -> str:
    """Return a period as a person writes it: seconds, minutes, hours or days, three figures."""
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
        The orbit's as it was measured, which counts more than a stated ``orbit``.
    """
    found = {name: seconds for name, seconds in periods.items() if name != "orbit"}
    whole = orbit or periods.get("orbit")
    if whole:
        found["orbit"] = whole
        found |= {f"orbit/{k}": whole / k for k in range(2, LINE_SETTINGS.known_harmonics + 1)}
    return found | {"day": _DAY_S, "day/2": _DAY_S / 2, "day/3": _DAY_S / 3}


def drawn_periods(known: Mapping[str, float]) -> dict[str, float]:
    """Return the known periods that a figure marks: of the orbit's harmonics, the first six."""
    late = {f"orbit/{k}" for k in range(LINE_SETTINGS.drawn_harmonics + 1, LINE_SETTINGS.known_harmonics + 1)}
    return {name: seconds for name, seconds in known.items() if name not in late | {"day/2", "day/3"}}


def orbit_period(seconds: Floats, phase: Floats) -> float | None:
    """Return the nodal period of an orbit phase, s; None with fewer than a hundred readings.

    Parameters
    ----------
    seconds, phase : ndarray, shape (time,)
        The phase in degrees, NaN where it is unknown.
    """
    known = np.flatnonzero(np.isfinite(phase))
    if known.size < 100:
        return None
    turn = np.diff(phase[known]) % 360.0
    step = np.diff(seconds[known])
    usual = step < 1.5 * np.median(step)
    rate = float(np.median(turn[usual] / step[usual]))
    return 360.0 / rate if rate > 0 else None


@dataclass(frozen=True)
class KnownPeriods:
    """Frequencies that need no explanation, and how near to one a line must be.

    The harmonics of the orbit are split by the Earth's turn: ``k/orbit + n/day``; on a grid too coarse to
    resolve these only the nearest count. The day and the mission's own periods have harmonics; periods much
    shorter than the orbit have sidebands at it: ``k/period + n/orbit``.

    Attributes
    ----------
    frequency : ndarray, shape (known,)
        Hz.
    names : list of str
        ``orbit/3 + 1/day``, ``day/2``, ``torquer/2 - 1/orbit`` ...
    width : ndarray, shape (known,)
        Hz.
    """

    frequency: Floats
    names: list[str]
    width: Floats

    @classmethod
    def of(
        cls, known: Mapping[str, float], step: float, settings: LineSettings = LINE_SETTINGS
    ) -> KnownPeriods:
        """Return what follows from known periods on a grid of frequencies.

        Parameters
        ----------
        known : mapping of str to float
            As `known_periods` returns them, s.
        step : float
            Distance of the grid's frequencies, Hz.
        """
        coarse = step >= 0.5 / _DAY_S
        turns = sorted(range(-settings.turns, settings.turns + 1) if not coarse else range(-1, 2), key=abs)
        orbit = 1.0 / known["orbit"] if "orbit" in known else 0.0
        own = set(known)
        found: dict[str, float] = {}
        for name, seconds in known.items():
            base = 1.0 / seconds
            if name.startswith("orbit"):
                found |= {_sideband_name(name, turn, "/day"): base + turn / _DAY_S for turn in turns}
                continue
            count = settings.stated_harmonics
            if name.startswith("day"):
                count = settings.day_harmonics if orbit else settings.daily_harmonics
            if "/" in name:
                count = 1
            short = orbit > 0 and base > 3.0 * orbit
            sides = sorted(range(-settings.sidebands, settings.sidebands + 1), key=abs) if short else [0]
            for times in range(1, count + 1):
                multiple = name if times == 1 else f"{name}/{times}"
                # A multiple that is named among the known ones is not made a second time.
                if times == 1 or multiple not in own:
                    found |= {
                        _sideband_name(multiple, side, "/orbit"): times * base + side * orbit
                        for side in sides
                    }
        frequency = np.array(list(found.values()))
        wide = coarse & (frequency > 30 * orbit) if orbit else np.zeros(frequency.size, dtype=bool)
        width = np.where(wide, settings.split, settings.apart) * step
        return cls(frequency, list(found), np.maximum(width, settings.stated_error * np.abs(frequency)))

    def name_of(self, frequency: float) -> str:
        """Return the name of the nearest one that is near enough; empty when there is none."""
        away = np.abs(self.frequency - frequency)
        best = int(np.argmin(away)) if away.size else 0
        return self.names[best] if away.size and away[best] <= self.width[best] else ""


def _sideband_name(name: str, side: int, unit: str) -> str:
    return name if side == 0 else f"{name} {'+' if side > 0 else '-'} {abs(side)}{unit}"


def find_lines(
    power: SpectrumSum,
    known: Mapping[str, float],
    shortest: float = 0.0,
    longest: float = np.inf,
    most: int = 20,
    settings: LineSettings = LINE_SETTINGS,
) -> list[Line]:
    """Return the lines of a mean spectrum: new ones, those that follow from them, known ones.

    Parameters
    ----------
    power : Power
        Sums of stretches.
    known : mapping of str to float
        Periods by name, s.
    shortest, longest : float
        Range of periods, s.
    most : int
        Lines returned at most of each sort, largest first.

    Returns
    -------
    list of Line
        Lines that stand above the median of the frequencies around them by more than chance allows.
        Sidebands and multiples of a stronger unknown line are labelled as such.
    """
    density, step = power.density, power.step
    background = np.array([background_of(row) for row in density])
    ratio = density / background
    inside = (power.frequency * longest >= 1.0) & (power.frequency * shortest <= 1.0)
    # Near zero and near Nyquist a window holds half as many independent numbers.
    inside[: settings.spread + 1] = inside[-settings.spread - 1 :] = False
    ratio = np.where(inside, ratio, 0.0)
    peaks = _peaks(ratio, power.stretches, settings)
    peaks.sort(key=lambda peak: -float(ratio[:, peak].max()))
    orbit = 1.0 / known["orbit"] if "orbit" in known else 0.0
    explained = KnownPeriods.of(known, step, settings)
    lines: list[Line] = []
    for peak in peaks:
        frequency = _centre(power.frequency, density[int(np.argmax(ratio[:, peak])), :], peak)
        if any(abs(1.0 / line.period_s - frequency) <= 2 * step for line in lines):
            continue
        label = explained.name_of(frequency)
        follows = "" if label else _relation(frequency, step, orbit, lines)
        amplitude, sigma = _amplitudes(power, density, background, peak, settings.spread)
        lines.append(
            Line(
                period_s=1.0 / frequency,
                label=label,
                follows=follows,
                ratio=float(ratio[:, peak].max()),
                amplitude=amplitude,
                sigma=sigma,
            )
        )
    new = [line for line in lines if line.is_new][:most]
    following = [line for line in lines if line.follows][:most]
    return new + following + [line for line in lines if line.is_known][:most]


def _peaks(ratio: Floats, stretches: int, settings: LineSettings) -> list[int]:
    """Return local maxima that noise would reach in one spectrum of a thousand."""
    chance = settings.chance / ratio.shape[1]
    # A median lies below the mean of such a spectrum by its own ratio.
    shape = max(stretches, 1)
    limit = max(
        scipy.special.gammainccinv(shape, chance) / scipy.special.gammaincinv(shape, 0.5),
        settings.least_ratio,
    )
    found: set[int] = set()
    for row in ratio:
        found |= set(local_maxima(row, limit, settings.spread))
    return sorted(found)


def local_maxima(values: Floats, least: float, distance: int) -> list[int]:
    """Return where values have maxima of at least `least`: the larger one of two nearer than `distance`.

    Of equal neighbours the middle counts. (`scipy.signal.find_peaks` finds the same; to import it takes a
    third of the time of a whole comparison.)
    """
    edges = np.flatnonzero(np.diff(values)) + 1
    first, last = np.append(0, edges), np.append(edges, values.size) - 1
    level = values[first]
    highest = (level[1:-1] > level[:-2]) & (level[1:-1] > level[2:]) & (level[1:-1] >= least)
    places = (first[1:-1] + last[1:-1])[highest] // 2
    kept: list[int] = []
    for place in places[np.argsort(values[places])[::-1]].tolist():
        if all(abs(place - other) >= distance for other in kept):
            kept.append(place)
    return sorted(kept)


def _centre(frequency: Floats, density: Floats, peak: int) -> float:
    """Return the frequency of a line between the grid's: the top of a parabola through three logarithms."""
    if not 0 < peak < density.size - 1:
        return float(frequency[peak])
    low, mid, high = np.log(np.maximum(density[peak - 1 : peak + 2], 1e-300))
    curvature = low - 2 * mid + high
    shift = 0.5 * (low - high) / curvature if curvature < 0 else 0.0
    return float(frequency[peak] + np.clip(shift, -0.5, 0.5) * frequency[0])


def _relation(frequency: float, step: float, orbit: float, lines: Sequence[Line]) -> str:
    """Return how a line follows from a stronger unknown one: a multiple of it, or a sideband at the orbit."""
    for line in lines:
        if not line.is_new:
            continue
        base = 1.0 / line.period_s
        for times in range(1, 6):
            for side in range(-2, 3) if orbit else (0,):
                # An error of the base counts as often as it is multiplied.
                if abs(abs(times * base + side * orbit) - frequency) <= (1.0 + 0.5 * times) * step:
                    period = format_period(line.period_s)
                    whole = period if times == 1 else f"({period})/{times}"
                    if side == 0:
                        return f"multiple: {whole}"
                    return f"sideband: {_sideband_name(whole, side, '/orbit')}"
    return ""


def _amplitudes(
    power: SpectrumSum, density: Floats, background: Floats, peak: int, spread: int
) -> tuple[Floats, Floats]:
    """Return a line's amplitude in each series and its standard deviation; NaN below three sigma."""
    around = slice(max(peak - spread, 0), peak + spread + 1)
    width = around.stop - around.start
    excess = (density[:, around] - background[:, around]).sum(axis=1) * power.step
    noise = background[:, peak] * power.step * np.sqrt(width / max(power.stretches, 1))
    amplitude = np.sqrt(2.0 * np.maximum(excess, 0.0))
    seen = excess > 3.0 * noise
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = noise / amplitude
        # The direction multiplies a field once in the residual and once more in the demodulation.
        scale = np.append(1.0, 1.0 / power.direction_square[1:])
        return np.where(seen, amplitude * scale, np.nan), np.where(seen, sigma * scale, np.nan)


def resolve_lines(
    seconds: Floats,
    residual: Floats,
    direction: Floats,
    lines: Sequence[Line],
    power: SpectrumSum,
    settings: LineSettings = LINE_SETTINGS,
) -> list[Line]:
    """Return the lines that are fields along the axes of their own, not sidebands of others.

    A field with a period shows in every series, with sidebands. All lines are fitted to the record
    as ``u_k cos`` and ``u_k sin`` (six columns each); the one that explains most is taken, then the
    one that explains most of the rest, until chance could explain every other one.

    Parameters
    ----------
    seconds : ndarray, shape (sample,)
    residual, direction : ndarray, shape (sample,) or (sample, row), (sample, 3) or (sample, row, 3)
        The record the lines were found in; NaN where it is not measured.
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
    lines = sorted(lines, key=lambda line: -line.ratio)[: settings.resolved]
    rows = residual.reshape(len(residual), -1)
    factors = direction.reshape(*rows.shape, 3)
    known = np.isfinite(rows).all(axis=1) & np.isfinite(factors).all(axis=(1, 2))
    if not lines or known.sum() < SPECTRUM_SETTINGS.least_samples:
        return []
    count = rows.shape[1]
    y, u = rows[known].reshape(-1), factors[known].reshape(-1, 3)
    # A constant field is no line, but the orbit's would explain it.
    constant = np.column_stack([np.tile(np.eye(count), (int(known.sum()), 1)), u])
    y = y - constant @ np.linalg.lstsq(constant, y)[0]
    frequency = np.array([1.0 / line.period_s for line in lines])
    time = np.repeat(seconds[known] - seconds[known][0], count)
    gram, right = _line_equations(time, y, u, frequency, settings.chunk)
    background = background_of(power.density[0]) / count
    at = np.clip(np.round(frequency / power.step).astype(np.int64) - 1, 0, background.size - 1)
    # White noise of this variance a row has the background's density.
    noise = background[at] * power.frequency[-1]
    taken = _select_lines(gram, right, noise, settings.chance)
    found = _lines_of_fit(lines, gram, right, noise, taken)
    found = [_check_daily_name(line, found, settings) for line in found]
    return [_as_multiple(line, found[:place], power.step, settings) for place, line in enumerate(found)]


def _check_daily_name(line: Line, found: Sequence[Line], settings: LineSettings) -> Line:
    """Take off a name that is due to the Earth's turn where lines nearer to the orbit's own are too weak.

    The field's harmonics make lines of the orbit split by once, twice, ... a day, and the first ones
    are the strong ones: a line at four times a day without them is something else.
    """
    base, side = _daily_sideband(line)
    if abs(side) < settings.far:
        return line
    nearer = [
        one.strength
        for one in found
        if _daily_sideband(one)[0] == base and abs(_daily_sideband(one)[1]) < abs(side)
    ]
    return line if max(nearer, default=0.0) > settings.family * line.strength else replace(line, label="")


def _daily_sideband(line: Line) -> tuple[str, int]:
    """Return the orbit's line that a line is a sideband of, and by how many times a day."""
    parts = line.label.split(" ")
    if len(parts) != 3 or not parts[2].endswith("/day"):
        return line.label, 0
    return parts[0], int(parts[1] + parts[2].removesuffix("/day"))


def _as_multiple(line: Line, stronger: Sequence[Line], step: float, settings: LineSettings) -> Line:
    """Label a line that is a multiple of a stronger new one, as the parts of a square wave are."""
    if line.is_known:
        return line
    for base in stronger:
        ratio = base.period_s / line.period_s
        times = round(ratio)
        if (
            base.is_new
            and 2 <= times <= settings.multiples
            and abs(ratio - times) <= settings.apart * step * base.period_s
        ):
            return replace(line, follows=f"multiple: ({format_period(base.period_s)})/{times}")
    return line


def _line_equations(
    seconds: Floats, residual: Floats, direction: Floats, frequency: Floats, chunk: int
) -> tuple[Floats, Floats]:
    """Return the products of all lines' columns with each other and with the residual."""
    width = 6 * frequency.size
    gram, right = np.zeros((width, width)), np.zeros(width)
    for start in range(0, seconds.size, chunk):
        rows = slice(start, start + chunk)
        angle = 2.0 * np.pi * seconds[rows, None] * frequency
        waves = np.stack([np.cos(angle), np.sin(angle)], axis=2)
        columns = (waves[:, :, None, :] * direction[rows, None, :, None]).reshape(len(angle), width)
        gram += columns.T @ columns
        right += columns.T @ residual[rows]
    return gram, right


def _select_lines(gram: Floats, right: Floats, noise: Floats, chance: float) -> list[int]:
    """Return which lines are taken, one after the other: each explains most of what the others leave."""
    count = noise.size
    limit = float(scipy.special.chdtri(6, chance / count))
    own = [gram[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(count)]
    taken: list[int] = []
    while len(taken) < count:
        columns = [6 * i + j for i in taken for j in range(6)]
        rest = right - gram[:, columns] @ _solved(gram[np.ix_(columns, columns)], right[columns])
        gain = np.array(
            [
                -1.0 if i in taken else rest[6 * i : 6 * i + 6] @ _solved(own[i], rest[6 * i : 6 * i + 6])
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


def _lines_of_fit(
    lines: Sequence[Line], gram: Floats, right: Floats, noise: Floats, taken: list[int]
) -> list[Line]:
    """Return the taken lines with the amplitudes of the common fit."""
    columns = [6 * i + j for i in taken for j in range(6)]
    whole = gram[np.ix_(columns, columns)]
    values = _solved(whole, right[columns])
    spreads = np.diag(np.linalg.pinv(whole, hermitian=True))
    found = []
    for place, number in enumerate(taken):
        mine = slice(6 * place, 6 * place + 6)
        value, spread = values[mine], np.sqrt(noise[number] * spreads[mine])
        along, sigma = np.hypot(value[0::2], value[1::2]), np.hypot(spread[0::2], spread[1::2]) / np.sqrt(2.0)
        own = whole[mine, mine]
        rows = float(np.trace(own))  # The six columns' squares sum to the number of rows.
        seen = np.sqrt(2.0 * max(float(value @ own @ value), 0.0) / rows)
        amplitude = np.append(seen, along)
        deviation = np.append(np.sqrt(2.0 * noise[number] / rows), sigma)
        found.append(replace(lines[number], follows="", amplitude=amplitude, sigma=deviation))
    return found


def record_lines(
    record: tuple[Floats, Floats, Floats],
    step: float,
    known: Mapping[str, float],
    shortest: float = 0.0,
    settings: SpectrumSettings = SPECTRUM_SETTINGS,
) -> tuple[SpectrumSum | None, list[Line]]:
    """Return the spectrum of a record of means, and the lines in it that are no sidebands of others.

    Parameters
    ----------
    record : tuple of ndarray
        Seconds, residual and direction, as `record_power` takes them.
    step : float
        Seconds between the means.
    known : mapping of str to float
        Periods by name, s.
    shortest : float
        Shortest period, s.
    """
    power = record_power(*record, step, settings)
    if power is None:
        return None, []
    return power, resolve_lines(*record, find_lines(power, known, shortest=shortest), power)


def name_slow_changes(
    lines: Sequence[Line], step: float, settings: LineSettings = LINE_SETTINGS
) -> list[Line]:
    """Return the lines, new ones close beside a stronger known one told as what that does in time.

    Parameters
    ----------
    step : float
        Resolution of the record's spectrum, Hz. A line of the orbit whose size changes in the course of the
        record, such as at the edges of calibration windows, has sidebands this close; they are no periods.
    """
    known = [line for line in lines if line.is_known]

    def named(line: Line) -> Line:
        if not line.is_new:
            return line
        near = [
            one
            for one in known
            if abs(1.0 / one.period_s - 1.0 / line.period_s) <= settings.slow * step
            and one.strength >= line.strength
        ]
        if not near:
            return line
        of = min(near, key=lambda one: abs(1.0 / one.period_s - 1.0 / line.period_s))
        return replace(line, follows=f"{of.label}, changing within the record")

    return [named(line) for line in lines]


def strongest_new(lines: Sequence[Line], step: float, settings: LineSettings = LINE_SETTINGS) -> Line | None:
    """Return the strongest line that nothing explains, or the fundamental it is a multiple of; None without.

    Parameters
    ----------
    lines : sequence of Line
        As `resolve_lines` returns them.
    step : float
        Resolution of their spectrum, Hz.
    """
    new = [line for line in lines if line.is_new]
    if not new:
        return None
    best = max(new, key=lambda line: line.strength)
    for times in range(4, 1, -1):
        for line in new:
            near = abs(times / line.period_s - 1.0 / best.period_s) < settings.apart * step * times
            if line is not best and near and line.strength > settings.comparable * best.strength:
                return line
    return best
