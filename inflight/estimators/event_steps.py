"""Steps of a daily parameter on event days, and on days of the week (Yin 2010, ch. 4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy import stats

from inflight.arrays import Floats
from inflight.calibration.robust import robust_sigma
from inflight.errors import CalibrationError

#: Days before and after an event whose means are compared, and the part of them that must be there.
WINDOW, _LEAST = 3, 0.6
#: Chance of any false step among all that are tested.
FALSE_ALARM = 0.01
#: Fewest contrasts away from events that the noise of a step is taken from.
_FEWEST = 20
#: Shuffles of the days of the week.
_SHUFFLES = 2000
WEEK = 7
#: The thesis' reset day: Wednesdays have MJD mod 7 = 4, counted from Saturday 2000-01-01.
WEEKDAYS = ("Saturday", "Sunday", "Monday", "Tuesday", "Wednesday", "Thursday", "Friday")


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
        How many times larger steps scatter away from events than the stated sigmas say.
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
            return np.asarray(self.family < FALSE_ALARM)

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


def event_steps(
    mjd: Floats, value: Floats, sigma: Floats, events: Floats, *, window: int = WINDOW, unit: str = ""
) -> EventSteps:
    """Measure the step of a parameter at each event.

    The mean of whole days after the event less that of whole days before; a day that holds the event in
    itself is left out. What such contrasts scatter by at all other noons, wander included, is their noise,
    with its heavy tails.

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
        When too few days are left to tell the noise of a step.
    """
    size, stated = _contrasts(mjd, value, sigma, events, window)
    others = mjd[np.min(np.abs(mjd[:, None] - events[None]), axis=1) > 0.5] if events.size else mjd
    away, away_sigma = _contrasts(mjd, value, sigma, others, window)
    pulls = (away / away_sigma)[np.isfinite(away)]
    if pulls.size < _FEWEST:
        raise CalibrationError(
            f"{pulls.size} contrasts away from events, {_FEWEST} are needed", remedy="use a longer span"
        )
    widened = robust_sigma(pulls, floor=1.0)
    error = stated * widened
    chance = 2.0 * stats.t.sf(np.abs(size / error), _tails(pulls))
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
        enough = part["count"] >= max(_LEAST * window, 1)
        full = np.where(enough, part["weight"], np.nan)
        sides.append((part["value"] / full, 1.0 / full))
    (before, early), (after, late) = sides
    return after - before, np.sqrt(early + late)


def _tails(pulls: Floats) -> float:
    """Return the degrees of freedom of Student's distribution whose 99 % quantile the pulls have."""
    ratio = float(np.quantile(np.abs(pulls), 0.99) / np.median(np.abs(pulls)))
    freedoms = np.array([3.0, 4.0, 5.0, 7.0, 10.0, 15.0, 30.0, 100.0, 1000.0])
    expected = stats.t.ppf(0.995, freedoms) / stats.t.ppf(0.75, freedoms)
    return float(np.interp(-ratio, -expected, freedoms))


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
        return self.chance < FALSE_ALARM

    def told(self) -> str:
        """Say it in a sentence."""
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
                "told": self.told(),
                "chance": self.chance,
                "step": self.step,
                "sigma_step": self.sigma_step,
            },
        )


def week_pattern(mjd: Floats, value: Floats, seed: int = 0, unit: str = "") -> WeekPattern:
    """Ask whether a parameter steps on one day of the week.

    The change across a day is from the day before to the day after, so that a reset at any hour of it is
    wholly inside; outlying changes are held to eight robust standard deviations.

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
    if len(weeks) < 10:
        raise CalibrationError(f"{len(weeks)} whole weeks, ten are needed", remedy="use a longer span")
    most = 8.0 * robust_sigma(weeks.ravel())
    squares = np.minimum(weeks**2, most**2)
    mean, sigma = squares.mean(axis=0), squares.std(axis=0, ddof=1) / np.sqrt(len(weeks))
    draws = np.random.default_rng(seed)
    shuffled = np.array([draws.permuted(squares, axis=1).mean(axis=0).max() for _ in range(_SHUFFLES)])
    best = int(np.argmax(mean))
    chance = float((1 + np.sum(shuffled >= mean[best])) / (1 + _SHUFFLES))
    # Its neighbours' changes hold part of its step; the days farther off do not.
    far = [(best + k) % WEEK for k in (2, 3, 4, 5)]
    excess = squares[:, best] - squares[:, far].mean(axis=1)
    size = float(np.sqrt(max(excess.mean(), 0.0)))
    error = float(excess.std(ddof=1) / np.sqrt(len(weeks)))
    return WeekPattern(mean, sigma, best, size, float(np.sqrt(size**2 + error) - size), chance, unit)
