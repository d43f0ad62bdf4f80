"""What a diagnosis rests on besides its table: every step's worth, cross-talk, values of what was not taken.

All of it is algebra on the evidence of a finished search; nothing here changes the search.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.diagnosis import Coefficient
from inflight.diagnosis.estimates import estimate, mimics, within_and_raw
from inflight.diagnosis.material import Material, held_out, of_known_rows
from inflight.diagnosis.search import Option, Search
from inflight.effects.coefficients import coefficient_unit
from inflight.estimators.absorption import correlation_of, gram_inverse

#: Parameters of a cross-talk matrix at most; candidates whose values are worked out.
MOST_PARAMETERS, MOST_TRIALS = 42, 16


@dataclass(frozen=True)
class Step:
    """One effect's part in how the held-out error falls.

    Attributes
    ----------
    name, family : str
    before, after : float
        Held-out rms without and with it, in the order the effects were taken, nT.
    first_in, last_in : float
        What it takes off the mean square when it is taken first, and when it is taken last, nT^2.
    """

    name: str
    family: str
    before: float
    after: float
    first_in: float
    last_in: float

    @property
    def removed(self) -> float:
        """What it takes off the mean square in the order the effects were taken, nT^2."""
        return self.before**2 - self.after**2


def waterfall(search: Search, material: Material) -> list[Step]:
    """Return how the held-out error falls with every effect the search took."""
    taken, known = list(search.accepted), of_known_rows(search, material)

    def size(options: Sequence[Option]) -> float:
        return held_out(search.holding(options), known)

    sizes = [size(taken[:count]) for count in range(len(taken) + 1)]
    out = []
    for place, option in enumerate(taken):
        first = sizes[0] ** 2 - size([option]) ** 2
        others = [one for one in taken if one is not option]
        last = size(others) ** 2 - sizes[-1] ** 2
        out.append(Step(option.name, option.family, sizes[place], sizes[place + 1], first, last))
    return out


# Cross-talk.


@dataclass(frozen=True)
class CrossTalk:
    """How parameters answer for each other.

    Attributes
    ----------
    names : tuple of str
        Calibration, then refined, then found.
    groups : tuple of str
        ``calibration``, ``model`` or ``found`` of each.
    correlation : ndarray, shape (parameter, parameter)
        Of their errors, the whole span as one calibration interval; 0 where data say nothing.
    """

    names: tuple[str, ...]
    groups: tuple[str, ...]
    correlation: Floats


def cross_talk(search: Search) -> CrossTalk:
    """Return the signed correlations of the parameters' errors.

    Of many refined parameters only those that are most correlated with the others are kept.
    """
    base = [(name, sigma) for term in search.library.base for name, sigma in _known(term.columns, term.sigma)]
    refined = [
        (name, sigma) for term in search.library.refined for name, sigma in _known(term.columns, term.sigma)
    ]
    found = [(name, np.inf) for option in search.accepted for name in option.columns]
    every = [*base, *refined, *found]
    if not every:
        return CrossTalk((), (), np.zeros((0, 0)))
    names = [name for name, _ in every]
    raw = search.raw
    place = raw.index(names)
    precision = search.precision(raw, names, np.array([sigma for _, sigma in every]))
    covariance = gram_inverse(raw.total[np.ix_(place, place)] + np.diag(precision))
    correlation = correlation_of(covariance)
    groups = ["calibration"] * len(base) + ["model"] * len(refined) + ["found"] * len(found)
    kept = _most_correlated(correlation, groups)
    return CrossTalk(
        tuple(names[one].removeprefix("model:") for one in kept),
        tuple(groups[one] for one in kept),
        correlation[np.ix_(kept, kept)],
    )


def _known(columns: Sequence[str], sigma: Sequence[float]) -> list[tuple[str, float]]:
    return list(zip(columns, sigma, strict=True))


def _most_correlated(correlation: Floats, groups: Sequence[str]) -> list[int]:
    fixed = [place for place, group in enumerate(groups) if group != "model"][:MOST_PARAMETERS]
    room = MOST_PARAMETERS - len(fixed)
    own = [place for place, group in enumerate(groups) if group == "model"]
    apart = np.abs(correlation - np.diag(np.diag(correlation)))
    strength = apart[:, fixed].max(axis=1, initial=0.0)
    chosen = sorted(own, key=lambda place: -strength[place])[:room]
    return sorted([*fixed, *chosen])


@dataclass(frozen=True)
class Shift:
    """What a found coefficient, ignored, does to the calibration; it is straight in the value.

    Attributes
    ----------
    effect, coefficient, unit : str
    value : float
    shifts : dict of str to float
        Calibration parameter -> its shift in the parameter's own physical unit.
    """

    effect: str
    coefficient: str
    unit: str
    value: float
    shifts: dict[str, float]


def shifts_of(search: Search, option: Option, coefficients: Sequence[Coefficient]) -> list[Shift]:
    """Return by how much the calibration shifts for the found value of each coefficient, were it ignored."""
    out = []
    for place, coefficient in enumerate(coefficients):
        gamma = np.zeros(len(option.columns))
        gamma[place] = coefficient.value
        found = mimics(search, option, gamma)
        out.append(Shift(option.name, coefficient.name, coefficient.unit, coefficient.value, dict(found)))
    return out


# Candidates that were not taken.


@dataclass(frozen=True)
class Trial:
    """A candidate put into the model alone.

    Attributes
    ----------
    retained : float
        Part of its variance that the model leaves.
    consistency : float or None
        W / k of the raw and the within-day values.
    values : tuple of (str, float, float, str)
        Coefficient, value, sigma, unit.
    """

    retained: float
    consistency: float | None
    values: tuple[tuple[str, float, float, str], ...]


def trials(search: Search, material: Material, names: Sequence[str]) -> dict[str, Trial]:
    """Return the values that candidates would have, each alone beside the model as it was.

    Changes bound to a time and candidates of many columns are left out: they have no value to print.
    """
    known = {option.name: option for option in search.options}
    out = {}
    for name in list(dict.fromkeys(names))[:MOST_TRIALS]:
        option = known.get(name)
        if option is None or option.change is not None:
            continue
        alone = search.holding([option])
        found = estimate(alone, option)
        values = tuple(
            (column.rsplit(".", 1)[-1], float(value), float(sigma), _unit(material, option, column))
            for column, value, sigma in zip(found.columns, found.value, found.sigma, strict=True)
        )
        out[name] = Trial(found.retained, within_and_raw(alone, option), values)
    return out


def _unit(material: Material, option: Option, column: str) -> str:
    for key in option.terms:
        term = material.terms[key]
        if column in term.columns:
            kind = type(term.entry.effect).parameters()[column[len(term.key) + 1 :].split("[", maxsplit=1)[0]]
            channel = term.entry.effect.channels[0] if term.entry.effect.channels else ""
            return coefficient_unit(kind, material.mission, channel) if channel else kind.unit
    return ""
