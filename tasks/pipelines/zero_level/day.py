"""What the zero level of a day is looked for in, how it is averaged, and the variables of its product."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import scipy

from inflight.arrays import Floats
from inflight.catalog import Day
from inflight.errors import CalibrationError, InflightError, ModelError
from inflight.flags import UNUSABLE, Flag, flag_meanings
from inflight.mission import Mission, ZeroLevelComparison
from inflight.tasks.archive import load_samples
from inflight.tasks.pipelines.base import Batch, product_of
from inflight.tasks.pipelines.zero_level.tables import STATES_TABLE, SUBTRACTED
from inflight.time import DAY, SECOND, Int64, to_utc
from inflight.zero_level import (
    AXES,
    Bools,
    Intervals,
    average_spans,
    classify_intervals,
    compression,
    delivered_rule,
    whole_average,
)

if TYPE_CHECKING:
    import xarray as xr

#: An interval is averaged to about so many means (assumed; a covariance needs 16).
_MEANS_OF_INTERVAL = 30
#: Part of the samples that a mean needs where nothing turns, and where a hole breaks a whole turn.
_COVERAGE, _WHOLE = 0.5, 1.0
#: Flags of samples that no average takes.
_LEFT_OUT = UNUSABLE | Flag.TRANSIENT | Flag.UNKNOWN_STATE


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
    entry = zero_level_of(mission, batch.settings.comparison)
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
        None
        if still
        else scipy.spatial.transform.Rotation.from_quat(mission.instruments[entry.vector].orientation),
    )


def _read_product(batch: Batch, day: Day) -> FieldOfDay:
    """Return the field of another comparison's product; a zero level that it had taken off is put back."""
    product = batch.cat.read(day)
    name = "field_spacecraft" if "outboard" in product else "field_sensor"
    subtracted = np.asarray(product.attrs.get(SUBTRACTED, (0.0, 0.0, 0.0)), dtype=np.float64)
    sigma = np.asarray(product["uncertainty"].values, dtype=np.float64)
    attrs = product.attrs
    entry = zero_level_of(batch.mission, batch.settings.comparison)
    in_sensor = name == "field_sensor"
    turn = scipy.spatial.transform.Rotation.from_quat(batch.mission.instruments[entry.vector].orientation)
    return FieldOfDay(
        np.asarray(product["tt2000"].values, dtype=np.int64),
        np.asarray(product[name].values, dtype=np.float64) + subtracted,
        sigma,
        np.asarray(product["flag"].values, dtype=np.uint32),
        "sensor" if in_sensor else "spacecraft",
        turn if in_sensor else None,
        str(attrs.get(STATES_TABLE) or attrs.get("calibration_table", "")).partition(",")[0],
        str(attrs.get("constant_before", attrs.get("constant", ""))),
    )


def zero_level_of(mission: Mission, comparison: str) -> ZeroLevelComparison:
    """Return what a comparison of this pipeline states."""
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
                f"'{entry.vector}' is delivered in {instrument.averaging / SECOND:g} s means, which are no "
                f"whole turns and samples: such {delivered.summary()}; across the spin axis zero levels are "
                "no better than that part of the offset there; ask for other means, or for all samples"
            )
    count = whole_average(spin, sampling, wanted / SECOND)
    rule = delivered_rule(spin, count * sampling, sampling)
    if not rule.kept and not instrument.averaging >= turn:
        found.append(
            f"no averages of about {wanted / SECOND:g} s are whole turns and samples: {rule.summary()}"
        )
    return Averaging(count * cadence, True, found)


def day_averages(read: FieldOfDay, rule: Averaging, span: tuple[int, int]) -> xr.Dataset:
    """Return the averages of a day's field on a fixed grid, so that the days of a segment have as many.

    Returns
    -------
    Dataset
        `mean` (block, mean_of, axis) nT, NaN where there is none, `mean_time` (block, mean_of), `start`,
        `end` (block) TT2000.

    Raises
    ------
    CalibrationError
        When no sample of the day is usable.
    """
    import xarray as xr

    good = _usable(read)
    if not good.any():
        raise CalibrationError(
            "no sample of the day is usable", remedy="look at the day's flags and deliveries"
        )
    start, end = span
    count = -(-DAY // rule.length)
    time = start + rule.length * np.arange(count, dtype=np.int64) + rule.length // 2
    mean = np.full((count, 3), np.nan)
    coverage = _WHOLE if rule.spins else _COVERAGE
    middle, taken = average_spans(read.tt2000, read.field, rule.length / SECOND, good, coverage)
    place = (middle - start) // rule.length
    inside = (place >= 0) & (place < count) & np.isfinite(taken).all(axis=1)
    mean[place[inside]], time[place[inside]] = taken[inside], middle[inside]
    return xr.Dataset(
        {
            "mean": (("block", "mean_of", "axis"), mean[None], {"units": "nT", "frame": read.frame}),
            "mean_time": (("block", "mean_of"), time[None], {"scale": "TT2000"}),
            "start": ("block", np.array([start])),
            "end": ("block", np.array([end])),
        }
    )


def _usable(read: FieldOfDay) -> Bools:
    """Return which samples averages may take; (time,)."""
    return np.asarray(((read.flag & np.uint32(_LEFT_OUT)) == 0) & np.isfinite(read.field).all(axis=1))


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


def product_variables(read: FieldOfDay, calibrated: Floats, sigma: Floats, flag: np.ndarray) -> xr.Dataset:
    """Return the variables of a product: the field, also in the spacecraft's axes, uncertainty and flags."""
    import xarray as xr

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


def size_variation(
    read: FieldOfDay, entry: ZeroLevelComparison, rule: Averaging, value: Floats
) -> dict[str, Any]:
    """Return the rms variation of the field's size in the day's Alfvenic intervals, before and after, nT.

    Returns
    -------
    dict
        `before_nT`, `after_nT`, and `turning_intervals`, how many there are; both None without any.
    """
    good = _usable(read)
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
