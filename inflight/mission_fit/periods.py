"""Periods in a daily parameter: Lomb-Scargle, false alarms from simulated red noise (Yin 2010, ch. 4).

Takes daily values with gaps and their errors; makes a `ParameterSpectrum`: amplitudes and the noise below
them (`_Noise`, Whittle's likelihood), the peaks beyond chance, and the waves of periods that are asked for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.lsq import robust_sigma


@dataclass(frozen=True, kw_only=True)
class PeriodSettings:
    """How periods of a daily parameter are searched.

    Attributes
    ----------
    false_alarm : float
        A peak is reported when chance makes one as high in so small a part of spectra.
    beats : float
        A named period is resolved by a span of so many beats with its neighbours: Rayleigh's criterion.
    oversampling : int
        Frequencies tried, per independent one; assumed.
    fewest : int
        Fewest days; assumed.
    line : float
        Frequencies so many times above the background are no part of it; assumed.
    passes : int
        Passes of leaving them out; assumed.
    most : int
        Peaks reported at most; assumed.
    """

    false_alarm: float = 0.01
    beats: float = 1.0
    oversampling: int = 2
    fewest: int = 30
    line: float = 6.0
    passes: int = 3
    most: int = 12


PERIOD_SETTINGS = PeriodSettings()


#: Half a turn and a turn of local time of CHAMP's orbit (Yin 2010, section 1.3), and the year; days.
KNOWN_PERIODS = {"130 d": 130.0, "260.5 d": 260.5, "365 d": 365.25}

#: A named period is resolved by a span of so many of it, and of so many beats with its neighbours.
MIN_CYCLES = 1.5


@dataclass(frozen=True)
class Peak:
    """A peak of the spectrum beyond chance: period (d), amplitude, its sigma, false-alarm chance, name."""

    period: float
    amplitude: float
    sigma: float
    false_alarm: float
    label: str


@dataclass(frozen=True)
class NamedPeriod:
    """A period that was asked for: amplitude, sigma and time of its maximum (MJD), or why it has none."""

    name: str
    period: float
    amplitude: float
    sigma: float
    maximum: float
    false_alarm: float
    resolved: bool
    why: str = ""


@dataclass(frozen=True)
class ParameterSpectrum:
    """Spectrum of one daily parameter.

    Attributes
    ----------
    frequency, amplitude : ndarray, shape (frequency,)
        Cycles a day; amplitude of a wave of each frequency, unit of the parameter.
    background, level : ndarray, shape (frequency,)
        Rms amplitude of the noise, and that which one spectrum of noise in a hundred exceeds anywhere.
    correlation_days : float
        Correlation time of the red part of the noise, to 1/e, days.
    span : float
        Days.
    peaks : tuple of Peak
        Largest first.
    named : tuple of NamedPeriod
    unit : str
    """

    frequency: Floats
    amplitude: Floats
    background: Floats
    level: Floats
    correlation_days: float
    span: float
    peaks: tuple[Peak, ...]
    named: tuple[NamedPeriod, ...]
    unit: str

    def summary(self) -> list[str]:
        """Return each named period as a sentence."""
        return [
            f"{one.name}: {one.amplitude:.3g} +- {one.sigma:.2g} {self.unit}, chance {one.false_alarm:.2g}"
            if one.resolved
            else f"{one.name}: not resolved, {one.why}"
            for one in self.named
        ]

    def table(self) -> xr.Dataset:
        """Return amplitudes of the named periods: dim parameter; NaN where not resolved."""
        return xr.Dataset(
            {
                "value": ("parameter", np.array([one.amplitude for one in self.named])),
                "sigma": ("parameter", np.array([one.sigma for one in self.named])),
                "false_alarm": ("parameter", np.array([one.false_alarm for one in self.named])),
                "determined": ("parameter", np.array([one.resolved for one in self.named])),
                "period": ("parameter", np.array([one.period for one in self.named]), {"units": "d"}),
                "units": ("parameter", np.full(len(self.named), self.unit)),
            },
            coords={"parameter": [one.name for one in self.named]},
            attrs={
                "span_days": self.span,
                "memory_days": self.correlation_days,
                "told": "; ".join(self.summary()),
            },
        )


def parameter_spectrum(
    mjd: Floats,
    value: Floats,
    sigma: Floats,
    known: Mapping[str, float] | None = None,
    *,
    shortest: float = 10.0,
    trials: int = 100,
    seed: int = 0,
    unit: str = "",
) -> ParameterSpectrum:
    """Return the spectrum of daily values with gaps, less a straight line.

    Parameters
    ----------
    mjd, value, sigma : ndarray, shape (day,)
        Days, values (NaN in gaps) and standard deviations.
    known : mapping of str to float, optional
        Periods to report by name, days; `KNOWN_PERIODS` when absent.
    shortest : float
        Shortest period, days.
    trials : int
        Series of noise that the false alarms come from.
    seed : int
        Of the noise.

    Raises
    ------
    CalibrationError
        When fewer than 30 days have a value.
    """
    use = np.isfinite(value) & np.isfinite(sigma) & (sigma > 0)
    if use.sum() < PERIOD_SETTINGS.fewest:
        raise CalibrationError(
            f"{int(use.sum())} days with a value make no spectrum",
            remedy=f"use {PERIOD_SETTINGS.fewest} or more",
        )
    t, y = mjd[use], value[use]
    # The values scatter beyond their own errors by this variance.
    excess = max(robust_sigma(y - np.median(y)) ** 2 - float(np.median(sigma[use])) ** 2, 0.0)
    weight = 1.0 / (sigma[use] ** 2 + excess)
    waves = _Waves.of(t, weight, shortest)
    power = waves.power(y[:, None])[0]
    noise = _background(waves, y)
    draws = np.random.default_rng(seed)
    drawn = waves.power(noise.series(waves, draws, trials))
    fitted = [(one, _Noise.fit(waves, one, noise).power(waves.frequency)) for one in drawn]
    highest = np.array([np.max(one / mean) for one, mean in fitted])
    # The largest of M exponential numbers; M from the median of the trials.
    effective = np.log(2.0) * np.exp(np.median(highest))
    known = KNOWN_PERIODS if known is None else known
    span = float(np.ptp(t))
    named = _named_periods(waves, y, noise, known, span)
    limit = (
        float(-np.log1p(-((1.0 - PERIOD_SETTINGS.false_alarm) ** (1.0 / effective))))
        if effective > 1
        else 4.6
    )
    back = np.sqrt(2.0 * noise.power(waves.frequency) / weight.sum())
    amplitude = np.sqrt(2.0 * power / weight.sum())
    peaks = _peaks(waves, y, noise, float(effective), known, span)
    return ParameterSpectrum(
        waves.frequency,
        amplitude,
        back,
        back * np.sqrt(limit),
        noise.correlation_days,
        span,
        peaks,
        named,
        unit,
    )


@dataclass(frozen=True)
class _Waves:
    """Waves of each frequency on given days, orthogonal to a straight line and to each other.

    `pair` (2, frequency, day) turns values into two numbers whose squares sum to the power: the drop of
    the weighted sum of squares that the best wave makes.
    """

    days: Floats
    weight: Floats
    frequency: Floats
    pair: Floats

    @classmethod
    def of(cls, days: Floats, weight: Floats, shortest: float) -> _Waves:
        span = float(np.ptp(days))
        frequency = np.arange(
            PERIOD_SETTINGS.oversampling, span / shortest * PERIOD_SETTINGS.oversampling + 1
        ) / (span * PERIOD_SETTINGS.oversampling)
        root = np.sqrt(weight)
        line, _ = np.linalg.qr(np.stack([root, root * (days - days.mean())], axis=1))
        angle = 2 * np.pi * frequency[:, None] * (days - days.mean())
        cosine, sine = root * np.cos(angle), root * np.sin(angle)
        cosine -= (cosine @ line) @ line.T
        sine -= (sine @ line) @ line.T
        cosine /= np.linalg.norm(cosine, axis=1)[:, None]
        sine -= np.sum(sine * cosine, axis=1)[:, None] * cosine
        sine /= np.linalg.norm(sine, axis=1)[:, None]
        return cls(days, weight, frequency, np.stack([cosine, sine]) * root)

    def power(self, series: Floats) -> Floats:
        """Return the powers of series (day, series); (series, frequency)."""
        return np.asarray(np.sum((self.pair @ series) ** 2, axis=0).T)


@dataclass(frozen=True)
class _Noise:
    """Power of noise: ``white + red / (1 + (2 pi f tau)^2)``; a power is exponential with this mean.

    `correlation_days` is tau, the correlation time of the red part.
    """

    white: float
    red: float
    correlation_days: float

    @classmethod
    def fit(cls, waves: _Waves, power: Floats, like: _Noise | None = None) -> _Noise:
        """Whittle's likelihood over frequencies that are no peaks; the search begins at `like`."""
        kept = np.ones(power.size, dtype=bool)
        span = float(np.ptp(waves.days))
        found = cls(float(np.median(power)) / np.log(2.0), 0.0, 1.0)
        square = (2 * np.pi * waves.frequency) ** 2
        for _ in range(PERIOD_SETTINGS.passes):
            before = kept
            found = like = cls._most_likely(square[kept], power[kept], span, like)
            peak = power > PERIOD_SETTINGS.line * found.power(waves.frequency)
            # A line spreads over its neighbours.
            kept = ~np.convolve(peak, np.ones(2 * PERIOD_SETTINGS.oversampling + 1), mode="same").astype(bool)
            if kept.sum() < 0.5 * kept.size or np.array_equal(kept, before):
                break
        return found

    @classmethod
    def _most_likely(cls, square: Floats, power: Floats, span: float, like: _Noise | None) -> _Noise:
        """Return the noise of the greatest likelihood; `square` is (2 pi f)^2, (frequency,)."""
        slow, fast = power[: max(power.size // 10, 3)].mean(), power[power.size // 2 :].mean()

        def cost(logs: Floats) -> tuple[float, Floats]:
            white, red, tau = np.exp(logs)
            lorentz = 1.0 + square * tau**2
            mean = white + red / lorentz
            by_mean = 1.0 / mean - power / mean**2
            slopes = (white, red / lorentz, -2.0 * red * square * tau**2 / lorentz**2)
            gradient = np.array([np.sum(by_mean * slope) for slope in slopes])
            return float(np.sum(power / mean + np.log(mean))), gradient

        start = np.log([max(fast, 1e-12), max(slow, 1e-12), span / 50.0])
        bounds = [(start[0] - 12, start[0] + 3), (start[1] - 12, start[1] + 8), tuple(np.log([0.5, span]))]
        if like is not None:
            known = np.log(np.maximum([like.white, like.red, like.correlation_days], 1e-300))
            start = np.clip(known, *np.transpose(bounds))
        found = scipy.optimize.minimize(cost, start, method="L-BFGS-B", bounds=bounds, jac=True)
        return cls(*(float(one) for one in np.exp(found.x)))

    def power(self, frequency: Floats) -> Floats:
        """Return the mean power at frequencies."""
        return np.asarray(
            self.white + self.red / (1.0 + (2 * np.pi * frequency * self.correlation_days) ** 2)
        )

    def series(self, waves: _Waves, draws: np.random.Generator, count: int) -> Floats:
        """Return series of this noise on the days of the waves; (day, series)."""
        days, weight = waves.days, waves.weight
        white = draws.standard_normal((days.size, count)) * np.sqrt(0.5 * self.white / weight)[:, None]
        # Two-sided density 2 v tau at zero, seen through sums of n weights over the span.
        density = days.size / max(float(np.ptp(days)), 1.0)
        size = np.sqrt(self.red / (4.0 * weight.mean() * density * self.correlation_days))
        correlation = np.exp(-np.diff(days) / self.correlation_days)
        red = np.empty_like(white)
        red[0] = draws.standard_normal(count)
        steps = draws.standard_normal((days.size - 1, count)) * np.sqrt(1.0 - correlation**2)[:, None]
        for index, part in enumerate(correlation):
            red[index + 1] = part * red[index] + steps[index]
        return np.asarray(white + size * red)


def _background(waves: _Waves, y: Floats) -> _Noise:
    """Return the noise of a series without its lines; their side lobes are no noise either."""
    noise = _Noise.fit(waves, waves.power(y[:, None])[0])
    for _ in range(PERIOD_SETTINGS.passes):
        lines = _find_lines(waves, y, noise, float(waves.frequency.size))
        if not lines:
            break
        power = waves.power(_residual(waves, y, lines)[:, None])[0]
        apart = np.min(np.abs(waves.frequency[:, None] - np.array(lines)), axis=1) * np.ptp(waves.days)
        # A fitted line leaves a hole where it was.
        noise = _Noise.fit(waves, np.where(apart < 1.0, noise.power(waves.frequency), power))
    return noise


def _false_alarm(ratio: float, effective: float) -> float:
    """Return the chance that noise exceeds a ratio anywhere among so many independent frequencies."""
    return float(-np.expm1(effective * np.log1p(-np.exp(-max(ratio, 1e-9)))))


def _peaks(
    waves: _Waves, y: Floats, noise: _Noise, effective: float, known: Mapping[str, float], span: float
) -> tuple[Peak, ...]:
    frequencies = _find_lines(waves, y, noise, effective)
    value, inverse = _fit(waves, y, frequencies)
    found = []
    for place, frequency in enumerate(frequencies):
        size, sigma, _ = _amplitude_of(value, inverse, place, noise, frequency)
        near = [name for name, days in known.items() if abs(1.0 / days - frequency) < 0.5 / span]
        chance = _false_alarm(0.5 * (size / sigma) ** 2, effective)
        found.append(Peak(1.0 / frequency, size, sigma, chance, " or ".join(near)))
    return tuple(sorted(found, key=lambda one: -one.amplitude))


def _find_lines(waves: _Waves, y: Floats, noise: _Noise, effective: float) -> list[float]:
    """Subtract the highest peak and its wave from the series, again and again: its side lobes go with it."""
    frequencies: list[float] = []
    residual = y
    while len(frequencies) < PERIOD_SETTINGS.most:
        power = waves.power(residual[:, None])[0]
        ratio = power / noise.power(waves.frequency)
        at = int(np.argmax(ratio))
        if _false_alarm(float(ratio[at]), effective) > PERIOD_SETTINGS.false_alarm:
            break
        frequencies.append(_refine_frequency(waves, residual, float(waves.frequency[at])))
        residual = _residual(waves, y, frequencies)
    return frequencies


def _refine_frequency(waves: _Waves, y: Floats, frequency: float) -> float:
    """Return the frequency near a given one whose wave leaves the smallest sum of squares."""

    def square(one: float) -> float:
        return float(np.sum(waves.weight * _residual(waves, y, [one]) ** 2))

    step = float(waves.frequency[0]) / 2
    bounds = (max(frequency - step, step / 2), frequency + step)
    return float(scipy.optimize.minimize_scalar(square, bounds=bounds, method="bounded").x)


def _line_and_waves(waves: _Waves, frequencies: Sequence[float]) -> Floats:
    """Return a constant, a straight line and a pair of waves a frequency; (day, 2 + 2 frequencies)."""
    away = waves.days - waves.days.mean()
    angles = [2 * np.pi * away * frequency for frequency in frequencies]
    columns = [wave(angle) for angle in angles for wave in (np.cos, np.sin)]
    return np.stack([np.ones_like(away), away / np.ptp(away), *columns], axis=1)


def _fit(waves: _Waves, y: Floats, frequencies: Sequence[float]) -> tuple[Floats, Floats]:
    """Fit line and waves together; coefficients, and their covariance for the stated weights."""
    rows, root = _line_and_waves(waves, frequencies), np.sqrt(waves.weight)
    value: Floats = np.asarray(np.linalg.lstsq(rows * root[:, None], y * root)[0], dtype=np.float64)
    inverse: Floats = np.asarray(np.linalg.inv((rows * waves.weight[:, None]).T @ rows), dtype=np.float64)
    return value, inverse


def _residual(waves: _Waves, y: Floats, frequencies: Sequence[float]) -> Floats:
    """Return the series less line and waves; (day,)."""
    return np.asarray(y - _line_and_waves(waves, frequencies) @ _fit(waves, y, frequencies)[0])


def _amplitude_of(
    value: Floats, inverse: Floats, place: int, noise: _Noise, frequency: float
) -> tuple[float, float, float]:
    """Return amplitude, its standard deviation and the phase (rad) of one of several waves."""
    at = slice(2 + 2 * place, 4 + 2 * place)
    wave = value[at]
    size = float(np.hypot(*wave))
    along = wave / max(size, 1e-300)
    # White noise of the stated weights has the power 2.
    mean = float(noise.power(np.array([frequency]))[0])
    sigma = float(np.sqrt(along @ inverse[at, at] @ along * mean / 2.0))
    return size, sigma, float(np.arctan2(wave[1], wave[0]))


def _named_periods(
    waves: _Waves, y: Floats, noise: _Noise, known: Mapping[str, float], span: float
) -> tuple[NamedPeriod, ...]:
    """Fit all resolved periods together with a straight line."""
    why = {name: _why_unresolved(name, known, span) for name in known}
    resolved = [name for name in known if not why[name]]
    value, inverse = _fit(waves, y, [1.0 / known[name] for name in resolved])
    found = []
    for name, days in known.items():
        if why[name]:
            nan = float("nan")
            found.append(NamedPeriod(name, days, nan, nan, nan, nan, False, why[name]))
            continue
        size, sigma, phase = _amplitude_of(value, inverse, resolved.index(name), noise, 1.0 / days)
        maximum = float(waves.days.mean() + days * phase / (2 * np.pi))
        # A period that was named beforehand is one frequency, not all of them.
        chance = _false_alarm(0.5 * (size / sigma) ** 2, 1.0)
        found.append(NamedPeriod(name, days, size, sigma, maximum, chance, True))
    return tuple(found)


def _why_unresolved(name: str, known: Mapping[str, float], span: float) -> str:
    """Return why a span does not resolve a period; empty when it does."""
    if span < MIN_CYCLES * known[name]:
        return f"{span:.0f} days are less than {MIN_CYCLES:g} periods"
    for other, days in known.items():
        beat = np.inf if other == name else abs(1.0 / days - 1.0 / known[name])
        if span * beat < PERIOD_SETTINGS.beats:
            return (
                f"{span:.0f} days do not tell it from {other}, {PERIOD_SETTINGS.beats / beat:.0f} are needed"
            )
    return ""
