"""A model fitted anew from the evidence: what it holds free, was given, and has lost, all at once.

Only the columns that the model has are looked at, so that it takes milliseconds whatever the
library's size. A column of the model may be a combination of the library's: a lag between two of the
bank, or a parameter times a function of the block.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.estimates import sandwich
from inflight.diagnosis.evidence import Evidence, solve_scaled
from inflight.diagnosis.library import Term
from inflight.diagnosis.scoring import Present, folds_of, score


@dataclass(frozen=True)
class Column:
    """A column of the model made from those of the evidence.

    Attributes
    ----------
    name : str
    parts : tuple of (str, float)
        Columns of the evidence, of one scale, and their weights.
    factor : ndarray, shape (block,), optional
        Function of the block it is multiplied by.
    """

    name: str
    parts: tuple[tuple[str, float], ...]
    factor: Floats | None = None


@dataclass(frozen=True)
class Fitted:
    """Values of everything a model lets data move, in one fit.

    Attributes
    ----------
    value, sigma : dict of str to float
        Change of each column from where the evidence is linearised, physical units. The sigma knows
        how the residual is correlated between blocks, and is the prior's where data tell nothing.
    base_value, base_sigma : dict of str to float
        The same of the calibration's own columns, mean over its intervals.
    in_sample, held_out : float
        Sum of squares that is left over the sum of the weights, nT^2.
    """

    value: Mapping[str, float]
    sigma: Mapping[str, float]
    base_value: Mapping[str, float]
    base_sigma: Mapping[str, float]
    in_sample: float
    held_out: float


@dataclass(frozen=True)
class Ground:
    """What a fit stands on: the evidence as the library has it, and what the calibration absorbs.

    Attributes
    ----------
    raw : Evidence
    base, refined : tuple of Term
        What each interval fits anew; what the model lets data refine.
    intervals : sequence of sequence of int
        Blocks of each calibration interval.
    variance : float
        Of a row, nT^2; it weighs data against what is known beforehand.
    """

    raw: Evidence
    base: tuple[Term, ...]
    refined: tuple[Term, ...]
    intervals: Sequence[Sequence[int]]
    variance: float

    def fit(
        self,
        columns: Sequence[Column],
        fixed: Mapping[str, float] | None = None,
        *,
        interleaved: bool = False,
    ) -> Fitted:
        """Fit the model's own columns and more, all together.

        Parameters
        ----------
        columns : sequence of Column
            What was put into the model.
        fixed : mapping of str to float
            Columns of refined terms that are held at a change from where they are, physical units: an
            effect taken out of the model is one whose parameters are held at nothing.
        interleaved : bool
            Hold out every k-th block instead of runs: for effects that lie in few blocks.
        """
        whole, names, sigma = self._model_of(columns, fixed or {})
        evidence, present = self._beside(whole, names, sigma)
        value, covariance = self._solved(evidence, present)
        base = self._base(whole, names, value, covariance)
        y = evidence.residuals[0]
        scale = evidence.scale[present.columns]
        found = np.sqrt(np.clip(np.diag(covariance), 0.0, None)) * scale
        # A column of which nothing is left beside the calibration is known as well as beforehand.
        found = np.where(np.diagonal(evidence.total)[present.columns] > 0, found, np.asarray(sigma))
        left = evidence.total[y, y] + 2.0 * evidence.total[y, present.columns] @ value
        left += value @ evidence.total[np.ix_(present.columns, present.columns)] @ value
        rows = max(float(evidence.count.sum()), 1.0)
        held = score(evidence, present, [], y, folds_of(len(evidence), interleaved)).loss0.sum()
        return Fitted(
            dict(zip(names, (value * scale).tolist(), strict=True)),
            dict(zip(names, found.tolist(), strict=True)),
            *base,
            max(float(left), 0.0) / rows,
            max(float(held), 0.0) / rows,
        )

    def absorbed(self, columns: Sequence[Column], fixed: Mapping[str, float]) -> tuple[Evidence, Present]:
        """Return what the calibration leaves of the model's columns, and which they are with their priors.

        Those of `columns` come last.
        """
        return self._beside(*self._model_of(columns, fixed))

    def _model_of(
        self, columns: Sequence[Column], fixed: Mapping[str, float]
    ) -> tuple[Evidence, list[str], list[float]]:
        """Return the evidence of calibration and model, names of the model's columns, and their priors."""
        free = [
            (name, sigma)
            for term in self.refined
            for name, sigma in zip(term.columns, term.sigma, strict=True)
            if name not in fixed
        ]
        names = [name for name, _ in free] + [one.name for one in columns]
        sigma = [sigma for _, sigma in free] + [np.inf] * len(columns)
        return combined(self.raw, [*self._base_names, *(n for n, _ in free)], columns, fixed), names, sigma

    def _beside(
        self, whole: Evidence, names: Sequence[str], sigma: Sequence[float]
    ) -> tuple[Evidence, Present]:
        gone = self._base_names
        evidence = whole.absorbed(gone, self.intervals, self._precision(whole, gone, self._base_sigma))
        return evidence, Present(evidence.index(names), self._precision(evidence, names, np.array(sigma)))

    @property
    def _base_names(self) -> list[str]:
        return [name for term in self.base for name in term.columns]

    @property
    def _base_sigma(self) -> Floats:
        return np.array([sigma for term in self.base for sigma in term.sigma])

    def _precision(self, evidence: Evidence, names: Sequence[str], sigma: Floats) -> Floats:
        scale = evidence.scale[evidence.index(names)]
        with np.errstate(divide="ignore"):
            return np.asarray(np.where(np.isfinite(sigma), self.variance * (scale / sigma) ** 2, 0.0))

    def _solved(self, evidence: Evidence, present: Present) -> tuple[Floats, Floats]:
        """Return values and covariance of the model's columns, scaled."""
        p = present.columns
        if not p.size:
            return np.zeros(0), np.zeros((0, 0))
        value, covariance = sandwich(evidence, present, evidence.residuals[0])
        # What is known beforehand is uncertain, too: a column the data do not see keeps its prior's sigma.
        inner = evidence.total[np.ix_(p, p)] + np.diag(present.precision)
        inverse = solve_scaled(inner, np.eye(p.size))
        return value, covariance + self.variance * (inverse * present.precision) @ inverse

    def _base(
        self, whole: Evidence, names: Sequence[str], value: Floats, covariance: Floats
    ) -> tuple[dict[str, float], dict[str, float]]:
        """Return the calibration's mean shift over its intervals and its error, physical units."""
        gone = self._base_names
        if not gone:
            return {}, {}
        at, others, y = whole.index(gone), whole.index(names), whole.residuals[0]
        prior = np.diag(self._precision(whole, gone, self._base_sigma))
        shift, turn = np.zeros(len(gone)), np.zeros((len(gone), len(names)))
        error = np.zeros((len(gone), len(gone)))
        count = len(self.intervals)
        for group in self.intervals:
            total = whole.gram[np.asarray(group)].sum(axis=0)
            inverse = solve_scaled(total[np.ix_(at, at)] + prior, np.eye(len(gone)))
            cross = inverse @ total[np.ix_(at, others)]
            shift -= (inverse @ total[at, y] + cross @ value) / count
            turn += cross / count
            error += self.variance * inverse / count**2
        sigma = np.sqrt(np.clip(np.diag(error + turn @ covariance @ turn.T), 0.0, None))
        scale = whole.scale[at]
        return (
            dict(zip(gone, (shift * scale).tolist(), strict=True)),
            dict(zip(gone, (sigma * scale).tolist(), strict=True)),
        )


def variance_of(white: Evidence, base: Sequence[Term]) -> float:
    """Return the variance of a row the calibration alone leaves, as the search weighs priors by; nT^2."""
    names = [name for term in base for name in term.columns]
    free = white.select(names).absorbed(names, [range(len(white))], np.zeros(len(names)))
    y = free.residuals[0]
    each = free.gram[:, y, y] / np.maximum(free.count, 1.0)
    return float(np.median(each[free.count > 0])) if np.any(free.count > 0) else 1.0


def combined(
    evidence: Evidence, plain: Sequence[str], columns: Sequence[Column], fixed: Mapping[str, float]
) -> Evidence:
    """Return the evidence of some columns as they are, of combinations, and of the residual after a change.

    Parameters
    ----------
    plain : sequence of str
        Columns taken over.
    columns : sequence of Column
        Columns made.
    fixed : mapping of str to float
        Changes that join the residual, physical units.
    """
    wanted = [*plain, *(name for one in columns for name, _ in one.parts), *fixed]
    small = evidence.select(list(dict.fromkeys(wanted)))
    names = [*plain, *(one.name for one in columns), "residual"]
    turn = np.zeros((len(small), len(small.names), len(names)))
    scale = np.ones(len(names))
    origin = small.index(plain)
    turn[:, origin, np.arange(len(plain))] = 1.0
    scale[: len(plain)] = small.scale[origin]
    for place, one in enumerate(columns, start=len(plain)):
        for name, weight in one.parts:
            index = int(small.index([name])[0])
            turn[:, index, place] += weight * (1.0 if one.factor is None else one.factor)
            scale[place] = small.scale[index]
    turn[:, small.residuals[0], -1] = 1.0
    for name, change in fixed.items():
        index = int(small.index([name])[0])
        turn[:, index, -1] += change / small.scale[index]
    gram = turn.transpose(0, 2, 1) @ small.gram @ turn
    return replace(small, names=tuple(names), gram=gram, scale=scale)
