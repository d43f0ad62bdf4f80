"""Calibration tables from stored normal equations: a day, a window of days, the whole span.

Normal equations of days are sums: those of a window are added and solved with the model's prior
(`inflight.calibration.NormalEquations`). Where the linearisation error of the solution exceeds
`MAX_LINEARISATION_ERROR`, `relinearise_at` says where to make the equations anew.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import (
    Interval,
    NormalEquations,
    calibration_table,
    empty_block,
    linearisation_error,
    reference_of,
    with_changes,
)
from inflight.catalog import Catalog, Day
from inflight.errors import CatalogError
from inflight.lsq import BIWEIGHT_RMS_FACTOR, Solution, residual_sum
from inflight.model import Model
from inflight.time import day_bounds

#: Equations are linearised again when the linearisation error of the residual exceeds this; nT.
MAX_LINEARISATION_ERROR = 1e-3


def load_equations(cat: Catalog, days: Sequence[Day]) -> NormalEquations:
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
    # Filled day by day: a Dataset a day of a whole mission would need a hundred times the room.
    rows = {
        name: np.empty((len(ordered), *variable.shape[1:]), variable.dtype)
        for name, variable in first.data_vars.items()
        if "block" in variable.dims
    }
    for index, day in enumerate(ordered):
        part = cat.read(day)
        if part["column"].values.tolist() != first["column"].values.tolist():
            raise CatalogError(
                f"its equations have the columns {part['column'].values.tolist()}, those of "
                f"{ordered[0].day} {first['column'].values.tolist()}",
                day=str(day.day),
                remedy="run 'inflight reprocess' over all days",
            )
        for name, values in rows.items():
            values[index] = part[name].values[0]
    return NormalEquations(
        first.drop_vars(list(rows)).assign(
            {name: (first[name].dims, values, first[name].attrs) for name, values in rows.items()}
        )
    )


def daily_table(equations: NormalEquations, model: Model) -> xr.Dataset:
    """Return the table of the blocks' own fits, one interval a block."""
    data = equations.dataset
    rows = []
    for index in range(len(equations)):
        one = equations.of_blocks(slice(index, index + 1))
        start, end = int(data["start"].values[index]), int(data["end"].values[index])
        prior = reference_of(model, (start + end) // 2)
        if not len(one.filled):
            rows.append(_prior_interval(one, model, start, end))
            continue
        solution = one.solve(prior.sigma, prior.value)
        rows.append(
            Interval(
                start,
                end,
                (start, end),
                np.asarray(data["fit"].values[index, :-1]),
                np.asarray(data["fit_covariance"].values[index, :-1, :-1]),
                solution,
                float(data["used"].values[index]),
                float(data["before"].values[index]),
                float(data["after"].values[index]),
            )
        )
    return with_changes(
        calibration_table(rows, reference_of(model, rows[0].start), _attributes(model, "daily"))
    )


def window_table(
    equations: NormalEquations,
    model: Model,
    edges: Sequence[np.datetime64],
    kind: str,
    finer: Sequence[xr.Dataset] = (),
) -> xr.Dataset:
    """Return the table of windows solved from the sums of their blocks; empty windows are skipped.

    How much parameters change is told by its own windows, or by those of `finer` where they are too few.
    """
    rows = []
    for start, end in itertools.pairwise(day_bounds(edge)[0] for edge in edges):
        part = equations.within(start, end)
        if len(part):
            rows.append(_solved_interval(part, model, start, end))
    table = calibration_table(rows, reference_of(model, rows[0].start), _attributes(model, kind))
    return with_changes(table, [table, *finer])


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


def _solved_interval(part: NormalEquations, model: Model, start: int, end: int) -> Interval:
    """Return the row of a span: the sum of its blocks, solved with the model's prior."""
    if not len(part.filled):
        return _prior_interval(part, model, start, end)
    part = part.filled
    middle = int(part.dataset["start"].values[0] // 2 + part.dataset["end"].values[-1] // 2)
    prior = reference_of(model, middle)
    common = part.at(prior.value)
    solution = common.solve(prior.sigma, prior.value)
    value, covariance = common.physical(solution)
    gram, count = common.total, float(common.count.sum())
    return Interval(
        start,
        end,
        (int(part.dataset["start"].values[0]), int(part.dataset["end"].values[-1])),
        value,
        covariance,
        solution,
        float(part.dataset["used"].values.sum()),
        float(np.sqrt(gram[-1, -1] / count)),
        float(np.sqrt(residual_sum(gram, solution.value) / count)) / BIWEIGHT_RMS_FACTOR,
        len(part),
    )


def span_solution(equations: NormalEquations, model: Model) -> Solution:
    """Solve all blocks together with the model's prior; scaled, relative to that prior."""
    equations = equations.filled if len(equations.filled) else equations
    prior = reference_of(model, int(equations.dataset["start"].values[0]))
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
    equations = equations.filled
    if not len(equations):
        return None
    whole = equations.at_one_reference()
    prior = reference_of(model, int(whole.dataset["start"].values[0]))
    value, _ = whole.physical(whole.solve(prior.sigma, prior.value))
    places = equations.dataset["linearised_at"].values[:, :-1]

    def is_far(place: Floats) -> bool:
        return linearisation_error(value, place, strength) > MAX_LINEARISATION_ERROR

    again = any(is_far(place) for place in places) and (last is None or is_far(np.asarray(last)))
    return value if again else None
