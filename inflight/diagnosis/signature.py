"""The signature of what is in no library: a line that nothing known explains, or a band that is too fast.

Takes the residual that a finished search leaves (`inflight.diagnosis.series`); makes the `Signature` of the
verdict from its spectrum (`inflight.residual.spectrum`), its lines and the known periods
(`inflight.residual.lines`) and its waveform (`inflight.residual.waveform`).

A rotating wheel whose speed drifts leaves no sharp line and no slow structure. Its power is in a band of
the spectrum all the same, and in no form of the search: `fast_part` measures it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from inflight.arrays import Floats
from inflight.diagnosis.residual import LAGS, DiagnosisData, Structure
from inflight.diagnosis.result import Signature
from inflight.diagnosis.series import Series
from inflight.residual import (
    SPECTRUM_SETTINGS,
    Line,
    SpectrumSum,
    Waveform,
    known_periods,
    mean_density,
    on_grid,
    orbit_period,
    record_lines,
    strongest_new,
    waveform_of,
)
from inflight.time import SECOND

AXES = ("x", "y", "z")


@dataclass(frozen=True, kw_only=True)
class SignatureSettings:
    """When a line or a band is worth a name.

    Attributes
    ----------
    least_samples : int
        Shortest record whose lines are looked for, samples. Assumed.
    least_part : float
        A line that explains less than this part of the residual's square is no effect worth a name. Assumed.
    turning : float
        By how much the field's direction must turn to have a period of its own. Assumed.
    length, fewest, smooth : int
        Samples of a stretch of the fast spectrum; stretches needed; frequencies it is smoothed over. Assumed.
    above, holds : float
        A band is this many times above the usual power, and holds this part of what is missing. Assumed.
    widest : float
        Longest over shortest period of one band. Assumed.
    more, part : float
        Missing power counts when its size is this many times the structure's, and this part of the noise
        floor. Assumed.
    around : float
        A known period explains a band when it is within it, or beyond its ends by this factor. Assumed.
    harmonics : int
        Of the tone that describes a line whose shape is no sine, at most. Assumed.
    """

    least_samples: int = 128
    least_part: float = 0.01
    turning: float = 0.3
    length: int = 256
    fewest: int = 12
    smooth: int = 5
    above: float = 3.0
    holds: float = 0.5
    widest: float = 4.0
    more: float = 2.0
    part: float = 0.5
    around: float = 1.1
    harmonics: int = 5


SIGNATURE_SETTINGS = SignatureSettings()


def periods_of(data: DiagnosisData) -> dict[str, float]:
    """Return the periods that need no explanation, by name, s: of orbit, day, mission, and the field's own.

    The orbit's is measured from its phase; without it the stated one; without that the one with which the
    field turns in the sensor.
    """
    series = data.series
    stated = {name: period / SECOND for name, period in data.mission.periods.items()}
    stated = {name: period for name, period in stated.items() if period > 2.0 * series.step_s}
    own, phase = _own_period(series), None
    if "orbit_phase" in series.channels:
        measured = np.where(series["weight"] > 0, series["orbit_phase"], np.nan)
        phase = orbit_period(series.tt2000 / SECOND, measured)
    orbit = phase or (None if "orbit" in stated else own)
    if own is not None and orbit is not own:
        stated["field direction"] = own
    return known_periods(stated, orbit)


def _own_period(series: Series) -> float | None:
    """Return the period with which the field turns in the sensor, s: the orbit's, or the spin's."""
    direction = series.direction()[:, 0]
    good = (series["weight"] > 0) & np.isfinite(direction).all(axis=1)
    if good.sum() < 64 or float(np.ptp(direction[good], axis=0).max()) < SIGNATURE_SETTINGS.turning:
        return None
    even = np.where(good[:, None], direction - direction[good].mean(axis=0), 0.0)
    power = (np.abs(np.fft.rfft(even, 4 * len(even), axis=0)) ** 2).sum(axis=1)
    at = int(np.argmax(power[8:])) + 8
    return 4 * len(even) * series.step_s / at


def residual_lines(
    series: Series, residual: Floats, known: dict[str, float]
) -> tuple[SpectrumSum | None, list[Line]]:
    """Return the spectrum of a residual (sample, row) of the series, and the lines in it.

    Returns
    -------
    Power or None
        None of a record that is too short, or has no time between its rows: a synthetic turn.
    list of Line
        As `inflight.residual.resolve_lines` returns them.
    """
    if series.turn_rows > 1:
        return None, []
    settings = replace(SPECTRUM_SETTINGS, shortest_s=SIGNATURE_SETTINGS.least_samples * series.step_s)
    record = (series.tt2000 - series.tt2000[0]) / SECOND, *_measured(series, residual)
    return record_lines(record, series.step_s, known, settings=settings)


def _measured(series: Series, residual: Floats) -> tuple[Floats, Floats]:
    """Return residual and direction with NaN where the series weighs nothing."""
    good = (series["weight"] > 0)[:, None]
    direction = np.where(good[:, :, None], series.direction(), np.nan)
    if not np.nan_to_num(direction).any():
        # A platform's residual has no direction of its own: it is a field along the first axis.
        direction = np.where(good[:, :, None], np.array([1.0, 0.0, 0.0]), np.full_like(direction, np.nan))
    return np.where(good, residual, np.nan), direction


def line_signature(data: DiagnosisData, residual: Floats) -> Signature | None:
    """Return the signature of the strongest line, or None when none stands out and matters.

    Parameters
    ----------
    residual : ndarray, shape (sample, row)
        What the search leaves of the series, nT.
    """
    series = data.series
    power, lines = residual_lines(series, residual, periods_of(data))
    line = strongest_new(lines, power.step) if power is not None else None
    if power is None or line is None:
        return None
    y, u = _measured(series, residual)
    good = np.isfinite(y).all(axis=1) & np.isfinite(u).all(axis=(1, 2))
    seconds = (series.tt2000[good] - series.tt2000[good][0]) / SECOND
    found = waveform_of(seconds, y[good], u[good], 1.0 / line.period_s, power.step)
    return signature_of(found, series.step_s) if found.part >= SIGNATURE_SETTINGS.least_part else None


def part_at_period(data: DiagnosisData, values: Floats, period_s: float) -> float:
    """Return the rms that a field of one period along three axes has in values of the series, nT.

    Parameters
    ----------
    values : ndarray, shape (sample, row)
        A residual, or what an effect makes of it, nT.
    """
    y, u = _measured(data.series, values)
    good = np.isfinite(y).all(axis=1) & np.isfinite(u).all(axis=(1, 2))
    turn = 2.0 * np.pi * ((data.series.tt2000[good] - data.series.tt2000[0]) / SECOND) / period_s
    waves = np.stack([np.cos(turn), np.sin(turn)])
    columns = np.einsum("ws,srk->srwk", waves, u[good]).reshape(-1, 6)
    at = y[good].reshape(-1)
    made = columns @ np.linalg.lstsq(columns, at - at.mean())[0]
    return float(np.sqrt(np.mean(made**2)))


def signature_of(found: Waveform, step_s: float = 0.0) -> Signature:
    """Return a waveform in the words of a verdict.

    Parameters
    ----------
    step_s : float
        Spacing of the samples, s: harmonics of the tone that describes it are slower than two of them.
    """
    order = 1 if found.shape == "sine" else SIGNATURE_SETTINGS.harmonics
    if step_s:
        order = max(1, min(order, int(found.period_s / (2.0 * step_s))))
    form = f", order={order}" if order > 1 else ""
    named = [dict(zip(AXES, one.tolist(), strict=False)) for one in (found.amplitudes, found.steps)]
    amplitudes, steps = ({name: tuple(pair) for name, pair in one.items()} for one in named)
    return Signature(
        period_s=found.period_s,
        axis=AXES[found.axis] if found.axis is not None else None,
        shape=found.shape,
        amplitude_nT=found.amplitude,
        period_sigma_s=found.period_sigma_s,
        duty=found.duty,
        amplitudes=amplitudes,
        steps=steps,
        added_by=f'"tone({found.period_s:.8g} s{form})"',
    )


@dataclass(frozen=True)
class Fast:
    """What is missing and has no slow structure.

    Attributes
    ----------
    rms_nT : float
        Root of the residual's square less that of noise and structure.
    faster_than_s : float
        Structure is looked for in means over so long.
    periods_s : tuple of float or None
        The range that holds most of it, when one stands out.
    """

    rms_nT: float  # noqa: N815 (a unit)
    faster_than_s: float
    periods_s: tuple[float, float] | None = None


def fast_part(
    series: Series, residual: Floats, residual_nT: float, floor_nT: float, structure: Structure
) -> Fast | None:
    """Return what the residual holds besides noise and slow structure; None when that is little.

    Parameters
    ----------
    residual : ndarray, shape (sample, row)
        What the search leaves of the series, nT.
    residual_nT, floor_nT : float
        Sizes of the residual and of its white level at the cadence of the comparison.
    """
    if series.turn_rows > 1:
        # A synthetic turn has no time between its rows.
        return None
    square = residual_nT**2 - floor_nT**2 - structure.rms_nT**2
    if not square > max(SIGNATURE_SETTINGS.more * structure.rms_nT, SIGNATURE_SETTINGS.part * floor_nT) ** 2:
        return None
    missing = float(np.sqrt(square))
    return Fast(missing, LAGS * series.step_s, _band(series, residual, missing))


def _band(series: Series, residual: Floats, missing: float) -> tuple[float, float] | None:
    """Return the shortest and longest period of the one band that holds most of what is missing, s."""
    rule = SIGNATURE_SETTINGS
    values = np.where(series["weight"][:, None] > 0, residual, np.nan)
    grid = on_grid((series.tt2000 - series.tt2000[0]) / SECOND, values, series.step_s)
    frequency, density, stretches = mean_density(grid, series.step_s, rule.length)
    if stretches < rule.fewest:
        return None
    padded = np.pad(density, rule.smooth // 2, mode="edge")
    power = np.convolve(padded, np.ones(rule.smooth) / rule.smooth, mode="valid")
    usual = float(np.median(power))
    bands, count = scipy.ndimage.label(power > rule.above * usual)
    excess = (power - usual) * frequency[1]
    held = np.array([excess[bands == one].sum() for one in range(1, count + 1)])
    # The slow end is structure, and has its own words.
    if not count or held.max() < rule.holds * missing**2:
        return None
    inside = np.flatnonzero(bands == int(np.argmax(held)) + 1)
    if inside[0] < 3 * rule.smooth // 2 or frequency[inside[-1]] > rule.widest * frequency[inside[0]]:
        return None
    low, high = np.interp([0.05, 0.95], np.cumsum(excess[inside]) / excess[inside].sum(), frequency[inside])
    return 1.0 / float(high), 1.0 / float(low)


def is_unknown_band(data: DiagnosisData, fast: Fast) -> bool:
    """Return True when a band of periods was found and no known period lies in it."""
    if fast.periods_s is None:
        return False
    short, long = fast.periods_s
    known = [period for name, period in periods_of(data).items() if "/" not in name]
    around = SIGNATURE_SETTINGS.around
    return not any(short / around <= period <= long * around for period in known)
