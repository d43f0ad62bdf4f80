"""The values in use, interval by interval: replaced only where an interval warrants it.

Each interval's estimate is held against the values in use (`inflight.spin.update`). Offset and elevation of
a sensor share one tone (Plaschke et al. 2019, eq. 21) and are told apart poorly: they are decided together,
on their common covariance. What is replaced is the estimate given everything that is kept: else a tone that
both share would come back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy import stats

from inflight.arrays import Floats
from inflight.spin.equation import SPIN_RELATED, TwelveParameters
from inflight.spin.layout import Bools
from inflight.spin.update import SIGNIFICANCE, Decision, decide_one, decide_updates

#: Parameters that share a tone.
_TOGETHER = (("offset[1]", "elevation[1]"), ("offset[2]", "elevation[2]"))
#: As rare by chance, of two numbers, as `SIGNIFICANCE` sigma of one.
_RARE = float(stats.chi2.isf(2.0 * stats.norm.sf(SIGNIFICANCE), 2))


@dataclass(frozen=True)
class InUse:
    """Values in use of the eight, in the order of `SPIN_RELATED`, before an interval.

    Attributes
    ----------
    value : ndarray, shape (8,)
    covariance : ndarray, shape (8, 8)
        As it was when each was put in.
    flown : ndarray of bool, shape (8,)
        True for what the flight has told; the rest is as it was on the ground.
    since : ndarray, shape (8,)
        When each was put in, days.
    drift : Drift
        What later estimates told of how fast values move.
    """

    value: Floats
    covariance: Floats
    flown: Bools
    since: Floats
    drift: Drift

    @classmethod
    def of_ground(cls, ground: TwelveParameters, sigma: Mapping[str, float]) -> Self:
        """Return what is used before the flight."""
        value = ground.spin_related()
        errors = np.array([sigma[name] for name in SPIN_RELATED])
        none = np.zeros(value.size)
        return cls(value, np.diag(errors**2), none.astype(np.bool_), none, Drift(none, none))

    def after(self, value: Floats, covariance: Floats, told: Bools, day: float) -> Step:
        """Decide on an interval's estimate.

        Parameters
        ----------
        value, covariance : ndarray, shape (8,) and (8, 8)
            The interval's own estimate, on top of what was known before the flight.
        told : ndarray of bool, shape (8,)
            What the interval knows better than the ground did.
        day : float
            Of the interval, counted from any.

        Returns
        -------
        Step
        """
        seen, own = self._given(value, covariance, ~told)
        sigma = np.where(told, np.sqrt(np.diag(own)), np.inf)
        decisions = self._decided(seen, sigma, own, told)
        put_in = np.array([one.verdict == "update" for one in decisions])
        new, spread = self._given(value, covariance, ~put_in)
        drift = self.drift.seeing(
            seen - self.value,
            np.diag(self.covariance) + np.diag(own),
            day - self.since,
            told & self.flown,
        )
        used = InUse(
            np.where(put_in, new, self.value),
            spread,
            self.flown | put_in,
            np.where(put_in, day, self.since),
            drift,
        )
        return Step(decisions, used, used.stated(seen, own, told & ~put_in, day), seen, sigma)

    def stated(self, seen: Floats, own: Floats, told: Bools, day: float) -> Floats:
        """Return the covariance to be stated for an interval; (8, 8).

        A value that is kept moves on as values did so far. What the interval's estimate differs by, over what
        both errors make of it, is added; and the value is as sure as that estimate is, and where it lies.
        """
        variance, apart = np.diag(self.covariance), seen - self.value
        moved = variance + np.where(self.flown, self.drift.rate * (day - self.since), 0.0)
        beyond = np.maximum(apart**2 - moved - np.diag(own), 0.0)
        now = np.where(told, np.minimum(moved + beyond, np.diag(own) + apart**2), moved)
        wider = np.sqrt(now / variance)
        return np.asarray(wider[:, None] * self.covariance * wider)

    def _given(self, value: Floats, covariance: Floats, held: Bools) -> tuple[Floats, Floats]:
        """Return an estimate given the values in use of what is held, and its covariance; whole arrays."""
        out, spread = self.value.copy(), self.covariance.copy()
        free = ~held
        if not free.any():
            return out, spread
        across, inside = covariance[np.ix_(free, held)], covariance[np.ix_(held, held)]
        slope = np.linalg.solve(inside, across.T).T if held.any() else across
        out[free] = value[free] + slope @ (self.value[held] - value[held])
        mine = self.covariance[np.ix_(held, held)]
        shared = slope @ mine
        spread[np.ix_(free, free)] = (
            covariance[np.ix_(free, free)] - slope @ across.T + slope @ mine @ slope.T
        )
        spread[np.ix_(free, held)], spread[np.ix_(held, free)] = shared, shared.T
        return out, spread

    def _decided(self, seen: Floats, sigma: Floats, own: Floats, told: Bools) -> tuple[Decision, ...]:
        present = TwelveParameters().changed(dict(zip(SPIN_RELATED, self.value.tolist(), strict=True)))
        known = dict(zip(SPIN_RELATED, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))
        made = {one.name: one for one in decide_updates(seen, sigma, present, known).decisions}
        for at, name in enumerate(SPIN_RELATED):
            if told[at] and not self.flown[at]:
                made[name] = first_of_flight(made[name])
        for pair in _TOGETHER:
            places = [SPIN_RELATED.index(name) for name in pair]
            if told[places].all() and self.flown[places].all():
                made |= self._together(pair, [made[name] for name in pair], seen, own)
        return tuple(made[name] for name in SPIN_RELATED)

    def _together(
        self, pair: tuple[str, str], made: list[Decision], seen: Floats, own: Floats
    ) -> dict[str, Decision]:
        """Return the decisions on two that share a tone: both are replaced, or none."""
        places = [SPIN_RELATED.index(name) for name in pair]
        apart = (seen - self.value)[places]
        inside = np.ix_(places, places)
        size = float(apart @ np.linalg.solve(self.covariance[inside] + own[inside], apart))
        if size <= _RARE and all(one.verdict != "update" for one in made):
            return {}
        other = dict(zip(pair, reversed(pair), strict=True))
        why = (
            f"offset and elevation together differ by chi2 {size:.1f} of two numbers" if size > _RARE else ""
        )
        return {
            one.name: one
            if one.verdict == "update"
            else replace(
                one, verdict="update", reason=why or f"goes with {other[one.name]}, which shares its tone"
            )
            for one in made
        }


@dataclass(frozen=True)
class Drift:
    """How fast values move, from all estimates of what was in use: a walk whose variance grows with time.

    Attributes
    ----------
    square, time : ndarray, shape (8,)
        Sums, weighted, of squared differences less what errors make of them, and of the days between.
    """

    square: Floats
    time: Floats

    @property
    def rate(self) -> Floats:
        """Variance a day, in squares of the parameters' units; (8,)."""
        known = self.time > 0.0
        return np.where(known, np.maximum(self.square, 0.0) / np.where(known, self.time, 1.0), 0.0)

    def seeing(self, apart: Floats, variance: Floats, age: Floats, told: Bools) -> Drift:
        """Return the sums with one more difference (8,) of this variance without drift, `age` days old."""
        weight = np.where(told & (age > 0.0), 1.0 / (variance + self.rate * age) ** 2, 0.0)
        return Drift(self.square + weight * (apart**2 - variance), self.time + weight * age)


@dataclass(frozen=True)
class Step:
    """What became of an interval's estimate.

    Attributes
    ----------
    decisions : tuple of Decision
        In the order of `SPIN_RELATED`.
    used : InUse
        From this interval on.
    covariance : ndarray, shape (8, 8)
        To be stated for this interval.
    seen, sigma : ndarray, shape (8,)
        The interval's own estimate, given what it does not tell, and its error; infinite where it does not.
    """

    decisions: tuple[Decision, ...]
    used: InUse
    covariance: Floats
    seen: Floats
    sigma: Floats


@dataclass(frozen=True)
class OneInUse:
    """One value in use that shares nothing with others, as the offset along the spin axis."""

    name: str
    value: float
    sigma: float
    flown: bool = False

    def after(self, value: float, sigma: float) -> tuple[Decision, OneInUse, float]:
        """Return the decision on a new value, what is used from now on, and the error to be stated."""
        made = decide_one(self.name, (self.value, self.sigma), (value, sigma))
        if np.isfinite(sigma) and not self.flown:
            made = first_of_flight(made)
        if made.verdict == "update":
            return made, OneInUse(self.name, value, sigma, True), sigma
        if not np.isfinite(sigma):
            return made, self, self.sigma
        apart = (value - self.value) ** 2
        moved = self.sigma**2 + max(apart - self.sigma**2 - sigma**2, 0.0)
        return made, self, float(np.sqrt(min(moved, sigma**2 + apart)))


def first_of_flight(made: Decision) -> Decision:
    """Return the decision to take what the flight tells for the first time: no product was made before."""
    better = made.present_sigma / made.sigma
    return replace(
        made,
        verdict="update",
        reason=f"the first value that the flight tells, known {better:.3g} times better than on the ground",
    )
