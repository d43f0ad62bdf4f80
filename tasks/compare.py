"""Compare the model with the measurements: size of the residual before and after, and where it fails."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import describe_directions, reference_of
from inflight.catalog import Catalog, Day
from inflight.errors import CatalogError
from inflight.flags import UNUSABLE, Flag
from inflight.geometry import orbit_phase
from inflight.mission import Mission
from inflight.statistics import (
    Dependence,
    NoiseFloor,
    Size,
    dependence,
    joined,
    joined_floor,
    noise_floor,
    size_of,
    spectrum,
    strongest,
)
from inflight.tasks.compare_page import CompareReport, Drawn, write_page
from inflight.tasks.models import current_model
from inflight.tasks.planning import equations_of, product_of
from inflight.tasks.report import Progress
from inflight.tasks.samples import channel_homes
from inflight.tasks.tables import load_equations, span_solution
from inflight.time import SECOND, DayLike, day_bounds, day_of

#: Means the figures are drawn from: at most so many rows in all, each of at least so many seconds.
_ROWS, _SHORTEST = 400_000, 60.0
#: Blocks of the dependences' uncertainty, seconds.
_BLOCK = 3 * 3600.0
_BINS = 160


@dataclass
class _Power:
    """Sums of the days' spectra on one frequency grid; a mission's spectra are never held one by one."""

    frequency: Floats
    before: Floats
    after: Floats
    days_before: int = 0
    days: int = 0


@dataclass
class _Digest:
    """Aggregates of a span: what figures and dependences are made from."""

    rows: list[dict[str, Floats]] = field(default_factory=list)
    before: list[Size] = field(default_factory=list)
    after: list[Size] = field(default_factory=list)
    floors: list[NoiseFloor] = field(default_factory=list)
    power: dict[tuple[int, float], _Power] = field(default_factory=dict)
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
) -> CompareReport:
    """Measure the residual of published products before and after calibration, and draw it.

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
    """
    span = slice(str(start) if start is not None else None, str(end) if end is not None else None)
    days = _products(cat, comparison, span)
    digest = _digest_of(cat, mission, days, progress or (lambda stage, done, total: None))
    rows = {name: np.concatenate([row[name] for row in digest.rows]) for name in digest.rows[0]}
    density = _mean_power(digest.power.values())
    found = list(_dependences(rows, mission))
    determined, directions = _determined(cat, mission, comparison, span)
    report = CompareReport(
        comparison,
        days[-1].context or "",
        joined(digest.before),
        joined(digest.after),
        joined_floor(digest.floors),
        [_told_of_day(*told) for told in zip(days, digest.before, digest.after, strict=True)],
        strongest(found),
        directions,
        determined,
        left_out=digest.left_out,
        outliers=digest.outliers,
        acknowledgement=mission.acknowledgement,
    )
    if output is not None:
        daily, window = (cat.table(f"{comparison}-{kind}", str(days[0].day)) for kind in ("daily", "window"))
        write_page(report, output, mission, Drawn(digest.counts, rows, density, found, (daily, window)))
    return report


def _products(cat: Catalog, comparison: str, span: slice) -> list[Day]:
    product = product_of(comparison)
    days = cat.days(product, span, states=("published",))
    if not days:
        raise CatalogError(
            f"'{product}' has no published days in the span", remedy="run 'inflight reprocess' first"
        )
    return days


def _digest_of(cat: Catalog, mission: Mission, days: Sequence[Day], tell: Progress) -> _Digest:
    """Read the days one after the other; what stays of each is small, however long the mission."""
    digest = _Digest()
    length = max(_SHORTEST, 86_400.0 * len(days) / _ROWS)
    for done, day in enumerate(days):
        tell("compare", done, len(days))
        _take(digest, cat, mission, day, length)
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


def _take(digest: _Digest, cat: Catalog, mission: Mission, day: Day, length: float) -> None:
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
    stamps = product["tt2000"].values
    cadence = float(np.median(np.diff(stamps))) / SECOND if stamps.size > 1 else 1.0
    digest.floors.append(noise_floor(after, cadence))
    _add_power(digest, spectrum(after, cadence), spectrum(before, cadence)[1])
    digest.rows.append(_means(product, before, after, stamps, length, _channels(cat, mission, day, stamps)))


def _count(digest: _Digest, before: Floats, after: Floats) -> None:
    """Add to the histograms; the first day sets their range."""
    if "edges" not in digest.counts:
        wide = 8.0 * max(digest.after[-1].std, 1e-3)
        digest.counts["edges"] = np.linspace(-wide, wide, _BINS + 1)
        digest.counts |= {"before": np.zeros(_BINS), "after": np.zeros(_BINS)}
    for name, values, size in (("before", before, digest.before[-1]), ("after", after, digest.after[-1])):
        shifted = values[np.isfinite(values)] - size.mean
        digest.counts[name] += np.histogram(shifted, digest.counts["edges"])[0]


def _means(
    product: xr.Dataset,
    before: Floats,
    after: Floats,
    stamps: Any,
    length: float,
    channels: dict[str, Floats],
) -> dict[str, Floats]:
    """Return means over spans of `length` seconds of the residuals and of everything they may follow."""
    span = ((stamps - stamps[0]) / (length * SECOND)).astype(np.int64)
    first = np.flatnonzero(np.append(True, np.diff(span) > 0))
    good = np.isfinite(after)

    def mean(values: Floats) -> Floats:
        used = good & np.isfinite(values)
        count = np.add.reduceat(used.astype(np.float64), first)
        total = np.add.reduceat(np.where(used, values, 0.0), first)
        return np.where(count > 0, total / np.maximum(count, 1.0), np.nan)

    field_ = product["field_sensor"].values
    size = np.linalg.norm(field_, axis=1)
    filled = np.where(good, after, np.inf), np.where(good, after, -np.inf)
    out = {
        "tt2000": stamps[first].astype(np.float64),
        "before": mean(before),
        "after": mean(after),
        "low": np.minimum.reduceat(filled[0], first),
        "high": np.maximum.reduceat(filled[1], first),
    }
    out |= {f"field direction {axis}": mean(field_[:, i] / size) for i, axis in enumerate("xyz")}
    out["field strength"] = mean(size)
    if "latitude" in product:
        latitude = product["latitude"].values
        out["latitude"] = latitude[first]
        out["longitude"] = product["longitude"].values[first]
        out["orbit phase"] = orbit_phase(latitude, np.gradient(latitude))[first]
    midnight, _ = day_bounds(day_of(stamps[:1])[0])
    out["time of day"] = (stamps[first] - midnight) / (3600.0 * SECOND)
    return out | {name: values[first] for name, values in channels.items()}


def _channels(cat: Catalog, mission: Mission, day: Day, stamps: Any) -> dict[str, Floats]:
    """Return every channel of one number a time, at the nearest earlier sample; NaN where there is none."""
    found = {}
    for name, (instrument, channel) in channel_homes(mission).items():
        told = mission.instruments[instrument].channels[channel]
        if told.axis_names or told.kind in ("flag", "attitude", "position"):
            continue
        source = cat.current(f"l1/{instrument}", day.day)
        if source is None:
            found[name] = np.full(stamps.size, np.nan)
            continue
        data = cat.read(source, [channel])
        own = data["tt2000"].values
        index = np.clip(np.searchsorted(own, stamps, side="right") - 1, 0, None)
        stale = np.abs(stamps - own[index]) > 2 * mission.instruments[instrument].cadence
        found[name] = np.where(stale, np.nan, data[channel].values[index].astype(np.float64))
    return found


def _add_power(digest: _Digest, after: tuple[Floats, Floats], before: Floats) -> None:
    frequency, power = after
    if not frequency.size:
        return
    grid = (frequency.size, round(float(frequency[-1]), 9))
    if grid not in digest.power:
        digest.power[grid] = _Power(frequency, np.zeros_like(power), np.zeros_like(power))
    sums = digest.power[grid]
    sums.after += power
    sums.days += 1
    if before.size == power.size:
        sums.before += before
        sums.days_before += 1


def _mean_power(sums: Collection[_Power]) -> tuple[Floats, Floats, Floats]:
    """Return frequency, mean power before and after, of the finest grid of frequencies."""
    if not sums:
        return np.empty(0), np.empty(0), np.empty(0)
    finest = max(sums, key=lambda one: (one.frequency.size, one.days))
    before = finest.before / finest.days_before if finest.days_before else np.full_like(finest.before, np.nan)
    return finest.frequency, before, finest.after / finest.days


_NO_COORDINATE = {"tt2000", "before", "after", "low", "high"}
_UNITS = {
    "latitude": "deg",
    "longitude": "deg",
    "orbit phase": "deg",
    "time of day": "h",
    "field strength": "nT",
}


def _dependences(rows: dict[str, Floats], mission: Mission) -> Iterator[Dependence]:
    block = (rows["tt2000"] / (_BLOCK * SECOND)).astype(np.int64)
    homes = channel_homes(mission)
    for name, values in rows.items():
        if name in _NO_COORDINATE:
            continue
        unit = _UNITS.get(name, "")
        if name in homes:
            instrument, channel = homes[name]
            unit = mission.instruments[instrument].channels[channel].unit
        found = dependence(name, unit, values, rows["after"], block)
        if found is not None:
            yield found
