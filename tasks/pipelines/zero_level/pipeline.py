"""The pipeline of a vector sensor against nature: averages of days, tables of zero levels, the field without them.

`ZeroLevelPipeline` takes an instrument, or the product of another comparison of it: of two sensors on a boom
the corrected field, whose constant part these levels are. That product may have had such a level taken off
already; it is put back first, so that both comparisons agree however often each is run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import scipy
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import change_outside, outside_learnt
from inflight.catalog import Catalog, Day
from inflight.errors import CalibrationError, CatalogError, InflightError, MissionError, ModelError
from inflight.flags import UNUSABLE, Flag, flag_meanings
from inflight.mission import Mission, ZeroLevelComparison
from inflight.tasks.archive import ArchiveIndex, load_samples, split_at_flips
from inflight.tasks.models import current_model
from inflight.tasks.pipelines.base import (
    ONE_DAY,
    Batch,
    Part,
    Pipeline,
    Plan,
    ProductBatch,
    Reprocessing,
    ReprocessSettings,
    TablesReport,
    TablesToPublish,
    TextLine,
    Versions,
    equations_of,
    month_edges,
    newest_table,
    page_sections,
    plan_days,
    product_of,
    rounded,
    window_edges,
    with_unit,
)
from inflight.tasks.pipelines.zero_level.tables import (
    BEFORE_ZERO_LEVEL,
    NAMES,
    SUBTRACTED,
    DayMeans,
    edges_of_constants,
    step_table,
    zero_level_table,
)
from inflight.tasks.report import Progress, write_page
from inflight.time import DAY, SECOND, DayLike, Int64, day_bounds, is_within, to_utc, usual_step
from inflight.zero_level import (
    AXES,
    Intervals,
    average_spans,
    check_averaging,
    classify_intervals,
    compression,
    delivered_rule,
    whole_average,
)

if TYPE_CHECKING:
    from inflight.figures import LazySection, Section
    from inflight.plumbing import Finding
    from inflight.tasks.pipelines.base import CompareResult, EarlierProducts, Report

#: An interval is averaged to about so many means (assumed; a covariance needs 16).
_MEANS_OF_INTERVAL = 30
#: Part of the samples that a mean needs where nothing turns, and where a hole breaks a whole turn.
_COVERAGE, _WHOLE = 0.5, 1.0
#: Flags of samples that no average takes.
_LEFT_OUT = UNUSABLE | Flag.TRANSIENT | Flag.UNKNOWN_STATE
#: Flags of samples that count in the coverage.
_HARMLESS = Flag.LEAP_SECOND | Flag.NO_ATTITUDE | Flag.PRIOR_PARAMETERS | Flag.EXTRAPOLATED | Flag.NOT_CORRECTED


class ZeroLevelPipeline(Pipeline):
    """Three offsets of a vector sensor from what natural fluctuations of the field do not do.

    The statistics of a day are averages of its readings, over whole turns where the spacecraft spins
    (Hedgecock's rule). Tables have the joint estimate of all methods with the test of each one's assumption
    (`inflight.zero_level`). The product is the field without the zero level; its residual the variation of
    the field's size in intervals in which the field turns.
    """

    tag = "zero_level"
    versions = Versions(statistics=1, tables=1, products=1)

    def handles(self, mission: Mission, settings: ReprocessSettings) -> bool:
        """Return True for a comparison of a vector sensor with nature."""
        return mission.comparisons[settings.comparison].kind == "zero_level"

    def make_plan(
        self,
        cat: Catalog,
        mission: Mission,
        settings: ReprocessSettings,
        span: tuple[DayLike | None, DayLike | None],
    ) -> Plan:
        """Find out what has to be done; a day of a product is made of that product alone.

        Raises
        ------
        MissionError
            When all days are to be fitted at once.
        CatalogError
            When there is no day to work on.
        """
        if settings.table == "continuous":
            raise MissionError(
                "a zero level has no table 'continuous'", remedy="choose daily, window, monthly or span"
            )
        product = _entry(mission, settings.comparison).product
        if product is None:
            return super().make_plan(cat, mission, settings, span)
        days = {
            day.day: replace(day, key=str(day.report.get(BEFORE_ZERO_LEVEL, day.key)))
            for day in cat.days(product_of(product), states=("published",))
            if is_within(day.day, *span)
        }
        if not days:
            raise CatalogError(
                f"no day has a product of '{product}'",
                remedy=f"run 'inflight reprocess --comparison {product}' first",
            )
        return plan_days(
            cat,
            mission,
            settings,
            used=current_model(cat, mission, settings.comparison),
            equations=equations_of(settings.comparison),
            version=self.versions.statistics,
            index=ArchiveIndex({(day.dataset, day.day): day for day in days.values()}),
            sources={day: (days[day],) for day in sorted(days)},
        )

    def make_day(self, batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the day's averages: `mean` (block, mean, axis) nT, `mean_time` (block, mean).

        Raises
        ------
        CalibrationError
            When no sample of the day is usable.
        """
        entry, read = _entry(batch.mission, batch.settings.comparison), read_field(batch, day)
        start, end = day_bounds(day)
        # On a fixed grid, so that the days of a segment have as many averages.
        rule = averaging_of(batch.mission, entry)
        count = -(-DAY // rule.length)
        time = start + rule.length * np.arange(count, dtype=np.int64) + rule.length // 2
        mean = np.full((count, 3), np.nan)
        good = (read.flag & np.uint32(_LEFT_OUT)) == 0
        good &= np.isfinite(read.field).all(axis=1)
        if not good.any():
            raise CalibrationError(
                "no sample of the day is usable", remedy="look at the day's flags and deliveries"
            )
        middle, taken = average_spans(
            read.tt2000, read.field, rule.length / SECOND, good, _WHOLE if rule.spins else _COVERAGE
        )
        place = (middle - start) // rule.length
        inside = (place >= 0) & (place < count) & np.isfinite(taken).all(axis=1)
        mean[place[inside]], time[place[inside]] = taken[inside], middle[inside]
        span = {"start": ("block", np.array([start])), "end": ("block", np.array([end]))}
        made = xr.Dataset(
            {
                "mean": (("block", "mean_of", "axis"), mean[None], {"units": "nT", "frame": read.frame}),
                "mean_time": (("block", "mean_of"), time[None], {"scale": "TT2000"}),
                **span,
            }
        )
        return made, {"used": int(inside.sum()), "basis": read.basis, "constant": read.constant}

    def solve(self, work: Reprocessing, days: Mapping[np.datetime64, Day]) -> TablesToPublish:
        """Make the tables of days, windows, months and the span, and that of steps where it is asked for.

        No window holds two positions of a flipper, or two constant parts of the product it is made from.
        """
        plan, mission, keep = work.plan, work.mission, self.table_stager(work, days)
        entry, ordered = _entry(mission, plan.settings.comparison), sorted(days)
        if not ordered:
            raise CalibrationError("no day has usable averages", remedy="look at the problems of the days")
        means = [DayMeans.of(work.cat.read(days[day]), days[day].report) for day in ordered]
        attributes = {"comparison": plan.settings.comparison, "model": plan.model.sha, "kind": "zero_level"}
        first, after = ordered[0], ordered[-1] + ONE_DAY
        daily = keep.table("daily", partial(zero_level_table, means, entry, [*ordered, after], attributes))
        windows = {
            "window": window_edges(first, ordered[-1], plan.settings.window_days),
            "monthly": month_edges(first, ordered[-1]),
            "span": [first, after],
        }
        for name, edges in windows.items():
            bounds = edges_of_constants(means, split_at_flips(edges, mission))
            keep.table(name, partial(zero_level_table, means, entry, bounds, attributes, daily))
        average = averaging_of(mission, entry).length / SECOND
        steps = {"steps": partial(step_table, means, entry, average, attributes)} if entry.step else {}
        return keep.solved(plan.settings.table, plan.model, keep.stage_possible(steps))

    def make_product(self, batch: ProductBatch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the day's field without the zero level, with the uncertainty of both, and a report."""
        read, table, span = read_field(batch, day), batch.table, day_bounds(day)
        row = row_at(table, sum(span) // 2)
        value, known = np.asarray(row["value"].values), row["determined"].values.astype(bool)
        covariance = np.asarray(row["covariance"].values)
        outside, change = outside_learnt(row, read.tt2000), change_outside(row, table, span, NAMES)
        variance = np.broadcast_to(np.diag(covariance), read.field.shape) + read.sigma**2
        if change is not None:
            variance = np.where(outside[:, None], variance + change**2, variance)
        flag = read.flag | (np.uint32(Flag.EXTRAPOLATED) * outside).astype(np.uint32)
        entry = _entry(batch.mission, batch.settings.comparison)
        if not known[[AXES.index(axis) for axis in entry.axes]].all():
            flag = flag | np.uint32(Flag.PRIOR_PARAMETERS)
        calibrated = read.field - value
        product = rounded(_product(read, calibrated, np.sqrt(variance), flag)).assign_attrs(
            mission=batch.mission.mission,
            acknowledgement=batch.mission.acknowledgement,
            day=str(day),
            comparison=batch.settings.comparison,
            zero_level_nT=value.tolist(),
            zero_level=describe_row(row, entry),
        )
        good = (flag & ~np.uint32(_HARMLESS)) == 0
        step = usual_step(read.tt2000, 1)
        report: dict[str, Any] = {
            "coverage": float(good.sum() * step / (span[1] - span[0])),
            "samples": int(good.sum()),
            "zero_level": str(product.attrs["zero_level"]),
        }
        return product, report | size_variation(read, entry, averaging_of(batch.mission, entry), value)

    def results(self, work: Reprocessing, solved: TablesToPublish | None) -> dict[str, Any]:
        """Return the variation of the field's size, each window's zero level, and averages that leave a tone."""
        published = work.cat.days(work.plan.product, states=("published",))
        reports = [day.report for day in published if day.day in work.plan.keys]
        entry = _entry(work.mission, work.plan.settings.comparison)
        out: dict[str, Any] = {
            "residual": combine_variations(reports) if solved else {},
            "averaging": averaging_of(work.mission, entry).warnings,
        }
        if solved is None:
            return out
        tables = {used.number: used.table for used in solved.used.values()}
        out["zero_levels"] = [one for table in tables.values() for one in rows_as_json(table, entry)]
        return out | ({"left_out": solved.notes} if solved.notes else {})

    def remarks(self, fields: Mapping[str, Any]) -> Iterator[str]:
        """Yield which zero levels could not be told and why, and averages that are not over whole turns."""
        yield from fields.get("averaging", ())
        for one in fields.get("zero_levels", ()):
            if one["not_determined"]:
                axes = " and ".join(one["not_determined"])
                yield f"{one['start']} to {one['end']}: the zero level along {axes} is not told: {one['reason']}"
        yield from super().remarks(fields)

    def compare(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        days: Sequence[Day],
        span: slice,
        progress: Progress,
        client: Any = None,
        earlier: EarlierProducts | None = None,
    ) -> CompareResult[ZeroLevelReport]:
        """Return the variation of the field's size before and after, and the zero levels with their tests."""
        from inflight.tasks.pipelines.base import CompareResult

        entry = _entry(mission, comparison)
        used = str(cat.read(days[-1], ["flag"]).attrs["calibration_table"]).partition(":")[0]
        table = newest_table(cat, used)
        levels = [] if table is None else rows_as_json(table, entry)
        report = ZeroLevelReport(comparison, [{"day": str(day.day), **day.report} for day in days], levels)
        title = f"{mission.mission}: zero level, {days[0].day} to {days[-1].day}"
        parts: list[LazySection] = [("Variation of the size", lambda: ([_variation_html(report)], []))]
        parts += [
            (heading, partial(lambda text, plots: (text, plots), text, plots))
            for heading, text, plots in self.sections(cat, mission, comparison)
        ]
        return CompareResult(report, title, parts)

    def report(
        self, cat: Catalog, mission: Mission, comparison: str, output: Path | None = None, cause: str = ""
    ) -> Report:
        """Return zero levels, methods and tests of the newest tables, and write their page when asked."""
        entry, table = _entry(mission, comparison), newest_table(cat, f"{comparison}-window")
        if table is None:
            raise CatalogError(
                f"no tables are published for comparison '{comparison}'",
                remedy=f"run 'inflight reprocess --comparison {comparison}' first",
            )
        if output is not None:
            from inflight.figures import html_page

            title = f"{mission.mission}: zero level of {entry.vector}"
            write_page(output, html_page(title, self.sections(cat, mission, comparison), mission.acknowledgement))
        levels = rows_as_json(table, entry)
        steps = newest_table(cat, f"{comparison}-steps") if entry.step else None
        fields = {"comparison": comparison, "zero_levels": levels, "steps": _steps_as_json(steps)}
        return TablesReport(fields, level_lines(comparison, levels), output)

    def sections(self, cat: Catalog, mission: Mission, comparison: str) -> list[Section]:
        """Return zero levels, what each method says, and the tests of their assumptions."""
        table = newest_table(cat, f"{comparison}-window")
        if table is None:
            return []
        from inflight.figures import bullet_list, html_table, parameter_figures, zero_methods_figure

        entry, daily = _entry(mission, comparison), newest_table(cat, f"{comparison}-daily")
        levels = Part("zero_level", "Zero levels")
        head = ("from", "to", *AXES, "methods")
        rows = [
            (one["start"], one["end"], *(one["sentence"][axis] for axis in AXES), one["method"])
            for one in rows_as_json(table, entry)
        ]
        levels.text.append(html_table(head, rows))
        levels.plots = [] if daily is None else list(parameter_figures(daily, table))
        tests = Part("assumptions", "What the methods assume")
        last = table.isel(interval=-1)
        sentences = [str(one) for one in last["assumption_text"].values if str(one)]
        tests.text.append(bullet_list(sentences) if sentences else str(last["reason"].values))
        own = Part("methods", "Each method by itself")
        own.text.append(html_table(("method", "intervals", *AXES, "remarks"), _method_rows(last)))
        told = table.assign(sigma=table["sigma"].where(table["determined"], np.inf))
        own.plots = [
            zero_methods_figure(told.isel(parameter=AXES.index(axis)), f"Zero level along {axis} by method")
            for axis in entry.axes
        ]
        found = [levels, own, tests]
        steps = newest_table(cat, f"{comparison}-steps") if entry.step else None
        if steps is not None:
            part = Part("steps", f"Steps of {entry.step / (3600 * SECOND):g} h")
            part.add_text("Results by themselves, too uncertain to correct a field with.")
            part.text.append(html_table(("from", *AXES), _step_rows(steps)))
            found.append(part)
        return page_sections(found)


# --- what is read ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FieldOfDay:
    """A day's field in axes in which the offset stands still, no zero level taken off.

    Attributes
    ----------
    tt2000 : ndarray of int64, shape (time,)
    field : ndarray, shape (time, 3)
        nT.
    sigma : ndarray, shape (time, 3)
        Uncertainty of the product, nT; 0 of readings, whose noise turbulence does not show.
    flag : ndarray of uint32, shape (time,)
    frame : str
        ``sensor`` or ``spacecraft``.
    orientation : Rotation or None
        From these axes to the spacecraft's, where they are not the same.
    basis, constant : str
        Of a product: the calibration table it was made with, and what its constant part is.
    """

    tt2000: Int64
    field: Floats
    sigma: Floats
    flag: np.ndarray
    frame: str
    orientation: scipy.spatial.transform.Rotation | None
    basis: str = ""
    constant: str = ""


def read_field(batch: Batch, day: np.datetime64) -> FieldOfDay:
    """Return what the zero level of a day is looked for in: readings of the instrument, or a product."""
    mission, job = batch.mission, batch.job
    entry = _entry(mission, batch.settings.comparison)
    if entry.product is not None:
        return _read_product(batch, job.index.days[product_of(entry.product), day])
    samples = load_samples(batch.cat, mission, batch.model, day, list(job.needs), job.index, geometry=False)
    corrected = cast("xr.Dataset", batch.model.corrected(samples))
    reading = np.asarray(corrected["vector"].values, dtype=np.float64)
    channel = mission.instruments[entry.vector].channels["field"]
    still = channel.frame not in (None, "sensor")
    return FieldOfDay(
        np.asarray(samples["tt2000"].values, dtype=np.int64),
        reading,
        np.zeros(reading.shape),
        np.asarray(samples["flag"].values, dtype=np.uint32),
        str(channel.frame) if still else "sensor",
        None if still else scipy.spatial.transform.Rotation.from_quat(mission.instruments[entry.vector].orientation),
    )


def _read_product(batch: Batch, day: Day) -> FieldOfDay:
    """Return the field of another comparison's product; a zero level that it had taken off is put back."""
    product = batch.cat.read(day)
    name = "field_spacecraft" if "outboard" in product else "field_sensor"
    subtracted = np.asarray(product.attrs.get(SUBTRACTED, (0.0, 0.0, 0.0)), dtype=np.float64)
    sigma = np.asarray(product["uncertainty"].values, dtype=np.float64)
    attrs = product.attrs
    entry = _entry(batch.mission, batch.settings.comparison)
    in_sensor = name == "field_sensor"
    turn = scipy.spatial.transform.Rotation.from_quat(batch.mission.instruments[entry.vector].orientation)
    return FieldOfDay(
        np.asarray(product["tt2000"].values, dtype=np.int64),
        np.asarray(product[name].values, dtype=np.float64) + subtracted,
        sigma,
        np.asarray(product["flag"].values, dtype=np.uint32),
        "sensor" if in_sensor else "spacecraft",
        turn if in_sensor else None,
        str(attrs.get("calibration_table", "")).partition(",")[0],
        str(attrs.get("constant_before", attrs.get("constant", ""))),
    )


def _entry(mission: Mission, comparison: str) -> ZeroLevelComparison:
    return cast("ZeroLevelComparison", mission.comparisons[comparison])


@dataclass(frozen=True)
class Averaging:
    """How readings are averaged before fluctuations are looked at.

    Attributes
    ----------
    length : int
        ns; a whole number of samples.
    spins : bool
        Whether they must be whole turns, too.
    warnings : list of str
        What of a turning field is left, where it is too much: of these means, and of those delivered.
    """

    length: int
    spins: bool = False
    warnings: list[str] = field(default_factory=list)


def averaging_of(mission: Mission, entry: ZeroLevelComparison) -> Averaging:
    """Return over how long the readings of a comparison are averaged.

    A mission that states the period `spin` delivers despun fields: what of an offset in the spin plane turns
    with the spacecraft averages out over whole turns that are whole samples, and over no others.
    """
    instrument = mission.instruments[entry.vector]
    wanted = entry.average or entry.interval // _MEANS_OF_INTERVAL
    cadence, turn = instrument.cadence, mission.periods.get("spin")
    if turn is None:
        return Averaging(max(round(wanted / cadence), 1) * cadence)
    spin, sampling = turn / SECOND, cadence / SECOND
    found = []
    if instrument.averaging:
        fine = entry.sampling / SECOND if entry.sampling else None
        delivered = delivered_rule(spin, instrument.averaging / SECOND, fine)
        if not delivered.kept:
            found.append(
                f"'{entry.vector}' is delivered in {instrument.averaging / SECOND:g} s means, and these "
                f"{delivered.summary()}: the zero levels across the spin axis are no better than that part of "
                "the offset there; ask for means over whole turns and whole samples, or for all samples"
            )
    count = whole_average(spin, sampling, wanted / SECOND)
    rule = delivered_rule(spin, count * sampling, sampling)
    if not rule.kept and not instrument.averaging >= turn:
        found.append(f"no averages of about {wanted / SECOND:g} s are whole turns and samples: {rule.summary()}")
    return Averaging(count * cadence, True, found)


def row_at(table: xr.Dataset, tt2000: int) -> xr.Dataset:
    """Return the interval of a table that holds an instant.

    Raises
    ------
    ModelError
        When none does.
    """
    inside = np.flatnonzero((table["start"].values <= tt2000) & (tt2000 < table["end"].values))
    if not inside.size:
        raise ModelError(
            f"the table of zero levels holds nothing at {to_utc(tt2000)}",
            remedy="reprocess the span with its table",
        )
    return table.isel(interval=int(inside[-1]))


def _product(read: FieldOfDay, calibrated: Floats, sigma: Floats, flag: np.ndarray) -> xr.Dataset:
    """Return the variables of a product: the field, also in the spacecraft's axes, uncertainty and flags."""
    masks, names = flag_meanings()
    vector = ("time", "axis")

    def described(name: str, frame: str) -> dict[str, str]:
        return {"units": "nT", "long_name": name, "frame": frame}

    main = f"field_{read.frame}" if read.frame in ("sensor", "spacecraft") else "field_despun"
    fields = {main: (vector, calibrated, described("field without the zero level", read.frame))}
    if read.orientation is not None:
        turned = np.full(calibrated.shape, np.nan)
        there = np.isfinite(calibrated).all(axis=1)
        turned[there] = read.orientation.apply(calibrated[there])
        fields["field_spacecraft"] = (vector, turned, described("field without the zero level", "spacecraft"))
    return xr.Dataset(
        {
            **fields,
            "uncertainty": (vector, sigma, described(f"one sigma of {main}, white noise aside", read.frame)),
            "flag": ("time", flag.astype(np.uint32), {"flag_masks": masks, "flag_meanings": names}),
            "tt2000": ("time", read.tt2000, {"units": "ns", "scale": "TT2000"}),
        },
        coords={"axis": list(AXES)},
    )


# --- what is told ---------------------------------------------------------------------------------------


def size_variation(
    read: FieldOfDay, entry: ZeroLevelComparison, rule: Averaging, value: Floats
) -> dict[str, Any]:
    """Return the rms variation of the field's size in the day's Alfvenic intervals, before and after, nT.

    Returns
    -------
    dict
        `before_nT`, `after_nT`, and `turning_intervals`, how many there are; both None without any.
    """
    good = ((read.flag & np.uint32(_LEFT_OUT)) == 0) & np.isfinite(read.field).all(axis=1)
    empty = {"before_nT": None, "after_nT": None, "turning_intervals": 0}
    if not good.any():
        return empty
    middle, mean = average_spans(read.tt2000, read.field, rule.length / SECOND, good, _COVERAGE)
    try:
        intervals = Intervals.of(middle, mean, entry.interval / SECOND, fewest=1)
    except InflightError:
        return empty
    turning = classify_intervals(intervals, value).alfvenic
    if not turning.any():
        return empty
    part, start = intervals.select(turning), np.array(entry.start)
    before, after = (float(np.sqrt(np.mean(compression(part, one)))) for one in (start, value))
    return {"before_nT": before, "after_nT": after, "turning_intervals": int(turning.sum())}


def combine_variations(reports: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the rms variation of the size of several days, by their intervals; empty without any."""
    known = [one for one in reports if one.get("turning_intervals")]
    total = sum(one["turning_intervals"] for one in known)
    return {
        name: float(np.sqrt(sum(one["turning_intervals"] * one[name] ** 2 for one in known) / total))
        for name in ("before_nT", "after_nT")
        if total
    }


def describe_row(row: xr.Dataset, entry: ZeroLevelComparison) -> str:
    """Return a zero level in words: each axis with its error, the methods, and what is not told."""
    return "; ".join(f"{axis} {sentence}" for axis, sentence in _axes(row, entry).items())


def _axes(row: xr.Dataset, entry: ZeroLevelComparison) -> dict[str, str]:
    """Return of each axis its zero level with its error, or that nothing tells it."""
    value, sigma, known = (row[name].values for name in ("value", "sigma", "determined"))
    return {
        axis: "not asked for"
        if axis not in entry.axes
        else with_unit(float(value[at]), float(sigma[at]), "nT")
        if known[at]
        else f"not told, within {entry.bound:g} nT of {entry.start[at]:g} nT"
        for at, axis in enumerate(AXES)
    }


def rows_as_json(table: xr.Dataset, entry: ZeroLevelComparison) -> list[dict[str, Any]]:
    """Return the rows of a table of zero levels as plain fields."""
    out = []
    for at in range(table.sizes["interval"]):
        row = table.isel(interval=at)
        known = row["determined"].values.astype(bool)
        shared = row["sigma"].values / np.where(known, row["independent_sigma"].values, np.nan)
        out.append(
            {
                "start": str(to_utc(int(row["start"])))[:10],
                "end": str(to_utc(int(row["end"])))[:10],
                "value_nT": [float(v) if k else None for v, k in zip(row["value"].values, known, strict=True)],
                "sigma_nT": row["sigma"].values.tolist(),
                "wander_nT": row["wander"].values.tolist(),
                "sigma_over_independent": [float(one) if np.isfinite(one) else None for one in shared],
                "sentence": _axes(row, entry),
                "method": str(row["method"].values),
                "kinds": dict(zip(table["kind"].values.tolist(), row["kinds"].values.tolist(), strict=True)),
                "not_determined": [axis for axis in entry.axes if not known[AXES.index(axis)]],
                "reason": str(row["reason"].values),
                "assumptions": [str(one) for one in row["assumption_text"].values if str(one)],
                "fails": [
                    str(text)
                    for text, holds, size in zip(
                        row["assumption_text"].values,
                        row["assumption_holds"].values,
                        row["assumption_value"].values,
                        strict=True,
                    )
                    if np.isfinite(size) and not holds
                ],
                "basis": str(row["basis"].values),
                "constant": str(row["constant"].values),
            }
        )
    return out


def level_lines(comparison: str, levels: Sequence[Mapping[str, Any]]) -> list[TextLine]:
    """Return the zero levels as a person reads them, the newest window with its tests."""
    lines = [TextLine(f"{comparison}: zero levels of {len(levels)} windows", "bold")]
    for one in levels:
        axes = ", ".join(f"{axis} {text}" for axis, text in one["sentence"].items())
        lines.append(TextLine(f"  {one['start']} to {one['end']}: {axes}; {one['method']}"))
        if one["not_determined"]:
            lines.append(TextLine(f"    {one['reason']}"))
        lines += [TextLine(f"    {text}") for text in one["fails"]]
    if levels:
        ratio = [one for one in levels[-1]["sigma_over_independent"] if one is not None]
        lines += [TextLine(f"  {text}", "dim") for text in levels[-1]["assumptions"]]
        if ratio:
            lines.append(
                TextLine(
                    f"  the methods share intervals: the joint error is {np.mean(ratio):.1f} times that of "
                    "independent data",
                    "dim",
                )
            )
    return lines


@dataclass
class ZeroLevelReport:
    """What `compare` found; `path` is the page, when one was written."""

    comparison: str
    by_day: list[dict[str, Any]]
    levels: list[dict[str, Any]]
    path: Path | None = None
    plumbing: Sequence[Finding] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""
        return {
            "command": "compare",
            "comparison": self.comparison,
            "plumbing": [dict(one.as_json()) for one in self.plumbing],
            "residual": combine_variations(self.by_day),
            "by_day": self.by_day,
            "zero_levels": self.levels,
            "fails_where": [text for one in self.levels for text in one["fails"]],
            "path": str(self.path) if self.path else "",
        }

    def summary(self) -> list[TextLine]:
        """Return what a person reads."""
        size = combine_variations(self.by_day)
        first = (
            f"the field's size, where the field turns, varies by {size['before_nT']:.3f} nT rms as measured, "
            f"by {size['after_nT']:.3f} nT without the zero level"
            if size
            else "no interval in which the field turns: nothing shows how well the zero level fits"
        )
        return [TextLine(first, "bold"), *level_lines(self.comparison, self.levels)]


def _variation_html(report: ZeroLevelReport) -> str:
    from inflight.figures import html_table

    rows = [
        (day["day"], day["turning_intervals"], f"{day['before_nT']:.3f}", f"{day['after_nT']:.3f}")
        for day in report.by_day
        if day.get("turning_intervals")
    ]
    head = ("day", "intervals in which it turns", "variation of the size as measured, nT", "without the zero level, nT")
    return html_table(head, rows) if rows else "No interval of the span is one in which the field turns."


def _method_rows(row: xr.Dataset) -> list[tuple[str, ...]]:
    """Return what each method says in a window by itself, one row a method."""
    out = []
    for at, name in enumerate(row["method_name"].values):
        value, sigma = row["method_value"].values[at], row["method_sigma"].values[at]
        cells = [
            with_unit(float(v), float(s), "nT") if np.isfinite(v) and np.isfinite(s) else "-"
            for v, s in zip(value, sigma, strict=True)
        ]
        out.append((str(name), str(int(row["method_used"].values[at])), *cells, str(row["method_reason"].values[at])))
    return out


def _step_rows(steps: xr.Dataset) -> list[tuple[str, ...]]:
    known = steps["determined"].values.astype(bool)
    return [
        (
            str(to_utc(int(steps["start"].values[at])))[:16],
            *(
                with_unit(float(v), float(s), "nT") if k else "-"
                for v, s, k in zip(steps["value"].values[at], steps["sigma"].values[at], known[at], strict=True)
            ),
        )
        for at in range(steps.sizes["interval"])
    ]


def _steps_as_json(steps: xr.Dataset | None) -> list[dict[str, Any]]:
    if steps is None:
        return []
    return [
        {
            "start": str(to_utc(int(steps["start"].values[at])))[:19],
            "value_nT": steps["value"].values[at].tolist(),
            "sigma_nT": steps["sigma"].values[at].tolist(),
            "determined": steps["determined"].values[at].astype(bool).tolist(),
        }
        for at in range(steps.sizes["interval"])
    ]
