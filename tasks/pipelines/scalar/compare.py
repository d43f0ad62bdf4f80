"""Compare the model with a scalar instrument: size of the residual before and after, and where it fails.

In go the products of days, out comes a `CompareReport` with what is drawn of it. Products are read one day
after the other into a `Digest`: means of short spans, histograms, spectra. Structures of the residual are
found in these means (`inflight.residual`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

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
    ResidualStatistics,
    SpectrumSum,
    add_power,
    daily_scatter,
    find_lines,
    finest_power,
    join_floors,
    known_periods,
    measure_dependences,
    merge_statistics,
    noise_floor,
    orbit_period,
    rank_dependences,
    record_lines,
    residual_statistics,
    rising_or_falling,
    stretch_power,
)
from inflight.tasks.models import current_model
from inflight.tasks.pipelines.base import (
    CompareReport,
    CompareResult,
    Sources,
    Spans,
    blocks_of,
    day_summary,
    each_day,
    equations_of,
    rows_of_day,
    scalar_channels,
    tables_in_use,
)
from inflight.tasks.pipelines.scalar.compare_page import FigureData, Spectra, compare_parts, page_title
from inflight.tasks.pipelines.scalar.tables import load_equations, span_solution
from inflight.tasks.report import Progress
from inflight.time import DAY, SECOND, Int64, day_bounds, usual_step


@dataclass(frozen=True, kw_only=True)
class CompareSettings:
    """How the products of a comparison are summarised.

    Attributes
    ----------
    most_rows : int
        Means of short spans that dependences and figures are made from, at most, in all; assumed.
    shortest_span_s : float
        Least length of such a span, s; assumed.
    least_spans : float
        Means show periods of so many of their lengths and more; spectra of days show the shorter ones;
        assumed.
    bins : int
        Bins of a histogram; assumed.
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
    cat: Catalog, mission: Mission, comparison: str, days: Sequence[Day], span: slice, progress: Progress
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
    """
    digest = digest_days(cat, mission, comparison, days, progress)
    rows = {name: np.concatenate([row[name] for row in digest.rows]) for name in digest.rows[0]}
    coordinates = {one.name: one for one in _coordinates(rows, mission)}
    block, block_name = blocks_of(rows["tt2000"], len(days))
    found = measure_dependences(coordinates.values(), rows["after"], block)
    direction = np.stack([rows[f"field direction {axis}"] for axis in "xyz"], axis=1)
    spectra = _spectra(digest, rows, direction, mission)
    determined, directions = _determined(cat, mission, comparison, span)
    daily, used = tables_in_use(cat, comparison, days[0])
    report = CompareReport(
        comparison=comparison,
        context=days[-1].context or "",
        before=merge_statistics(digest.before),
        after=merge_statistics(digest.after),
        floor=join_floors(digest.floors),
        by_day=[day_summary(*of_day) for of_day in zip(days, digest.before, digest.after, strict=True)],
        fails_where=rank_dependences(coordinates, found, rows["after"], direction, block),
        directions=directions,
        determined=determined,
        block=block_name,
        lines=spectra.lines,
        daily_scatter=daily_scatter(daily, day_bounds(days[0].day)[0], day_bounds(days[-1].day)[1]),
        skipped=digest.skipped,
        outliers=digest.outliers,
    )
    data = FigureData(digest.counts, rows, spectra, found, (daily, used))
    return CompareResult(report, page_title(report, mission), compare_parts(report, data))


@dataclass
class Digest:
    """What is kept of the days' products: small, however long the mission.

    Attributes
    ----------
    length : float
        Of the short spans, s.
    rows : list of dict
        Of each day, means over the short spans, as `rows_of_day`.
    before, after : list of Size
    floors : list of NoiseFloor
        Of the residual after calibration.
    power_before, power : dict
        Spectra by the length of their stretches.
    counts : dict of str to ndarray
        Histograms ``before`` and ``after`` over ``edges``, nT, each about the day's mean.
    skipped, outliers : int
        Samples without a usable measurement, and outliers.
    """

    length: float
    rows: list[dict[str, Floats]] = field(default_factory=list)
    before: list[ResidualStatistics] = field(default_factory=list)
    after: list[ResidualStatistics] = field(default_factory=list)
    floors: list[NoiseFloor] = field(default_factory=list)
    power_before: dict[tuple[int, float], SpectrumSum] = field(default_factory=dict)
    power: dict[tuple[int, float], SpectrumSum] = field(default_factory=dict)
    counts: dict[str, Floats] = field(default_factory=dict)
    skipped: int = 0
    outliers: int = 0

    def add_sizes(self, before: Floats, after: Floats) -> None:
        """Add a day's sizes and histograms; the first day sets the range."""
        self.before.append(residual_statistics(before))
        self.after.append(residual_statistics(after))
        if "edges" not in self.counts:
            wide = COMPARE_SETTINGS.half_width * max(self.after[-1].std, 1e-3)
            self.counts["edges"] = np.linspace(-wide, wide, COMPARE_SETTINGS.bins + 1)
            self.counts |= {
                "before": np.zeros(COMPARE_SETTINGS.bins),
                "after": np.zeros(COMPARE_SETTINGS.bins),
            }
        for name, values, size in (
            ("before", before, self.before[-1]),
            ("after", after, self.after[-1]),
        ):
            shifted = values[np.isfinite(values)] - size.mean
            self.counts[name] += np.histogram(shifted, self.counts["edges"])[0]

    def add_spectra(self, stamps: Int64, before: Floats, after: Floats, direction: Floats) -> None:
        """Add a day's noise floor and spectra; missing rows are gaps there too.

        Parameters
        ----------
        stamps : ndarray of int64, shape (time,)
            TT2000.
        before, after : ndarray, shape (time,)
            nT; NaN where they are not to be used.
        direction : ndarray, shape (time, 3)
            Of the field.
        """
        step = usual_step(stamps, SECOND)
        slot = np.round((stamps - stamps[0]) / step).astype(np.int64)
        grid = np.full((int(slot[-1]) + 1, 5), np.nan)
        grid[slot] = np.column_stack([before, after, direction])
        cadence = step / SECOND
        self.floors.append(noise_floor(grid[:, 1], cadence))
        # Only whole days share their frequencies: a day with a leap second, or begun late, is cut or padded.
        whole = np.full((max(DAY // step, 1), 5), np.nan)
        count = min(len(whole), len(grid))
        whole[:count] = grid[:count]
        add_power(self.power_before, stretch_power(whole[:, 0], whole[:, 2:], cadence))
        add_power(self.power, stretch_power(whole[:, 1], whole[:, 2:], cadence))


def digest_days(
    cat: Catalog, mission: Mission, comparison: str, days: Sequence[Day], progress: Progress
) -> Digest:
    """Read the products of days one after the other and return what is kept of them."""
    digest = Digest(max(COMPARE_SETTINGS.shortest_span_s, 86_400.0 * len(days) / COMPARE_SETTINGS.most_rows))
    sources = Sources.of(cat, mission, slice(str(days[0].day), str(days[-1].day + np.timedelta64(1, "D"))))
    for day in each_day(days, progress):
        product = cat.read(day)
        stamps, flag = np.asarray(product["tt2000"].values, dtype=np.int64), product["flag"].values
        good = (flag & np.uint32(UNUSABLE)) == 0
        before, after = (
            np.where(good, product[name].values, np.nan) for name in ("residual_preflight", "residual")
        )
        digest.add_sizes(before, after)
        # Outliers belong to the size of the residual, but would hide its structure.
        clear = (flag & np.uint32(Flag.OUTLIER)) == 0
        digest.skipped += int((~good).sum())
        digest.outliers += int((good & ~clear).sum())
        before, after = (np.where(clear, values, np.nan) for values in (before, after))
        digest.add_spectra(stamps, before, after, direction_of(product["field_sensor"].values))
        spans = Spans.of(stamps, digest.length)
        digest.rows.append(rows_of_day(cat, mission, comparison, sources, product, before, after, spans))
    return digest


def _determined(cat: Catalog, mission: Mission, comparison: str, span: slice) -> tuple[list[str], list[str]]:
    """Return the parameters, and the combinations of them, that the span's equations determine."""
    equations = load_equations(cat, cat.days(equations_of(comparison), span, states=("published",)))
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
    lines.sort(key=lambda line: (not line.is_new, line.is_known, -line.strength))
    return Spectra(fast, before, slow, lines, known)


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
