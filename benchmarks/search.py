"""The search: ranking 300 candidates of 3000 days, and the pass against reading, decoding and BLAS.

Gram blocks of 3000 days is made from random rows with the structure of real evidence: nine parameters,
a few of a model, 300 candidates of three columns, 200 blocks. The ranking reads nothing else.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.nine import timed
from inflight.catalog import Catalog, Workspace
from inflight.diagnosis import ModelColumns, draw_signs, family_wise_p, make_folds, score, sign_flip_ratios
from inflight.lsq import GramArrays, GramBlocks
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


def ranking(draws: int = 2000) -> list[str]:
    """Return the lines to print: scores, cross-validation and flips of one form, and of all three."""
    made = synthetic()
    y = len(made.grams.names) - 1

    def scored() -> object:
        return score(made.grams, made.present, made.candidates, y, make_folds(len(made.grams)))

    def flipped() -> object:
        signs, units = draw_signs(len(made.grams), draws, 0)
        observed, drawn = sign_flip_ratios(made.grams, made.present, made.candidates, y, signs, units)
        return family_wise_p(observed, drawn)

    with threadpool_limits(1):
        begun = time.perf_counter()
        scored()
        first = time.perf_counter() - begun
        again, flips = timed(scored, 3) / 1e3, timed(flipped, 3) / 1e3
    size = made.grams.gram[0].nbytes / 2 / 15
    return [
        f"ranking {CANDIDATES} candidates ({len(made.grams.names)} columns, {len(made.grams)} blocks):",
        f"  one form: cross-validation {again:.2f} s (first time {first:.2f} s), {draws} flips {flips:.2f} s",
        f"  raw, within-day and prewhitened: {3 * (again + flips):.1f} s (aim 1.5 s)",
        f"  stored: {size / 1e3:.0f} kB a day and form",
    ]


def evidence_pass(cat: Catalog, days: int = 8) -> list[str]:
    """Return the lines to print: the pass of a mission against its floor, a day and core."""
    from inflight.tasks.analysis import block_grams
    from inflight.tasks.analysis import diagnosis as diagnose
    from inflight.tasks.archive import ArchiveIndex, ChannelReader, DerivedChannels, load_samples
    from inflight.tasks.pipelines import learns_states

    mission = Workspace.open(cat.workspace).mission()
    made = diagnose.plan_pass(cat, mission, diagnose.DiagnoseSettings())
    plan, index = made.plan, made.index
    reader = ChannelReader(
        cat,
        mission,
        plan.channel_needs,
        index,
        plan.cadence_ns,
        plan.span,
        by_levels=learns_states(mission, "main"),
    )
    derived = DerivedChannels(reader, plan.days, plan.channel_summaries, plan.library.placebos)
    some = plan.blocks[2 : 2 + days]
    columns = len(plan.library.columns)
    rows = int(DAY / plan.cadence_ns)
    matrix = np.random.default_rng(0).normal(size=(rows, columns + 1))
    with threadpool_limits(1):

        def make() -> None:
            reader.clear_cache()
            for block in some:
                block_grams(cat, mission, plan, index, derived, block)

        whole = timed(make, 3) / 1e3 / len(some)

        def read() -> None:
            for block in some:
                needs = list(plan.needs)
                load_samples(
                    cat, mission, plan.model, block[0], needs, ArchiveIndex(index.days), geometry=False
                )
                reader.clear_cache()
                reader.day(block[0])

        reading = timed(read, 3) / 1e3 / len(some)
        blas = 2 * timed(lambda: matrix.T @ matrix, 5) / 1e3
    return [
        f"evidence of a day: {columns} columns at {plan.cadence_ns / SECOND:g} s, two forms: {whole:.2f} s",
        f"  floor: reading {reading:.2f} s, BLAS {blas:.2f} s; ratio {whole / (reading + blas):.1f} (aim 2)",
    ]
