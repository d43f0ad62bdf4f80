"""Coverage: how often the truth lies within one and two stated sigmas of the values a search gives an effect.

The design is that of a simulated mission's own pass: its rows, its calibration, its library. Only the
residual is drawn anew, many times: an effect of known values, the noise of the samples, a parameter of the
calibration that drifts irregularly, and, in half of the table, a unit that no channel tells of and that
switches at random. Right counts lie within their binomial interval, all but one in a hundred.

``make coverage`` prints the table; docs/reference/coverage.md shows it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from inflight.arrays import Floats
from inflight.catalog import Catalog, Workspace
from inflight.design import DesignRows, Library, design_matrix
from inflight.diagnosis import Search, estimate, time_variable_columns
from inflight.diagnosis.search import Option
from inflight.diagnosis.stepwise import best_passing
from inflight.lsq import GramArrays, gram_of, parts_of, prewhiten
from inflight.tasks.analysis import DiagnoseSettings
from inflight.tasks.analysis.diagnosis import PlannedPass, plan_pass
from inflight.tasks.analysis.gram_pass import day_rows
from inflight.tasks.archive import ChannelReader, DerivedChannels
from inflight.time import DAY, SECOND, day_bounds


@dataclass(frozen=True, kw_only=True)
class CoverageSettings:
    """What is drawn.

    Attributes
    ----------
    noise_nT : float
        Of a row, all of whose samples are there.
    size, unit, drift : float
        Rms, in noises of a row, of what the calibration leaves of the effect, of what the unit does along the
        field on the average, and of what the drifting parameter does.
    dwell_s, memory_s : float
        Mean time between switchings of the unit, and correlation time of the drift, s.
    chance : float
        Chance of right counts to be outside their interval.
    """

    noise_nT: float = 0.1  # noqa: N815 (a unit)
    size: float = 0.5
    unit: float = 0.2
    drift: float = 0.2
    dwell_s: float = 2400.0
    memory_s: float = 43_200.0
    chance: float = 0.01


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """Counts of one effect: values drawn, those within one and two sigmas; the same where it was found.

    `others` are the draws in which another effect or another form of it was taken first; `pull` is the rms of
    the errors in stated sigmas.
    """

    family: str
    name: str
    unit: bool
    columns: int
    values: int
    within: tuple[int, int]
    pull: float
    found_values: int
    found_within: tuple[int, int]
    found_pull: float
    others: dict[str, int]

    def is_right(self, chance: float) -> tuple[bool, bool]:
        """Return whether the counts of all draws, and of those that found it, lie in their intervals."""
        given, found = (
            all(
                low <= k / max(count, 1) <= high
                for k, (low, high) in zip(within, intervals(count // self.columns, chance), strict=True)
            )
            for count, within in ((self.values, self.within), (self.found_values, self.found_within))
        )
        return given, found


def intervals(draws: int, chance: float) -> list[tuple[float, float]]:
    """Return the shares between which right ones lie, within one and two sigmas, all but a chance.

    The values of one draw share its noise: only draws are independent.
    """
    if not draws:
        return [(0.0, 1.0)] * 2
    shares = [scipy.special.erf(k / np.sqrt(2.0)) for k in (1, 2)]
    low_high = [scipy.stats.binom.interval(1.0 - chance, draws, share) for share in shares]
    return [(float(low) / draws, float(high) / draws) for low, high in low_high]


class Design:
    """The rows of every day of a workspace, its library, and searches over residuals drawn on them."""

    def __init__(self, cat: Catalog) -> None:
        self.cat, self.mission = cat, Workspace.open(cat.workspace).mission()
        self.made: PlannedPass = plan_pass(cat, self.mission, DiagnoseSettings())
        plan = self.made.plan
        reader = ChannelReader(
            cat, self.mission, plan.channel_needs, self.made.index, plan.cadence_ns, plan.span, "main"
        )
        self.derived = DerivedChannels(
            reader, plan.days, plan.channel_summaries, plan.library.placebos, plan.origin.days
        )
        self.vector = self.mission.comparisons["main"].instruments()["vector"]
        self.days = [day for block in plan.blocks for day in block]

    def rows(self) -> Iterator[tuple[DesignRows, list[int]]]:
        """Yield the rows of each day, and the edges of its blocks."""
        plan = self.made.plan
        for day in self.days:
            rows, _ = day_rows(self.cat, self.mission, plan, self.made.index, self.derived, day)
            first, last = day_bounds(day)
            yield rows, [first + part * (last - first) // plan.parts for part in range(plan.parts + 1)]

    def grams(self, residuals: list[Floats]) -> tuple[GramArrays, GramArrays]:
        """Return the Gram blocks over residuals, raw and prewhitened; (time, residual) of each day's rows."""
        plan, library = self.made.plan, self.made.plan.library
        found: list[list[GramArrays]] = [[], []]
        count = residuals[0].shape[1]
        names = (*library.columns, *(f"residual~{k}" if k else "residual" for k in range(count)))
        scale = np.array([*plan.scale, *np.ones(count)])
        for (rows, edges), drawn in zip(self.rows(), residuals, strict=True):
            columns, stamps = design_matrix(library.all_terms, rows), rows.samples["tt2000"].values
            parts = parts_of(stamps, edges)
            values = (columns, np.where(rows.weight > 0, drawn.T, 0.0).T[:, None, :])
            white = [prewhiten(one, rows.weight, stamps, plan.correlation_time_s) for one in values]
            in_part = np.array([rows.weight[part].sum() for part in parts])
            for out, pair in zip(found, (values, white), strict=True):
                gram = gram_of(*pair, rows.weight, parts)
                out.append(GramArrays(names, gram, np.array(edges[:-1]), np.array(edges[1:]), in_part, scale))
        raw, prewhitened = (one[0].join(one[1:]) for one in found)
        return raw, prewhitened

    def search(self, residuals: list[Floats]) -> Search:
        """Return the first state of a search over residuals; (time, residual) of each day's rows."""
        return search_over(*self.grams(residuals), self.made.plan.library)


def search_over(raw: GramArrays, prewhitened: GramArrays, library: Library) -> Search:
    """Return the first state of a search, with calibration intervals of half a month."""
    day = (raw.start - raw.start[0]) // DAY
    groups = [np.flatnonzero(day == one).tolist() for one in np.unique(day)]
    intervals_of = [np.flatnonzero(day // 15 == one).tolist() for one in np.unique(day // 15)]
    return Search.begin(
        raw, prewhitened, library, intervals_of, groups, time_variable=time_variable_columns(library)
    )


def coverage(cat: Catalog, seeds: int = 200, settings: CoverageSettings | None = None) -> Iterator[Coverage]:
    """Yield the counts of one effect of each family, without a unit that switches in the data and with one.

    Parameters
    ----------
    cat : Catalog
        Of a workspace with a scalar comparison and some days.
    seeds : int
        Residuals drawn of each.
    """
    settings = settings or CoverageSettings()
    design = Design(cat)
    first = design.search([np.zeros((len(rows.weight), 1)) for rows, _ in design.rows()])
    chosen: dict[str, Option] = {}
    for option in first.options:
        if not option.placebo and not option.agnostic and option.change is None and option.lag_s == 0.0:
            chosen.setdefault(option.family, option)
    for option in chosen.values():
        for unit in (False, True):
            yield _counts(design, first, option, unit, seeds, settings)


def _counts(
    design: Design, first: Search, option: Option, unit: bool, seeds: int, settings: CoverageSettings
) -> Coverage:
    generator = np.random.default_rng([seeds, *map(ord, option.name), unit])
    truth = _values(first, option, seeds, settings.size * settings.noise_nT, generator)
    size = settings.unit * settings.noise_nT if unit else 0.0
    residuals = _drawn(design, option, truth, size, seeds, settings, generator)
    search = design.search(residuals)
    errors, told, others = [], [], dict[str, int]()
    for seed in range(seeds):
        own = replace(search, residual=seed)
        best = best_passing(own.table(), own)
        if best is None or best[0].name != option.name:
            name = best[0].name if best else "nothing"
            others[name] = others.get(name, 0) + 1
        found = estimate(own.with_accepted([option]), option)
        errors.append((found.value - truth[:, seed] * _scale(first, option)) / found.sigma)
        told.append(best is not None and best[0].name == option.name)
    every, right = np.abs(np.array(errors)), np.array(told)

    def within(some: Floats) -> tuple[int, int]:
        return int((some < 1.0).sum()), int((some < 2.0).sum())

    def pull(some: Floats) -> float:
        return float(np.sqrt(np.mean(some**2))) if some.size else np.nan

    return Coverage(
        family=option.family,
        name=option.name,
        unit=unit,
        columns=len(option.columns),
        values=every.size,
        within=within(every),
        pull=pull(every),
        found_values=every[right].size,
        found_within=within(every[right]),
        found_pull=pull(every[right]),
        others=dict(sorted(others.items(), key=lambda one: -one[1])),
    )


def _scale(search: Search, option: Option) -> Floats:
    return search.raw.scale[search.raw.index(option.columns)]


def _values(search: Search, option: Option, seeds: int, size: float, generator: Any) -> Floats:
    """Return values of an option's columns, scaled, of any direction, that leave so much; (column, seed)."""
    form = search.forms["raw"]
    columns = form.index(option.columns)
    gram = form.rows(columns, columns).sum(axis=0)
    drawn = generator.normal(size=(columns.size, seeds)) / np.sqrt(np.diag(gram))[:, None]
    left = np.sqrt(np.einsum("cs,cd,ds->s", drawn, gram, drawn) / form.count.sum())
    return np.asarray(drawn * size / left)


def _drawn(
    design: Design,
    option: Option,
    values: Floats,
    unit_nT: float,
    seeds: int,
    settings: CoverageSettings,
    generator: Any,
) -> list[Floats]:
    """Return the residuals of each day; (time, seed)."""
    library, cadence = design.made.plan.library, design.made.plan.cadence_ns / SECOND
    drift = np.exp(-cadence / settings.memory_s)
    state = generator.normal(size=(1, seeds))
    switched = generator.random(size=seeds) < 0.5
    # Of any direction: along the field there is a third of its square.
    unit = generator.normal(size=(3, seeds))
    unit *= 2.0 * np.sqrt(3.0) * unit_nT / np.linalg.norm(unit, axis=0)
    which = generator.integers(sum(len(term.columns) for term in library.base), size=seeds)
    terms = [library.by_key[key] for key in option.terms]
    out = []
    for rows, _ in design.rows():
        times = len(rows.weight)
        with np.errstate(divide="ignore"):
            spread = np.where(rows.weight > 0, settings.noise_nT / np.sqrt(rows.weight), 0.0)
        drawn = generator.normal(size=(times, seeds)) * spread[:, None]
        kicks = generator.normal(size=(times, seeds)) * np.sqrt(1.0 - drift**2)
        walk, state = scipy.signal.lfilter([1.0], [1.0, -drift], kicks, axis=0, zi=drift * state)
        state = state / drift
        own = design_matrix(library.base, rows)[:, 0]
        own /= np.sqrt(np.mean(own**2, axis=0))
        drawn += settings.drift * settings.noise_nT * walk * own[:, which]
        changes = np.cumsum(generator.random(size=(times, seeds)) < cadence / settings.dwell_s, axis=0)
        state_of_unit = (changes + switched) % 2
        switched = state_of_unit[-1]
        drawn += (rows.directions[design.vector][:, 0] @ unit) * state_of_unit
        # y + X d is the residual after a change d: what must be added is hidden with the other sign.
        drawn -= design_matrix(terms, rows)[:, 0] @ values
        out.append(drawn)
    return out


def table(counts: list[Coverage], settings: CoverageSettings | None = None) -> list[str]:
    """Return the lines of the table, as Markdown: shares within one and two sigmas, rms errors in sigmas."""
    settings = settings or CoverageSettings()
    out = [
        "| effect | a unit switches | given: 1 sigma | 2 sigma | rms | found | 1 sigma | 2 sigma | rms |",
        "|---|---|---|---|---|---|---|---|---|",
    ]

    def shares(count: int, within: tuple[int, int], pull: float, right: bool) -> str:
        if not count:
            return "- | - | -"
        return f"{within[0] / count:.1%} | {within[1] / count:.1%} | {pull:.2f}{'' if right else ' *'}"

    for one in counts:
        given, found = one.is_right(settings.chance)
        out.append(
            f"| {one.name} | {'yes' if one.unit else 'no'} "
            f"| {shares(one.values, one.within, one.pull, given)} "
            f"| {one.found_values / one.values:.0%} "
            f"| {shares(one.found_values, one.found_within, one.found_pull, found)} |"
        )
    return [*out, "", "`*`: outside the interval that holds 99 of 100 right counts."]
