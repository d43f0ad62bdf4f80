"""Compare the model with a scalar instrument: size of the residual before and after, and where it fails.

In go the products of days, out comes a `CompareReport` with what is drawn of it. Products are read, or what
the catalog keeps of them (`compare_days.py`), into a `Digest`: means of short spans, histograms, spectra.
Structures of the residual are found in these means (`inflight.residual`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.arrays import Floats
from inflight.calibration import describe_directions, reference_of
from inflight.catalog import Catalog, Day
from inflight.mission import Mission
from inflight.progress import Progress
from inflight.residual import (
    Coordinate,
    Dependence,
    Line,
    SpectrumSum,
    above_floor,
    add_power,
    daily_scatter,
    find_lines,
    finest_power,
    join_floors,
    known_periods,
    measure_dependences,
    merge_statistics,
    name_slow_changes,
    orbit_period,
    rank_dependences,
    record_lines,
    rising_or_falling,
)
from inflight.tasks.models import ModelHistory, current_model
from inflight.tasks.pipelines.base import (
    CompareReport,
    CompareResult,
    DigestPlan,
    EarlierProducts,
    EarlierResidual,
    blocks_of,
    day_summary,
    equations_of,
    iter_digests,
    scalar_channels,
    tables_in_use,
)
from inflight.tasks.pipelines.scalar.compare_days import (
    DIGEST_VERSION,
    BlockDigest,
    DayNumbers,
    digest_block,
    drawn_histogram,
)
from inflight.tasks.pipelines.scalar.compare_page import FigureData, Spectra, compare_parts, page_title
from inflight.tasks.pipelines.scalar.tables import load_equations, span_solution
from inflight.time import DAY, SECOND, Int64, day_bounds

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True, kw_only=True)
class CompareSettings:
    """How the products of a comparison are summarised.

    Attributes
    ----------
    most_rows : int
        Means of short spans that dependences and figures are made from, at most, in all; assumed.
    shortest_span_s : float
        Least length of such a span, s, which is doubled until there are few enough; assumed.
    least_spans : float
        Means show periods of so many of their lengths and more; spectra of days show the shorter ones;
        assumed.
    bins : int
        Bins of a histogram at most, of a power of two wide; assumed.
    half_width : float
        Of a histogram, in standard deviations of the first day; assumed.
    branch_rows : int
        Rows on either side over which a channel rises or falls; assumed.
    """

    most_rows: int = 400_000
    shortest_span_s: float = 60.0
    least_spans: float = 4.0
    bins: int = 160
    half_width: float = 8.0
    branch_rows: int = 2


COMPARE_SETTINGS = CompareSettings()

#: Columns of rows that are no coordinates.
_RESIDUAL_COLUMNS = {"tt2000", "before", "after", "low", "high"}

_UNITS = {
    "time": "d",
    "latitude": "deg",
    "longitude": "deg",
    "orbit phase": "deg",
    "sun phase": "deg",
    "local time": "h",
    "time of day": "h",
    "field strength": "nT",
    "Sun azimuth": "deg",
    "Sun elevation": "deg",
} | {f"field component {axis}": "nT" for axis in "xyz"}


def compare_samples(
    cat: Catalog,
    mission: Mission,
    comparison: str,
    days: Sequence[Day],
    span: slice,
    progress: Progress,
    client: Any = None,
    earlier: EarlierProducts | None = None,
) -> CompareResult[CompareReport]:
    """Measure the residual of each sample of published products, before and after calibration.

    Parameters
    ----------
    days : sequence of Day
        Of the products.
    span : slice
        Of the normal equations that show what the data determine.
    progress : callable
        Called with (stage, done, total).
    client : dask Client, optional
        On whose processes many days are read.
    earlier : EarlierProducts, optional
        Of another version of the model, set beside these.
    """
    # First: what is kept of the earlier products is superseded by what is made of these.
    other = digest_days(cat, mission, comparison, earlier.days, progress, client, True) if earlier else None
    digest = digest_days(cat, mission, comparison, days, progress, client)
    rows = {name: np.concatenate([row[name] for row in digest.rows]) for name in digest.rows[0]}
    daily, used = tables_in_use(cat, comparison, days[0])
    coordinates = {one.name: one for one in _coordinates(rows, mission)}
    if (window := _within_windows(used, rows["tt2000"])) is not None:
        coordinates[window.name] = window
    block, block_name = blocks_of(rows["tt2000"], len(days))
    found = measure_dependences(coordinates.values(), rows["after"], block)
    direction = np.stack([rows[f"field direction {axis}"] for axis in "xyz"], axis=1)
    spectra = _spectra(digest, rows, direction, mission)
    determined, directions = _determined(cat, mission, comparison, span, used, progress)
    before, after = ([getattr(one, state) for one in digest.days] for state in ("before", "after"))
    floor = join_floors([one.floor for one in digest.days])
    old = None
    if earlier is not None and other is not None:
        old = EarlierResidual(
            earlier.version,
            earlier.message,
            other.clear,
            above_floor(other.clear, floor.level_nT),
            [
                {"day": str(day.day), "after_nT": one.after.rms}
                for day, one in zip(earlier.days, other.days, strict=True)
            ],
        )
    report = CompareReport(
        comparison=comparison,
        context=days[-1].context or "",
        before=merge_statistics(before),
        after=merge_statistics(after),
        clear=digest.clear,
        version=cat.context(str(days[-1].context)).model_version if days[-1].context else 0,
        floor=floor,
        by_day=[day_summary(*of_day) for of_day in zip(days, before, after, strict=True)],
        fails_where=rank_dependences(coordinates, found, rows["after"], direction, block),
        directions=directions,
        determined=determined,
        block=block_name,
        lines=spectra.lines,
        daily_scatter=daily_scatter(daily, day_bounds(days[0].day)[0], day_bounds(days[-1].day)[1]),
        skipped=sum(one.skipped for one in digest.days),
        outliers=sum(one.outliers for one in digest.days),
        earlier=old,
        history=ModelHistory(cat, mission, comparison).items(),
    )
    curves = {} if other is None else _dependences_of(other, found, mission)
    spectrum = None if other is None else finest_power(other.power)
    data = FigureData(digest.histograms(), rows, spectra, found, (daily, used), curves, spectrum)
    return CompareResult(report, page_title(report, mission), compare_parts(report, data), data)


@dataclass
class Digest:
    """What is kept of the days' products: small, however long the mission.

    Attributes
    ----------
    length : float
        Of the short spans, s.
    rows : list of dict
        Of each day, means over the short spans, as `rows_of_day`.
    days : list of DayNumbers
    power_before, power : dict
        Spectra by the length of their stretches.
    counts : ndarray of int64, shape (2, bin)
        Histograms before and after, each about the day's mean; bins as `bin_edges`.
    """

    length: float
    rows: list[dict[str, Floats]] = field(default_factory=list)
    days: list[DayNumbers] = field(default_factory=list)
    power_before: dict[tuple[int, float], SpectrumSum] = field(default_factory=dict)
    power: dict[tuple[int, float], SpectrumSum] = field(default_factory=dict)
    counts: Int64 | None = None

    def add(self, block: BlockDigest) -> None:
        """Add the days of a block."""
        edges = np.cumsum([one.rows for one in block.days])[:-1]
        parts = {name: np.split(values, edges) for name, values in block.rows.items()}
        self.rows += [{name: part[at] for name, part in parts.items()} for at in range(len(block.days))]
        self.days += block.days
        for sums, own in ((self.power_before, block.power_before), (self.power, block.power)):
            for power in own.values():
                add_power(sums, power)
        self.counts = block.counts if self.counts is None else self.counts + block.counts

    @property
    def clear(self) -> float:
        """Rms after calibration without outliers, nT."""
        count = sum(one.samples for one in self.days)
        return float(np.sqrt(sum(one.samples * one.clear**2 for one in self.days) / count)) if count else 0.0

    def histograms(self) -> dict[str, Floats]:
        """Return histograms ``before`` and ``after`` over ``edges``, nT; the first day sets the range."""
        spread = next((one.after.std for one in self.days if one.after.count), 0.0)
        half_width = COMPARE_SETTINGS.half_width * max(spread, 1e-3)
        assert self.counts is not None  # there is at least one day
        edges, (before, after) = drawn_histogram(self.counts, half_width, COMPARE_SETTINGS.bins)
        return {"edges": edges, "before": before, "after": after}


def span_length(days: int) -> float:
    """Return the length of the short spans of a record of so many days, s.

    Twice as long where the record has twice the days, and the same in between, so that what is kept of a
    record serves when it grows.
    """
    length = COMPARE_SETTINGS.shortest_span_s
    while 86_400.0 * days / length > COMPARE_SETTINGS.most_rows:
        length *= 2.0
    return length


def digest_days(
    cat: Catalog,
    mission: Mission,
    comparison: str,
    days: Sequence[Day],
    progress: Progress,
    client: Any = None,
    earlier: bool = False,
) -> Digest:
    """Return what is compared of products, published or `earlier` ones: read now, or kept of them."""
    digest = Digest(span_length(len(days)))
    plan = DigestPlan(
        cat=cat,
        mission=mission,
        comparison=comparison,
        dataset=f"comparison/{comparison}/{digest.length:.0f}s",
        version=DIGEST_VERSION,
        kind=BlockDigest,
        make=digest_block,
        options=(digest.length,),
        earlier=earlier,
    )
    for block in iter_digests(plan, days, client, progress):
        digest.add(block)
    return digest


def _dependences_of(digest: Digest, found: Sequence[Dependence], mission: Mission) -> dict[str, Dependence]:
    """Return by coordinate what another residual of the same days follows, of coordinates that are drawn."""
    rows = {name: np.concatenate([row[name] for row in digest.rows]) for name in digest.rows[0]}
    drawn = {one.coordinate for one in found}
    coordinates = [one for one in _coordinates(rows, mission) if one.name in drawn]
    block, _ = blocks_of(rows["tt2000"], len(digest.days))
    return {one.coordinate: one for one in measure_dependences(coordinates, rows["after"], block)}


def _determined(
    cat: Catalog, mission: Mission, comparison: str, span: slice, used: xr.Dataset, progress: Progress
) -> tuple[list[str], list[str]]:
    """Return the parameters, and the combinations of them, that the span's equations determine.

    A fit of all days at once keeps no equations of single days: its table says what it determines.
    """
    days = cat.days(equations_of(comparison), span, states=("published",))
    if not days and "determined" in used:
        sure = zip(used["parameter"].values, used["determined"].values[-1], strict=True)
        return [str(name) for name, known in sure if known], []
    equations = load_equations(cat, days, progress)
    model = current_model(cat, mission, comparison).model
    solution = span_solution(equations, model)
    names = reference_of(model, int(equations.dataset["start"].values[0])).columns
    known = [name for name, sure in zip(names, solution.determined, strict=True) if sure]
    return known, describe_directions(solution, names)


def _spectra(digest: Digest, rows: dict[str, Floats], direction: Floats, mission: Mission) -> Spectra:
    """Return the spectra of days and of weeks, and the lines in them."""
    stated = {name: period / SECOND for name, period in mission.periods.items()}
    seconds = rows["tt2000"] / SECOND
    orbit = orbit_period(seconds, rows["orbit phase"]) if "orbit phase" in rows else None
    known, shortest = known_periods(stated, orbit), COMPARE_SETTINGS.least_spans * digest.length
    fast, before = finest_power(digest.power), finest_power(digest.power_before)
    slow, slow_lines = record_lines(
        (seconds, rows["after"], direction), digest.length, known, shortest=shortest
    )
    lines: list[Line] = find_lines(fast, known, longest=shortest if slow else np.inf) if fast else []
    lines += slow_lines
    if slow is not None:
        lines = name_slow_changes(lines, slow.step)
    lines.sort(key=lambda line: (not line.is_new, line.is_known, -line.strength))
    return Spectra(fast, before, slow, lines, known)


def _within_windows(table: xr.Dataset, tt2000: Floats) -> Coordinate | None:
    """Return the time since each calibration window began; None unless there are several of several days."""
    start = np.sort(np.asarray(table["start"].values, dtype=np.int64))
    inside = np.searchsorted(start, tt2000, side="right") - 1
    if np.unique(inside).size < 2 or np.median(np.diff(start)) < 2 * DAY:
        return None
    passed = (tt2000 - start[np.clip(inside, 0, None)]) / DAY
    return Coordinate("time in the calibration window", "d", "window", np.where(inside < 0, np.nan, passed))


def _coordinates(rows: dict[str, Floats], mission: Mission) -> Iterator[Coordinate]:
    """Yield everything the residual may follow: time, geometry, field, every channel with its branches."""
    channels = scalar_channels(mission)
    yield Coordinate("time", "d", "time", (rows["tt2000"] - rows["tt2000"][0]) / DAY)
    for name, values in rows.items():
        if name in _RESIDUAL_COLUMNS:
            continue
        if name in channels:
            channel = channels[name][2]
            branch = rising_or_falling(values, COMPARE_SETTINGS.branch_rows)
            yield Coordinate(name, channel.unit, channel.kind, values, branch)
        else:
            # As `inflight.residual.dependence` knows kinds: all three components of one are of a kind.
            kind = "_".join(name.removesuffix(" x").removesuffix(" y").removesuffix(" z").split())
            kind = "sun_angle" if name.startswith("Sun ") else kind
            yield Coordinate(name, _UNITS.get(name, ""), kind, values)
