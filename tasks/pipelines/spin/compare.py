"""Compare of a spinning sensor: the spin tones of its products, and what they depend on.

The residual of a spinning sensor is its spin tones (Plaschke et al. 2019, section 4): the product itself is
folded into synthetic turns (`inflight.samples.spin_folding`), and so is the pre-flight calibration of the
same readings. The page shows tones before and after, and what they follow.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog, Day
from inflight.errors import InflightError, MissionError
from inflight.figures import (
    LazySection,
    SectionBody,
    excess_scatter_figure,
    html_table,
    mean_turn_figure,
    paragraph,
    tone_dependence_figure,
    tone_name,
    tones_over_time_figure,
)
from inflight.mission import Mission
from inflight.model import Model, folding_of, rows_of, spin_residual
from inflight.progress import Progress, tell_each
from inflight.residual import NO_FLOOR, NO_STATISTICS, NoiseFloor, ResidualStatistics, daily_scatter
from inflight.samples import Complex, Folding, fold_spins
from inflight.spin import (
    TONES,
    ToneCoordinate,
    ToneDependence,
    Tones,
    rank_tone_dependences,
    tone_dependence,
    tones_of,
    tones_of_turns,
)
from inflight.tasks.archive import ArchiveIndex, Need, SpinClock, load_samples
from inflight.tasks.models import current_model, preflight_model
from inflight.tasks.pipelines.base import (
    CompareReport,
    CompareResult,
    Sources,
    Spans,
    blocks_of,
    channel_means,
    daily_residual_figure,
    day_summary,
    geometry_means,
    product_needs,
    scalar_channels,
    scatter_html,
    structures_html,
    tables_in_use,
)
from inflight.time import DAY, SECOND, Int64, day_bounds
from inflight.units import with_error


@dataclass(frozen=True, kw_only=True)
class SpinCompareSettings:
    """Numbers of a comparison of a spinning sensor.

    Attributes
    ----------
    drawn_tones : int
        Tones drawn over time, the strongest. Assumed.
    fewest_periods : float
        The phase of a period of the mission is a coordinate when the span holds so many. Assumed: of less,
        it would be time by another name.
    interval_sigmas : float
        Half width of the interval of the noise floor, in its sigma: 95 % of a normal distribution.
    """

    drawn_tones: int = 2
    fewest_periods: float = 1.5
    interval_sigmas: float = 1.96


SPIN_COMPARE_SETTINGS = SpinCompareSettings()


@dataclass
class SpinCompareReport(CompareReport):
    """What `compare` found of a turning sensor; `tones` are the rms of each before and after, nT."""

    tones: tuple[Floats, Floats] = (np.zeros(len(TONES)), np.zeros(len(TONES)))

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""
        return super().as_json() | {
            "tones": [
                {
                    "row": ("axial", "modulus")[row],
                    "harmonic": harmonic,
                    "before_nT": before,
                    "after_nT": after,
                }
                for (row, harmonic), before, after in zip(
                    TONES, *(one.tolist() for one in self.tones), strict=True
                )
            ]
        }


@dataclass(frozen=True)
class SpinDrawn:
    """What the page draws: intervals' times and tones, mean turns, and what the tones follow."""

    time: Int64
    before: Tones
    after: Tones
    turns: tuple[ToneDependence | None, ToneDependence | None]
    found: Sequence[ToneDependence]


def spin_parts(report: SpinCompareReport, drawn: SpinDrawn) -> list[LazySection]:
    """Return everything that is shown of a spin comparison, as the page and the explorer have it."""
    return [
        ("Residual", lambda: _residual(report, drawn)),
        ("Where it fails", lambda: (structures_html(report), [])),
        ("What the tones follow", lambda: _dependences(report, drawn)),
        ("Parameters", lambda: ([scatter_html(report)], [excess_scatter_figure(report.daily_scatter)])),
    ]


def _residual(report: SpinCompareReport, drawn: SpinDrawn) -> SectionBody:
    """Return the size of the tones before and after, and how they vary over days and over a turn."""
    rows = [
        (tone_name(tone), f"{before:.5f}", f"{after:.5f}")
        for tone, (before, after) in enumerate(zip(*report.tones, strict=True))
    ]
    rows.append(("all, a component", f"{report.before.rms:.5f}", f"{report.after.rms:.5f}"))
    floor = report.floor
    note = (
        f"Rms over intervals, by weights that fall with nature's own noise in each. Nature's noise at the "
        f"neighbouring frequencies would alone leave {floor.level_nT:.5f} nT a component (95 % interval "
        f"{floor.low_nT:.5f} to {floor.high_nT:.5f}): how much a turn's tones differ from the next turn's. "
        f"{report.skipped} samples of turns with too few readings are left out."
    )
    daily = daily_residual_figure(report)
    daily.title.text = "What goes with the spin, each day"
    strongest = np.argsort(-drawn.after.size)[: SPIN_COMPARE_SETTINGS.drawn_tones]
    over_time = [
        tones_over_time_figure(drawn.time, drawn.before, drawn.after, int(tone)) for tone in strongest
    ]
    text = [html_table(("tone", "pre-flight, nT", "calibrated, nT"), rows), paragraph(note)]
    return text, [daily, mean_turn_figure(*drawn.turns), *over_time]


def _dependences(report: SpinCompareReport, drawn: SpinDrawn) -> SectionBody:
    """Return what the tones depend on; channels that show the spin themselves in a table."""
    legend = (
        "Of each coordinate the tone that follows it most, less its mean: cosine and sine of the spin's "
        f"phase, clear ones first; bars are one sigma between blocks of one {report.block}."
    )
    rows = []
    for one in (one for one in drawn.found if one.coordinate.channel_tone is not None):
        tone = one.strongest
        slope, sigma = np.abs(one.mean[0, tone]), one.sigma[0, tone]
        unit = f"nT/{one.coordinate.unit}" if one.coordinate.unit else "nT"
        amplitude = with_error(one.amplitude[tone], one.sigma_amplitude[tone])
        rows.append(
            (
                one.coordinate.name,
                tone_name(tone),
                amplitude,
                f"{with_error(float(slope), float(sigma))} {unit}",
            )
        )
    head = ("channel", "residual tone in step with it", "rms, nT", "size for each unit")
    varying = [one for one in drawn.found if len(one.centre) > 1]
    varying.sort(key=lambda one: (not one.clear.any(), -one.amplitude[one.strongest]))
    text = [legend, html_table(head, rows) if rows else ""]
    return text, [tone_dependence_figure(one, one.strongest) for one in varying]


_ONE_DAY = np.timedelta64(1, "D")

#: Harmonics of the spin at which channels are compared with the residual, and their places among the tones.
_HARMONICS = {"at the spin": 0, "at twice the spin": 1}

#: Unit and kind of the coordinates that are not channels.
_COORDINATES = {
    "field along the spin axis": ("nT", "field_along"),
    "field across the spin axis": ("nT", "field_across"),
    "time of day": ("h", "time_of_day"),
    "orbit phase": ("deg", "orbit_phase"),
    "sun phase": ("deg", "sun_phase"),
    "sunlit": ("1", "sunlit"),
    "local time": ("h", "local_time"),
    "latitude": ("deg", "latitude"),
    "longitude": ("deg", "longitude"),
}


@dataclass
class _ToneRecord:
    """What is kept of the days, one row an interval.

    Attributes
    ----------
    time : list of ndarray of int64
        TT2000 of the intervals' middles, one array a day.
    before, after : list of Tones
        Of the pre-flight calibration and of the product.
    sizes : list of tuple of Size
        Of each day's residual before and after.
    coordinates, channel_tones : list of dict
        What the tones may follow: means over intervals, and the tones of channels that show the spin.
    """

    time: list[Int64] = field(default_factory=list)
    before: list[Tones] = field(default_factory=list)
    after: list[Tones] = field(default_factory=list)
    sizes: list[tuple[ResidualStatistics, ResidualStatistics]] = field(default_factory=list)
    coordinates: list[dict[str, Floats]] = field(default_factory=list)
    channel_tones: list[dict[str, Complex]] = field(default_factory=list)
    skipped: int = 0

    @property
    def stamps(self) -> Int64:
        """TT2000 of the intervals' middles."""
        return np.concatenate(self.time)

    def tones(self, state: str) -> Tones:
        """Return all intervals' tones ``before`` or ``after``."""
        parts: list[Tones] = getattr(self, state)
        return Tones(
            np.concatenate([one.value for one in parts]),
            np.concatenate([one.weight for one in parts]),
            np.concatenate([one.noise for one in parts]),
        )


def compare_spin(
    cat: Catalog,
    mission: Mission,
    comparison: str,
    days: Sequence[Day],
    progress: Progress,
) -> CompareResult[SpinCompareReport]:
    """Measure the tones of published products before and after calibration.

    Parameters
    ----------
    days : sequence of Day
        Of the products.
    progress : callable
        Called with (stage, done, total).

    Raises
    ------
    MissionError
        When the mission does not say how fast it spins.
    """
    folding = folding_of(mission, comparison)
    if folding is None:
        raise MissionError(
            "the mission does not say how fast it spins", remedy="state 'spin' under its periods"
        )
    reader = _Reader.of(cat, mission, comparison, days, folding)
    found = _ToneRecord()
    for day in tell_each(progress, "compare", days):
        reader.add_day(found, day)
    before, after = found.tones("before"), found.tones("after")
    coordinates = {one.name: one for one in _tone_coordinates(found, mission)}
    block, block_name = blocks_of(found.stamps.astype(np.float64), len(days))
    failures, whole = rank_tone_dependences(after, coordinates, block)
    daily, used = tables_in_use(cat, comparison, days[0])
    report = SpinCompareReport(
        comparison,
        days[-1].context or "",
        _total_size([size for size, _ in found.sizes], before),
        _total_size([size for _, size in found.sizes], after),
        _noise_floor(after, block),
        [
            day_summary(day, *sizes, noise_floor_nT=tones.floor)
            for day, sizes, tones in zip(days, found.sizes, found.after, strict=True)
        ],
        failures,
        [],
        [
            str(name)
            for name, known in zip(used["parameter"].values, used["determined"].values[-1], strict=True)
            if known
        ],
        block_name,
        [],
        daily_scatter(daily, day_bounds(days[0].day)[0], day_bounds(days[-1].day)[1]),
        skipped=found.skipped,
        version=cat.context(str(days[-1].context)).model_version if days[-1].context else 0,
        tones=(before.size, after.size),
    )
    steady = coordinates["spin phase"]
    turns = [tone_dependence(one, steady, block) for one in (before, after)]
    drawn = SpinDrawn(found.stamps, before, after, (turns[0], turns[1]), whole)
    title = f"{mission.mission}: what still goes with the spin, {days[0].day} to {days[-1].day}"
    return CompareResult(report, title, spin_parts(report, drawn))


@dataclass(frozen=True)
class _Reader:
    """What a day's tones are read with."""

    cat: Catalog
    mission: Mission
    comparison: str
    model: Model
    preflight: Model
    folding: Folding
    needs: list[Need]
    index: ArchiveIndex
    sources: Sources

    @classmethod
    def of(
        cls, cat: Catalog, mission: Mission, comparison: str, days: Sequence[Day], folding: Folding
    ) -> _Reader:
        model, preflight = (
            current_model(cat, mission, comparison).model,
            preflight_model(cat, mission, comparison),
        )
        needs = list(product_needs(mission, model, preflight))
        around = slice(str(days[0].day - _ONE_DAY), str(days[-1].day + 2 * _ONE_DAY))
        sources = Sources.of(cat, mission, slice(str(days[0].day), str(days[-1].day + _ONE_DAY)))
        index = ArchiveIndex.of(cat, needs, around)
        return cls(cat, mission, comparison, model, preflight, folding, needs, index, sources)

    def add_day(self, found: _ToneRecord, day: Day) -> None:
        """Add one day's tones and everything they may follow."""
        samples = load_samples(
            self.cat,
            self.mission,
            self.model,
            day.day,
            self.needs,
            self.index,
            geometry=False,
            folded=False,
        )
        span = day_bounds(day.day)
        raw = fold_spins(samples, self.folding, span)
        folded = fold_spins(self._product_samples(day, samples), self.folding, span)
        calibrated = np.asarray(folded["vector"].values, dtype=np.float64)
        after, good = spin_residual(self.folding, calibrated, folded)
        before = np.where(good[:, None], rows_of(self.preflight, raw).residual, np.nan)
        # The weights that 'inflight reprocess' takes, so that both give the same residual.
        weight, sectors = np.where(good, raw["weight"].values, 0.0), self.folding.sectors
        noise = np.asarray(raw["noise"].values)
        for tones, rows in ((found.before, before), (found.after, after)):
            tones.append(tones_of_turns(rows, weight, noise, sectors))
        sizes = _size(before, weight, found.before[-1]), _size(after, weight, found.after[-1])
        found.sizes.append(sizes)
        found.skipped += int((~good).sum())
        stamps = np.asarray(folded["tt2000"].values, dtype=np.int64)
        spans = Spans.of(stamps, self.folding.interval_ns / SECOND)
        count = len(found.before[-1].value)
        spans = replace(spans, stamps=stamps[: count * sectors])
        found.time.append(spans.middle)
        turned = calibrated[: spans.numbers.size * sectors].reshape(-1, sectors, 3)
        coordinates = {
            "field along the spin axis": turned[:, :, 2].mean(axis=1),
            "field across the spin axis": np.hypot(turned[:, :, 0], turned[:, :, 1]).mean(axis=1),
            "time of day": (spans.middle - spans.midnight) / (3600.0 * SECOND),
        }
        coordinates |= channel_means(self.cat, self.mission, self.sources, day.day, spans, flags=True)
        coordinates |= geometry_means(self.cat, self.mission, self.comparison, self.sources, day.day, spans)
        found.coordinates.append(coordinates)
        found.channel_tones.append(self._channel_tones(day.day, count))

    def _product_samples(self, day: Day, samples: xr.Dataset) -> xr.Dataset:
        """Return the product's field as samples to be folded, with the phase unwrapped as it was used."""
        product = self.cat.read(day, ["field_sensor", "flag", "tt2000"])
        if not np.array_equal(product["tt2000"].values, samples["tt2000"].values):
            raise InflightError(
                "the product has other samples than the archive",
                day=str(day.day),
                remedy="run 'inflight reprocess' again",
            )
        return xr.Dataset(
            {
                "vector": (("time", "axis"), product["field_sensor"].values),
                "spin_phase": ("time", samples["spin_phase"].values),
                "tt2000": ("time", samples["tt2000"].values),
                "flag": ("time", product["flag"].values),
            }
        )

    def _channel_tones(self, day: np.datetime64, count: int) -> dict[str, Complex]:
        """Return the tones of channels that show the spin; (interval,) by name."""
        clock = SpinClock.of(self.cat, self.mission, self.comparison, self.index, day)
        out: dict[str, Complex] = {}
        if clock is None:
            return out
        sectors, (start, _) = self.folding.sectors, day_bounds(day)
        edges = start + self.folding.cadence_ns * np.arange(count * sectors + 1, dtype=np.int64)
        for name, (instrument, channel, described) in scalar_channels(self.mission).items():
            source = self.sources.days.get((instrument, day))
            cadence = self.mission.instruments[instrument].cadence
            if described.axis_names or source is None or not clock.is_resolved_by(cadence):
                continue
            data = self.cat.read(source, [channel])
            stamps = np.asarray(data["tt2000"].values, dtype=np.int64)
            values = np.asarray(data[channel].values, dtype=np.float64)
            folded = clock.folded(values, stamps, clock.phase(stamps), edges)
            tones = tones_of(folded[:, None], sectors)
            out |= {f"{name} {times}": tones[:, at] for times, at in _HARMONICS.items()}
        return out


def _tone_coordinates(found: _ToneRecord, mission: Mission) -> Iterator[ToneCoordinate]:
    """Yield everything the tones may follow: the spin itself, time, field, geometry, channels."""
    stamps = found.stamps
    yield ToneCoordinate("spin phase", "", "spin_phase", np.zeros(stamps.size))
    yield ToneCoordinate("time", "d", "time", (stamps - stamps[0]) / DAY)
    for name, period in mission.periods.items():
        if name != "spin" and stamps[-1] - stamps[0] > SPIN_COMPARE_SETTINGS.fewest_periods * period:
            phase = 360.0 * ((stamps - stamps[0]) / period % 1.0)
            yield ToneCoordinate(f"phase of the period '{name}'", "deg", "orbit_phase", phase)
    channels = scalar_channels(mission, flags=True)
    sizes = [one.size for one in found.time]
    for name, values in _joined(found.coordinates, sizes, np.nan).items():
        if name in channels:
            yield ToneCoordinate(name, channels[name][2].unit, channels[name][2].kind, values)
        else:
            yield ToneCoordinate(name, *_COORDINATES.get(name, ("deg", "sun_angle")), values)
    for name, tone in _joined(found.channel_tones, sizes, np.nan + 0j).items():
        described = channels[name.rsplit(" at ", 1)[0]][2]
        # A tone below the channel's resolution is none; a missing one stays missing.
        kept = np.where(np.abs(tone) <= 0.5 * (described.resolution or 0.0), 0.0, tone)
        yield ToneCoordinate(name, described.unit, described.kind, np.abs(kept), kept)


def _joined(parts: Sequence[Mapping[str, Any]], sizes: Sequence[int], empty: complex) -> dict[str, Any]:
    """Return series of all days, of so many intervals each; `empty` on the days that do not have one."""
    names = dict.fromkeys(name for part in parts for name in part)
    return {
        name: np.concatenate(
            [part.get(name, np.full(size, empty)) for part, size in zip(parts, sizes, strict=True)]
        )
        for name in names
    }


def _size(rows: Floats, weight: Floats, tones: Tones) -> ResidualStatistics:
    """Return the size of rows (time, 2), rms as that of their tones; nT."""
    known = np.isfinite(rows).all(axis=1) & (weight > 0.0)
    values, shares = rows[known], weight[known]
    if not len(values):
        return NO_STATISTICS
    # The rows have no mean: that of their turn is taken off.
    order = np.argsort(np.abs(values).max(axis=1), kind="stable")
    half = np.searchsorted(np.cumsum(shares[order]), 0.5 * shares.sum())
    robust = 1.4826 * float(np.median(np.abs(values[order[: 2 * int(half) + 1]])))
    return ResidualStatistics(
        count=int(known.sum()),
        mean=0.0,
        std=tones.rms,
        rms=tones.rms,
        robust=robust,
        least=float(values.min()),
        largest=float(values.max()),
    )


def _total_size(sizes: Sequence[ResidualStatistics], tones: Tones) -> ResidualStatistics:
    """Return the size of all days together: rms by the intervals' weights."""
    known = [one for one in sizes if one.count]
    if not known:
        return sizes[0]
    return ResidualStatistics(
        count=sum(one.count for one in known),
        mean=0.0,
        std=tones.rms,
        rms=tones.rms,
        robust=float(np.median([one.robust for one in known])),
        least=min(one.least for one in known),
        largest=max(one.largest for one in known),
    )


def _noise_floor(tones: Tones, block: np.ndarray) -> NoiseFloor:
    """Return nature's noise by the intervals' weights, with its 95 % interval between blocks."""
    level = tones.floor
    if not level > 0.0:
        return NO_FLOOR
    others = [block != one for one in np.unique(block)]
    # The delete-one-block jackknife.
    each = np.array(
        [
            Tones(tones.value[rest], tones.weight[rest], tones.noise[rest]).floor
            for rest in others
            if rest.any()
        ]
    )
    if each.size < 2:
        return NoiseFloor(level, float("nan"), float("nan"))
    sigma = float(np.sqrt((each.size - 1) / each.size * np.sum((each - np.mean(each)) ** 2)))
    half = SPIN_COMPARE_SETTINGS.interval_sigmas * sigma
    return NoiseFloor(level, max(level - half, 0.0), level + half)
