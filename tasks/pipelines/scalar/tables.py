"""Calibration tables from stored normal equations: a day, a window of days, the whole span.

Normal equations of days are sums: those of a window are added and solved with the model's prior
(`inflight.calibration.NormalEquations`). Where the linearisation error of the solution exceeds
`MAX_LINEARISATION_ERROR`, `relinearise_at` says where to make the equations anew.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import (
    Interval,
    NormalEquations,
    calibration_table,
    empty_block,
    linearisation_error,
    published_fit,
    reference_of,
    solve_sets,
    with_changes,
)
from inflight.catalog import Catalog, Day, DayData, Run, idempotency_key, write_segment
from inflight.errors import CalibrationError, CatalogError
from inflight.lsq import BIWEIGHT_RMS_FACTOR, Solution, residual_sum
from inflight.mission_fit import held_numbers_of, held_shifts, held_shifts_of_each, with_held_numbers
from inflight.model import Model
from inflight.progress import Progress, silent, tell_each
from inflight.time import day_bounds

#: Equations are linearised again when the linearisation error of the residual exceeds this; nT.
MAX_LINEARISATION_ERROR = 1e-3

#: Days whose equations are kept together once all are there: reading a day's costs as much as reading theirs.
JOINED_DAYS = 32


def load_equations(cat: Catalog, days: Sequence[Day], progress: Progress = silent) -> NormalEquations:
    """Read the normal equations of days, published or verified, in order of time.

    Raises
    ------
    CatalogError
        When there is no day.
    """
    if not days:
        raise CatalogError(
            "no normal equations of single days are published in the span",
            remedy="run 'inflight reprocess' first; a fit of all days at once keeps equations of its own",
        )
    ordered = sorted(days, key=lambda day: day.day)
    first = cat.read(ordered[0])
    # Filled part by part: a Dataset a day of a whole mission would need a hundred times the room.
    rows = {
        name: np.empty((len(ordered), *variable.shape[1:]), variable.dtype)
        for name, variable in first.data_vars.items()
        if "block" in variable.dims
    }
    joined = {day.key: day for day in cat.days(_joined(ordered), states=("published",))}
    parts = []
    for members in _whole_spans(ordered):
        kept = joined.get(_key_of_joined(members)) if len(members) == JOINED_DAYS else None
        parts += members if kept is None else [kept]
    index = 0
    for day in tell_each(progress, "statistics", parts):
        part = cat.read(day)
        if "day_start" in part:
            part = part.isel(block=0).drop_vars("start").rename(day="block", day_start="start")
        if part["column"].values.tolist() != first["column"].values.tolist():
            raise CatalogError(
                f"its equations have the columns {part['column'].values.tolist()}, those of "
                f"{ordered[0].day} {first['column'].values.tolist()}",
                day=str(day.day),
                remedy="run 'inflight reprocess' over all days",
            )
        size = part.sizes["block"]
        for name, values in rows.items():
            values[index : index + size] = part[name].values
        index += size
    return NormalEquations(
        first.drop_vars(list(rows)).assign(
            {name: (first[name].dims, values, first[name].attrs) for name, values in rows.items()}
        )
    )


def keep_joined(cat: Catalog, run: Run, equations: NormalEquations, days: Sequence[Day]) -> None:
    """Keep the equations of whole spans of `JOINED_DAYS` dates together, where that is not done yet.

    Parameters
    ----------
    equations : NormalEquations
        Of the days, as `load_equations` reads them.
    """
    ordered = sorted(days, key=lambda day: day.day)
    joined = {day.key for day in cat.days(_joined(ordered), states=("published",))}
    place, more = 0, []
    for members in _whole_spans(ordered):
        if len(members) == JOINED_DAYS and (key := _key_of_joined(members)) not in joined:
            part = equations.of_blocks(slice(place, place + JOINED_DAYS)).dataset
            # A row of a store lies in its day: all days are one row of the first.
            kept = part.rename(block="day", start="day_start")
            rows = {name: one.expand_dims("block") for name, one in kept.items() if "day" in one.dims}
            kept = kept.assign(rows | {"start": ("block", part["start"].values[:1], part["start"].attrs)})
            more.append(DayData(members[0].day, kept, key, tuple(day.id for day in members)))
        place += len(members)
    if more:
        run.attach(write_segment(cat.workspace, run.id, _joined(ordered), more))


def _joined(days: Sequence[Day]) -> str:
    """Return the dataset in which the equations of days are kept together."""
    return f"{days[0].dataset}-joined"


def _whole_spans(ordered: Sequence[Day]) -> Iterator[list[Day]]:
    """Yield the days of each span of `JOINED_DAYS` dates, on a grid that no other day moves."""
    for _, members in itertools.groupby(ordered, lambda day: int(day.day.astype(np.int64)) // JOINED_DAYS):
        yield list(members)


def _key_of_joined(days: Sequence[Day]) -> str:
    """Return the key of the equations of days kept together: of these very revisions."""
    return idempotency_key(_joined(days), days[0].day, 0, "", [f"{day.id} {day.key}" for day in days])


def daily_table(
    equations: NormalEquations, model: Model, form: str = "exact", progress: Progress = silent
) -> xr.Dataset:
    """Return the table of the blocks' own fits, one interval a block; `form` as `window_table`."""
    data, bare = equations.dataset, equations.bare
    fit, covariance = data["fit"].values[:, :-1], data["fit_covariance"].values[:, :-1, :-1]
    used, before, after = (data[name].values for name in ("used", "before", "after"))
    held = _held_products(equations)
    spans = list(zip(equations.start.tolist(), equations.end.tolist(), strict=True))
    priors = [reference_of(model, (start + end) // 2) for start, end in spans]
    filled = np.flatnonzero(bare.count > 0)
    sigma, value = (
        np.array([getattr(prior, name) for prior in priors])[filled] for name in ("sigma", "value")
    )
    alone = bare.of_blocks(filled)
    solved = alone.solve_each(sigma, value)
    shifts = held_shifts_of_each(alone, held[filled], sigma, after[filled])
    solutions = dict(zip(filled.tolist(), zip(solved, shifts, strict=True), strict=True))
    rows = []
    for index, (start, end) in enumerate(tell_each(progress, "intervals", spans)):
        if index not in solutions:
            rows.append(_prior_interval(bare.of_blocks(slice(index, index + 1)), model, start, end))
            continue
        solution, moved = solutions[index]
        rows.append(
            Interval(
                start,
                end,
                (start, end),
                fit[index],
                covariance[index],
                solution,
                float(used[index]),
                float(before[index]),
                float(after[index]),
                held=moved,
            )
        )
    if form != "exact":
        each = [np.array([index]) for index in range(len(rows))]
        rows, made_by = _published_rows(equations, rows, each, model, form)
        return with_changes(_table_of(rows, model, "daily").assign(made_by))
    return with_changes(_table_of(rows, model, "daily"))


def _table_of(rows: Sequence[Interval], model: Model, kind: str) -> xr.Dataset:
    """Return the table of intervals, with the numbers of the vector sensor that the model holds."""
    table = calibration_table(rows, reference_of(model, rows[0].start), _attributes(model, kind))
    return with_held_numbers(table, [row.held for row in rows], held_numbers_of(model))


def window_table(
    equations: NormalEquations,
    model: Model,
    edges: Sequence[np.datetime64],
    kind: str,
    finer: Sequence[xr.Dataset] = (),
    form: str = "exact",
    progress: Progress = silent,
) -> xr.Dataset:
    """Return the table of windows solved from the sums of their blocks; empty windows are skipped.

    How much parameters change is told by its own windows, or by those of `finer` where they are too few.

    Parameters
    ----------
    form : str
        ``exact``, or a form of `inflight.calibration.published_fit`: the table then has `estimate`
        (interval), and in its covariance by how much one pass of that form misses the exact fit.
    progress : callable, optional
        Called with ("intervals", done, total).
    """
    each, parts, bare, used = [], [], equations.bare, equations.dataset["used"].values
    held = _held_products(equations)
    spans = list(itertools.pairwise(day_bounds(edge)[0] for edge in edges))
    for start, end in tell_each(progress, "intervals", spans):
        inside = np.flatnonzero((bare.start >= start) & (bare.end <= end))
        if inside.size:
            filled = inside[bare.count[inside] > 0]
            blocks = bare.of_blocks(filled if filled.size else inside)
            parts.append(_Window(start, end, blocks, held[filled], float(used[filled].sum())))
            each.append(inside)
    rows = _solved_windows(parts, model)
    made_by: dict[str, Any] = {}
    if form != "exact":
        rows, made_by = _published_rows(equations, rows, each, model, form)
    table = _table_of(rows, model, kind).assign(made_by)
    return with_changes(table, [table, *finer])


def _published_rows(
    equations: NormalEquations,
    rows: Sequence[Interval],
    blocks: Sequence[npt.NDArray[np.int64]],
    model: Model,
    form: str,
) -> tuple[list[Interval], dict[str, Any]]:
    """Return rows with the values of a published form where it has a solution, and which have, as a variable.

    Parameters
    ----------
    blocks : sequence of ndarray
        The blocks of each row.
    """
    grams, made, names = equations.dataset["published"].values, [], []
    for row, inside in zip(rows, blocks, strict=True):
        try:
            value = published_fit(form, grams[inside].sum(axis=0), reference_of(model, row.start).value)
        except CalibrationError:
            made.append(row)
            names.append("exact")
            continue
        off = value - row.value
        made.append(replace(row, value=value, covariance=row.covariance + np.outer(off, off)))
        names.append(form)
    return made, {"estimate": ("interval", np.array(names))}


def _held_products(equations: NormalEquations) -> Floats:
    """Return products of the nine with one sigma of each held number; (block, number, 9), of none without."""
    data = equations.dataset
    return np.asarray(data["held"].values[..., :-1]) if "held" in data else np.zeros((len(equations), 0, 9))


def _prior_interval(part: NormalEquations, model: Model, start: int, end: int) -> Interval:
    """Return the row of a span without usable data: the model's values, with their prior uncertainty."""
    prior = reference_of(model, (start + end) // 2)
    empty = empty_block(prior, prior)
    return Interval(
        start,
        end,
        (start, start),
        prior.value,
        empty.covariance,
        empty.solution,
        0.0,
        np.nan,
        np.nan,
        len(part),
    )


class _Window(NamedTuple):
    """A span, its blocks, their products with the held numbers, and their samples.

    Blocks without data are left out, and have no products; where all are, all stand here.
    """

    start: int
    end: int
    blocks: NormalEquations
    held: Floats
    used: float


def _solved_windows(parts: Sequence[_Window], model: Model) -> list[Interval]:
    """Return the row of each span: the sum of its blocks, solved with the model's prior."""
    there = {place: part.blocks for place, part in enumerate(parts) if len(part.blocks.filled)}
    priors = {
        place: reference_of(model, int(blocks.start[0] // 2 + blocks.end[-1] // 2))
        for place, blocks in there.items()
    }
    common = {place: blocks.at(priors[place].value) for place, blocks in there.items()}
    sigma, prior = (np.array([getattr(one, name) for one in priors.values()]) for name in ("sigma", "value"))
    solved = dict(zip(there, solve_sets(list(common.values()), sigma, prior), strict=True))
    rows = []
    for place, part in enumerate(parts):
        if place not in solved:
            rows.append(_prior_interval(part.blocks, model, part.start, part.end))
            continue
        blocks, solution = common[place], solved[place]
        value, covariance = blocks.physical(solution)
        gram, count = blocks.total, float(blocks.count.sum())
        after = float(np.sqrt(residual_sum(gram, solution.value) / count)) / BIWEIGHT_RMS_FACTOR
        rows.append(
            Interval(
                part.start,
                part.end,
                (int(blocks.start[0]), int(blocks.end[-1])),
                value,
                covariance,
                solution,
                part.used,
                float(np.sqrt(gram[-1, -1] / count)),
                after,
                len(blocks),
                held_shifts(blocks, part.held, priors[place].sigma, after),
            )
        )
    return rows


def span_solution(equations: NormalEquations, model: Model) -> Solution:
    """Solve all blocks together with the model's prior; scaled, relative to that prior."""
    equations = equations.filled if len(equations.filled) else equations
    prior = reference_of(model, int(equations.start[0]))
    return equations.at(prior.value).solve(prior.sigma, prior.value)


def _attributes(model: Model, kind: str) -> dict[str, str]:
    made_with = {"comparison": model.comparison, "kind": kind, "model": model.sha, "model_name": model.name}
    empirical = ", ".join(model.empirical)
    return made_with | ({"empirical_effects": empirical} if empirical else {})


def relinearise_at(
    equations: NormalEquations, model: Model, strength: float, last: Sequence[float] | None = None
) -> Floats | None:
    """Return where the equations should be linearised again, or None when they are near enough.

    Each block states where it was linearised. When the linearisation error of the solution there exceeds
    `MAX_LINEARISATION_ERROR`, another pass is needed.

    Parameters
    ----------
    strength : float
        Of the field, nT.
    last : sequence of float, optional
        Where all blocks were linearised last. Days whose own fit is certain stay linearised there, so a pass
        at the same place changes nothing.

    Returns
    -------
    ndarray, shape (9,), or None
    """
    equations = equations.bare.filled
    if not len(equations):
        return None
    whole = equations.at_one_reference()
    prior = reference_of(model, int(whole.start[0]))
    value, _ = whole.physical(whole.solve(prior.sigma, prior.value))
    places = np.asarray(equations.linearised_at)[:, :-1]

    def is_far(place: Floats) -> bool:
        return linearisation_error(value, place, strength) > MAX_LINEARISATION_ERROR

    again = any(is_far(place) for place in places) and (last is None or is_far(np.asarray(last)))
    return value if again else None
