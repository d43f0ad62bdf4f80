"""Effects that a search took, estimated again at the data's own cadence, all together with the calibration.

A search works on means of 10 s to a minute. Values and errors that are published must not depend on that
choice: `NativeEstimator` makes Gram blocks of the model's columns and of those taken from the native samples
(a pass of its own, over few columns and the channels they need) and returns the search on them: its choices,
in a joint fit of everything. Blocks are kept like those of the search: the same effects cost no second pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from inflight.catalog import Catalog
from inflight.design import Library
from inflight.diagnosis import Native, Option, Search
from inflight.frames import GEOMETRY
from inflight.mission import Mission
from inflight.progress import Progress
from inflight.samples import parse_channel
from inflight.tasks.analysis.gram_pass import PassPlan, load_estimate_grams, make_blocks
from inflight.tasks.analysis.settings import DiagnoseSettings
from inflight.tasks.archive import ArchiveIndex, Need
from inflight.tasks.batches import end_processes, give_back_memory
from inflight.tasks.pipelines import learns_states
from inflight.time import SECOND, day_bounds


@dataclass(frozen=True, kw_only=True)
class NativeEstimator:
    """Makes estimates at the data's own cadence, for searches over one pass.

    Attributes
    ----------
    plan : PassPlan
        Of the search's pass.
    index, base : ArchiveIndex, Need
        As of `inflight.tasks.analysis.gram_pass.make_blocks`.
    context : str
        Of the runs that make blocks.
    """

    cat: Catalog
    mission: Mission
    plan: PassPlan
    index: ArchiveIndex
    base: Need
    settings: DiagnoseSettings
    context: str
    client: Any = None
    progress: Progress

    @property
    def cadence_ns(self) -> int:
        """The slower of the cadences of the instruments that are compared."""
        return max(need.cadence_ns for need in self.plan.needs if need.channel == "field")

    def __call__(self, search: Search, numbers: bool = False, near: Sequence[Option] = ()) -> Native | None:
        """Return what a search took on Gram blocks at the native cadence.

        There is none where the search itself was at the native cadence, where a block of the search could not
        be made, and where channels stand for the levels they switch between: of these, samples near a
        switching, which may be on its wrong side, would only weigh more.

        Parameters
        ----------
        numbers : bool
            The model's own numbers are estimated, too, and where nothing was taken they alone.
        near : sequence of Option
            What else is to have columns: what was taken is held against it.
        """
        same = self.plan.folding is not None or self.cadence_ns >= self.plan.cadence_ns
        nothing = not search.accepted and not (numbers and search.library.refined)
        if same or nothing or learns_states(self.mission, self.settings.comparison):
            return None
        plan = self._plan_for(search, near)
        give_back_memory()
        _, blocks, _ = make_blocks(
            self.cat,
            self.mission,
            plan,
            self.index,
            self.base,
            self.settings,
            self.context,
            f"equations/{self.settings.comparison}/native",
            self.client,
            lambda stage, done, total: self.progress("estimate", done, total),
        )
        end_processes(self.client)
        raw, series = load_estimate_grams(self.cat, plan, blocks, self.progress)
        if raw.start.tolist() != search.raw.start.tolist():
            return None
        return Native(search.with_grams(raw, plan.library), self.cadence_ns / SECOND, series)

    def _plan_for(self, search: Search, near: Sequence[Option]) -> PassPlan:
        """Return the plan of a pass over what the search took and others, with the channels that it needs."""
        own = search.library
        sources = {source for option in (*search.accepted, *near) for source in option.sources}
        there = {name for term in (*own.base, *own.refined) for name in term.columns}
        needed = {term.key: term for term in own.all_terms if set(term.columns) & (sources - there)}
        edges = search.fitted_terms[len(own.refined) :]
        library = Library(own.base, own.refined, needed, edges=edges, edged=own.edged)
        used = {part.channel for name in library.channels for part in parse_channel(name).parts}
        geometry = {
            home
            for instrument, name, channel in self.mission.channel_instruments()
            if channel.kind in ("position", "attitude") and used & set(GEOMETRY)
            for home in (name, f"{instrument}.{name}")
        }
        named = used | set(library.channels) | geometry
        needs = tuple(need for need in self.plan.channel_needs if need.name in named)
        summaries = {name: one for name, one in self.plan.channel_summaries.items() if name in named}
        # Days whose blocks the search lacks have no part in what it found.
        spans = [(day_bounds(block[0])[0], day_bounds(block[-1])[1]) for block in self.plan.blocks]
        before = np.searchsorted(search.raw.start, np.array(spans))
        blocks = tuple(
            block for block, (first, last) in zip(self.plan.blocks, before, strict=True) if last > first
        )
        return replace(
            self.plan,
            blocks=blocks,
            cadence_ns=self.cadence_ns,
            library=library,
            channel_needs=needs,
            channel_summaries=summaries,
            estimates=True,
        )
