"""Which values are used: updates from interval to interval, and the table of all twelve parameters.

Takes: every interval's estimate of the eight spin-related parameters with its covariance, the values in use,
and values from elsewhere (the offset along the spin axis, the ground). Makes: `Decision` on each parameter,
the next `SpinParametersInUse`, and `ParameterTable` with where each of the twelve came from.

An update that is no better known than what it replaces, or that changes it by less than its own error, only
adds jitter (Plaschke et al. 2019, sections 6 and 8). Offset and elevation of a sensor share one tone (eq. 21)
and are separated poorly: they are decided together, by their common covariance. What is replaced is the
estimate given everything that is kept: else a tone that both share would come back.

Errors here are those for given values of `HELD`, the four that leave no tone: they are common to all
intervals. `join_parameters` adds what the errors of these make of the eight.

The spin determines eight of the twelve. The offset along the spin axis comes from `inflight.zero_level`,
gains and the rotation about the spin axis from the ground or from a model of the Earth's field.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.spin.equation import PARAMETER_NAMES, SPIN_RELATED, CalibrationParameters
from inflight.spin.intervals import Bools

UpdateAction = Literal["update", "confirm", "keep"]


@dataclass(frozen=True, kw_only=True)
class UpdateSettings:
    """When a value in use is replaced.

    Attributes
    ----------
    significance : float
        A change counts from this many standard deviations on. Level of significance: 0.3 %.
    well_better : float
        A value is known well better with this part of the other's error. Derived: of two that are known alike
        the difference scatters by more than the error of one: every thirtieth would be replaced by noise.
    """

    significance: float = 3.0
    well_better: float = 0.5


UPDATE_SETTINGS = UpdateSettings()


@dataclass(frozen=True, kw_only=True)
class Decision:
    """What becomes of one parameter.

    Attributes
    ----------
    name : str
    present, present_sigma, new, sigma : float
        Value in use, its uncertainty, and the new estimate with its own.
    verdict : {"update", "confirm", "keep"}
        Take the new value; keep the value with a smaller error; keep both.
    reason : str
    """

    name: str
    present: float
    present_sigma: float
    new: float
    sigma: float
    verdict: UpdateAction
    reason: str


def decide_update(
    name: str,
    old: tuple[float, float],
    new: tuple[float, float],
    significance: float = UPDATE_SETTINGS.significance,
) -> Decision:
    """Return the decision on one parameter.

    A value is replaced where it differs by more than `significance` of the new sigma and the new one is known
    well better, or where the two contradict each other beyond both errors.

    Parameters
    ----------
    name : str
    old, new : tuple of float
        Value and sigma in use, infinite where not known at all, and of the new estimate, infinite where it
        was not determined.
    significance : float
    """
    sigma = new[1]

    def decision(verdict: UpdateAction, reason: str) -> Decision:
        return Decision(
            name=name,
            present=old[0],
            present_sigma=old[1],
            new=new[0],
            sigma=sigma,
            verdict=verdict,
            reason=reason,
        )

    if not (np.isfinite(sigma) and np.isfinite(new[0])):
        return decision("keep", "the record does not tell it")
    change = abs(new[0] - old[0])
    difference = f"differs by {change / sigma:.1f} sigma" if sigma > 0.0 else f"differs by {change:.3g}"
    if change > significance * sigma and sigma < UPDATE_SETTINGS.well_better * old[1]:
        return decision("update", f"{difference}, and is known well better than the value in use")
    if change > significance * float(np.hypot(sigma, old[1])):
        return decision("update", f"{difference}, more than both uncertainties allow")
    if sigma < old[1]:
        return decision("confirm", f"{difference}: a new value would only add jitter")
    return decision(
        "keep", f"{difference} but is known no better than the value in use: it would only add jitter"
    )


#: Parameters that share a tone.
_TOGETHER = (("offset[1]", "elevation[1]"), ("offset[2]", "elevation[2]"))

#: As rare by chance, of two numbers, as `UpdateSettings.significance` sigma of one.
_RARE_CHI2 = -2.0 * math.log(math.erfc(UPDATE_SETTINGS.significance / math.sqrt(2.0)))


@dataclass(frozen=True)
class SpinParametersInUse:
    """Values in use of the eight, in the order of `SPIN_RELATED`, before an interval.

    Attributes
    ----------
    value : ndarray, shape (8,)
    covariance : ndarray, shape (8, 8)
        As it was when each was put in.
    from_flight : ndarray of bool, shape (8,)
        True for what the flight has determined; the rest is as it was on the ground.
    since : ndarray, shape (8,)
        When each was put in, days.
    drift : Drift
        How fast values move, by later estimates.
    """

    value: Floats
    covariance: Floats
    from_flight: Bools
    since: Floats
    drift: Drift

    @classmethod
    def from_ground(cls, ground: CalibrationParameters, sigma: Mapping[str, float]) -> Self:
        """Return what is used before the flight."""
        value = ground.spin_related()
        errors = np.array([sigma[name] for name in SPIN_RELATED])
        none = np.zeros(value.size)
        return cls(value, np.diag(errors**2), none.astype(np.bool_), none, Drift(none, none))

    def update(self, value: Floats, covariance: Floats, determined: Bools, day: float) -> UpdateStep:
        """Decide on an interval's estimate.

        Parameters
        ----------
        value, covariance : ndarray, shape (8,) and (8, 8)
            The interval's own estimate, on top of what was known before the flight.
        determined : ndarray of bool, shape (8,)
            Parameters that the interval knows better than the ground did.
        day : float
            Of the interval, counted from any.

        Returns
        -------
        UpdateStep
        """
        estimate, own = self._given(value, covariance, ~determined)
        sigma = np.where(determined, np.sqrt(np.diag(own)), np.inf)
        in_use = np.sqrt(np.diag(self.covariance))
        made = {
            name: decide_update(
                name,
                (float(self.value[at]), float(in_use[at])),
                (float(estimate[at]), float(sigma[at])),
            )
            for at, name in enumerate(SPIN_RELATED)
        }
        for at in np.flatnonzero(determined & ~self.from_flight):
            made[SPIN_RELATED[at]] = accept_first_value(made[SPIN_RELATED[at]], "by the tones known")
        for pair in _TOGETHER:
            places = [SPIN_RELATED.index(name) for name in pair]
            if determined[places].all() and self.from_flight[places].all():
                made |= self._decide_together(pair, [made[name] for name in pair], estimate, own)
        decisions = tuple(made[name] for name in SPIN_RELATED)
        put_in = np.array([one.verdict == "update" for one in decisions])
        new, spread = self._given(value, covariance, ~put_in)
        drift = self.drift.with_difference(
            estimate - self.value,
            np.diag(self.covariance) + np.diag(own),
            day - self.since,
            determined & self.from_flight,
        )
        used = SpinParametersInUse(
            np.where(put_in, new, self.value),
            spread,
            self.from_flight | put_in,
            np.where(put_in, day, self.since),
            drift,
        )
        return UpdateStep(
            decisions, used, used.stated_covariance(estimate, own, determined & ~put_in, day), estimate, sigma
        )

    def stated_covariance(self, estimate: Floats, own: Floats, determined: Bools, day: float) -> Floats:
        """Return the covariance to be stated for an interval; (8, 8).

        A value that is kept drifts on as values did so far. The difference of the interval's estimate beyond
        both errors is added; the estimate's own error and the difference bound the error from above.
        """
        variance, apart = np.diag(self.covariance), estimate - self.value
        moved = variance + np.where(self.from_flight, self.drift.rate * (day - self.since), 0.0)
        beyond = np.maximum(apart**2 - moved - np.diag(own), 0.0)
        now = np.where(determined, np.minimum(moved + beyond, np.diag(own) + apart**2), moved)
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

    def _decide_together(
        self, pair: tuple[str, str], made: list[Decision], estimate: Floats, own: Floats
    ) -> dict[str, Decision]:
        """Return the decisions on two that share a tone: both are replaced, or none."""
        places = [SPIN_RELATED.index(name) for name in pair]
        apart = (estimate - self.value)[places]
        inside = np.ix_(places, places)
        size = float(apart @ np.linalg.solve(self.covariance[inside] + own[inside], apart))
        if size <= _RARE_CHI2 and all(one.verdict != "update" for one in made):
            return {}
        other = dict(zip(pair, reversed(pair), strict=True))
        why = (
            f"offset and elevation together differ by chi2 {size:.1f} of two numbers"
            if size > _RARE_CHI2
            else ""
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
    """How fast values move: a random walk whose variance grows with time, from all later estimates.

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

    def with_difference(self, apart: Floats, variance: Floats, age: Floats, determined: Bools) -> Drift:
        """Return the sums with one more difference (8,) of this variance without drift, `age` days old."""
        weight = np.where(determined & (age > 0.0), 1.0 / (variance + self.rate * age) ** 2, 0.0)
        return Drift(self.square + weight * (apart**2 - variance), self.time + weight * age)


@dataclass(frozen=True)
class UpdateStep:
    """An interval's estimate, the decisions on it, and what is used from then on.

    Attributes
    ----------
    decisions : tuple of Decision
        In the order of `SPIN_RELATED`.
    used : ValuesInUse
        From this interval on.
    covariance : ndarray, shape (8, 8)
        To be stated for this interval.
    estimate, sigma : ndarray, shape (8,)
        The interval's own estimate, given what it does not determine, and its error, infinite there.
    """

    decisions: tuple[Decision, ...]
    used: SpinParametersInUse
    covariance: Floats
    estimate: Floats
    sigma: Floats


@dataclass(frozen=True)
class ValueInUse:
    """One value in use that is correlated with no other, as the offset along the spin axis."""

    name: str
    value: float
    sigma: float
    from_flight: bool = False

    def update(self, value: float, sigma: float) -> tuple[Decision, ValueInUse, float]:
        """Return the decision on a new value, what is used from now on, and the error to be stated."""
        made = decide_update(self.name, (self.value, self.sigma), (value, sigma))
        if np.isfinite(sigma) and not self.from_flight:
            made = accept_first_value(made)
        if made.verdict == "update":
            return made, ValueInUse(self.name, value, sigma, True), sigma
        if not np.isfinite(sigma):
            return made, self, self.sigma
        apart = (value - self.value) ** 2
        moved = self.sigma**2 + max(apart - self.sigma**2 - sigma**2, 0.0)
        return made, self, float(np.sqrt(min(moved, sigma**2 + apart)))


def _rounded_times(ratio: float) -> str:
    """Return a ratio to two digits, without a power of ten: 2.6, 38, 26000."""
    return f"{float(f'{ratio:.2g}'):.15g}"


def accept_first_value(made: Decision, known: str = "known") -> Decision:
    """Return the decision to take a first value of the flight: no product was made before it.

    `known` says how: sigmas of the eight are those for given values of `HELD`.
    """
    better = made.present_sigma / made.sigma
    times = _rounded_times(better)
    return replace(
        made,
        verdict="update",
        reason=f"the first value that the flight tells, {known} {times} times better than on the ground",
    )


#: Sources of values.
GROUND, SPIN = "ground", "spin"


@dataclass(frozen=True)
class ExternalValue:
    """A value from elsewhere: `value` and `sigma` in the parameter's unit, and `source`, such as a method."""

    value: float
    sigma: float
    source: str


@dataclass(frozen=True)
class ParameterTable:
    """The twelve parameters in the order of `NAMES`.

    Attributes
    ----------
    value, sigma : ndarray, shape (12,)
    source : tuple of 12 str
        ``ground``, ``spin``, or the method that was given.
    determined : ndarray of bool, shape (12,)
        False for what remains at its ground value.
    """

    value: Floats
    sigma: Floats
    source: tuple[str, ...]
    determined: npt.NDArray[np.bool_]

    @property
    def parameters(self) -> CalibrationParameters:
        """The values as parameters of the calibration equation."""
        return CalibrationParameters.from_values(self.value)

    def sigmas(self) -> dict[str, float]:
        """Return the uncertainties by name."""
        return dict(zip(PARAMETER_NAMES, self.sigma.tolist(), strict=True))


def join_parameters(
    spin: tuple[Floats, Floats, CalibrationParameters],
    ground: CalibrationParameters,
    ground_sigma: Mapping[str, float],
    others: Mapping[str, ExternalValue] | None = None,
) -> ParameterTable:
    """Join the spin's eight parameters with the axial offset and the values of the ground.

    Tones tell the eight for given values of the four of `HELD`. Where other values of these are put in, the
    eight move along (`held_slopes`), and their errors become those of the eight by the same slopes.

    Parameters
    ----------
    spin : tuple of (ndarray (8,), ndarray (8,), CalibrationParameters)
        Values, sigmas for given values of `HELD` (infinite for what is not determined) and parameters of an
        estimate.
    ground : CalibrationParameters
        Before flight, or of the table before.
    ground_sigma : mapping of str to float
        By name; what is not named is not known at all.
    others : mapping of str to ExternalValue, optional
        The spin-axis offset ``offset[3]`` in the unit of the readings, and whatever else is known better than
        on the ground: gains, rotation.

    Raises
    ------
    CalibrationError
        A name that is no parameter, or one that the spin determines.
    """
    others = others or {}
    wrong = sorted(name for name in others if name not in PARAMETER_NAMES or name in SPIN_RELATED)
    if wrong:
        raise CalibrationError(
            f"{wrong} cannot be joined", remedy=f"take of {sorted(set(PARAMETER_NAMES) - set(SPIN_RELATED))}"
        )
    value, sigma = ground.values(), np.array([ground_sigma.get(name, np.inf) for name in PARAMETER_NAMES])
    source = [GROUND] * len(PARAMETER_NAMES)
    for name, known in others.items():
        at = PARAMETER_NAMES.index(name)
        value[at], sigma[at], source[at] = known.value, known.sigma, known.source
    found, errors, parameters = spin
    for order, name in enumerate(SPIN_RELATED):
        at = PARAMETER_NAMES.index(name)
        if np.isfinite(errors[order]):
            value[at], sigma[at], source[at] = found[order], errors[order], SPIN
    held = [PARAMETER_NAMES.index(name) for name in HELD]
    slopes = held_slopes(parameters)
    moved = slopes @ (value[held] - parameters.values()[held])
    errors_held = np.where(np.isfinite(sigma[held]), sigma[held], 0.0)
    added = np.sqrt(np.sum((slopes * errors_held) ** 2, axis=1))
    for order, name in enumerate(SPIN_RELATED):
        at = PARAMETER_NAMES.index(name)
        if source[at] == SPIN:
            value[at] += moved[order]
            sigma[at] = float(np.hypot(sigma[at], added[order]))
    determined = np.array([each != GROUND for each in source])
    return ParameterTable(value, sigma, tuple(source), determined)


#: The four that leave no tone: an estimate of the eight holds for given values of these.
HELD = ("spin_plane_gain", "axial_gain", "rotation", "offset[3]")

#: Step of the derivative of the coupling matrix by gains and angles; its error is of second order.
_STEP = 1e-6


def held_slopes(parameters: CalibrationParameters) -> Floats:
    """Return by how much the eight move with each of `HELD`, so that the tones stay as they are.

    A field ``D B`` with ``D`` a turn about the spin axis, a factor in the spin plane and one along the axis
    has no tones where B has none: the eight that go with other gains and another rotation are those of the
    coupling matrix ``D C``. Of the offsets the tones hold the part in the spin plane, that of ``C O``.

    Returns
    -------
    ndarray, shape (8, 4)
        Rows in the order of `SPIN_RELATED`, columns in that of `HELD`.
    """
    shape, change = _changes_without_tones(parameters)
    by_held = change @ np.linalg.inv(change[[shape.index(name) for name in HELD[:3]]])
    matrix, out = parameters.matrix(), np.zeros((len(SPIN_RELATED), len(HELD)))
    for row, name in enumerate(SPIN_RELATED):
        if name in shape:
            out[row, :3] = by_held[shape.index(name)]
    out[_SPIN_PLANE_OFFSETS, 3] = -np.linalg.solve(matrix[:2, :2], matrix[:2, 2])
    return out


def held_response(parameters: CalibrationParameters) -> Floats:
    """Return what each of `HELD` does to the despun field, when the eight move along (`held_slopes`).

    Returns
    -------
    ndarray, shape (4, 4)
        Rows: a factor in the spin plane, one along the axis, a turn about it (rad), a field along it (nT).
        Columns in the order of `HELD`.
    """
    shape, change = _changes_without_tones(parameters)
    out = np.zeros((len(HELD), len(HELD)))
    out[:3, :3] = np.linalg.inv(change[[shape.index(name) for name in HELD[:3]]])
    offsets = np.append(held_slopes(parameters)[_SPIN_PLANE_OFFSETS, 3], 1.0)
    out[3, 3] = -(parameters.matrix() @ offsets)[2]
    return out


_SPIN_PLANE_OFFSETS = [SPIN_RELATED.index(f"offset[{axis}]") for axis in (1, 2)]


def _changes_without_tones(parameters: CalibrationParameters) -> tuple[list[str], Floats]:
    """Return all but the offsets, and how they change with a factor in the plane, one along z, and a turn."""
    shape = [name for name in PARAMETER_NAMES if not name.startswith("offset")]
    columns = []
    for name in shape:
        value = parameters.values()[PARAMETER_NAMES.index(name)]
        up, down = (parameters.changed({name: value + way * _STEP}).matrix() for way in (1.0, -1.0))
        columns.append((up - down).ravel() / (2.0 * _STEP))
    matrix = parameters.matrix()
    plane, along = np.diag([1.0, 1.0, 0.0]), np.diag([0.0, 0.0, 1.0])
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    without_tones = np.stack([(one @ matrix).ravel() for one in (plane, along, turn)], axis=1)
    return shape, np.asarray(np.linalg.solve(np.stack(columns, axis=1), without_tones))
