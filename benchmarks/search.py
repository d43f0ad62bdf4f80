"""The search: ranking 300 candidates of 3000 days, and the pass against reading, decoding and BLAS.

Gram blocks of 3000 days is made from random rows with the structure of real evidence: nine parameters,
a few of a model, 300 candidates of three columns, 200 blocks. The ranking reads nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from benchmarks.measured import Row, timed
from inflight.catalog import Catalog, Workspace
from inflight.diagnosis import ModelColumns, draw_signs, family_wise_p, make_folds, score, sign_flip_ratios
from inflight.lsq import GramArrays, GramBlocks
from inflight.threads import one_thread
from inflight.time import DAY, SECOND

#: Blocks of a mission of 3000 days, candidates, columns of each, rows that stand for a block's.
BLOCKS, CANDIDATES, WIDTH, ROWS = 200, 300, 3, 1500


@dataclass(frozen=True)
class Made:
    """GramBlocks with its candidates' columns."""

    grams: GramBlocks
    present: ModelColumns
    candidates: list[np.ndarray] = field(default_factory=list)


def synthetic(blocks: int = BLOCKS, candidates: int = CANDIDATES) -> Made:
    """Return random evidence: two model columns, the candidates', a residual that follows one of them."""
    generator = np.random.default_rng(1)
    width = 2 + candidates * WIDTH + 1
    gram = np.empty((blocks, width, width))
    for block in range(blocks):
        rows = generator.normal(size=(ROWS, width))
        rows[:, -1] += 0.2 * rows[:, 2]
        gram[block] = rows.T @ rows
    gram = gram.astype(np.float32)  # as the forms of a search hold them
    names = (*(f"c{place}" for place in range(width - 1)), "residual")
    start = np.arange(blocks, dtype=np.int64) * 15 * DAY
    evidence = GramArrays(names, gram, start, start + 15 * DAY, np.full(blocks, float(ROWS)), np.ones(width))
    columns = [np.arange(2 + WIDTH * place, 2 + WIDTH * (place + 1)) for place in range(candidates)]
    return Made(evidence, ModelColumns(np.array([0, 1]), np.zeros(2)), columns)


def ranking(candidates: int = CANDIDATES, draws: int = 2000) -> Row:
    """Return the row of ranking so many candidates in three forms: cross-validation and sign flips."""
    made = synthetic(candidates=candidates)
    y = len(made.grams.names) - 1
    folds = make_folds(len(made.grams))

    def ranked() -> object:
        for _ in range(3):
            score(made.grams, made.present, made.candidates, y, folds)
            signs, units = draw_signs(len(made.grams), draws, 0)
            observed, drawn = sign_flip_ratios(made.grams, made.present, made.candidates, y, signs, units)
            family_wise_p(observed, drawn)
        return None

    with one_thread():
        total = min(timed(lambda: made.grams.gram.sum(axis=0), 3))
        ranked()
        return Row(
            what=f"rank {candidates} candidates, {BLOCKS} blocks",
            seconds=timed(ranked, 3),
            floor_s=total,
            floor="rank: the matrices of one form read once in memory",
            aim="1.5 s" if candidates == CANDIDATES else "",
        )


def evidence_pass(cat: Catalog, days: int = 8) -> Row:
    """Return the row of the pass, a day on one core, against reading, decoding and BLAS."""
    from inflight.tasks.analysis import block_grams
    from inflight.tasks.analysis import diagnosis as diagnose
    from inflight.tasks.archive import ArchiveIndex, ChannelReader, DerivedChannels, load_samples
    from inflight.tasks.pipelines import learns_states

    mission = Workspace.open(cat.workspace).mission()
    made = diagnose.plan_pass(cat, mission, diagnose.DiagnoseSettings())
    plan, index = made.plan, made.index
    levels = learns_states(mission, "main")
    reader = ChannelReader(
        cat, mission, plan.channel_needs, index, plan.cadence_ns, plan.span, by_levels=levels
    )
    derived = DerivedChannels(
        reader, plan.days, plan.channel_summaries, plan.library.placebos, plan.origin.days
    )
    some = plan.blocks[2 : 2 + max(1, days // plan.fits)]
    count = sum(len(block) for block in some)
    matrix = np.random.default_rng(0).normal(size=(int(DAY / plan.cadence_ns), len(plan.library.columns) + 1))

    def make() -> None:
        reader.clear_cache()
        for block in some:
            block_grams(cat, mission, plan, index, derived, block)

    def read() -> None:
        for day in (day for block in some for day in block):
            known = ArchiveIndex(index.days)
            load_samples(cat, mission, plan.model, day, list(plan.needs), known, geometry=False)
            reader.clear_cache()
            reader.day(day)

    with one_thread():
        make()
        blas = 2 * min(timed(lambda: matrix.T @ matrix, 5))
        return Row(
            what=f"statistics of a day, {matrix.shape[1]} columns at {plan.cadence_ns / SECOND:g} s",
            seconds=[one / count for one in timed(make, 3)],
            floor_s=min(timed(read, 3)) / count + blas,
            floor="statistics: the day read, decoded and aligned, X'X in two forms, one core",
            aim="0.3 s",
        )
