"""Behaviour of daily parameters over a mission (Yin 2010, ch. 4).

Takes daily values and their errors; makes running means that allow for gaps (`running_mean`), slow trends
(`fit_slope`), steps on event days and on days of the week (`measure_event_steps`, `find_week_pattern`), spans
of days on which a clock was wrong (`find_clock_faults`, from daily estimates of the time shift), and the
local time of an orbit's ascending node from where samples lie on the orbit (`node_local_time`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.lsq import (
    BIWEIGHT_WIDTH,
    correlation_steps,
    long_run_covariance,
    robust_fit,
    robust_sigma,
    window_means,
)


@dataclass(frozen=True, kw_only=True)
class BehaviourSettings:
    """What running means, steps and clock faults of daily parameters need.

    Attributes
    ----------
    coverage : float
        Least part of a window's days that have a value; assumed.
    lean : float
        Windows by which the mean time of a window's days may lie from its middle: at the ends of a mission
        and beside a long gap a mean is that of another time; assumed.
    fewest : int
        Fewest days of a mean; assumed.
    harmonics : int
        Harmonics of the window's length, which its mean removes; assumed.
    step_window : int
        Days before and after an event whose means are compared; assumed.
    least : float
        Part of them that must be there; assumed.
    fewest_contrasts : int
        Fewest contrasts away from events that the noise of a step is taken from; assumed.
    step_false_alarm : float
        Chance of any false step among all that are tested.
    clip : float
        Changes of a week are clipped at so many robust standard deviations; assumed.
    fewest_weeks : int
        Fewest weeks with all their days; assumed.
    shuffles : int
        Shuffles of the days of the week: chances down to 1/2000.
    clock_false_alarm : float
        Chance that a mission without a clock fault is reported to have one.
    longest_fault : int
        Longest fault that is searched for, days: a longer one is the usual state; assumed.
    around : int
        Days on either side that determine the usual shift; assumed.
    fewest_days : int
        The fewest of them; assumed.
    far : float
        A day so many sigmas off is off by itself; assumed.
    """

    coverage: float = 0.6
    lean: float = 0.05
    fewest: int = 5
    harmonics: int = 3
    step_window: int = 3
    least: float = 0.6
    fewest_contrasts: int = 20
    step_false_alarm: float = 0.01
    clip: float = 8.0
    fewest_weeks: int = 10
    shuffles: int = 2000
    clock_false_alarm: float = 0.01
    longest_fault: int = 30
    around: int = 45
    fewest_days: int = 10
    far: float = 6.0


BEHAVIOUR_SETTINGS = BehaviourSettings()

WEEK = 7

#: By MJD mod 7, counted from Saturday 2000-01-01; Wednesday, 4, is the thesis' reset day.
WEEKDAYS = ("Saturday", "Sunday", "Monday", "Tuesday", "Wednesday", "Thursday", "Friday")


@dataclass(frozen=True)
class RunningMean:
    """Centred running mean of a daily parameter; all (day,).

    Attributes
    ----------
    mjd, value, sigma : ndarray
        NaN where the window holds too few days, or leans to one side.
    coverage : ndarray
        Part of the window's days that have a value.
    window : float
        Days.
    """

    mjd: Floats
    value: Floats
    sigma: Floats
    coverage: Floats
    window: float
    unit: str = ""

    def table(self) -> xr.Dataset:
        """Return the means: dim interval (a day each)."""
        return xr.Dataset(
            {
                "value": ("interval", self.value, {"units": self.unit}),
                "sigma": ("interval", self.sigma, {"units": self.unit}),
                "coverage": ("interval", self.coverage),
                "mjd": ("interval", self.mjd, {"units": "d"}),
            },
            attrs={"window_days": self.window, "units": self.unit},
        )


def running_mean(
    mjd: Floats,
    value: Floats,
    window: float,
    *,
    coverage: float = BEHAVIOUR_SETTINGS.coverage,
    unit: str = "",
) -> RunningMean:
    """Return the mean of the days within half a window on either side, each day alike.

    Days count alike, whatever their sigma, so that a window of one cycle of local time (260.5 d) removes
    what repeats with it. The uncertainty is that of a mean of correlated days, from the scatter about the
    running mean less what repeats with the window, and its correlation time. The window must lie within the
    span; gaps inside it may not shift its mean time.

    Parameters
    ----------
    mjd : ndarray, shape (day,)
        Middles of the days, rising; days may be missing.
    value : ndarray, shape (day,)
        NaN in gaps.
    window : float
        Days.
    coverage : float
        Least part of the window's days that must have a value.

    Raises
    ------
    CalibrationError
        When no window has enough days.
    """
    known = np.isfinite(value)
    if not known.any():
        raise CalibrationError("no day has a value", remedy="use a longer span")
    place = np.rint(mjd - mjd[0]).astype(np.int64)
    daily, weight = np.full((int(place[-1]) + 1, 1), np.nan), np.zeros(int(place[-1]) + 1)
    daily[place[known], 0], weight[place[known]] = value[known], 1.0
    means = window_means(daily, weight, window)
    mean, count, share, lean = (
        one[place] for one in (means.mean[:, 0], means.weight, means.coverage, means.lean)
    )
    inside = (mjd - window / 2 >= mjd[known].min() - 1.0) & (mjd + window / 2 <= mjd[known].max() + 1.0)
    defined = inside & (share >= coverage) & (np.abs(lean) <= BEHAVIOUR_SETTINGS.lean * window)
    if not defined.any():
        raise CalibrationError(
            f"no window of {window:g} days has {100 * coverage:.0f} % of its days, evenly on both sides",
            remedy="use a shorter window, or a longer span",
        )
    residual = np.where(defined & known, value - mean, np.nan)
    # What repeats with the window does not enter its mean, whatever its size.
    rest = np.isfinite(residual)
    angles = [2 * np.pi * k * mjd / window for k in range(1, BEHAVIOUR_SETTINGS.harmonics + 1)]
    rows = np.stack([wave(angle) for angle in angles for wave in (np.cos, np.sin)], axis=1)
    if rest.sum() >= 2 * rows.shape[1]:
        residual = residual - rows @ np.linalg.lstsq(rows[rest], residual[rest])[0]
    sigma = np.sqrt(_variance_of_day(residual, float(np.ptp(mjd)) / window) / np.maximum(count, 1.0))
    nan = np.nan
    return RunningMean(
        mjd, np.where(defined, mean, nan), np.where(defined, sigma, nan), share, float(window), unit
    )


def _variance_of_day(residual: Floats, means: float) -> float:
    """Return the long-run variance of a day: the variance of a mean of n days is this over n.

    As many independent means were subtracted as windows fit into the span.
    """
    known = residual[np.isfinite(residual)]
    if known.size < BEHAVIOUR_SETTINGS.fewest:
        return float("nan")
    spread = robust_sigma(known - np.median(known))
    clipped = np.clip(known, -BIWEIGHT_WIDTH * spread, BIWEIGHT_WIDTH * spread) if spread > 0 else known
    return float(long_run_covariance(clipped[:, None], means)[0, 0]) / known.size


@dataclass(frozen=True)
class Slope:
    """A straight line through a daily parameter, fitted with waves of given periods.

    Attributes
    ----------
    slope, sigma : float
        Unit a day.
    value, sigma_value : float
        At `mjd`, the mean day.
    correlation_days : int
        Correlation time of the residual, in days with a value; it is in the sigma.
    days, outlying : int
    """

    slope: float
    sigma: float
    value: float
    sigma_value: float
    mjd: float
    correlation_days: int
    days: int
    outlying: int
    unit: str = ""

    def table(self) -> xr.Dataset:
        """Return slope and value: dim parameter."""
        return xr.Dataset(
            {
                "value": ("parameter", np.array([self.slope, self.value])),
                "sigma": ("parameter", np.array([self.sigma, self.sigma_value])),
                "units": ("parameter", np.array([f"{self.unit}/d", self.unit])),
            },
            coords={"parameter": ["slope", "value"]},
            attrs={"mjd": self.mjd, "days": self.days, "memory": self.correlation_days},
        )


def fit_slope(
    mjd: Floats, value: Floats, sigma: Floats, periods: Sequence[float] = (), unit: str = ""
) -> Slope:
    """Fit a straight line robustly; its uncertainty allows for the correlation of days.

    Parameters
    ----------
    mjd, value, sigma : ndarray, shape (day,)
        Days, values (NaN in gaps), standard deviations.
    periods : sequence of float
        Days; waves fitted with the line, such as those that `parameter_spectrum` resolves.

    Raises
    ------
    CalibrationError
        When fewer days than unknowns and five have a value.
    """
    use = np.isfinite(value) & np.isfinite(sigma) & (sigma > 0)
    unknowns = 2 + 2 * len(periods)
    if use.sum() < unknowns + BEHAVIOUR_SETTINGS.fewest:
        raise CalibrationError(
            f"{int(use.sum())} days with a value for {unknowns} unknowns", remedy="use a longer span"
        )
    t, y, own = mjd[use], value[use], sigma[use]
    centre, span = float(t.mean()), max(float(np.ptp(t)), 1.0)
    angles = [2 * np.pi * (t - centre) / period for period in periods]
    waves = [wave(angle) for angle in angles for wave in (np.cos, np.sin)]
    rows = np.stack([(t - centre) / span, np.ones_like(t), *waves], axis=1)
    fit = robust_fit(rows, y, own**2, unknowns)
    errors = np.sqrt(np.diag(fit.covariance))
    return Slope(
        float(fit.value[0]) / span,
        float(errors[0]) / span,
        float(fit.value[1]),
        float(errors[1]),
        centre,
        int(correlation_steps(fit.residual[:, None])[0]),
        int(use.sum()),
        fit.outlying,
        unit,
    )


@dataclass(frozen=True)
class EventSteps:
    """Steps at given times; all (event,).

    Attributes
    ----------
    at : ndarray
        MJD.
    size, sigma : ndarray
        After less before, and its standard deviation by the scatter of such contrasts away from events;
        NaN where days are missing.
    chance : ndarray
        Chance of such a step without one.
    family : ndarray
        The same among all events tested (Holm).
    widened : float
        How many times more steps scatter away from events than by their stated sigmas.
    """

    at: Floats
    size: Floats
    sigma: Floats
    chance: Floats
    family: Floats
    widened: float
    unit: str = ""

    @property
    def found(self) -> np.ndarray:
        """Which events have a step beyond chance; (event,) bool."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.family < BEHAVIOUR_SETTINGS.step_false_alarm)

    def table(self) -> xr.Dataset:
        """Return the steps: dim event."""
        return xr.Dataset(
            {
                "value": ("event", self.size),
                "sigma": ("event", self.sigma),
                "chance": ("event", self.chance),
                "family_chance": ("event", self.family),
                "determined": ("event", self.found),
                "mjd": ("event", self.at, {"units": "d"}),
                "units": ("event", np.full(self.at.size, self.unit)),
            },
            attrs={"widened": self.widened},
        )


def measure_event_steps(
    mjd: Floats,
    value: Floats,
    sigma: Floats,
    events: Floats,
    *,
    window: int = BEHAVIOUR_SETTINGS.step_window,
    unit: str = "",
) -> EventSteps:
    """Measure the step of a parameter at each event.

    The mean of whole days after the event less that of whole days before; a day that holds the event in
    itself is left out. The scatter of such contrasts at all other noons, slow changes included, is their
    noise, with its heavy tails.

    Parameters
    ----------
    mjd, value, sigma : ndarray, shape (day,)
        Middles of days, parameter (NaN in gaps), standard deviations.
    events : ndarray, shape (event,)
        MJD with their time of day.
    window : int
        Days on either side.

    Raises
    ------
    CalibrationError
        When too few days are left to determine the noise of a step.
    """
    size, stated = _contrasts(mjd, value, sigma, events, window)
    others = mjd[np.min(np.abs(mjd[:, None] - events[None]), axis=1) > 0.5] if events.size else mjd
    away, away_sigma = _contrasts(mjd, value, sigma, others, window)
    standardised = (away / away_sigma)[np.isfinite(away)]
    if standardised.size < BEHAVIOUR_SETTINGS.fewest_contrasts:
        raise CalibrationError(
            f"{standardised.size} contrasts away from events, "
            f"{BEHAVIOUR_SETTINGS.fewest_contrasts} are needed",
            remedy="use a longer span",
        )
    widened = robust_sigma(standardised, floor=1.0)
    error = stated * widened
    # Student's distribution with the 99 % quantile of the contrasts.
    ratio = float(np.quantile(np.abs(standardised), 0.99) / np.median(np.abs(standardised)))
    freedoms = np.array([3.0, 4.0, 5.0, 7.0, 10.0, 15.0, 30.0, 100.0, 1000.0])
    expected = scipy.stats.t.ppf(0.995, freedoms) / scipy.stats.t.ppf(0.75, freedoms)
    freedom = float(np.interp(-ratio, -expected, freedoms))
    chance = 2.0 * scipy.stats.t.sf(np.abs(size / error), freedom)
    return EventSteps(events, size, error, chance, holm(chance), widened, unit)


def _contrasts(mjd: Floats, value: Floats, sigma: Floats, at: Floats, window: int) -> tuple[Floats, Floats]:
    """Return weighted mean after less before and its stated standard deviation; NaN where days miss."""
    known = np.isfinite(value) & np.isfinite(sigma) & (sigma > 0)
    weight = np.where(known, 1.0 / np.where(known, sigma, 1.0) ** 2, 0.0)
    sums = {
        "weight": np.concatenate([[0.0], np.cumsum(weight)]),
        "value": np.concatenate([[0.0], np.cumsum(weight * np.where(known, value, 0.0))]),
        "count": np.concatenate([[0.0], np.cumsum(known)]),
    }
    sides = []
    for low, high in ((at - window - 0.5, at - 0.5), (at + 0.5, at + window + 0.5)):
        first, last = np.searchsorted(mjd, low), np.searchsorted(mjd, high, side="right")
        part = {name: total[last] - total[first] for name, total in sums.items()}
        enough = part["count"] >= max(BEHAVIOUR_SETTINGS.least * window, 1)
        full = np.where(enough, part["weight"], np.nan)
        sides.append((part["value"] / full, 1.0 / full))
    (before, early), (after, late) = sides
    return after - before, np.sqrt(early + late)


def holm(chance: Floats) -> Floats:
    """Return chances among all tests made (Holm 1979); NaN stay, and count as no test."""
    out = np.full(chance.shape, np.nan)
    known = np.flatnonzero(np.isfinite(chance))
    order = known[np.argsort(chance[known])]
    factors = np.arange(order.size, 0, -1)
    out[order] = np.minimum(np.maximum.accumulate(chance[order] * factors), 1.0)
    return out


@dataclass(frozen=True)
class WeekPattern:
    """Which day of the week a parameter steps on, whatever the sign.

    Attributes
    ----------
    square, sigma : ndarray, shape (7,)
        Mean square of the change across each day (MJD mod 7), from the day before to the day after, unit
        squared, and its standard deviation.
    day : int
        MJD mod 7 of the largest.
    step : float
        Rms step on that day beyond the others', unit.
    sigma_step : float
    chance : float
        Chance that any day stands out as far (shuffled within weeks).
    """

    square: Floats
    sigma: Floats
    day: int
    step: float
    sigma_step: float
    chance: float
    unit: str = ""

    @property
    def found(self) -> bool:
        """True when the day stands out beyond chance."""
        return self.chance < BEHAVIOUR_SETTINGS.step_false_alarm

    def summary(self) -> str:
        """Return the pattern as a sentence."""
        name = f"{WEEKDAYS[self.day]}s (MJD mod 7 = {self.day})"
        if not self.found:
            return f"no day of the week stands out (largest on {name}, chance {self.chance:.2g})"
        return f"steps of {self.step:.3g} +- {self.sigma_step:.2g} {self.unit} rms on {name}"

    def table(self) -> xr.Dataset:
        """Return the mean squares: dim weekday (MJD mod 7)."""
        return xr.Dataset(
            {
                "value": ("weekday", self.square),
                "sigma": ("weekday", self.sigma),
                "units": ("weekday", np.full(WEEK, f"{self.unit}2")),
            },
            coords={"weekday": np.arange(WEEK)},
            attrs={
                "told": self.summary(),
                "chance": self.chance,
                "step": self.step,
                "sigma_step": self.sigma_step,
            },
        )


def find_week_pattern(mjd: Floats, value: Floats, seed: int = 0, unit: str = "") -> WeekPattern:
    """Test whether a parameter steps on one day of the week.

    The change across a day is from the day before to the day after, so that a reset at any hour of it is
    wholly inside; outlying changes are clipped at eight robust standard deviations.

    Parameters
    ----------
    mjd, value : ndarray, shape (day,)
        Middles of days at steps of one day but for gaps; NaN in gaps.
    seed : int
        Of the shuffles.

    Raises
    ------
    CalibrationError
        When fewer than ten weeks have all their days.
    """
    day = np.floor(mjd).astype(np.int64)
    whole = np.full(int(day[-1] - day[0]) + 1, np.nan)
    whole[day - day[0]] = value
    change = np.full(whole.size, np.nan)
    change[1:-1] = whole[2:] - whole[:-2]
    # Weeks begin on MJD mod 7 = 0, so that a column is a day of the week.
    skip = int(-day[0]) % WEEK
    weeks = change[skip : skip + (change.size - skip) // WEEK * WEEK].reshape(-1, WEEK)
    weeks = weeks[np.isfinite(weeks).all(axis=1)]
    if len(weeks) < BEHAVIOUR_SETTINGS.fewest_weeks:
        raise CalibrationError(f"{len(weeks)} whole weeks, ten are needed", remedy="use a longer span")
    most = BEHAVIOUR_SETTINGS.clip * robust_sigma(weeks.ravel())
    squares = np.minimum(weeks**2, most**2)
    mean, sigma = squares.mean(axis=0), squares.std(axis=0, ddof=1) / np.sqrt(len(weeks))
    draws = np.random.default_rng(seed)
    shuffled = np.array(
        [draws.permuted(squares, axis=1).mean(axis=0).max() for _ in range(BEHAVIOUR_SETTINGS.shuffles)]
    )
    best = int(np.argmax(mean))
    chance = float((1 + np.sum(shuffled >= mean[best])) / (1 + BEHAVIOUR_SETTINGS.shuffles))
    # Its neighbours' changes hold part of its step; the days farther off do not.
    far = [(best + k) % WEEK for k in (2, 3, 4, 5)]
    excess = squares[:, best] - squares[:, far].mean(axis=1)
    size = float(np.sqrt(max(excess.mean(), 0.0)))
    error = float(excess.std(ddof=1) / np.sqrt(len(weeks)))
    return WeekPattern(mean, sigma, best, size, float(np.sqrt(size**2 + error) - size), chance, unit)


@dataclass(frozen=True)
class ClockFault:
    """Days first to last (MJD, whole days, inclusive), how far the clock was off (s), sigma, significance."""

    first: int
    last: int
    shift: float
    sigma: float
    z: float


@dataclass(frozen=True)
class ClockFaults:
    """All faults of a mission.

    Attributes
    ----------
    faults : tuple of ClockFault
        In order of time.
    usual, scatter : ndarray, shape (day,)
        What the shift usually is around each day, and the standard deviation of a day about it, s.
    mjd : ndarray, shape (day,)
        Middles of the days.
    limit : float
        Significance beyond which a span is a fault.
    """

    faults: tuple[ClockFault, ...]
    usual: Floats
    scatter: Floats
    mjd: Floats
    limit: float

    def summary(self) -> list[str]:
        """Return each fault as a sentence."""
        return [
            f"MJD {one.first} to {one.last}: the time shift is off by {1e3 * one.shift:.2f} +- "
            f"{1e3 * one.sigma:.2f} ms"
            for one in self.faults
        ]

    def table(self) -> xr.Dataset:
        """Return the faults: dim fault; `value` s."""
        rows = self.faults
        return xr.Dataset(
            {
                "value": ("fault", np.array([one.shift for one in rows])),
                "sigma": ("fault", np.array([one.sigma for one in rows])),
                "units": ("fault", np.full(len(rows), "s")),
                "first": ("fault", np.array([one.first for one in rows], dtype=np.int64), {"units": "MJD"}),
                "last": ("fault", np.array([one.last for one in rows], dtype=np.int64), {"units": "MJD"}),
                "z": ("fault", np.array([one.z for one in rows])),
            },
            attrs={"told": "; ".join(self.summary()), "limit": self.limit},
        )


def find_clock_faults(
    mjd: Floats, shift: Floats, sigma: Floats, longest: int = BEHAVIOUR_SETTINGS.longest_fault
) -> ClockFaults:
    """Find spans of days whose time shift stands out from what it is around them.

    Every span of 1 to `longest` days is compared with the median of the days around, and its significance
    with that of all spans of its length; the most significant is a fault, its days are left out, and so on,
    while noise would make one like it in one mission of a hundred.

    Parameters
    ----------
    mjd : ndarray, shape (day,)
        Middles of the days, rising.
    shift, sigma : ndarray, shape (day,)
        Daily estimates of the time shift and their standard deviations, s; NaN in gaps.
    longest : int
        Days.

    Raises
    ------
    CalibrationError
        When fewer than ten days have an estimate.
    """
    known = np.flatnonzero(np.isfinite(shift) & np.isfinite(sigma) & (sigma > 0))
    if known.size < BEHAVIOUR_SETTINGS.fewest_days:
        raise CalibrationError(
            f"{known.size} days have a time shift, {BEHAVIOUR_SETTINGS.fewest_days} are needed",
            remedy="use a longer span",
        )
    limit = float(scipy.stats.norm.isf(0.5 * BEHAVIOUR_SETTINGS.clock_false_alarm / (known.size * longest)))
    t, y, own = mjd[known], shift[known], sigma[known]
    free = np.ones(t.size, dtype=bool)
    faults: list[ClockFault] = []
    while True:
        usual = _median_around(t, y, free)
        # The stated errors, widened to the days' own scatter.
        residual = y - usual
        scatter = own * robust_sigma(residual[free] / own[free], floor=1.0)
        found = _most_significant(residual / scatter, t, free, longest)
        if found is None or abs(found[2]) < limit:
            break
        first, last, z = found
        days = slice(first, last + 1)
        weight = 1.0 / scatter[days] ** 2
        fault_shift = float(np.sum(weight * residual[days]) / weight.sum())
        error = float(1.0 / np.sqrt(weight.sum()))
        faults.append(ClockFault(int(np.floor(t[first])), int(np.floor(t[last])), fault_shift, error, z))
        free[days] = False
    of_all_days = np.full((2, mjd.size), np.nan)
    of_all_days[:, known] = usual, scatter
    ordered = tuple(sorted(faults, key=lambda fault: fault.first))
    return ClockFaults(ordered, of_all_days[0], of_all_days[1], mjd, limit)


def _median_around(days: Floats, value: Floats, free: np.ndarray) -> Floats:
    """Return the median of the free days around each; (day,)."""
    base, series = days[free], value[free]
    whole = float(np.median(series))
    low = np.searchsorted(base, days - BEHAVIOUR_SETTINGS.around)
    high = np.searchsorted(base, days + BEHAVIOUR_SETTINGS.around, side="right")
    spans = zip(low, high, high - low >= BEHAVIOUR_SETTINGS.fewest_days, strict=True)
    return np.array([np.median(series[a:b]) if enough else whole for a, b, enough in spans])


def _most_significant(
    z: Floats, days: Floats, free: np.ndarray, longest: int
) -> tuple[int, int, float] | None:
    """Return first, last and significance of the most significant span of free days."""
    best: tuple[int, int, float] | None = None
    sums = np.concatenate([[0.0], np.cumsum(np.where(free, z, 0.0))])
    taken = np.concatenate([[0], np.cumsum(~free)])
    far = np.concatenate([[0], np.cumsum(np.abs(z) > BEHAVIOUR_SETTINGS.far)])
    for length in range(1, min(longest, z.size // 2) + 1):
        score = (sums[length:] - sums[:-length]) / np.sqrt(length)
        whole = (taken[length:] == taken[:-length]) & (
            days[length - 1 :] - days[: z.size - length + 1] < longest
        )
        # Slow changes of the shift make long spans scatter more than their days do; spans with a day that is
        # itself far off do not show it.
        without_far = np.abs(score[whole & (far[length:] == far[:-length])])
        usual = robust_sigma(without_far) if without_far.size >= BEHAVIOUR_SETTINGS.fewest_days else 1.0
        score = np.where(whole, score / max(usual, 1.0), 0.0)
        at = int(np.argmax(np.abs(score)))
        if best is None or abs(score[at]) > abs(best[2]):
            best = (at, at + length - 1, float(score[at]))
    return best


def node_local_time(local_time: Floats, orbit_phase: Floats, latitude: Floats) -> Floats:
    """Return the local time of the ascending node, h; shape of the arguments.

    From the node at an angle u along an orbit inclined by i the longitude has grown by
    ``atan2(cos i sin u, cos u)``: near the poles of a polar orbit by 180 degrees at once. The inclination is
    that which the latitudes show, ``sin(latitude) = sin i sin u``; of a prograde and a retrograde orbit
    of the same latitudes that one is taken whose node changes less from each place to the next.

    Parameters
    ----------
    local_time : ndarray
        h, where the satellite is; in order of time.
    orbit_phase, latitude : ndarray
        deg; u and the geocentric latitude there.
    """
    u, sine = np.deg2rad(orbit_phase), np.sin(np.deg2rad(latitude))
    known = np.isfinite(u) & np.isfinite(sine)
    power = float(np.sum(np.sin(u[known]) ** 2))
    tilt = min(abs(float(np.sum(sine[known] * np.sin(u[known])))) / power, 1.0) if power > 0 else 1.0
    cosine = float(np.sqrt(1.0 - tilt**2))
    both = []
    for sign in (1.0, -1.0):
        away = np.rad2deg(np.arctan2(sign * cosine * np.sin(u), np.cos(u)))
        # The Earth turns by 15 degrees an hour.
        both.append(np.asarray((local_time - away / 15.0) % 24.0))
    return min(both, key=_mean_step)


def _mean_step(hours: Floats) -> float:
    """Return the mean step on the clock's circle from each place to the next, h."""
    known = hours[np.isfinite(hours)]
    steps = (np.diff(known) + 12.0) % 24.0 - 12.0
    return float(np.mean(np.abs(steps))) if steps.size else 0.0
