"""Compare the model with a scalar instrument: size of the residual before and after, and where it fails.

Days of products are read one after the other; what is kept of each (means of short spans, histograms,
spectra) is small, however long the mission. Structures of the residual are looked for in these means
(`inflight.residual`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import describe_directions, reference_of
from inflight.catalog import Catalog, Day
from inflight.flags import UNUSABLE, Flag
from inflight.frames import direction_of
from inflight.mission import Mission
from inflight.residual import (
    Coordinate,
    Line,
    NoiseFloor,
    Power,
    Size,
    add_power,
    daily_scatter,
    find_lines,
    finest_power,
    join_floors,
    join_sizes,
    known_periods,
    measure_dependences,
    noise_floor,
    orbit_period,
    rank_dependences,
    record_lines,
    rising_or_falling,
    size_of,
    stretch_power,
)
from inflight.tasks.models import current_model
from inflight.tasks.pipelines.base import (
    CompareReport,
    CompareResult,
    Sources,
    Spans,
    blocks_of,
    equations_of,
    rows_of_day,
    scalar_channels,
)
from inflight.tasks.pipelines.scalar.compare_page import Drawn, Spectra, compare_parts, page_title
from inflight.tasks.pipelines.scalar.tables import load_equations, span_solution
from inflight.tasks.report import Progress
from inflight.time import DAY, SECOND, day_bounds, usual_step

#: Means the figures are drawn from: at most so many rows in all, each of at least so many seconds.
_ROWS, _SHORTEST = 400_000, 60.0

#: Means tell periods of so many of their lengths and more, and apart by less than whole days can.
_SEAM = 4.0

_BINS = 160

#: Rows on either side over which a channel rises or falls.
_REACH = 2


@dataclass
class _Digest:
    """Aggregates of a span: what figures and dependences are made from."""

    length: float
    rows: list[dict[str, Floats]] = field(default_factory=list)
    before: list[Size] = field(default_factory=list)
    after: list[Size] = field(default_factory=list)
    floors: list[NoiseFloor] = field(default_factory=list)
    power_before: dict[tuple[int, float], Power] = field(default_factory=dict)
    power: dict[tuple[int, float], Power] = field(default_factory=dict)
    counts: dict[str, Floats] = field(default_factory=dict)
    skipped: int = 0
    outliers: int = 0


def compare_samples(
    cat: Catalog, mission: Mission, comparison: str, days: Sequence[Day], span: slice, tell: Progress
) -> CompareResult[CompareReport]:
    """Measure the residual of each sample of published products, before and after calibration.

    Parameters
    ----------
    days : sequence of Day
        Of the products.
    span : slice
        Of which the normal equations tell what the data determine.
    tell : callable
        Called with (stage, done, total).
    """
    digest = _digest_of(cat, mission, comparison, days, tell)
    rows = {name: np.concatenate([row[name] for row in digest.rows]) for name in digest.rows[0]}
    coordinates = {one.name: one for one in _coordinates(rows, mission)}
    block, block_name = blocks_of(rows["tt2000"], len(days))
    found = measure_dependences(coordinates.values(), rows["after"], block)
    direction = np.stack([rows[f"field direction {axis}"] for axis in "xyz"], axis=1)
    spectra = _spectra(digest, rows, direction, mission)
    determined, directions = _determined(cat, mission, comparison, span)
    tables = _tables(cat, comparison, days)
    report = CompareReport(
        comparison,
        days[-1].context or "",
        join_sizes(digest.before),
        join_sizes(digest.after),
        join_floors(digest.floors),
        [_told_of_day(*told) for told in zip(days, digest.before, digest.after, strict=True)],
        rank_dependences(coordinates, found, rows["after"], direction, block),
        directions,
        determined,
        block_name,
        spectra.lines,
        daily_scatter(tables[0], day_bounds(days[0].day)[0], day_bounds(days[-1].day)[1]),
        skipped=digest.skipped,
        outliers=digest.outliers,
        acknowledgement=mission.acknowledgement,
    )
    drawn = Drawn(digest.counts, rows, spectra, found, tables)
    return CompareResult(report, page_title(report, mission), compare_parts(report, drawn))


def _tables(cat: Catalog, comparison: str, days: Sequence[Day]) -> tuple[xr.Dataset, xr.Dataset]:
    """Return the table of daily fits, and the one products use."""
    daily, used = (cat.table(f"{comparison}-{kind}", str(days[0].day)) for kind in ("daily", "window"))
    return daily, used


def _digest_of(
    cat: Catalog, mission: Mission, comparison: str, days: Sequence[Day], tell: Progress
) -> _Digest:
    """Read the days one after the other; what stays of each is small, however long the mission."""
    digest = _Digest(max(_SHORTEST, 86_400.0 * len(days) / _ROWS))
    sources = Sources.of(cat, mission, slice(str(days[0].day), str(days[-1].day + np.timedelta64(1, "D"))))
    for done, day in enumerate(days):
        tell("compare", done, len(days))
        _take(digest, cat, mission, comparison, sources, day)
    tell("compare", len(days), len(days))
    return digest


def _determined(cat: Catalog, mission: Mission, comparison: str, span: slice) -> tuple[list[str], list[str]]:
    """Return the parameters, and the combinations of them, that the span's equations determine."""
    equations = load_equations(cat, cat.days(equations_of(comparison), span, states=("published",)))
    model = current_model(cat, mission, comparison).model
    solution = span_solution(equations, model)
    names = reference_of(model, int(equations.dataset["start"].values[0])).columns
    known = [name for name, sure in zip(names, solution.determined, strict=True) if sure]
    return known, describe_directions(solution, names)


def _told_of_day(day: Day, before: Size, after: Size) -> dict[str, Any]:
    return {
        "day": str(day.day),
        "version": day.version,
        "before_nT": before.rms,
        "after_nT": after.rms,
        "before_less_mean_nT": before.std,
        "after_less_mean_nT": after.std,
        "samples": after.count,
    }


def _take(
    digest: _Digest, cat: Catalog, mission: Mission, comparison: str, sources: Sources, day: Day
) -> None:
    """Add one day to the digest."""
    product = cat.read(day)
    flag = product["flag"].values
    good = (flag & np.uint32(UNUSABLE)) == 0
    after = np.where(good, product["residual"].values, np.nan)
    before = np.where(good, product["residual_preflight"].values, np.nan)
    digest.before.append(size_of(before))
    digest.after.append(size_of(after))
    _count(digest, before, after)
    # Outliers belong to the size of the residual, but would hide its structure.
    clear = (flag & np.uint32(Flag.OUTLIER)) == 0
    digest.skipped += int((~good).sum())
    digest.outliers += int((good & ~clear).sum())
    after, before = np.where(clear, after, np.nan), np.where(clear, before, np.nan)
    _add_spectra(digest, product, before, after)
    spans = Spans.of(np.asarray(product["tt2000"].values, dtype=np.int64), digest.length)
    digest.rows.append(rows_of_day(cat, mission, comparison, sources, product, before, after, spans))


def _count(digest: _Digest, before: Floats, after: Floats) -> None:
    """Add to the histograms; the first day sets their range."""
    if "edges" not in digest.counts:
        wide = 8.0 * max(digest.after[-1].std, 1e-3)
        digest.counts["edges"] = np.linspace(-wide, wide, _BINS + 1)
        digest.counts |= {"before": np.zeros(_BINS), "after": np.zeros(_BINS)}
    for name, values, size in (("before", before, digest.before[-1]), ("after", after, digest.after[-1])):
        shifted = values[np.isfinite(values)] - size.mean
        digest.counts[name] += np.histogram(shifted, digest.counts["edges"])[0]


def _add_spectra(digest: _Digest, product: xr.Dataset, before: Floats, after: Floats) -> None:
    """Add a day's noise floor and spectra; missing rows are gaps there too."""
    stamps = np.asarray(product["tt2000"].values, dtype=np.int64)
    step = usual_step(stamps, SECOND)
    slot = np.round((stamps - stamps[0]) / step).astype(np.int64)
    grid = np.full((int(slot[-1]) + 1, 5), np.nan)
    direction = direction_of(product["field_sensor"].values)
    grid[slot] = np.column_stack([before, after, direction])
    cadence = step / SECOND
    digest.floors.append(noise_floor(grid[:, 1], cadence))
    # Whole days alone share their frequencies: a day of a leap second, or one begun late, is brought to them.
    whole = np.full((max(DAY // step, 1), 5), np.nan)
    count = min(len(whole), len(grid))
    whole[:count] = grid[:count]
    add_power(digest.power_before, stretch_power(whole[:, 0], whole[:, 2:], cadence))
    add_power(digest.power, stretch_power(whole[:, 1], whole[:, 2:], cadence))


def _spectra(digest: _Digest, rows: dict[str, Floats], direction: Floats, mission: Mission) -> Spectra:
    """Return the spectra of days and of weeks, and the lines in them."""
    stated = {name: period / SECOND for name, period in mission.periods.items()}
    seconds = rows["tt2000"] / SECOND
    orbit = orbit_period(seconds, rows["orbit phase"]) if "orbit phase" in rows else None
    known, seam = known_periods(stated, orbit), _SEAM * digest.length
    fast, before = finest_power(digest.power), finest_power(digest.power_before)
    slow, slow_lines = record_lines((seconds, rows["after"], direction), digest.length, known, shortest=seam)
    lines: list[Line] = find_lines(fast, known, longest=seam if slow else np.inf) if fast else []
    lines += slow_lines
    lines.sort(key=lambda line: (not line.is_new, line.is_known, -line.strength))
    return Spectra(fast, before, slow, lines, known)


_NO_COORDINATE = {"tt2000", "before", "after", "low", "high"}

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


def _coordinates(rows: dict[str, Floats], mission: Mission) -> Iterator[Coordinate]:
    """Yield everything the residual may follow: time, geometry, field, every channel with its branches."""
    channels = scalar_channels(mission)
    days = (rows["tt2000"] - rows["tt2000"][0]) / DAY
    yield Coordinate("time", "d", "time", days)
    for name, values in rows.items():
        if name in _NO_COORDINATE:
            continue
        if name in channels:
            told = channels[name][2]
            yield Coordinate(name, told.unit, told.kind, values, rising_or_falling(values, _REACH))
        else:
            yield Coordinate(name, _UNITS.get(name, ""), _kind(name), values)


def _kind(name: str) -> str:
    """Return what sort of coordinate a name is, as `inflight.residual.dependence` knows them."""
    if name.startswith("Sun "):
        return "sun_angle"
    return "_".join(name.removesuffix(" x").removesuffix(" y").removesuffix(" z").split())
