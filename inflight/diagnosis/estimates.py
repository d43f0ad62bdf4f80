"""Values of what the search took: joint fit, errors that know how the residual is correlated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.evidence import Evidence
from inflight.diagnosis.scoring import Present, projected
from inflight.diagnosis.search import Option, Search
from inflight.estimators.absorption import gram_inverse, taken_over

#: Reach of the scores' correlation, in blocks.
_BARTLETT = 3


@dataclass(frozen=True)
class Estimate:
    """Values of some columns, all in the model together.

    Attributes
    ----------
    columns : tuple of str
    value, sigma : ndarray, shape (column,)
        Physical units.
    covariance : ndarray, shape (column, column)
        Physical units.
    retained : float
        Part of the effect's own variance the rest of the model leaves.
    rms : float
        Size of the contribution that is left beside the rest of the model, nT.
    """

    columns: tuple[str, ...]
    value: Floats
    sigma: Floats
    covariance: Floats
    retained: float
    rms: float


def sandwich(evidence: Evidence, present: Present, y: int) -> tuple[Floats, Floats]:
    """Return values and covariance of the model's columns, scaled; clustered by block (Bartlett's kernel).

    Scatter of few blocks that tell nearly all of a column comes out too small, for the fit follows them. No
    value is surer than rows of white noise of the size of what is left would make it.
    """
    total = evidence.total
    p = present.columns
    matrix = total[np.ix_(p, p)] + np.diag(present.precision)
    inverse = gram_inverse(matrix)
    value = -inverse @ total[p, y]
    scores = evidence.gram[:, p, y] + np.einsum("bij,j->bi", evidence.gram[:, p[:, None], p[None, :]], value)
    count = len(scores)
    meat = scores.T @ scores
    own = meat.copy()
    for lag in range(1, min(_BARTLETT, count - 1) + 1):
        weight = 1.0 - lag / (_BARTLETT + 1.0)
        cross = scores[lag:].T @ scores[:-lag]
        meat += weight * (cross + cross.T)
    # By chance few blocks look anticorrelated; that is no knowledge.
    meat = _at_least(meat, own)
    free = max(count - p.size / 3.0, 2.0)
    left = total[y, y] + 2.0 * total[y, p] @ value + value @ total[np.ix_(p, p)] @ value
    white = max(float(left), 0.0) / max(float(evidence.count.sum()), 1.0) * total[np.ix_(p, p)]
    return value, _at_least(inverse @ (meat * count / free) @ inverse, inverse @ white @ inverse)


def _at_least(covariance: Floats, least: Floats) -> Floats:
    """Return a covariance with variances no smaller than those of another one, and its own correlations."""
    own = np.diag(covariance)
    raised = np.maximum(own, np.diag(least))
    with np.errstate(invalid="ignore", divide="ignore"):
        lift = np.sqrt(np.where(own > 0, raised / own, 1.0))
    out = covariance * lift[:, None] * lift[None, :]
    out[np.diag_indices_from(out)] = raised
    return np.asarray(out)


def estimate(search: Search, option: Option, form: str = "raw") -> Estimate:
    """Return the values of an accepted option's columns, in the joint fit of the whole model."""
    evidence, present, y = search.forms[form], search.present(form), search.y(form)
    value, covariance = sandwich(evidence, present, y)
    columns = evidence.index(option.columns)
    places = np.array([int(np.flatnonzero(present.columns == column)[0]) for column in columns])
    scale = evidence.scale[columns]
    own, block = value[places], covariance[np.ix_(places, places)]
    kept, rms = _retained(search, option, own, form)
    return Estimate(
        option.columns,
        own * scale,
        np.sqrt(np.clip(np.diag(block), 0.0, None)) * scale,
        block * np.outer(scale, scale),
        kept,
        rms,
    )


def _retained(search: Search, option: Option, gamma: Floats, form: str) -> tuple[float, float]:
    """Return which part of an effect's variance no other column explains, and the rms that is left, nT.

    Its own variance is that about a constant channel: a temperature of 293 K that moves by one kelvin
    moves by one kelvin.
    """
    evidence = search.forms[form]
    columns = evidence.index(option.columns)
    left = projected(evidence.total, search.present(form, option))
    kept = float(gamma @ left[np.ix_(columns, columns)] @ gamma)
    whole = float(gamma @ centred(search, option) @ gamma)
    rows = max(float(evidence.count.sum()), 1.0)
    return min(kept / whole, 1.0) if whole > 0 else 0.0, float(np.sqrt(max(kept, 0.0) / rows))


def centred(search: Search, option: Option) -> Floats:
    """Return the Gram matrix of an option's columns about constant channels (see `Evidence.centred`)."""
    own = search.raw.index(option.columns)
    # Only a channel has a mean that is none of the effect's doing.
    base = [name for term in search.library.base for name in term.columns] if option.channels else []
    return search.raw.centred(own, search.raw.index(base))


def detectable(search: Search, option: Option, form: str = "raw") -> Floats:
    """Return the amplitude of each column that would stand out by three sigma; physical units.

    From the scatter of the blocks' scores around the present model, the option not being in it.
    """
    evidence, y = search.forms[form], search.y(form)
    present = search.present(form, option)
    columns = evidence.index(option.columns)
    both = Present(
        np.concatenate([present.columns, columns]), np.append(present.precision, np.zeros(columns.size))
    )
    _, covariance = sandwich(evidence, both, y)
    sigma = np.sqrt(np.clip(np.diag(covariance)[-columns.size :], 0.0, None))
    return np.asarray(3.0 * sigma * evidence.scale[columns])


def mimics(search: Search, option: Option, gamma: Floats) -> list[tuple[str, float]]:
    """Return by how much the calibration's parameters shift when the effect is there but ignored.

    Parameters
    ----------
    gamma : ndarray
        Values of its columns, physical units.

    Returns
    -------
    list of (str, float)
        Column of the calibration and its shift, physical units, one interval over the whole span.
    """
    raw = search.raw
    names = [name for term in search.library.base for name in term.columns]
    base, own = raw.index(names), raw.index(option.columns)
    total = raw.total
    shift = taken_over(total, base, own) @ (gamma / raw.scale[own])
    return list(zip(names, (shift * raw.scale[base]).tolist(), strict=True))


def within_and_raw(search: Search, option: Option) -> float | None:
    """Return how far the raw and the within-day values of an effect disagree, per column (W / k).

    Large values tell of a wrong effect or a wrong form; it is a hint, not a test.
    """
    if option.change is not None:
        return None
    raw, within = estimate(search, option, "raw"), estimate(search, option, "within")
    difference = raw.value - within.value
    both = raw.covariance + within.covariance
    seen = np.sqrt(np.clip(np.diag(both), 0, None)) > 0
    if not seen.any():
        return None
    inverse = gram_inverse(both[np.ix_(seen, seen)])
    return float(difference[seen] @ inverse @ difference[seen] / seen.sum())
