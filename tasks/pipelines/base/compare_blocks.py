"""Digests of blocks of days: what a comparison reads of products, made once and kept by the catalog.

A comparison takes from the products of days what it needs of them (a *digest*), a block of `BLOCK_DAYS` days
at a time. Blocks lie on a fixed grid of dates, so that they are the same whatever span is compared; a whole
one is kept as a day of a dataset of its own, named by its first date, under a key of all it is made from.
The days at the two ends of a span that are no whole block are read again by each comparison.

`iter_digests` gives the digests in order. Blocks that are not kept are made here, or on the processes of a
Dask client where they are many; what is made is the same.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING, Any, Generic, Protocol, Self, TypeVar

import numpy as np

from inflight.catalog import Catalog, Day, DayData, Run, Segment, idempotency_key, write_segment
from inflight.errors import CatalogError, StorageError
from inflight.mission import Mission
from inflight.progress import Progress
from inflight.tasks.batches import few_at_once, iter_results
from inflight.tasks.pipelines.base.compare_rows import Sources
from inflight.tasks.pipelines.base.publication import reuse_interrupted_days
from inflight.threads import one_thread
from inflight.time import day_bounds

if TYPE_CHECKING:
    import xarray as xr

#: Days of a block.
BLOCK_DAYS = 8

#: Days to make from which on processes are started for them: they take some three seconds to start. Assumed.
DAYS_FOR_PROCESSES = 200

#: Threads that make fewer days. Assumed: what they do is bound by memory.
THREADS = 2

_ONE_DAY = np.timedelta64(1, "D")


class Digest(Protocol):
    """What is kept of the products of some days."""

    def as_dataset(self) -> xr.Dataset:
        """Return it as arrays over one `block`."""

    @classmethod
    def of_dataset(cls, kept: xr.Dataset) -> Self:
        """Return what `as_dataset` made."""


D = TypeVar("D", bound=Digest)


@dataclass(frozen=True, kw_only=True)
class DigestPlan(Generic[D]):
    """How digests of a comparison are made.

    Attributes
    ----------
    dataset : str
        In which whole blocks of published products are kept. It is in every key, so that a block is the same
        in whichever dataset it is found.
    version : int
        Of the algorithm.
    kind : type
        Of the digest.
    make : callable
        Returns the digest of some days: (catalog, mission, comparison, sources, days, *options).
    options : tuple
        What `make` takes beyond, plain numbers.
    earlier : bool
        Of products before the published ones, whose blocks are kept in ``<dataset>-earlier``: what was kept
        of them while they were published goes there.
    """

    cat: Catalog
    mission: Mission
    comparison: str
    dataset: str
    version: int
    kind: type[D]
    make: Callable[..., D]
    options: tuple[Any, ...] = ()
    earlier: bool = False

    @property
    def kept_in(self) -> tuple[str, str]:
        """Return the dataset that blocks are kept in, and the other one that may have them."""
        both = (self.dataset, f"{self.dataset}-earlier")
        return both[::-1] if self.earlier else both


@dataclass(frozen=True)
class _Block:
    """The days of one block; `key` is empty, and nothing kept, unless all of the block is in the span."""

    first: np.datetime64
    days: tuple[Day, ...]
    sources: Sources
    key: str = ""
    run: str = ""
    parents: tuple[str, ...] = ()


def iter_digests(plan: DigestPlan[D], days: Sequence[Day], client: Any, progress: Progress) -> Iterator[D]:
    """Yield the digests of the blocks of all days, in order of time.

    Parameters
    ----------
    days : sequence of Day
        Of the products.
    client : dask Client or None
        On which many blocks are made.
    progress : callable
        Called with (stage, done, total), in days.
    """
    blocks = _blocks_of(plan, days)
    wanted = {block.first: block.key for block in blocks if block.key}
    kept, own = _kept_blocks(plan, wanted), plan.kept_in[0]
    missing = {first: key for first, key in wanted.items() if first not in kept or kept[first].dataset != own}
    done = 0
    progress("compare", 0, len(days))
    with ExitStack() as stack:
        run = _run_to_keep(plan, stack) if missing else None
        if run is not None:
            kept |= reuse_interrupted_days(run, own, missing, missing)
            blocks = [replace(one, run=run.id) if one.first in missing else one for one in blocks]
        todo = [block for block in blocks if block.first not in kept]
        made = _made_blocks(plan, todo, client, stack)
        for block in blocks:
            there, segment = kept.get(block.first), None
            if there is None:
                digest, segment = next(made)
            else:
                digest = plan.kind.of_dataset(plan.cat.read(there))
                if there.dataset != own:
                    segment = _keep(plan, block, digest)
            if run is not None and segment is not None:
                run.attach(segment)
            done += len(block.days)
            yield digest
            progress("compare", done, len(days))
        if run is not None:
            run.publish()


def _made_blocks(
    plan: DigestPlan[D], blocks: Sequence[_Block], client: Any, stack: ExitStack
) -> Iterator[tuple[D, Segment | None]]:
    """Return what makes the blocks in order: on the processes of the client where they are many."""
    jobs = [(plan, block) for block in blocks]
    if client is not None and sum(len(block.days) for block in blocks) >= DAYS_FOR_PROCESSES:
        return iter_results(client, digest_and_keep, jobs)
    # Decompression, transforms and sums let other threads run; they start at once. Limited here, too: the
    # limits of the threads begin and end at any time.
    stack.enter_context(one_thread())
    pool = stack.enter_context(ThreadPoolExecutor(min(THREADS, max(len(jobs), 1))))
    return few_at_once(lambda job: pool.submit(digest_and_keep, *job), lambda future: future.result(), jobs)


def digest_and_keep(plan: DigestPlan[D], block: _Block) -> tuple[D, Segment | None]:
    """Make the digest of a block, on one BLAS thread; write it as a segment when it belongs to a run."""
    with one_thread():
        digest = plan.make(plan.cat, plan.mission, plan.comparison, block.sources, block.days, *plan.options)
    return digest, _keep(plan, block, digest)


def _keep(plan: DigestPlan[D], block: _Block, digest: D) -> Segment | None:
    """Write the digest of a block as a segment when it belongs to a run and there is room."""
    if not block.run:
        return None
    kept = digest.as_dataset()
    kept["start"] = ("block", np.array([day_bounds(block.first)[0]], dtype=np.int64))
    data = DayData(block.first, kept, block.key, block.parents)
    try:
        return write_segment(plan.cat.workspace, block.run, plan.kept_in[0], [data])
    except StorageError:
        # A comparison is told where nothing can be kept, too.
        return None


def _blocks_of(plan: DigestPlan[D], days: Sequence[Day]) -> list[_Block]:
    """Cut days into blocks; whole ones get the key of what they are made from."""
    sources = Sources.of(plan.cat, plan.mission, slice(str(days[0].day), str(days[-1].day + _ONE_DAY)))
    mission = hashlib.sha256(plan.mission.text.encode()).hexdigest()
    blocks = []
    for number, members in groupby(days, key=lambda day: int(day.day.astype(np.int64)) // BLOCK_DAYS):
        first, inside = np.datetime64(number * BLOCK_DAYS, "D"), tuple(members)
        own = sources.of_days([day.day for day in inside])
        block = _Block(first, inside, own)
        if days[0].day <= first and first + BLOCK_DAYS * _ONE_DAY <= days[-1].day + _ONE_DAY:
            made_from = [*inside, *own.days.values()]
            inputs = [mission, *map(str, plan.options), *(f"{one.dataset} {one.key}" for one in made_from)]
            key = idempotency_key(plan.dataset, first, plan.version, "", inputs)
            block = replace(block, key=key, parents=tuple(one.id for one in made_from))
        blocks.append(block)
    return blocks


def _kept_blocks(plan: DigestPlan[D], wanted: Mapping[np.datetime64, str]) -> dict[np.datetime64, Day]:
    """Return the days that hold blocks as they would be made now, those of the plan's own dataset first.

    Parameters
    ----------
    wanted : mapping of date to str
        Keys of the whole blocks, by their first days.
    """
    if not wanted:
        return {}
    there = [day for name in reversed(plan.kept_in) for day in plan.cat.days(name, states=("published",))]
    return {day.day: day for day in there if wanted.get(day.day) == day.key}


def _run_to_keep(plan: DigestPlan[D], stack: ExitStack) -> Run | None:
    """Return a run that blocks are kept by; None where the workspace can only be read."""
    settings = {"comparison": plan.comparison, "dataset": plan.kept_in[0]}
    try:
        return stack.enter_context(plan.cat.run("compare", settings))
    except (CatalogError, StorageError):
        return None
