"""The search: ranking up to 1000 candidates of 3000 days, and its two passes over samples.

Gram blocks of 3000 days are made from random rows with the structure and the form of real evidence: nine
parameters fitted each day, two columns of a model, candidates of three columns, blocks of 16 days. The
ranking reads nothing else. Passes are measured a day on one core.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import xarray as xr

from benchmarks.measured import Row, in_process, timed
from benchmarks.rivals import Rivals, derived_of, lstsq_s, native_columns
from inflight.catalog import Catalog, Workspace
from inflight.diagnosis import ModelColumns, draw_signs, family_wise_p, make_folds, score, sign_flip_ratios
from inflight.lsq import FactoredGrams
from inflight.mission import Mission
from inflight.progress import silent
from inflight.tasks import Workbench
from inflight.tasks.analysis import DiagnoseSettings, block_grams
from inflight.tasks.analysis.diagnosis import PlannedPass, begin_search, native_estimator, plan_pass
from inflight.tasks.analysis.gram_pass import PassPlan
from inflight.tasks.archive import ArchiveIndex, load_samples
from inflight.tasks.pipelines import learns_states
from inflight.threads import one_thread
from inflight.time import DAY, SECOND

#: Blocks of 3000 days and days of each, candidates, columns of each, rows that stand for a day's.
BLOCKS, FITS, CANDIDATES, WIDTH, ROWS = 188, 16, 300, 3, 60
#: Rows of a day at 60 s.
_DAY_ROWS = 1440
_BASE = tuple(f"b{place}" for place in range(9))


@dataclass(frozen=True)
class Made:
    """Gram blocks of two forms with their candidates' columns, before the calibration is marginalised."""

    raw: FactoredGrams
    white: FactoredGrams
    candidates: list[list[str]] = field(default_factory=list)


def synthetic(blocks: int = BLOCKS, candidates: int = CANDIDATES) -> Made:
    """Return random evidence: calibration, model, candidates, and a residual that follows one of these."""
    columns = [[f"c{place}.{at}" for at in range(WIDTH)] for place in range(candidates)]
    names = (*_BASE, "m0", "m1", *(name for own in columns for name in own), "residual")
    raw, white = (
        FactoredGrams.read(_blocks(blocks, names, seed), blocks, names, np.ones(len(names)), _BASE)
        for seed in (1, 2)
    )
    return Made(raw, white, columns)


def _blocks(blocks: int, names: Sequence[str], seed: int) -> Iterator[xr.Dataset]:
    """Yield stores of one block each, as a pass makes them."""
    generator = np.random.default_rng(seed)
    parts = [slice(ROWS * day, ROWS * (day + 1)) for day in range(FITS)]
    for block in range(blocks):
        rows = generator.standard_normal((FITS * ROWS, len(names)), dtype=np.float32).astype(np.float64)
        rows[:, -1] += 0.2 * rows[:, 11]
        start = (block * FITS + np.arange(FITS, dtype=np.int64)) * DAY
        days = [
            FactoredGrams.of_rows(
                names,
                rows[part, None, :-1],
                rows[part, None, -1:],
                np.ones(ROWS),
                [slice(0, ROWS)],
                (start[at : at + 1], start[at : at + 1] + DAY),
                np.ones(len(names)),
                _BASE,
            )
            for at, part in enumerate(parts)
        ]
        yield days[0].merged(days[1:], FITS).as_dataset()


def ranking(candidates: int = CANDIDATES, draws: int = 2000) -> list[Row]:
    """Return the rows of ranking so many candidates in three forms, in a process of its own.

    In the first the calibration is marginalised, in the second candidates are scored on what that leaves,
    with cross-validation and sign flips: nothing is kept of an earlier ranking.
    """
    return in_process(_ranking, candidates, draws)


def _ranking(candidates: int, draws: int) -> list[Row]:
    made = synthetic(candidates=candidates)
    blocks, none = len(made.raw), np.zeros(9)
    intervals = [list(range(at, min(at + 23, blocks))) for at in range(0, blocks, 23)]
    forms: list[FactoredGrams] = []

    def marginalised() -> None:
        forms[:] = [
            made.raw.marginalise(_BASE, intervals, none),
            made.raw.marginalise(_BASE, None, none),
            made.white.marginalise(_BASE, intervals, none),
        ]

    def ranked() -> None:
        for grams in forms:
            y, columns = grams.residuals[0], [grams.index(own) for own in made.candidates]
            present = ModelColumns(grams.index(["m0", "m1"]), np.zeros(2))
            score(grams, present, columns, y, make_folds(len(grams)))
            signs, units = draw_signs(len(grams), draws, 0)
            observed, drawn = sign_flip_ratios(grams, present, columns, y, signs, units)
            family_wise_p(observed, drawn)

    with one_thread():
        first, second = [], []
        for _ in range(3):
            first += timed(marginalised)
            second += timed(ranked)
        matrix = made.raw.shared.rest.values
        floor = min(timed(lambda: matrix.sum(axis=0), 3))
        rows = np.random.default_rng(0).normal(size=(FITS * _DAY_ROWS, 9 + 2 + WIDTH))
        refit = blocks * candidates * lstsq_s(rows, rows[:, 0] + 1.0, 3)
    row = Row(
        what=f"rank {candidates} candidates, {blocks} blocks of {FITS} days",
        seconds=second,
        floor_s=floor,
        floor="rank: the matrix of one form read once in memory",
        naive_s=refit,
        naive="rank: calibration, model and candidate fitted anew by lstsq to every row at 60 s, for each "
        "candidate, once and in one form, without folds and sign flips; from one block",
        aim="1.5 s" if candidates == CANDIDATES else "",
    )
    before = replace(row, what=f"{candidates} candidates: calibration marginalised", seconds=first, aim="")
    return [before, row]


def evidence_pass(folder: Path, rivals: Rivals, days: int = 8) -> list[Row]:
    """Return the row of the pass of a search, a day on one core."""
    cat, mission = Catalog(folder), Workspace.open(folder).mission()
    made = plan_pass(cat, mission, DiagnoseSettings())
    width = len(made.plan.library.columns) + 1
    row = _pass(cat, mission, made, made.plan, days)
    count = len(made.plan.days)
    return [
        replace(
            row,
            what=f"statistics of a day, {width} columns at {made.plan.cadence_ns / SECOND:g} s",
            floor_s=row.floor_s + rivals.blas / count,
            floor="statistics: the day read, decoded and aligned, X'X in two forms, one core",
            naive_s=(rivals.align + rivals.candidates * rivals.refit) / count,
            naive="statistics: xarray opens and interpolates, each candidate fitted anew with the model",
            aim="0.3 s",
        )
    ]


def native_pass(folder: Path, align_s: float, effect: str = "day_night", days: int = 4) -> list[Row]:
    """Return the row of an iteration of the estimate at the data's own cadence, a day on one core.

    A diagnosis of the workspace is there. The estimate is of the model's own numbers, of the calibration and
    of an effect that is taken; `align_s` is what xarray needs to open and interpolate a day.
    """
    cat, mission = Catalog(folder), Workspace.open(folder).mission()
    with one_thread():
        bench = Workbench(cat, mission)
        search = begin_search(bench.made, bench.settings)
        taken = next(one for one in search.options if one.mechanism == effect)
        estimator = native_estimator(cat, mission, bench.made, bench.settings, None, silent)
        plan = estimator._plan_for(search.with_accepted([taken]), ())
        planned = PlannedPass(plan, bench.made.index, bench.made.base, bench.made.used, bench.made.survey)
        row = _pass(cat, mission, planned, plan, days)
        columns, residual = native_columns(
            cat, mission, planned, plan.library, plan.days[len(plan.days) // 2]
        )
        refit = lstsq_s(columns, residual, 3)
        blas = min(timed(lambda: columns.T @ columns, 3))
        width = columns.shape[1]
    return [
        replace(
            row,
            what=f"estimate of a day at {plan.cadence_ns / SECOND:g} s, an iteration, {width} columns",
            floor_s=row.floor_s + blas,
            floor="estimate: the day read, decoded and aligned, X'X once, one core",
            naive_s=align_s + refit,
            naive="estimate: xarray opens and interpolates, the same columns of the day by lstsq",
            aim="0.2 s",
        )
    ]


def _pass(cat: Catalog, mission: Mission, made: PlannedPass, plan: PassPlan, days: int) -> Row:
    """Return the row of making a plan's blocks of some days; its floor is reading what they are made from."""
    levels = learns_states(mission, plan.model.comparison)
    derived = derived_of(cat, mission, made, plan, by_levels=levels)
    reader = derived.reader
    some = plan.blocks[2 : 2 + max(1, days // plan.fits)]
    every = [day for block in some for day in block]

    def make() -> None:
        reader.clear_cache()
        for block in some:
            block_grams(cat, mission, plan, made.index, derived, block)

    def read() -> None:
        for day in every:
            known = ArchiveIndex(made.index.days)
            load_samples(cat, mission, plan.model, day, list(plan.needs), known, geometry=False)
            reader.clear_cache()
            reader.day(day)

    with one_thread():
        make()
        seconds = [one / len(every) for one in timed(make, 3)]
        floor = min(timed(read, 3)) / len(every)
    return Row(what="", seconds=seconds, floor_s=floor)
