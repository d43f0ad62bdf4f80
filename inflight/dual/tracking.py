"""Trainings through the mission: states and units keep their numbers, and a training as a table.

Takes an earlier and a later training; makes the later one with the earlier one's numbers of states and units
and its constant part, and how the corrections changed. Each training holds by its own readings alone:
averaged with earlier ones it would lag behind a unit that ages slowly, each time by less than the noise
shows, and state too small an error.

States are matched by their differences after a common shift; units by the states in which they are switched.
The tables are Datasets, certified and with a validity in the archive; the names of their variables are fixed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy
import xarray as xr

from inflight.arrays import Floats
from inflight.dual.segments import DriftRate
from inflight.dual.states import squared_distance
from inflight.dual.training import Training, relative_to
from inflight.errors import CalibrationError


@dataclass(frozen=True, kw_only=True)
class ContinuationSettings:
    """Numbers of the match of two trainings.

    Attributes
    ----------
    missed : float
        Chance that the same state is not recognised in a later training, of all its states; and that an
        unchanged correction counts as aged. Level of significance.
    least_match : float
        Part of the time observed that a match explains at least, and part of the best match's time from
        which others are its rivals. Derived: by the vector of one unit states are shifted onto each other,
        too, but half of them at most.
    """

    missed: float = 1e-3
    least_match: float = 0.5


CONTINUATION_SETTINGS = ContinuationSettings()


@dataclass(frozen=True, kw_only=True)
class ContinuedTraining:
    """How a later training compares with an earlier one.

    Attributes
    ----------
    training : Training
        The later one with the earlier one's numbers and constant part.
    matched : ndarray of int64, shape (pair, 2)
        Places of a state in the earlier and the later training.
    shift : ndarray, shape (axis,)
        By how much the difference drifted in between, the same for all states, nT.
    change, sigma : ndarray, shape (pair, axis)
        Change of the correction, less that of all together where one is relative, and its standard
        deviation, nT.
    aged : ndarray of bool, shape (pair,)
        The change exceeds what noise makes.
    """

    training: Training
    matched: npt.NDArray[np.int64]
    shift: Floats
    change: Floats
    sigma: Floats
    aged: npt.NDArray[np.bool_]


def continue_training(earlier: Training, later: Training) -> ContinuedTraining:
    """Return a later training that continues an earlier one.

    Parameters
    ----------
    later : Training
        As it was made, or as it continued any other one before: `standalone_training` is taken of it.

    Notes
    -----
    States are matched by their differences after a common shift, the one that matches most states; a state
    that has none takes the next number that no training before had. The corrections become relative to the
    same state as before where both know it. A constant part that is known for the earlier one only is taken
    over: its error grows by the common shift, which may be the offset of either sensor.
    """
    later = standalone_training(later)
    matched, shift = _matched(earlier, later)
    number, next_number = _numbered(matched, earlier.number, len(later), earlier.next_number)
    old, own = earlier.correction[matched[:, 0]], later.correction[matched[:, 1]]
    total = earlier.covariance[matched[:, 0]] + later.covariance[matched[:, 1]] + 1e-12 * np.eye(3)
    common = np.zeros(3)
    if len(old) and not (earlier.constant_known and later.constant_known):
        # Both may be relative to different states.
        weight = np.linalg.inv(total + 1e-6 * np.trace(total.mean(axis=0)) * np.eye(3) + 1e-12 * np.eye(3))
        common = np.linalg.solve(weight.sum(axis=0), np.einsum("pij,pj->i", weight, own - old))
    change = own - (old + common)
    distance = np.einsum("pi,pij,pj->p", change, np.linalg.inv(total), change)
    aged = np.asarray(distance > scipy.stats.chi2.isf(CONTINUATION_SETTINGS.missed / max(len(matched), 1), 3))
    reference = -1 if later.reference < 0 else int(number[later.number == later.reference][0])
    training = replace(later, number=number, reference=reference, next_number=next_number)
    training = _with_units(earlier, training, matched)
    training = _with_constant(earlier, training, matched[~aged], shift)
    return ContinuedTraining(
        training=training,
        matched=matched,
        shift=shift,
        change=change,
        sigma=np.sqrt(np.einsum("pii->pi", total)),
        aged=aged,
    )


def standalone_training(training: Training) -> Training:
    """Return a training as it was made, without numbers and constant of those before it."""
    count, units = len(training), len(training.unit)
    own = replace(
        training,
        number=np.arange(count),
        unit_number=np.arange(units),
        next_number=count,
        next_unit=units,
    )
    if not count or (training.constant_known and not training.carried):
        return own
    return relative_to(own, int(np.argmax(training.seconds)))


def _numbered(
    matched: npt.NDArray[np.int64], known: npt.NDArray[np.int64], count: int, free: int
) -> tuple[npt.NDArray[np.int64], int]:
    """Return numbers of `count` things, those matched with known ones theirs, and the next free number."""
    number = np.full(count, -1, dtype=np.int64)
    number[matched[:, 1]] = known[matched[:, 0]]
    new = number < 0
    number[new] = free + np.arange(np.count_nonzero(new))
    return number, free + int(np.count_nonzero(new))


def _with_units(earlier: Training, later: Training, matched: npt.NDArray[np.int64]) -> Training:
    """Return the later training with the earlier one's numbers of units, switched on and off alike.

    Two units are the same when they are switched in the same of the states that both know, or in the other
    ones: which of its two states is "on" is a convention.
    """
    before, after = earlier.occupancy[matched[:, 0]], later.occupancy[matched[:, 1]]
    same, inverted = [], np.zeros(after.shape[1], dtype=bool)
    switching = [one for one in range(before.shape[1]) if len(before) and np.ptp(before[:, one])]
    for one, other, sign in product(switching, range(after.shape[1]), (1, -1)):
        if not np.ptp(before[:, one] - sign * after[:, other]):
            same.append((one, other))
            inverted[other] = sign < 0
    pairs = np.array(same, dtype=np.int64).reshape(-1, 2)
    # Two that always switched together cannot be distinguished: either may be the same as before.
    first, second = (np.bincount(column)[column] if column.size else column for column in pairs.T)
    single = (first == 1) & (second == 1)
    inverted[pairs[~single, 1]] = False
    pairs = pairs[single]
    number, free = _numbered(pairs, earlier.unit_number, len(later.unit), earlier.next_unit)
    signs = np.where(inverted, -1, 1)
    occupancy = np.where(inverted, later.occupancy.max(axis=0, initial=0) - later.occupancy, later.occupancy)
    known = replace(
        later,
        unit_number=number,
        next_unit=free,
        occupancy=occupancy,
        unit=later.unit * signs[:, None],
        unit_correction=later.unit_correction * signs[:, None],
    )
    if not len(signs):
        return known
    value = later.value * signs[:, None]
    joint = later.joint * signs[:, None, None, None] * signs[None, None, :, None]
    return replace(known, design=occupancy.astype(np.float64), value=value, joint=joint)


def _with_constant(
    earlier: Training, later: Training, same: npt.NDArray[np.int64], shift: Floats
) -> Training:
    """Return the later training with the earlier one's constant part, or relative to the same state.

    Parameters
    ----------
    same : ndarray of int64, shape (pair, 2)
        Places of the states that have not changed; without any there is no common constant.
    """
    if later.constant_known or not len(same):
        return later
    size = np.einsum("pii->p", earlier.covariance[same[:, 0]])
    known = np.flatnonzero(earlier.number[same[:, 0]] == earlier.reference)
    # The state whose error is the smallest; the reference has none.
    link = int(known[0]) if known.size else int(np.argmin(size))
    one, other = same[link]
    if earlier.reference >= 0 and not known.size:
        return later
    joined = relative_to(later, int(later.number[other]))
    if not earlier.constant_known:
        return joined
    spread = earlier.covariance[one] + np.diag(shift**2)
    return replace(
        joined,
        correction=joined.correction + earlier.correction[one],
        covariance=joined.covariance + spread,
        reference=-1,
        constant_known=True,
        carried=True,
    )


def _matched(earlier: Training, later: Training) -> tuple[npt.NDArray[np.int64], Floats]:
    """Return pairs of the same state and the common shift; none when it is not clear.

    Of shifts that match half as much as the best one the smallest is taken, if it matches half of the time
    and is clearly the smallest: one state alone, after the difference has moved by half the distance to the
    next one, could be either.
    """
    nothing = np.empty((0, 2), dtype=np.int64), np.zeros(3)
    apart = later.centre[None] - earlier.centre[:, None]
    scatter = (earlier.scatter**2 + later.scatter**2) * np.eye(3)
    spread = earlier.centre_covariance[:, None] + later.centre_covariance[None] + scatter
    limit = scipy.stats.chi2.isf(CONTINUATION_SETTINGS.missed / max(len(later), 1), 3)
    rows, columns = np.flatnonzero(earlier.observed), np.flatnonzero(later.observed)
    between, width = apart[np.ix_(rows, columns)], spread[np.ix_(rows, columns)]
    tried: list[tuple[float, float, Floats, Floats]] = []
    # Each pair of observed states gives a shift to try; its noise is that of the pair.
    for one, other in np.ndindex(between.shape[:2]):
        shift = between[one, other]
        residual = between - shift
        weight_of = np.linalg.inv(width + width[one, other])
        distance = np.einsum("kli,klij,klj->kl", residual, weight_of, residual)
        pairs = _nearest_pairs(distance, limit)
        weight = float(later.seconds[columns[pairs[:, 1]]].sum())
        tried.append((weight, float(np.linalg.norm(shift)), shift, width[one, other]))
    if not tried:
        return nothing
    most = max(one[0] for one in tried)
    # By the vector of one unit states are shifted onto each other as well, but half of them at most.
    rivals = sorted(
        (one for one in tried if one[0] >= CONTINUATION_SETTINGS.least_match * most), key=lambda one: one[1]
    )
    weight, size, shift, own = rivals[0]
    # Shifts of one and the same matching differ by their noise only.
    others = [one[1] for one in rivals if squared_distance(one[2] - shift, own + one[3]) > limit]
    if weight < CONTINUATION_SETTINGS.least_match * later.seconds.sum() or (
        others and size > 0.5 * min(others)
    ):
        return nothing
    residual = apart - shift
    distance = np.einsum("kli,klij,klj->kl", residual, np.linalg.inv(spread + own), residual)
    pairs = _nearest_pairs(distance, limit)
    precision = np.linalg.inv(spread[pairs[:, 0], pairs[:, 1]])
    right = np.einsum("pij,pj->i", precision, apart[pairs[:, 0], pairs[:, 1]])
    return pairs, np.asarray(np.linalg.solve(precision.sum(axis=0), right))


def _nearest_pairs(distance: Floats, limit: float) -> npt.NDArray[np.int64]:
    """Return pairs that are each other's nearest, within a limit."""
    to = distance.argmin(axis=1)
    back = distance.argmin(axis=0)
    own = np.arange(len(distance))
    mutual = (back[to] == own) & (distance[own, to] < limit)
    return np.stack([own[mutual], to[mutual]], axis=1)


_VERSION = 2

#: Dims of the arrays of a training, and their units.
_ARRAYS = {
    "number": (("state",), ""),
    "centre": (("state", "axis"), "nT"),
    "centre_covariance": (("state", "axis", "other"), "nT2"),
    "correction": (("state", "axis"), "nT"),
    "covariance": (("state", "axis", "other"), "nT2"),
    "segments": (("state",), ""),
    "seconds": (("state",), "s"),
    "transitions": (("state", "next"), ""),
    "occupancy": (("state", "unit"), ""),
    "unit": (("unit", "axis"), "nT"),
    "unit_correction": (("unit", "axis"), "nT"),
    "unit_covariance": (("unit", "axis", "other"), "nT2"),
    "drift": (("axis",), "nT"),
    "design": (("state", "parameter"), ""),
    "value": (("parameter", "axis"), "nT"),
    "joint": (("parameter", "axis", "other_parameter", "other"), "nT2"),
    "unit_number": (("unit",), ""),
}

#: Fields of `DriftRate`: names of their variables, and units.
_RATES = {
    "slope": ("drift_slope", "nT2 s-2"),
    "slope_walk": ("drift_bend", "nT2 s-3"),
    "level_walk": ("drift_value", "nT2 s-1"),
}

_NUMBERS = ("scatter", "excess")


def training_to_dataset(training: Training) -> xr.Dataset:
    """Return a training as a Dataset: dims state, next, unit, parameter, axis, other, other_parameter.

    The states' numbers are the variable ``number``; ``start`` and ``end`` are those of the readings, TT2000.
    """
    arrays: dict[str, Any] = {
        name: (dims, getattr(training, name), {"units": unit} if unit else {})
        for name, (dims, unit) in _ARRAYS.items()
    }
    for field, (name, unit) in _RATES.items():
        arrays[name] = (("axis",), getattr(training.drift_rate, field), {"units": unit})
    for name in ("start", "end"):
        arrays[name] = ((), np.int64(getattr(training, name)), {"scale": "TT2000"})
    attrs: dict[str, Any] = {name: float(getattr(training, name)) for name in _NUMBERS}
    attrs |= {
        "dual_training": _VERSION,
        "constant_known": int(training.constant_known),
        "reference": int(training.reference),
        "next_number": int(training.next_number),
        "next_unit": int(training.next_unit),
        "carried": int(training.carried),
        "sureness": float(training.confidence),
        "reason": training.reason,
    }
    axes = {"axis": ["x", "y", "z"], "other": ["x", "y", "z"]}
    return xr.Dataset(arrays, coords=axes, attrs=attrs)


def training_from_dataset(table: xr.Dataset) -> Training:
    """Return the training of a Dataset that `training_to_dataset` made.

    Raises
    ------
    CalibrationError
        The Dataset is no training, or of a later version.
    """
    version = table.attrs.get("dual_training")
    if version != _VERSION:
        raise CalibrationError(
            f"version {version} of a table of two sensors' states found, {_VERSION} expected",
            remedy="train anew, or take the table of a training",
        )
    arrays: dict[str, Any] = {name: np.asarray(table[name].values) for name in _ARRAYS}
    numbers: dict[str, Any] = {name: float(table.attrs[name]) for name in _NUMBERS}
    rate = DriftRate(**{field: np.asarray(table[name].values) for field, (name, _) in _RATES.items()})
    return Training(
        **arrays,
        **numbers,
        drift_rate=rate,
        start=int(table["start"]),
        end=int(table["end"]),
        constant_known=bool(table.attrs["constant_known"]),
        reference=int(table.attrs["reference"]),
        next_number=int(table.attrs["next_number"]),
        next_unit=int(table.attrs["next_unit"]),
        carried=bool(table.attrs["carried"]),
        # Older tables do not have it.
        confidence=float(table.attrs.get("sureness", 1.0)),
        reason=str(table.attrs["reason"]),
    )
