"""Coverage: how often the truth lies within one and two stated sigmas of the values a search gives an effect.

The design is that of a simulated mission's own pass: its rows, its calibration, its library. Only the
residual is drawn anew, many times: an effect of known values, the noise of the samples, a parameter of the
calibration that drifts irregularly, a unit that no channel tells of and that switches at random, and every
number that the model holds with a stated sigma, off by a draw from it. In some rows the noise is that of two
instruments whose stamps do not coincide. Right counts lie within their binomial interval, all but one in a
hundred.

``make coverage`` prints the table; docs/reference/coverage.md shows it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
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
from inflight.samples import Series, align
from inflight.tasks.analysis import DiagnoseSettings
from inflight.tasks.analysis.diagnosis import PlannedPass, plan_pass
from inflight.tasks.analysis.gram_pass import day_rows
from inflight.tasks.archive import ChannelReader, DerivedChannels
from inflight.time import DAY, SECOND, Int64, day_bounds


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
    uneven, jitter : float
        Of an instrument with stamps of its own: spacing, in that of the rows, and scatter of its stamps.
    searched : int
        Draws of which it is asked what the search takes first: a search costs thirty times an estimate.
    chance : float
        Chance of right counts to be outside their interval.
    """

    noise_nT: float = 0.1  # noqa: N815 (a unit)
    size: float = 0.5
    unit: float = 0.2
    drift: float = 0.2
    dwell_s: float = 2400.0
    memory_s: float = 43_200.0
    uneven: float = 1.001
    jitter: float = 0.05
    searched: int = 40
    chance: float = 0.01


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """Counts of one effect: values drawn, those within one and two sigmas; the same where it was found.

    `searched` are the draws that were searched, `others` those of them in which another effect or another
    form of it was taken first; `pull` is the rms of the errors in stated sigmas; `noise` says what is in the
    data.
    """

    family: str
    name: str
    noise: str
    columns: int
    values: int
    searched: int
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


@dataclass(frozen=True)
class _Day:
    """Rows of a day, edges of its blocks, and each form's columns with their own Gram matrices."""

    rows: DesignRows
    edges: list[int]
    parts: list[slice]
    columns: tuple[Floats, Floats]
    grams: tuple[Floats, Floats]


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
        self.columns = {name: place for place, name in enumerate(plan.library.columns)}

    def rows(self) -> Iterator[tuple[DesignRows, list[int]]]:
        """Yield the rows of each day, and the edges of its blocks."""
        for day in self.each:
            yield day.rows, day.edges

    @cached_property
    def each(self) -> list[_Day]:
        """Every day: its columns do not change with the residual, and are made once."""
        plan, out = self.made.plan, []
        for day in self.days:
            rows, _ = day_rows(self.cat, self.mission, plan, self.made.index, self.derived, day)
            first, last = day_bounds(day)
            edges = [first + part * (last - first) // plan.parts for part in range(plan.parts + 1)]
            stamps = rows.samples["tt2000"].values
            parts = parts_of(stamps, edges)
            plain = design_matrix(plan.library.all_terms, rows)
            both = (plain, prewhiten(plain, rows.weight, stamps, plan.correlation_time_s))
            nothing = np.zeros((*plain.shape[:2], 0))
            grams = [gram_of(columns, nothing, rows.weight, parts) for columns in both]
            out.append(_Day(rows, edges, parts, (both[0][:, 0], both[1][:, 0]), (grams[0], grams[1])))
        return out

    def grams(self, residuals: list[Floats]) -> tuple[GramArrays, GramArrays]:
        """Return the Gram blocks over residuals, raw and prewhitened; (time, residual) of each day's rows."""
        plan = self.made.plan
        found: list[list[GramArrays]] = [[], []]
        count, kinds = residuals[0].shape[1], len(self.columns)
        names = (*self.columns, *(f"residual~{k}" if k else "residual" for k in range(count)))
        scale = np.array([*plan.scale, *np.ones(count)])
        for day, drawn in zip(self.each, residuals, strict=True):
            weight, edges = day.rows.weight, np.array(day.edges)
            stamps = day.rows.samples["tt2000"].values
            values = np.where(weight > 0, drawn.T, 0.0).T
            white = prewhiten(values, weight, stamps, plan.correlation_time_s)
            in_part = np.array([weight[part].sum() for part in day.parts])
            for out, left, columns, own in zip(found, (values, white), day.columns, day.grams, strict=True):
                gram = np.zeros((len(day.parts), kinds + count, kinds + count))
                gram[:, :kinds, :kinds] = own
                for one, part in zip(gram, day.parts, strict=True):
                    weighted = left[part] * weight[part, None]
                    one[:kinds, kinds:] = columns[part].T @ weighted
                    one[kinds:, :kinds] = one[:kinds, kinds:].T
                    one[kinds:, kinds:] = left[part].T @ weighted
                out.append(GramArrays(names, gram, edges[:-1], edges[1:], in_part, scale))
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


@dataclass(frozen=True)
class Draws:
    """What is drawn of one option: without the unit, with it, or with it and noise of uneven stamps."""

    option: Option
    seeds: int
    unit: bool = True
    uneven: bool = False

    @property
    def words(self) -> str:
        """What is in the data beside noise and drift."""
        return "a unit, uneven stamps" if self.uneven else "a unit" if self.unit else ""


def families(search: Search) -> dict[str, Option]:
    """Return one option of each family and of each form that acts on a sensor, the plainest of each."""
    chosen: dict[str, Option] = {}
    for option in search.options:
        if option.placebo or option.agnostic or option.change is not None:
            continue
        label = option.mechanism.partition("(")[0]
        if option.lag_s == 0.0:
            chosen.setdefault(option.family, option)
            if label.startswith("channel_"):
                chosen.setdefault(label, option)
        elif label == "channel_field":
            chosen.setdefault("lag", option)
    unique = {option.name: key for key, option in reversed(chosen.items())}
    return {key: option for key, option in chosen.items() if unique[option.name] == key}


def coverage(
    cat: Catalog, seeds: int = 200, settings: CoverageSettings | None = None, only: str = ""
) -> Iterator[Coverage]:
    """Yield the counts of one effect of each family and form, and of some with uneven stamps.

    Parameters
    ----------
    cat : Catalog
        Of a workspace with a scalar comparison and some days.
    seeds : int
        Residuals drawn of each.
    only : str
        Effects whose name holds this.
    """
    settings = settings or CoverageSettings()
    design = Design(cat)
    first = design.search([np.zeros((len(rows.weight), 1)) for rows, _ in design.rows()])
    chosen = [option for option in families(first).values() if only in option.name]
    rows = [Draws(option, seeds) for option in chosen]
    # What is quick: a rate has most of a high-pass in it, and a current that switches.
    rows += [
        Draws(one, seeds, uneven=True) for one in chosen if one.family in ("eddy", "current", "day_night")
    ]
    for draws in rows:
        yield _counts(design, first, draws, settings)


def _counts(design: Design, first: Search, draws: Draws, settings: CoverageSettings) -> Coverage:
    option, seeds = draws.option, draws.seeds
    generator = np.random.default_rng([seeds, *map(ord, option.name), draws.unit, draws.uneven])
    truth = _values(first, option, seeds, settings.size * settings.noise_nT, generator)
    residuals = _drawn(design, draws, truth, settings, generator)
    search = design.search(residuals)
    del residuals
    errors, told, others = [], [], dict[str, int]()
    for seed in range(seeds):
        own = replace(search, residual=seed)
        if seed < settings.searched:
            best = best_passing(own.table(), own)
            told.append(best is not None and best[0].name == option.name)
            if not told[-1]:
                name = best[0].name if best else "nothing"
                others[name] = others.get(name, 0) + 1
        found = estimate(own.with_accepted([option]), option)
        errors.append((found.value - truth[:, seed] * _scale(first, option)) / found.sigma)
    every = np.abs(np.array(errors))
    right = np.flatnonzero(told)

    def within(some: Floats) -> tuple[int, int]:
        return int((some < 1.0).sum()), int((some < 2.0).sum())

    def pull(some: Floats) -> float:
        return float(np.sqrt(np.mean(some**2))) if some.size else np.nan

    return Coverage(
        family=option.family,
        name=option.name,
        noise=draws.words,
        columns=len(option.columns),
        values=every.size,
        searched=len(told),
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
    design: Design, draws: Draws, values: Floats, settings: CoverageSettings, generator: Any
) -> list[Floats]:
    """Return the residuals of each day; (time, seed)."""
    library, cadence = design.made.plan.library, design.made.plan.cadence_ns / SECOND
    seeds, noise_nT = draws.seeds, settings.noise_nT
    drift = np.exp(-cadence / settings.memory_s)
    state = generator.normal(size=(1, seeds))
    switched = generator.random(size=seeds) < 0.5
    # Of any direction: along the field there is a third of its square.
    unit = generator.normal(size=(3, seeds))
    size = settings.unit * noise_nT if draws.unit else 0.0
    unit *= 2.0 * np.sqrt(3.0) * size / np.linalg.norm(unit, axis=0)
    base = [design.columns[name] for term in library.base for name in term.columns]
    which = generator.integers(len(base), size=seeds)
    own = [design.columns[name] for name in draws.option.columns]
    numbers, off = _numbers(design, seeds, generator)
    out = []
    for day in design.each:
        rows, columns = day.rows, day.columns[0]
        times = len(rows.weight)
        with np.errstate(divide="ignore"):
            spread = np.where(rows.weight > 0, noise_nT / np.sqrt(rows.weight), 0.0)
        noise = generator.normal(size=(times, seeds))
        if draws.uneven:
            stamps = np.asarray(rows.samples["tt2000"].values)
            noise = (noise + _at_stamps(stamps, cadence, seeds, settings, generator)) / np.sqrt(2.0)
        drawn = noise * spread[:, None]
        kicks = generator.normal(size=(times, seeds)) * np.sqrt(1.0 - drift**2)
        walk, state = scipy.signal.lfilter([1.0], [1.0, -drift], kicks, axis=0, zi=drift * state)
        state = state / drift
        drifting = columns[:, base] / np.sqrt(np.mean(columns[:, base] ** 2, axis=0))
        drawn += settings.drift * noise_nT * walk * drifting[:, which]
        if draws.unit:
            changes = np.cumsum(generator.random(size=(times, seeds)) < cadence / settings.dwell_s, axis=0)
            state_of_unit = (changes + switched) % 2
            switched = state_of_unit[-1]
            drawn += (rows.directions[design.vector][:, 0] @ unit) * state_of_unit
        # y + X d is the residual after a change d: what must be added is hidden with the other sign.
        drawn -= columns[:, own] @ values + columns[:, numbers] @ off
        out.append(drawn)
    return out


def _numbers(design: Design, seeds: int, generator: Any) -> tuple[list[int], Floats]:
    """Return the columns of the numbers that the model holds with a sigma, and how far off they are, scaled.

    A stated sigma means that a number is off by a draw from it: where each was right, errors that count it
    would look too large. The calibration's own, which each interval fits anew, are among them.
    """
    places, scaled = [], []
    library = design.made.plan.library
    for term in (*library.refined, *library.base):
        for name, sigma, scale in zip(term.columns, term.sigma, term.scale, strict=True):
            if np.isfinite(sigma):
                places.append(design.columns[name])
                scaled.append(sigma / scale)
    return places, generator.normal(size=(len(places), seeds)) * np.array(scaled)[:, None]


def _at_stamps(
    stamps: Int64, cadence: float, seeds: int, settings: CoverageSettings, generator: Any
) -> Floats:
    """Return noise of readings with stamps of their own, resampled; (time, seed).

    Their spacing is nearly that of the rows, so that each lies elsewhere between two of them.
    """
    step = cadence * SECOND * settings.uneven
    count = int((stamps[-1] - stamps[0]) / step) + 80
    moved = np.arange(count) - 40 + generator.uniform(-settings.jitter, settings.jitter, count)
    moved += generator.random()
    own = stamps[0] + np.rint(moved * step).astype(np.int64)
    values = generator.normal(size=(count, seeds))
    series = Series(values, own, {"cadence_ns": round(step), "units": "nT"})
    return np.nan_to_num(np.asarray(align({"vector": series}, stamps)["vector"].values))


def table(counts: list[Coverage], settings: CoverageSettings | None = None) -> list[str]:
    """Return the lines of the table, as Markdown: shares within one and two sigmas, rms errors in sigmas."""
    settings = settings or CoverageSettings()
    out = [
        "| effect | in the data | given: 1 sigma | 2 sigma | rms | found | 1 sigma | 2 sigma | rms |",
        "|---|---|---|---|---|---|---|---|---|",
    ]

    def shares(count: int, within: tuple[int, int], pull: float, right: bool) -> str:
        if not count:
            return "- | - | -"
        return f"{within[0] / count:.1%} | {within[1] / count:.1%} | {pull:.2f}{'' if right else ' *'}"

    for one in counts:
        given, found = one.is_right(settings.chance)
        out.append(
            f"| `{one.name}` | {one.noise or '-'} "
            f"| {shares(one.values, one.within, one.pull, given)} "
            f"| {one.found_values / one.columns:.0f} of {one.searched} "
            f"| {shares(one.found_values, one.found_within, one.found_pull, found)} |"
        )
    return [*out, "", "`*`: outside the interval that holds 99 of 100 right counts."]
