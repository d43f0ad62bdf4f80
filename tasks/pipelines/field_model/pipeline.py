"""The pipeline of a vector sensor against a model of the Earth's field: one file on the pipeline protocol.

The statistics of a day are sums of an orbit each (`inflight.calibration.field_model`); tables of days,
windows, months and the span are solved from them. The product is the calibrated field with the model's beside
it; its residual is their difference in spacecraft axes.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from inflight.arrays import Floats
from inflight.calibration import (
    MOUNTING,
    VALUE_ORIGINS,
    change_outside,
    comparison_grams,
    field_variance,
    fit_twelve,
    mounting,
    outside_learnt,
    own_equation,
    prior_of_twelve,
    readings_of,
    with_changes,
    with_learnt_spans,
)
from inflight.catalog import Catalog, Day
from inflight.effects import position_channel
from inflight.errors import CalibrationError, CatalogError, MissionError
from inflight.flags import UNUSABLE, Flag, flag_meanings
from inflight.frames import itrf_to_spacecraft, latitude_longitude, position_in_itrf, to_nec
from inflight.main_field import MainField
from inflight.mission import FieldModelComparison, Mission
from inflight.model import REFERENCE, Model
from inflight.progress import Progress, silent, tell_each
from inflight.residual import (
    Coordinate,
    above_floor,
    daily_scatter,
    join_floors,
    measure_dependences,
    merge_statistics,
    noise_floor,
    residual_statistics,
)
from inflight.tasks.archive import geometry_channels, load_samples, within_day
from inflight.tasks.models import ModelHistory
from inflight.tasks.pipelines.base import (
    ONE_DAY,
    Batch,
    CompareReport,
    CompareResult,
    EarlierProducts,
    EarlierResidual,
    Pipeline,
    Plan,
    ProductBatch,
    Report,
    Reprocessing,
    ReprocessSettings,
    Sources,
    Spans,
    TablesReport,
    TablesToPublish,
    TextLine,
    Versions,
    blocks_of,
    daily_residual_figure,
    day_summary,
    history_section,
    month_edges,
    newest_table,
    residual_of_days,
    rounded,
    rows_of_day,
    sizes_html,
    structures_html,
    tables_in_use,
    window_edges,
    with_unit,
)
from inflight.tasks.report import write_page
from inflight.time import SECOND, DayLike, Int64, day_bounds, to_utc, usual_step

if TYPE_CHECKING:
    import xarray as xr

    from inflight.figures import Section

#: Spans whose means a comparison looks at, s: a minute is half a thousand kilometres of a low orbit.
_SPAN_S = 60.0

#: Clear structures told of each component, at most.
_TOLD = 3

_AXES = "xyz"


class FieldModelPipeline(Pipeline):
    """Twelve parameters of a vector sensor, ``B = M E + b``, against a model of the main field."""

    tag = "field_model"
    versions = Versions(statistics=2, tables=2, products=3)

    def handles(self, mission: Mission, settings: ReprocessSettings) -> bool:
        """Return True for a comparison with a field model."""
        return mission.comparisons[settings.comparison].kind == "field_model"

    def make_plan(
        self,
        cat: Catalog,
        mission: Mission,
        settings: ReprocessSettings,
        span: tuple[DayLike | None, DayLike | None],
    ) -> Plan:
        """Find out what has to be done.

        Raises
        ------
        MissionError
            When the mission has no position over the Earth or no attitude, no file of the model's
            coefficients, or all days are to be fitted at once.
        """
        self.refuse_continuous(settings, "no trend in time is fitted against a field model")
        kinds = {channel.kind for _, _, channel in mission.channel_instruments()}
        missing = [] if position_channel(mission) else ["a position (kind: position, frame: itrf or gcrf)"]
        missing += [] if "attitude" in kinds else ["an attitude (kind: attitude)"]
        if missing:
            raise MissionError(
                f"comparisons.{settings.comparison}: a field model needs {' and '.join(missing)}, and the "
                "mission has none",
                file="mission.yaml",
                remedy="add the channel of an orbit or attitude instrument",
            )
        model_field(cat, mission, settings.comparison)
        return super().make_plan(cat, mission, settings, span)

    def extra_channels(self, mission: Mission, comparison: str) -> Sequence[str]:
        """Return attitude and position."""
        return geometry_channels(mission)

    def make_day(self, batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the sums of a day's blocks, along ``block``, and what was used.

        Raises
        ------
        CalibrationError
            When fewer samples than the settings' `min_coverage` are usable; it says what is missing.
        """
        import xarray as xr

        samples = _samples(batch, day)
        reading, reference, good = readings_of(batch.model, samples)
        start, end = day_bounds(day)
        step = usual_step(np.asarray(samples["tt2000"].values), SECOND)
        coverage = float(good.sum() * step / (end - start))
        if good.sum() <= MOST_PARAMETERS or coverage < batch.settings.min_coverage:
            raise _too_few(batch, day, samples, coverage)
        prior = prior_of_twelve(batch.model, (start + end) // 2)
        uniform = _uniform_fields(batch.model, samples)
        rate = _rate(reference, np.asarray(samples["tt2000"].values))
        grams = comparison_grams(reading, reference, uniform, good, prior, rate=rate)
        edges = np.linspace(start, end, len(grams) + 1).astype(np.int64)
        made = {
            "gram": (("block", "column", "other"), grams),
            "start": ("block", edges[:-1]),
            "end": ("block", edges[1:]),
        }
        return xr.Dataset(made), {"coverage": coverage, "used": int(good.sum())}

    def solve(self, work: Reprocessing, days: Mapping[np.datetime64, Day]) -> TablesToPublish:
        """Make the tables of days, windows and the span, and that of months when it is asked for."""
        keep, ordered, plan = self.table_stager(work, days), sorted(days), work.plan
        parts = [work.cat.read(days[day]) for day in tell_each(work.progress, "statistics", ordered)]
        grams, start, end = (
            np.concatenate([one[name].values for one in parts]) for name in ("gram", "start", "end")
        )
        first, after = ordered[0], ordered[-1] + ONE_DAY
        edges: dict[str, Sequence[np.datetime64]] = {
            "daily": [*ordered, after],
            "window": window_edges(first, ordered[-1], plan.settings.window_days),
            "span": [first, after],
        }
        if plan.settings.table == "monthly":
            edges["monthly"] = month_edges(first, ordered[-1])
        external = stated(work.mission, plan.settings.comparison).external
        for name, bounds in edges.items():
            what = (plan.model, bounds, name, external, work.progress)
            keep.table(name, partial(twelve_table, grams, (start, end), *what))
        return keep.solved(plan.settings.table, plan.model)

    def make_product(self, batch: ProductBatch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return one day's calibrated field, its residual before and after, and a report of both."""
        product = field_model_product(batch, day)
        flag = product["flag"].values
        measured = (flag & np.uint32(UNUSABLE)) == 0
        before, after = (
            float(np.sqrt(np.nanmean(product[name].values[measured] ** 2)))
            for name in ("residual_preflight", "residual")
        )
        start, end = day_bounds(day)
        step = usual_step(np.asarray(product["tt2000"].values), SECOND)
        report = {
            "coverage": float(measured.sum() * step / (end - start)),
            "samples": int(measured.sum()),
            "before_nT": before,
            "after_nT": after,
        }
        return rounded(product), report

    def results(self, work: Reprocessing, solved: TablesToPublish | None) -> dict[str, Any]:
        """Return the residual of the planned days, a component."""
        return {"residual": residual_of_days(work) if solved else {}}

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
    ) -> CompareResult[FieldModelReport]:
        """Measure the residual of each component before and after, and what it follows."""
        return compare_components(cat, mission, comparison, days, progress, earlier)

    def report(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        output: Path | None = None,
        cause: str = "",
        progress: Progress = silent,
    ) -> Report:
        """Return what the newest window says of the sensor: scale factors, angles, mounting, offsets."""
        table = newest_table(cat, f"{comparison}-window")
        if table is None:
            raise CatalogError(
                f"no table of '{comparison}' is published", remedy="run 'inflight reprocess' first"
            )
        intervals = intervals_of(table)
        fields = {
            "command": "chain",
            "comparison": comparison,
            "intervals": intervals,
            "path": str(output) if output else "",
        }
        if output is not None:
            from inflight import __version__
            from inflight.figures import html_page

            title = f"{mission.mission}: {comparison}, {intervals[0]['first']} to {intervals[-1]['last']}"
            footer = f"inflight {__version__}. {mission.acknowledgement}"
            write_page(output, html_page(title, self.sections(cat, mission, comparison), footer))
        lines = [TextLine(f"{comparison}: {len(intervals)} windows", "bold")]
        for one in intervals[-1:]:
            lines += [TextLine(f"  {one['first']} to {one['last']}")]
            lines += [
                TextLine(f"  {part['name']:<22} {with_unit(part['value'], part['sigma'], part['unit'])}")
                for part in one["parameters"]
            ]
        return TablesReport(fields, lines, output)

    def sections(self, cat: Catalog, mission: Mission, comparison: str) -> list[Section]:
        """Return parameters over days, and what the newest window says of the sensor."""
        from inflight.figures import html_table, parameter_figures

        daily, used = (newest_table(cat, f"{comparison}-{name}") for name in ("daily", "window"))
        if daily is None or used is None:
            return []
        newest = intervals_of(used)[-1]
        parameters = newest["parameters"]
        rows = [(one["name"], with_unit(one["value"], one["sigma"], one["unit"])) for one in parameters]
        text = f"From the table of windows, {newest['first']} to {newest['last']}; one sigma."
        return [
            ("What the sensor is", [text, html_table(("parameter", "value"), rows)], []),
            ("Parameters over days", [], parameter_figures(daily, used)),
        ]


#: Fewer usable samples make no fit.
MOST_PARAMETERS = 12


def model_field(cat: Catalog, mission: Mission, comparison: str) -> MainField:
    """Return the main field that a comparison states; raises `MissionError` without its file."""
    return MainField.of(stated(mission, comparison).model, Path(cat.workspace))


def stated(mission: Mission, comparison: str) -> FieldModelComparison:
    """Return a comparison with a field model as the mission states it."""
    entry = mission.comparisons[comparison]
    assert isinstance(entry, FieldModelComparison)
    return entry


def _samples(batch: Batch, day: np.datetime64, surroundings: bool = False) -> xr.Dataset:
    return load_samples(
        batch.cat,
        batch.mission,
        batch.model,
        day,
        list(batch.job.needs),
        batch.job.index,
        geometry=False,
        surroundings=surroundings,
    )


def _rate(field: Floats, stamps: Int64) -> Floats:
    """Return how fast a field (time, axis) changes, nT/s; 0 where it is not known."""
    return np.nan_to_num(np.gradient(field, stamps / SECOND, axis=0)) if len(field) > 1 else 0.0 * field


def _uniform_fields(model: Model, samples: xr.Dataset) -> Floats:
    """Return Earth-fixed unit vectors in the sensor's nominal axes; (time, axis, vector), 0 where unknown."""
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    position, attitude = samples["position"], np.asarray(samples["attitude"].values, dtype=np.float64)
    here = position_in_itrf(np.asarray(position.values), str(position.attrs["frame"]), stamps)
    frame, sensor = str(samples["attitude"].attrs.get("frame", "")), own_equation(model).sensor
    each = [
        sensor.rotation.inv().apply(
            np.nan_to_num(itrf_to_spacecraft(np.broadcast_to(one, here.shape), attitude, frame, here, stamps))
        )
        for one in np.eye(3)
    ]
    return np.stack(each, axis=2)


def _too_few(batch: Batch, day: np.datetime64, samples: xr.Dataset, coverage: float) -> CalibrationError:
    """Return the error of a day with too few usable samples: it says what most of them lack."""
    flag = np.asarray(samples["flag"].values)
    unusable = float(((flag & np.uint32(UNUSABLE)) != 0).mean())
    lost = {
        "a usable reading": unusable,
        "a position": float((~np.isfinite(samples["position"].values).all(axis=1)).mean()),
        "an attitude": float((~np.isfinite(samples["attitude"].values).all(axis=1)).mean()),
    }
    worst = max(lost, key=lambda name: lost[name])
    return CalibrationError(
        f"{coverage:.1%} of the day is usable, at least {batch.settings.min_coverage:.1%} is needed; "
        f"{lost[worst]:.1%} of the samples have not {worst}",
        remedy="ingest what is missing, lower 'min_coverage', or exclude the day",
        day=str(day),
    )


def twelve_table(
    grams: Floats,
    spans: tuple[Int64, Int64],
    model: Model,
    edges: Sequence[np.datetime64],
    kind: str,
    external_nT: float,
    progress: Progress = silent,
) -> xr.Dataset:
    """Return the table of intervals between days; dims interval, parameter, other.

    Parameters
    ----------
    grams : ndarray, shape (block, 19, 19)
        Of all days.
    spans : tuple of ndarray of int64, shape (block,)
        Where blocks start and end, TT2000.
    external_nT : float
        See `inflight.calibration.field_model.fit_twelve`.
    progress : callable, optional
        Called with ("intervals", done, total).
    """
    import xarray as xr

    start, end = spans
    own, rows, bounds, learnt = own_equation(model), [], [], []
    between = list(itertools.pairwise(day_bounds(edge)[0] for edge in edges))
    for first, after in tell_each(progress, "intervals", between):
        inside = np.flatnonzero((first <= start) & (start < after) & (grams[:, 3, 3] > 0))
        if not inside.size:
            continue
        prior = prior_of_twelve(model, (first + after) // 2)
        rows.append(fit_twelve(grams[inside], *prior, external_nT, own.sensor.sigma.delay / SECOND))
        bounds.append((first, after))
        learnt.append((int(start[inside[0]]), int(end[inside[-1]])))
    if not rows:
        raise CalibrationError("no day has a usable sample", remedy="look at flags, positions and attitudes")
    value, sigma = prior_of_twelve(model, bounds[0][0])
    names = [f"{own.name}.matrix[{row}{column}]" for row in _AXES for column in _AXES]
    names += [f"{own.name}.shift[{axis}]" for axis in _AXES]
    begin, after_each = np.array(bounds, dtype=np.int64).T
    each, covariance = ("interval", "parameter"), np.array([one.covariance for one in rows])
    determined, scale = np.array([one.determined for one in rows]), {"scale": "TT2000"}
    table = xr.Dataset(
        {
            "value": (each, np.array([one.value for one in rows])),
            "sigma": (each, np.sqrt(np.einsum("ijj->ij", covariance))),
            "covariance": ((*each, "other"), covariance),
            "determined": (each, determined),
            "source": (
                each,
                np.where(determined, VALUE_ORIGINS.index("data"), VALUE_ORIGINS.index("prior")).astype(
                    np.int8
                ),
                {"flag_meanings": " ".join(VALUE_ORIGINS)},
            ),
            "prior": ("parameter", value),
            "prior_sigma": ("parameter", sigma),
            "late": (each, np.array([one.late for one in rows])),
            "units": ("parameter", np.array(["1"] * 9 + ["nT"] * 3, dtype="U8")),
            "start": ("interval", begin, scale),
            "end": ("interval", after_each, scale),
            **{
                name: ("interval", np.array([getattr(one, name) for one in rows]), {"units": unit})
                for name, unit in (("before", "nT"), ("after", "nT"), ("count", "1"))
            },
        },
        coords={"parameter": names, "other": names},
        attrs={"comparison": model.comparison, "kind": kind, "model": model.sha, "model_name": model.name},
    )
    taught = np.array(learnt, dtype=np.int64)
    return with_changes(with_learnt_spans(table, taught[:, 0], taught[:, 1]))


def _row_of_day(table: xr.Dataset, day: np.datetime64) -> xr.Dataset:
    """Return the interval of a table that holds the begin of a day."""
    start, _ = day_bounds(day)
    inside = np.flatnonzero((table["start"].values <= start) & (start < table["end"].values))
    if not inside.size:
        raise CatalogError("the table holds nothing on the day", day=str(day), remedy="reprocess the span")
    return table.isel(interval=int(inside[-1]))


def field_model_product(batch: ProductBatch, day: np.datetime64) -> xr.Dataset:
    """Return the level-2 product of a day.

    Returns
    -------
    xarray.Dataset
        `field_sensor` (the sensor's nominal axes), `field_spacecraft`, `field_nec`, `field_model` (the
        model's, spacecraft axes), `residual`, `residual_preflight` (spacecraft axes), `uncertainty` (sensor
        axes), ``correction_<effect>``, `before_stray_field` (spacecraft axes); (time, axis) nT; `latitude`,
        `longitude`, `flag`.
    """
    import xarray as xr

    mission, table = batch.mission, batch.table
    samples, model = _samples(batch, day, surroundings=True), batch.model.bind(table)
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    start, end = day_bounds(day)
    row = _row_of_day(table, day)
    corrected = model.corrected(samples)
    reading, _, _ = readings_of(batch.model, samples)
    field, sensor = np.asarray(corrected["field"].values), own_equation(model).sensor
    reference = np.asarray(samples[REFERENCE].values)

    def turned(values: Floats) -> Floats:
        return np.where(np.isfinite(values), sensor.rotation.apply(np.nan_to_num(values)), np.nan)

    body = turned(field)
    flag = np.asarray(samples["flag"].values, dtype=np.uint32)
    lost = ~np.isfinite(field).all(axis=1) & (flag & np.uint32(UNUSABLE) == 0)
    flag = np.where(lost, flag | np.uint32(Flag.CHANNEL_MISSING), flag)
    if not np.all(row["determined"].values):
        flag = flag | np.uint32(Flag.PRIOR_PARAMETERS)
    step = usual_step(stamps, SECOND) / SECOND
    levels = [noise_floor(one, step).level_nT for one in (body - reference).T]
    noise = float(np.nan_to_num(np.nanmax(levels))) if np.isfinite(levels).any() else 0.0
    # The twelve turn the sensor's axes: what its orientation is known to is in their covariance.
    moved = _rate(field, stamps) * sensor.sigma.delay / SECOND
    variance = field_variance(reading, row["covariance"].values, noise, row["late"].values, moved)
    change = change_outside(row, table, (start, end), [str(name) for name in row["parameter"].values])
    if change is not None:
        outside = outside_learnt(row, stamps)
        flag = np.where(outside, flag | np.uint32(Flag.EXTRAPOLATED), flag)
        wider = np.abs(np.column_stack([reading, np.ones(len(reading))]))
        more = np.stack([wider @ change[[*range(3 * at, 3 * at + 3), 9 + at]] for at in range(3)], axis=1)
        variance = np.where(outside[:, None], variance + more**2, variance)
    vector, masks = ("time", "axis"), flag_meanings()

    def told(values: Floats, long_name: str, frame: str) -> tuple[Any, Floats, dict[str, str]]:
        return vector, values, {"units": "nT", "long_name": long_name, "frame": frame}

    before = batch.preflight.residual(samples)
    position, attitude = samples["position"], np.asarray(samples["attitude"].values, dtype=np.float64)
    here = position_in_itrf(np.asarray(position.values), str(position.attrs["frame"]), stamps)
    variables = {
        "field_sensor": told(field, "calibrated field", "sensor"),
        "field_spacecraft": told(body, "calibrated field", "spacecraft"),
        "field_model": told(reference, "main field of the model", "spacecraft"),
        "residual": told(body - reference, "calibrated field less the model's", "spacecraft"),
        "residual_preflight": told(before, "the same with the pre-flight model", "spacecraft"),
        "uncertainty": told(np.sqrt(variance), "one sigma", "sensor"),
    }
    frame = str(samples["attitude"].attrs.get("frame", ""))
    if frame in ("itrf", "nec"):
        nec = to_nec(body, attitude, here, frame)
        variables["field_nec"] = told(nec, "calibrated field", "nec")
    flag = np.where(np.isfinite(attitude).all(axis=1), flag, flag | np.uint32(Flag.NO_ATTITUDE))
    terms = model.correction_terms(cast("xr.Dataset", corrected))
    for name, term in terms.items():
        variables[f"correction_{name}"] = told(term, f"taken out of the reading: {name}", "sensor")
    with_terms = model.before_corrections(cast("xr.Dataset", corrected), terms)
    if with_terms is not None:
        text = "calibrated field, nothing of the spacecraft's taken out"
        variables["before_stray_field"] = told(turned(with_terms), text, "spacecraft")
    latitude, longitude = latitude_longitude(here)
    return xr.Dataset(
        {
            **variables,
            "latitude": ("time", latitude, {"units": "deg", "long_name": "geocentric latitude"}),
            "longitude": ("time", longitude, {"units": "deg", "long_name": "longitude"}),
            "flag": ("time", flag.astype(np.uint32), {"flag_masks": masks[0], "flag_meanings": masks[1]}),
            "tt2000": ("time", stamps, {"units": "ns", "scale": "TT2000"}),
        },
        coords={"axis": list(_AXES)},
        attrs={
            "comparison": model.comparison,
            "mission": mission.mission,
            "acknowledgement": mission.acknowledgement,
            "day": str(day),
            "field_model": stated(mission, model.comparison).model,
        },
    ).isel(time=within_day(stamps, day))


@dataclass(frozen=True)
class ComponentStructure:
    """What one component of the residual follows."""

    axis: str
    coordinate: str
    amplitude: float
    sigma: float
    unit: str

    @property
    def sentence(self) -> str:
        """The structure in one sentence."""
        size = with_unit(self.amplitude, self.sigma, "nT rms")
        return f"{self.axis} (spacecraft) follows {self.coordinate}: {size}"


@dataclass
class FieldModelReport(CompareReport):
    """What `compare` found; sizes are rms of a component, `components` of each of them, nT."""

    components: tuple[tuple[float, float], ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""
        each = zip(_AXES, self.components, strict=False)
        return super().as_json() | {
            "components": [{"axis": axis, "before_nT": one[0], "after_nT": one[1]} for axis, one in each]
        }


def compare_components(
    cat: Catalog,
    mission: Mission,
    comparison: str,
    days: Sequence[Day],
    progress: Progress,
    earlier: EarlierProducts | None = None,
) -> CompareResult[FieldModelReport]:
    """Measure the residual of each component of products before and after, and what it follows.

    With `earlier`, what an earlier version of the model left of the same days stands beside it.
    """
    sources = Sources.of(cat, mission, slice(str(days[0].day), str(days[-1].day + ONE_DAY)))
    rows: list[dict[str, Floats]] = []
    sizes, floors, skipped = [], [], 0
    for day in tell_each(progress, "compare", days):
        product = cat.read(day, ["residual", "residual_preflight", "field_sensor", "flag"])
        stamps = np.asarray(product["tt2000"].values, dtype=np.int64)
        before, after = (_usable(product, name) for name in ("residual_preflight", "residual"))
        sizes.append([[residual_statistics(one) for one in state.T] for state in (before, after)])
        cadence = usual_step(stamps, SECOND) / SECOND
        floors += [noise_floor(one, cadence) for one in after.T]
        skipped += int((product["flag"].values & np.uint32(UNUSABLE) > 0).sum())
        spans = Spans.of(stamps, _SPAN_S)
        own = rows_of_day(cat, mission, comparison, sources, product, before[:, 0], after[:, 0], spans)
        rows.append(own | {f"after {axis}": spans.mean(after[:, at]) for at, axis in enumerate(_AXES)})
    joined = {name: np.concatenate([one[name] for one in rows]) for name in rows[0]}
    block, block_name = blocks_of(joined["tt2000"], len(days))
    skip = {"before", "after", "low", "high", "tt2000", *(f"after {axis}" for axis in _AXES)}
    coordinates = [
        Coordinate(name, "", "", values)
        for name, values in joined.items()
        if name not in skip and not name.startswith("field direction")
    ]
    found = {axis: measure_dependences(coordinates, joined[f"after {axis}"], block) for axis in _AXES}
    structures = [
        ComponentStructure(axis, one.coordinate, one.amplitude, one.sigma_amplitude, one.unit)
        for axis, own in found.items()
        for one in sorted((one for one in own if one.is_clear), key=lambda one: -one.amplitude)[:_TOLD]
    ]
    structures.sort(key=lambda one: -one.amplitude)
    daily, used = tables_in_use(cat, comparison, days[0])
    names, known = used["parameter"].values, used["determined"].values[-1]
    merged = [[merge_statistics([day[state][at] for day in sizes]) for at in range(3)] for state in (0, 1)]
    floor, old = join_floors(floors), None
    if earlier is not None:
        each = [
            merge_statistics([residual_statistics(one) for one in _usable(cat.read(day), "residual").T])
            for day in earlier.days
        ]
        left = merge_statistics(each).rms
        sized = zip(earlier.days, each, strict=True)
        by_day = [{"day": str(day.day), "after_nT": one.rms} for day, one in sized]
        above = above_floor(left, floor.level_nT)
        old = EarlierResidual(earlier.version, earlier.message, left, above, by_day)
    report = FieldModelReport(
        comparison=comparison,
        context=days[-1].context or "",
        before=merge_statistics(merged[0]),
        after=merge_statistics(merged[1]),
        floor=floor,
        earlier=old,
        by_day=[
            day_summary(day, merge_statistics(own[0]), merge_statistics(own[1]))
            for day, own in zip(days, sizes, strict=True)
        ],
        fails_where=structures,
        directions=[],
        determined=[str(name) for name, sure in zip(names, known, strict=True) if sure],
        block=block_name,
        lines=[],
        daily_scatter=daily_scatter(daily, day_bounds(days[0].day)[0], day_bounds(days[-1].day)[1]),
        skipped=skipped,
        version=cat.context(str(days[-1].context)).model_version if days[-1].context else 0,
        history=ModelHistory(cat, mission, comparison).items(),
        components=tuple((before.rms, after.rms) for before, after in zip(merged[0], merged[1], strict=True)),
    )
    title = f"{mission.mission}: model against the Earth's field, {days[0].day} to {days[-1].day}"

    def sizes_of_components() -> tuple[list[str], list[Any]]:
        from inflight.figures import html_table

        head = ("component, spacecraft axes", "pre-flight model, nT", "calibrated, nT")
        each = zip(_AXES, report.components, strict=True)
        cells = [(axis, f"{before:.3f}", f"{after:.3f}") for axis, (before, after) in each]
        return [sizes_html(report), html_table(head, cells)], [daily_residual_figure(report)]

    def follows() -> tuple[list[str], list[Any]]:
        from inflight.figures import dependence_figure

        drawn = [(axis, one) for axis, own in found.items() for one in own if one.is_clear]
        drawn.sort(key=lambda pair: -pair[1].amplitude)
        plots = []
        for axis, one in drawn[:9]:
            plots.append(dependence_figure(one))
            plots[-1].title.text = f"{axis}: {plots[-1].title.text}"
        return ["Mean residual of a component in bins of each coordinate, the largest first."], plots

    parts = [
        ("Residual", sizes_of_components),
        ("Where it fails", lambda: (structures_html(report), [])),
        ("What the residual follows", follows),
        ("What each change took off", lambda: history_section(report)),
    ]
    return CompareResult(report, title, parts)


def _usable(product: xr.Dataset, name: str) -> Floats:
    """Return a vector of a product, NaN where its flag makes the sample unusable; (time, axis)."""
    good = (product["flag"].values & np.uint32(UNUSABLE)) == 0
    return np.where(good[:, None], product[name].values, np.nan)


def intervals_of(table: xr.Dataset) -> list[dict[str, Any]]:
    """Return what each interval says of the sensor, as plain fields: see `inflight.calibration.mounting`."""
    out = []
    for at in range(table.sizes["interval"]):
        row = table.isel(interval=at)
        value, sigma = mounting(row["value"].values, row["covariance"].values)
        first, last = (str(to_utc(int(one)))[:10] for one in (row["learnt_start"], row["learnt_end"] - 1))
        parameters = [
            {"name": name, "value": value[name], "sigma": sigma[name], "unit": unit}
            for name, unit in MOUNTING.items()
        ]
        out.append({"first": first, "last": last, "parameters": parameters})
    return out
