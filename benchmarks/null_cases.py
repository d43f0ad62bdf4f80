"""How often a search would add something to noise: many residuals of one pass, scored at once.

The library, its evidence and its rules are those of the run itself, so the rate is that of the run. What
is the same for all residuals, above all the inverses of the candidates' own matrices, is made once a fold;
a residual in which any candidate passes held-out t and gain then gets its whole table, flips and placebos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis import (
    Index,
    ModelColumns,
    Search,
    TimeVariableColumns,
    active_blocks,
    batch_changes,
    drifts,
    episodes,
    group_by_size,
    make_folds,
    project_out,
    score,
    steps,
)
from inflight.lsq import GramBlocks, expected_gain_t, inverse_square_root


def additions(search: Search, residuals: Sequence[int] | None = None) -> dict[int, list[str]]:
    """Return the residuals to which the first round would add something, and what may be added.

    Parameters
    ----------
    search : Search
        Nothing taken yet; its evidence holds several residuals.
    residuals : sequence of int, optional
        Which of them, counted from 0; all when absent.

    Returns
    -------
    dict of int to list of str
        By `Table.passing`, in any form; residuals with nothing to add are not in it.
    """
    residual_indices = list(range(len(search.raw.residuals))) if residuals is None else list(residuals)
    out: dict[int, list[str]] = {}
    for place in suspects(search, residual_indices):
        table = replace_residual(search, place).table()
        passing = np.any(list(table.passing(search.rules).values()), axis=0)
        names = [table.options[int(at)].name for at in np.flatnonzero(passing)]
        if names:
            out[place] = names
    return out


def replace_residual(search: Search, residual: int) -> Search:
    """Return a search of another residual of the same evidence, nothing taken."""
    return Search.begin(
        search.raw,
        search.white,
        search.library,
        search.requested_intervals,
        search.shared.days,
        search.rules,
        time_variable=search.time_variable,
        residual=residual,
    )


def suspects(search: Search, residuals: Sequence[int]) -> list[int]:
    """Return the residuals in which any candidate reaches the held-out t and gain of an addition."""
    found = np.zeros(len(residuals), dtype=bool)
    real = [option for option in search.options if not option.placebo]
    for form, evidence in search.forms.items():
        columns = [evidence.index(option.columns) for option in real]
        y = np.array(evidence.residuals, dtype=np.int64)[list(residuals)]
        found |= _reached(search, evidence, search.present(form), columns, y)
    return [
        place
        for place, there in zip(residuals, found | _timed(search, residuals), strict=True)
        if there or _episode(search, place)
    ]


def _reached(
    search: Search, evidence: GramBlocks, present: ModelColumns, columns: Sequence[Index], y: Index
) -> Floats:
    """Return which residuals have a candidate beyond the rules' t and gain; (residual,) of bool."""
    gain, t = score_many(evidence, present, columns, y, make_folds(len(evidence)))
    return np.asarray(((t > search.rules.t) & (gain > search.rules.gain)).any(axis=0))


def score_many(
    evidence: GramBlocks, present: ModelColumns, candidates: Sequence[Index], y: Index, folds: Sequence[Index]
) -> tuple[Floats, Floats]:
    """Return held-out gain and t of all candidates on several residuals; (candidate, residual) each.

    The same numbers as `inflight.diagnosis.scoring.score` gives one residual after the other.

    Parameters
    ----------
    y : ndarray of int, shape (residual,)
        Indices of the residuals.
    """
    total = evidence.total
    loss0 = np.zeros((len(evidence), y.size))
    gained, promised = np.zeros((2, len(evidence), len(candidates), y.size))
    for fold, held in zip(folds, evidence.sums(folds), strict=True):
        train = total - held
        blocks = _turned(evidence.rows(np.arange(len(evidence.names)), blocks=fold), present, train)
        train = project_out(train, present)
        loss0[fold] = blocks[:, y, y]
        for positions, columns in group_by_size(candidates):
            half = inverse_square_root(train[columns[:, :, None], columns[:, None, :]])
            right = train[columns[:, :, None], y]
            gamma = -np.matmul(half, np.matmul(half.transpose(0, 2, 1), right))
            own = blocks[:, columns[:, :, None], columns[:, None, :]]
            square = np.sum(np.matmul(own, gamma) * gamma, axis=2)
            linear = np.sum(blocks[:, columns[:, :, None], y] * gamma, axis=2)
            gained[np.ix_(fold, positions)] = -2.0 * linear - square
            promised[np.ix_(fold, positions)] = square
    whole = loss0.sum(axis=0)
    gain = gained.sum(axis=0) / np.where(whole > 0, whole, 1.0)
    active = np.broadcast_to(active_blocks(evidence, candidates)[:, :, None], gained.shape)
    flat = (len(evidence), -1)
    t = expected_gain_t(gained.reshape(flat), promised.reshape(flat), active.reshape(flat))
    return gain, t.reshape(gain.shape)


def _turned(blocks: Floats, present: ModelColumns, train: Floats) -> Floats:
    """Return blocks whose columns have lost what the model's explain of them in the training blocks."""
    p = present.columns
    if not p.size:
        return blocks
    own = present.solve(train[p])
    across = np.matmul(blocks[:, :, p], own)
    inner = np.matmul(own.T, np.matmul(blocks[:, p[:, None], p], own))
    return np.asarray(blocks - across - across.transpose(0, 2, 1) + inner)


def _small(search: Search, residuals: Sequence[int]) -> tuple[GramBlocks, list[str], list[str]]:
    """Return calibration, model and carriers with some residuals, and the names of the first two."""
    base = [name for term in search.library.base for name in term.columns]
    refined = [name for term in search.library.refined for name in term.columns]
    names = list(dict.fromkeys([*base, *refined, *search.time_variable.names]))
    small = search.raw.select(names)
    selected = [*range(len(names)), *(len(names) + np.asarray(residuals))]
    return (
        replace(
            small,
            names=tuple(small.names[place] for place in selected),
            gram=small.gram[:, selected][:, :, selected],
            scale=small.scale[selected],
        ),
        base,
        refined,
    )


def _absorbed(
    search: Search, small: GramBlocks, base: Sequence[str], refined: Sequence[str]
) -> tuple[GramBlocks, ModelColumns]:
    sigma = np.asarray([s for term in search.library.base for s in term.sigma])
    wide = small.marginalise(base, search.intervals, search.precision(small, base, sigma))
    own = np.asarray([s for term in search.library.refined for s in term.sigma])
    return wide, ModelColumns(wide.index(refined), search.precision(wide, refined, own))


def _timed(search: Search, residuals: Sequence[int]) -> Floats:
    """Return which residuals a drift or a step may be added to; (residual,) of bool."""
    small, base, refined = _small(search, residuals)
    found = drifts(small, search.time_variable) + steps(small, search.time_variable)
    reached = np.zeros(len(residuals), dtype=bool)
    for batch in batch_changes(found):
        functions = {name: function for change in batch for name, function in change.functions.items()}
        wide, present = _absorbed(search, small.expand(functions), base, refined)
        columns = [wide.index(list(change.functions)) for change in batch]
        reached |= _reached(search, wide, present, columns, np.array(wide.residuals, dtype=np.int64))
    return reached


def _episode(search: Search, residual: int) -> bool:
    """Return True when an episode of clock or bias may be added to a residual."""
    small, base, refined = _small(search, [residual])
    carriers = TimeVariableColumns(
        clock=tuple(name for name in search.time_variable.clock if name not in base),
        bias=tuple(name for name in search.time_variable.bias if name not in base),
    )
    evidence = search.forms["raw"]
    found = episodes(small, evidence, carriers, evidence.residuals[residual])
    if not found:
        return False
    functions = {name: function for change in found for name, function in change.functions.items()}
    wide, present = _absorbed(search, small.expand(functions), base, refined)
    columns = [wide.index(list(change.functions)) for change in found]
    scores = score(wide, present, columns, wide.residuals[0], make_folds(len(wide), True))
    return bool(np.any((scores.t > search.rules.t) & (scores.gain > search.rules.gain)))
