"""What the thesis finds in the residual, put into daily values and given back (Yin 2010, chapter 4).

Tolerances as in `inflight.scorecard.recovered_parameters`.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from inflight.mission_fit import WEEKDAYS, day_statistics, find_clock_faults, find_week_pattern, fit_slope
from inflight.scorecard.figure import RECOVERED, Estimate, PublishedFigure
from inflight.scorecard.recovered_parameters import NOISE, SEEDS
from inflight.scorecard.residual import SECTION
from inflight.scorecard.scene import DAYS, SimulatedDays

#: Drift of the z offset, nT/d; a day's scatter and a wave of 260.5 d beside it, nT (chosen).
_DRIFT, _SCATTER, _WAVE = -0.00024, 0.2, 0.15
#: The clock fault: first and last day, s, and a day's scatter (chosen), s.
_FAULT, _CLOCK_SCATTER = (3164, 3167, 0.012), 0.0005
#: Slopes of Fig. 4.21 by day and by night, nT: in this order their difference has the sign of section 4.3.
_SLOPES = (0.18, -0.47)
#: Fewest samples of a day's light or dark part.
_SIDE = 300
#: MJD mod 7 of the reset day.
WEDNESDAY = WEEKDAYS.index("Wednesday")


def drift(scene: SimulatedDays) -> Estimate:
    """Return the mean over seeds of a drift put into daily offsets, nT/d."""
    days = np.arange(204.5, 3204.5)
    found = []
    for seed in range(SEEDS):
        wave = _WAVE * np.cos(2.0 * np.pi * days / 260.5)
        value = _DRIFT * days + wave + np.random.default_rng([4, seed]).normal(0.0, _SCATTER, days.size)
        fit = fit_slope(days, value, np.full(days.size, _SCATTER), periods=(260.5,))
        found.append(Estimate.of(fit.slope, fit.sigma))
    return Estimate.mean(found)


def weekday_of_resets(scene: SimulatedDays) -> tuple[float, ...]:
    """Return MJD mod 7 of the day on which an offset is found to step, least and largest over seeds.

    The offset steps on Wednesdays by as much, rms, as single days scatter. NaN where no day stands out.
    """
    days, found = np.arange(204.5, 3204.5), []
    for seed in range(SEEDS):
        generator = np.random.default_rng([5, seed])
        steps = np.where(np.floor(days) % 7 == WEDNESDAY, generator.normal(size=days.size), 0.0)
        # A reset at noon: half of it is in the mean of its own day.
        value = np.cumsum(steps) - 0.5 * steps + generator.normal(size=days.size)
        pattern = find_week_pattern(days, value)
        found.append(float(pattern.day) if pattern.found else np.nan)
    return float(np.min(found)), float(np.max(found))


def fault_of_clock(scene: SimulatedDays) -> tuple[float, float, float]:
    """Return first and last day and size of the only fault found; mean over seeds, NaN where more are."""
    days, found = np.arange(2700.5, 3400.5), []
    for seed in range(SEEDS):
        shift = 0.015 + np.random.default_rng([6, seed]).normal(0.0, _CLOCK_SCATTER, days.size)
        shift += np.where((days > _FAULT[0]) & (days < _FAULT[1] + 1), _FAULT[2], 0.0)
        faults = find_clock_faults(days, shift, np.full(days.size, _CLOCK_SCATTER)).faults
        one = faults[0] if len(faults) == 1 else None
        found.append((one.first, one.last, one.shift) if one else (np.nan,) * 3)
    first, last, size = np.mean(found, axis=0)
    return float(first), float(last), float(size)


def slopes_by_day_and_night(scene: SimulatedDays) -> Estimate:
    """Return the slopes of dB on Bz/F by day and by night of a field that was put in, nT."""
    sums = np.zeros((2, 3))
    for seed in range(SEEDS):
        for mjd in DAYS:
            day = scene.day(mjd)
            field = _SLOPES[0] * day.sunlit + _SLOPES[1] * (1.0 - day.sunlit)
            noise = np.random.default_rng([27, seed, mjd]).normal(0.0, NOISE, day.sunlit.size)
            residual = field * day.direction[:, 2] + noise
            for index, side in enumerate((day.sunlit == 1.0, day.sunlit == 0.0)):
                # Orbits in full sun have no night to take a slope of.
                if side.sum() >= _SIDE:
                    one = day_statistics(residual, day.direction, *day.span, good=side)
                    # A short night sees few directions: its slope says little.
                    weight = float((one["count"] * one["geometry"]).item())
                    variance = float(one["covariance"].sel(statistic="slope", other="slope").item())
                    sums[index] += weight * np.array([float(one["slope"].item()), 1.0, weight * variance])
    return Estimate.of(sums[:, 0] / sums[:, 1], np.sqrt(sums[:, 2]) / sums[:, 1])


recovered = partial(PublishedFigure, section=SECTION, basis="recovered_from_injection", why=RECOVERED)

FIGURES = (
    recovered(
        id="offset.drift-recovered",
        what="drift of daily z offsets that scatter by 0.2 nT beside a wave of 260.5 d, 3000 days",
        unit="nT/d",
        source="Yin 2010, section 4.1.2",
        published=_DRIFT,
        # Three times 2.1e-6, and the last printed digit is 1e-5.
        tolerance=0.000006,
        obtain=drift,
        nominal=0.0,
    ),
    recovered(
        id="resets.recovered",
        what="MJD mod 7 of the weekday on which an offset is found to step, least and largest over seeds",
        unit="1",
        source="Yin 2010, section 4.1.2: Wednesdays",
        published=(float(WEDNESDAY), float(WEDNESDAY)),
        tolerance=0.0,
        obtain=weekday_of_resets,
        nominal=(float("nan"), float("nan")),
    ),
    recovered(
        id="clock-fault.recovered",
        what="first and last day, and size, of the only fault found in 700 daily time shifts",
        unit="d, d, s",
        source="Yin 2010, section 4.2.2, Fig. 4.18",
        published=tuple(float(one) for one in _FAULT),
        # The days exactly, the shift to its last printed digit.
        tolerance=(0.0, 0.0, 0.0005),
        obtain=fault_of_clock,
        nominal=(float("nan"),) * 3,
        why="Found without being told where: this proves the estimator, not the fault.",
    ),
    recovered(
        id="day-night.slopes",
        what="slopes of dB on Bz/F by day and by night of a field put into days that have a night",
        unit="nT",
        source="Yin 2010, Fig. 4.21; which is by day follows from the sign of the angles of section 4.3",
        published=_SLOPES,
        # Three times 0.7 pT, and the penumbra belongs to neither; half of the last printed digit.
        tolerance=0.005,
        obtain=slopes_by_day_and_night,
        nominal=(0.0, 0.0),
    ),
)
