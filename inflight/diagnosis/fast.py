"""What is faster than the search can see: how much of it there is, and between which periods.

A rotating wheel whose speed drifts leaves no sharp line and no slow structure. Its power stands in a band
of the spectrum all the same, and in no form of the search.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label

from inflight.arrays import Floats
from inflight.diagnosis.left import LAGS, Structure
from inflight.diagnosis.series import Series
from inflight.time import SECOND

#: Rows of a segment; segments needed; and frequencies the spectrum is smoothed over.
_LENGTH, _FEWEST, _SMOOTH = 256, 12, 5
#: A band stands this many times above the usual power, and holds this part of what is missing.
_STANDS, _HOLDS = 3.0, 0.5
#: Missing power counts when its size is this many times the structure's, and this part of the floor.
_MORE, _PART = 2.0, 0.5


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
    series: Series, left: Floats, residual_nT: float, floor_nT: float, structure: Structure
) -> Fast | None:
    """Return what is left beside noise and slow structure; None when that is little.

    Parameters
    ----------
    left : ndarray, shape (sample, row)
        What is left of the series, nT.
    residual_nT, floor_nT : float
        Sizes of the residual and of its white level at the cadence of the comparison.
    """
    if series.turn_rows > 1:
        # A synthetic turn has no time between its rows.
        return None
    square = residual_nT**2 - floor_nT**2 - structure.rms_nT**2
    if not square > max(_MORE * structure.rms_nT, _PART * floor_nT) ** 2:
        return None
    missing = float(np.sqrt(square))
    return Fast(missing, LAGS * series.step_s, _band(series, left, missing))


def _band(series: Series, left: Floats, missing: float) -> tuple[float, float] | None:
    """Return the shortest and longest period of the one band that holds most of what is missing, s."""
    found = _spectrum(series, left)
    if found is None:
        return None
    frequency, power = found
    usual = float(np.median(power))
    bands, count = label(power > _STANDS * usual)
    excess = (power - usual) * frequency[1]
    held = np.array([excess[bands == one].sum() for one in range(1, count + 1)])
    # The slow end is structure, and has its own words.
    if not count or held.max() < _HOLDS * missing**2:
        return None
    inside = np.flatnonzero(bands == int(np.argmax(held)) + 1)
    if inside[0] < 3 * _SMOOTH // 2 or frequency[inside[-1]] > 4.0 * frequency[inside[0]]:
        return None
    low, high = np.interp([0.05, 0.95], np.cumsum(excess[inside]) / excess[inside].sum(), frequency[inside])
    return 1.0 / float(high), 1.0 / float(low)


def _spectrum(series: Series, left: Floats) -> tuple[Floats, Floats] | None:
    """Return frequencies and the power of all rows, mean of many short windows, nT^2/Hz; None if too few."""
    step = series.step_s
    place = np.rint((series.tt2000 - series.tt2000[0]) / (step * SECOND)).astype(np.int64)
    good = series["weight"] > 0
    values = np.zeros((int(place[-1]) + 1, left.shape[1]))
    there = np.zeros(len(values))
    values[place[good]], there[place[good]] = left[good], 1.0
    window = np.hanning(_LENGTH + 1)[:-1]
    total, used = np.zeros(_LENGTH // 2 + 1), 0
    for start in range(0, len(values) - _LENGTH + 1, _LENGTH // 2):
        inside = there[start : start + _LENGTH]
        if inside.mean() < 0.7:
            continue
        part = values[start : start + _LENGTH]
        part = (part - part.sum(axis=0) / inside.sum()) * inside[:, None] * window[:, None]
        total += np.mean(np.abs(np.fft.rfft(part, axis=0)) ** 2, axis=1) / np.mean(inside)
        used += 1
    if used < _FEWEST:
        return None
    power = total / used * 2.0 * step / np.sum(window**2)
    smooth = np.convolve(np.pad(power, _SMOOTH // 2, mode="edge"), np.ones(_SMOOTH) / _SMOOTH, mode="valid")
    return np.asarray(np.fft.rfftfreq(_LENGTH, step), dtype=np.float64), smooth
