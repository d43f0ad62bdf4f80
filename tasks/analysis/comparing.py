"""Compare the model with the measurements: size of the residual before and after, and where it fails."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import describe_directions, reference_of
from inflight.catalog import Catalog, Day
from inflight.figures import html_page
from inflight.flags import UNUSABLE, Flag
from inflight.frames import direction_of
from inflight.mission import Mission, is_told_by_states
from inflight.residual import (
    Coordinate,
    Line,
    NoiseFloor,
    Power,
    Size,
    add_power,
    daily_wander,
    find_failures,
    find_lines,
    finest,
    joined,
    joined_floor,
    known_periods,
    measure,
    noise_floor,
    resolve_lines,
    size_of,
    slow_power,
    stretch_power,
)
from inflight.tasks.models import current_model
from inflight.tasks.pipelines import (
    Compared,
    Sources,
    Spans,
    blocks_of,
    equations_of,
    load_equations,
    published_products,
    rows_of_day,
    scalar_channels,
    span_solution,
)
from inflight.tasks.pipelines.scalar import CompareReport, Drawn, Spectra, compare_parts, page_title
from inflight.tasks.pipelines.spin import SpinCompareReport, compare_spin
from inflight.tasks.pipelines.states import DualCompareReport, compare_dual
from inflight.tasks.report import Progress, write_page
from inflight.time import DAY, SECOND, DayLike, day_bounds, usual_step

#: Means the figures are drawn from: at most so many rows in all, each of at least so many seconds.
_ROWS, _SHORTEST = 400_000, 60.0

#: Means tell periods of so many of their lengths and more, and apart by less than whole days can.
_SEAM = 4.0

_BINS = 160


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
    left_out: int = 0
    outliers: int = 0


def compare(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None = None,
    end: DayLike | None = None,
    comparison: str = "main",
    output: Path | None = None,
    progress: Progress | None = None,
) -> CompareReport | DualCompareReport:
    """Measure the residual of published products before and after calibration, and draw it.

    Of a spin comparison it is what still goes with the spin: see `inflight.tasks.pipelines.spin.compare`.

    Parameters
    ----------
    start, end : UTC date, optional
        Half-open span of days; all published days when absent.
    output : Path, optional
        Where to write the static page; none is written when absent.

    Raises
    ------
    CatalogError
        When no product of the comparison is published in the span.

    Notes
    -----
    Two sensors on one boom without a scalar one have another measure: see `compare_dual`.
    """
    found = measured(cat, mission, start, end, comparison, progress)
    if output is not None:
        write_page(output, html_page(found.title, found.sections(), mission.acknowledgement))
        found.report.path = output
    return found.report


def measured(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None = None,
    end: DayLike | None = None,
    comparison: str = "main",
    progress: Progress | None = None,
) -> Compared[CompareReport] | Compared[SpinCompareReport] | Compared[DualCompareReport]:
    """Measure as `compare` does; return with the report what its figures are drawn from."""
    if is_told_by_states(mission, comparison):
        return compare_dual(cat, mission, start, end, comparison, progress)
    span = slice(str(start) if start is not None else None, str(end) if end is not None else None)
    tell = progress or (lambda stage, done, total: None)
    days = published_products(cat, comparison, span)
    if mission.comparisons[comparison].kind == "spin":
        return compare_spin(cat, mission, comparison, days, tell)
    return _compare_samples(cat, mission, comparison, span, days, tell)


def _compare_samples(
    cat: Catalog, mission: Mission, comparison: str, span: slice, days: Sequence[Day], tell: Progress
) -> Compared[CompareReport]:
    """Measure a residual of each sample."""
    digest = _digest_of(cat, mission, comparison, days, tell)
    rows = {name: np.concatenate([row[name] for row in digest.rows]) for name in digest.rows[0]}
    coordinates = {one.name: one for one in _coordinates(rows, mission)}
    block, block_name = blocks_of(rows["tt2000"], len(days))
    found = measure(coordinates.values(), rows["after"], block)
    direction = np.stack([rows[f"field direction {axis}"] for axis in "xyz"], axis=1)
    spectra = _spectra(digest, rows, direction, mission)
    determined, directions = _determined(cat, mission, comparison, span)
    tables = _tables(cat, comparison, days)
    report = CompareReport(
        comparison,
        days[-1].context or "",
        joined(digest.before),
        joined(digest.after),
        joined_floor(digest.floors),
        [_told_of_day(*told) for told in zip(days, digest.before, digest.after, strict=True)],
        find_failures(coordinates, found, rows["after"], direction, block),
        directions,
        determined,
        block_name,
        spectra.lines,
        daily_wander(tables[0], day_bounds(days[0].day)[0], day_bounds(days[-1].day)[1]),
        left_out=digest.left_out,
        outliers=digest.outliers,
        acknowledgement=mission.acknowledgement,
    )
    drawn = Drawn(digest.counts, rows, spectra, found, tables)
    return Compared(report, page_title(report, mission), compare_parts(report, drawn))


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
    digest.left_out += int((~good).sum())
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
    known = known_periods(stated, _orbit_period(rows))
    fast, before = finest(digest.power), finest(digest.power_before)
    slow = slow_power(rows["tt2000"] / SECOND, rows["after"], direction, digest.length)
    seam = _SEAM * digest.length
    lines: list[Line] = find_lines(fast, known, longest=seam if slow else np.inf) if fast else []
    if slow is not None:
        record = rows["tt2000"] / SECOND, rows["after"], direction
        lines += resolve_lines(*record, find_lines(slow, known, shortest=seam), slow)
    lines.sort(key=lambda line: (not line.is_new, line.is_known, -line.strength))
    return Spectra(fast, before, slow, lines, known)


def _orbit_period(rows: dict[str, Floats]) -> float | None:
    """Return the nodal period that the orbit phase tells, s; None without one."""
    phase = rows.get("orbit phase", np.empty(0))
    known = np.flatnonzero(np.isfinite(phase))
    if known.size < 100:
        return None
    turn = np.diff(phase[known]) % 360.0
    step = np.diff(rows["tt2000"][known]) / SECOND
    usual = step < 1.5 * np.median(step)
    rate = float(np.median(turn[usual] / step[usual]))
    return 360.0 / rate if rate > 0 else None


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
            yield Coordinate(name, told.unit, told.kind, values, _rising(values))
        else:
            yield Coordinate(name, _UNITS.get(name, ""), _kind(name), values)


def _kind(name: str) -> str:
    """Return what sort of coordinate a name is, as `inflight.residual.dependence` knows them."""
    if name.startswith("Sun "):
        return "sun_angle"
    return "_".join(name.removesuffix(" x").removesuffix(" y").removesuffix(" z").split())


def _rising(values: Floats) -> Floats:
    """Return +1 where a channel rises over five rows, -1 where it falls, 0 where it hardly moves."""
    change = np.zeros_like(values)
    change[2:-2] = values[4:] - values[:-4]
    change = np.nan_to_num(change)
    spread = float(np.nanstd(values)) if np.isfinite(values).any() else 0.0
    return np.where(np.abs(change) > 0.02 * spread, np.sign(change), 0.0)
