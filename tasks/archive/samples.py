"""Samples of a day: channels read from the archive with a margin of the neighbouring days, and aligned.

`load_samples` makes them; `channel_series` reads one channel. Of a spinning spacecraft the phase of the spin
is added, from sun pulses or from an angle. A flipper (`inflight.zero_level.flipper`) swaps sensors 1 and 3 at
events of kind ``flip`` and ``flip_back``; readings are in the spacecraft's axes throughout, so that a flip
changes the offsets of x and z, and a day is calibrated for the position that holds longest on it.
`substitute_missing` puts typical values in the place of missing channels.
"""

from __future__ import annotations

import itertools
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats, finite_rows
from inflight.catalog import Catalog, Day
from inflight.effects import position_channel
from inflight.errors import CalibrationError, SamplesError
from inflight.flags import Flag
from inflight.frames import GEOMETRY, SLOW_GEOMETRY, add_geometry, itrf_to_spacecraft, position_in_itrf
from inflight.instruments import Channel
from inflight.main_field import MainField
from inflight.mission import Mission
from inflight.model import (
    REFERENCE,
    EffectSubstitution,
    Model,
    SubstitutedSamples,
    TypicalValue,
    folding_of,
    missing_rows,
    substitute,
)
from inflight.samples import (
    FIELD_ROLES,
    ChannelFactor,
    Series,
    align,
    channel_product,
    fold_spins,
    parse_channel,
)
from inflight.spin import PhaseFault, phase_from_angle, phase_from_pulses
from inflight.tasks.archive.inputs import (
    INPUT_SETTINGS,
    RANGE,
    SPIN_AXIS,
    SPIN_PHASE,
    ArchiveIndex,
    Need,
    base_role,
    channels_by_name,
    geometry_channels,
    range_of,
)
from inflight.time import SECOND, Int64, as_day, day_bounds, utc_text
from inflight.units import factor_and_offset, parse_unit

if TYPE_CHECKING:
    import xarray as xr

_Read = TypeVar("_Read")


def channel_series(
    cat: Catalog, need: Need, day: np.datetime64, index: ArchiveIndex, margins: bool = True
) -> Series | None:
    """Return a channel of a day, with margins of its neighbours where asked for; None without the day."""
    today = index.get(need, day)
    if today is None:
        return None
    around = _around(cat, need, day, index) if margins else [(today, None)]
    stamps = _joined_stamps(cat, around)
    values = (
        _smoothed_channel(cat, around, need, stamps) if need.smooth_ns else _joined(cat, around, need.channel)
    )
    flag = _joined(cat, around, "flag") if need.name in FIELD_ROLES else None
    # The mission's lag and cadence hold, not those of the day the files were taken in.
    attrs = {**_read(cat, today, need.channel)[1], "cadence_ns": need.cadence_ns, "lag_ns": need.lag_ns}
    if need.average_ns:
        attrs["average_ns"] = need.average_ns
    series = Series(values, stamps, attrs, flag)
    return _derived(series, need.part) if need.part else series


#: A day of the archive and which of its rows are used; None for all.
_Part = tuple[Day, tuple[int, int] | None]


def _around(cat: Catalog, need: Need, day: np.datetime64, index: ArchiveIndex) -> list[_Part]:
    """Return the days that a day of a series is made from, in order, with their rows."""
    reach, (start, end) = need.margin_ns, day_bounds(day)
    spans = [
        *((-step, start - reach - need.history_ns, start) for step in range(need.days_before, 0, -1)),
        (0, start, end),
        (1, end, end + reach),
    ]
    out: list[_Part] = []
    for step, low, high in spans:
        found = index.get(need, day + step * _DAY)
        if found is None:
            continue
        if step == 0:
            out.append((found, None))
        else:
            first, last = np.searchsorted(_read(cat, found, "tt2000")[0], (low, high))
            out.append((found, (int(first), int(last))))
    return out


def _joined(cat: Catalog, parts: Sequence[_Part], name: str) -> npt.NDArray[Any]:
    """Return a variable of the parts, one after the other, as an array of its own."""
    pieces = [(_read(cat, day, name)[0], rows) for day, rows in parts]
    return np.concatenate([values if rows is None else values[slice(*rows)] for values, rows in pieces])


def _joined_stamps(cat: Catalog, parts: Sequence[_Part]) -> Int64:
    """Return the stamps of the parts; inside `cached_readings` channels of one instrument get one array."""
    key = ("tt2000", *((day.segment, day.rows, rows) for day, rows in parts))
    return _CACHE.get(key, lambda: _joined(cat, parts, "tt2000"))


def _smoothed_channel(cat: Catalog, parts: Sequence[_Part], need: Need, stamps: Int64) -> Floats:
    """Return a channel of the parts, averaged as the mission says, as an array of its own.

    Inside `cached_readings` it is averaged once for the model's samples and for the channels of a search.
    """
    key = (need.channel, need.smooth_ns, *((day.segment, day.rows, rows) for day, rows in parts))
    made = _CACHE.get(key, lambda: _smoothed(_joined(cat, parts, need.channel), stamps, need.smooth_ns))
    return np.array(made)


def _smoothed(values: Floats, stamps: Int64, over_ns: int) -> Floats:
    """Return means of the readings within half of `over_ns` on either side; NaN stays where it is.

    Both sides reach equally far, so that at a gap or an end nothing is shifted in time.
    """
    from inflight.samples import running_means  # compiled: who only plans does not wait for it

    out = np.array(values, dtype=np.float64).reshape(len(values), -1)
    known = finite_rows(out)
    if known.all():
        out = running_means(stamps, out, over_ns // 2)
    else:
        out[known] = running_means(stamps[known], out[known], over_ns // 2)
    return out.reshape(np.shape(values))


def _derived(series: Series, part: ChannelFactor) -> Series:
    """Return a slow response or a play of a channel, or of geometry from positions, at its own stamps."""
    stamps, attrs = series.stamps, dict(series.attrs)
    values = np.asarray(series.values, dtype=np.float64)
    if part.channel in GEOMETRY and attrs.get("kind") == "position":
        if part.channel not in SLOW_GEOMETRY:
            raise SamplesError(
                f"'{part.channel}' has no slow response here",
                channel=part.name,
                remedy="of what the orbit tells, only 'sunlit' and 'latitude' may carry a lag or a width",
            )
        import xarray as xr

        orbit = xr.Dataset({"position": (("time", "axis"), values, attrs), "tt2000": ("time", stamps)})
        values = np.asarray(add_geometry(orbit)[part.channel].values, dtype=np.float64)
        attrs = {name: attrs[name] for name in ("cadence_ns", "lag_ns")} | {"units": GEOMETRY[part.channel]}
    return replace(series, values=part.of(values, np.diff(stamps) / SECOND), attrs=attrs)


class _ReadingCache(threading.local):
    """What a thread read last, by segment, rows and name; nothing outside `cached_readings`."""

    found: OrderedDict[tuple[Any, ...], Any] | None = None

    def get(self, key: tuple[Any, ...], make: Callable[[], _Read]) -> _Read:
        """Return what is kept under a key; made, and kept, where it is not there."""
        if self.found is None:
            return make()
        if key in self.found:
            self.found.move_to_end(key)
        else:
            self.found[key] = make()
            while len(self.found) > 1 and self._is_too_much():
                self.found.popitem(last=False)
        return cast("_Read", self.found[key])

    def _is_too_much(self) -> bool:
        kept = [one[0] if isinstance(one, tuple) else one for one in (self.found or {}).values()]
        most = INPUT_SETTINGS.cached_bytes
        return len(kept) > INPUT_SETTINGS.cached_arrays or sum(array.nbytes for array in kept) > most


_CACHE = _ReadingCache()


@contextmanager
def cached_readings() -> Iterator[None]:
    """Keep the channels read last in memory: a batch reads the margins of a day again with its neighbours."""
    before, _CACHE.found = _CACHE.found, OrderedDict()
    try:
        yield
    finally:
        _CACHE.found = before


def own_readings(
    cat: Catalog, index: ArchiveIndex, need: Need, day: np.datetime64
) -> np.ndarray[Any, Any] | None:
    """Return a channel's readings of a day as they were archived; None without an archived day."""
    today = index.get(need, day)
    return None if today is None else _read(cat, today, need.channel)[0]


def _read(cat: Catalog, day: Day, name: str) -> tuple[npt.NDArray[Any], dict[str, Any]]:
    """Return values and attributes of a variable of a day; they may be kept, and are not to be changed."""
    return _CACHE.get((day.segment, day.rows, name), lambda: cat.read_variable(day, name))


#: Before and after every stamp, and too far for a difference of two to overflow.
_NEVER = -(2**61), 2**61

_FLIP_KINDS = ("flip", "flip_back")

_DAY = np.timedelta64(1, "D")


def flips_of(mission: Mission) -> list[tuple[int, bool]]:
    """Return the flips in order of time: TT2000, and whether the sensors lie flipped from then on."""
    return sorted((event.at, event.kind == "flip") for event in mission.events if event.kind in _FLIP_KINDS)


def longest_position(mission: Mission, day: np.datetime64) -> tuple[int, int]:
    """Return the half-open TT2000 span of a day's position: that which holds longest."""
    start, end = day_bounds(day)
    edges = [start, *(at for at, _ in flips_of(mission) if start < at < end), end]
    return max(itertools.pairwise(edges), key=lambda span: span[1] - span[0])


def flip_flags(mission: Mission, day: np.datetime64, stamps: Int64) -> np.ndarray:
    """Return ``FLIPPED`` for the samples of a day that its calibration is not for; (time,) uint32."""
    low, high = longest_position(mission, day)
    outside = (stamps < low) | (stamps >= high)
    return np.where(outside, np.uint32(Flag.FLIPPED), np.uint32(0))


def exclusion_flags(mission: Mission, comparison: str, stamps: Int64) -> np.ndarray:
    """Return ``EXCLUDED`` for the samples that no fit of a comparison takes; (time,) uint32."""
    out = np.zeros(stamps.shape, dtype=np.uint32)
    instruments = set(mission.comparisons[comparison].instruments().values())
    for one in mission.exclusions:
        if one.instrument in instruments:
            out[(one.start <= stamps) & (stamps < one.end)] = np.uint32(Flag.EXCLUDED)
    return out


def in_own_range(
    mission: Mission, comparison: str, need: Need, telling: Series | None, vector: Series
) -> Series:
    """Return a vector instrument's readings without those of other ranges than that of a comparison.

    A reading is in the range when those of the channel before and after it are; farther than one and a half
    cadences from any the range is not known. The others are NaN and flagged ``OTHER_RANGE``, so that no mean
    or interpolation mixes ranges.

    Parameters
    ----------
    telling : Series or None
        The channel that tells the range.

    Raises
    ------
    SamplesError
        When the channel's day is not in the archive.
    """
    entry = mission.comparisons[comparison]
    if telling is None or entry.kind != "scalar" or entry.range is None:
        raise SamplesError(
            "nothing tells the measuring range",
            channel=f"{need.instrument}.{need.channel}",
            remedy="ingest the day's files",
        )
    told = np.asarray(telling.values, dtype=np.float64)
    known = np.isfinite(told)
    # One more at both ends that is too far away to count.
    at = np.concatenate([[_NEVER[0]], telling.stamps[known] + need.lag_ns, [_NEVER[1]]])
    inside = np.concatenate([[False], np.isin(told[known], entry.range.value), [False]])
    before, after = (np.searchsorted(at, vector.stamps, side=side) for side in ("right", "left"))
    reach = 3 * need.cadence_ns // 2
    near = vector.stamps - at[before - 1] <= reach, at[after] - vector.stamps <= reach
    wrong = near[0] & ~inside[before - 1] | near[1] & ~inside[after]
    other = wrong | ~(near[0] | near[1])
    values = np.array(vector.values, dtype=np.float64)
    marked = np.where(other & finite_rows(values), np.uint32(Flag.OTHER_RANGE), np.uint32(0))
    values[other] = np.nan
    return replace(vector, values=values, flag=marked if vector.flag is None else vector.flag | marked)


def position_edges(mission: Mission) -> list[np.datetime64]:
    """Return the first days of each position after the first one."""
    edges = []
    for at, _ in flips_of(mission):
        day = as_day(utc_text(at)[:10])
        edges.append(day if longest_position(mission, day)[0] >= at else day + _DAY)
    return sorted(set(edges))


def split_at_flips(edges: Sequence[np.datetime64], mission: Mission) -> list[np.datetime64]:
    """Return edges of windows with those of the positions among them: no window holds two."""
    inside = [day for day in position_edges(mission) if edges[0] < day < edges[-1]]
    return sorted({*edges, *inside})


#: Cause of a day that is there, though not all of it was measured.
PARTIAL = "partial"

_REMEDY = "ingest the missing housekeeping; until then the samples carry the flag channel_missing"


def substitute_missing(
    cat: Catalog,
    mission: Mission,
    model: Model,
    needs: Iterable[Need],
    index: ArchiveIndex,
    day: np.datetime64,
    samples: xr.Dataset,
) -> SubstitutedSamples | None:
    """Return a day's samples with typical values where channels of the model are missing; None if none is.

    Parameters
    ----------
    needs : iterable of Need
        Of the model; those that are `replaceable` have typical values.
    index : ArchiveIndex
        The days around, and those that `ArchiveIndex.typical_days` names.
    samples : xarray.Dataset
        The day's, as `inflight.tasks.archive.samples.load_samples` returns them.
    """
    missing = missing_rows(model, samples)
    if not missing:
        return None
    lost, ranges = [need for need in needs if need.name in missing], {}
    for need in lost:
        channel = mission.instruments[need.instrument].channels[need.channel]
        if need.part is None and not channel.axis_names and channel.range is not None:
            ranges[need.name] = channel.range
    typical = typical_values(cat, [need for need in lost if need.replaceable], index, day)
    return substitute(model, samples, typical, ranges, missing)


def typical_values(
    cat: Catalog, needs: Iterable[Need], index: ArchiveIndex, day: np.datetime64
) -> dict[str, TypicalValue]:
    """Return what channels usually read, by name: those of one instrument from the same days together.

    A channel of which no day of the archive has enough values is left out.
    """
    groups: dict[tuple[str, tuple[np.datetime64, ...]], list[Need]] = {}
    for need in needs:
        days = tuple(source.day for source in index.typical_days(need, day))
        if days:
            groups.setdefault((need.dataset, days), []).append(need)
    found: dict[str, TypicalValue] = {}
    for (dataset, days), group in groups.items():
        parts: list[_Part] = [(index.days[dataset, source], None) for source in days]
        values = {need.name: np.asarray(_joined(cat, parts, need.channel), np.float64) for need in group}
        source = "the day" if days == (day,) else " and ".join(map(str, days))
        found |= TypicalValue.of(values, _joined(cat, parts, "tt2000"), source)
    return found


def substitution_report(treated: Mapping[str, EffectSubstitution], scalar_nT: float) -> dict[str, Any]:
    """Return the entries of a day's report about typical values: by effect, and as the day's message.

    Parameters
    ----------
    scalar_nT : float
        By how much they make the scalar field uncertain, rms over the samples treated.
    """
    by_effect = {
        name: {"samples": one.samples, "channels": list(one.channels), "instead": one.instead}
        for name, one in treated.items()
    }
    sentence = "; ".join(f"{name}: {one}" for name, one in treated.items())
    return {"stand_ins": by_effect, "stand_ins_scalar_nT": scalar_nT, PARTIAL: sentence}


def substitution_problems(days: Iterable[Day]) -> list[dict[str, str]]:
    """Return the entries of a run's problems for days whose products have typical values.

    Parameters
    ----------
    days : iterable of Day
        Products, as the catalog has them.
    """
    out = []
    for day in days:
        if effects := day.report.get("stand_ins"):
            channels = sorted({name for effect in effects.values() for name in effect["channels"]})
            out.append(partial_problem(day.day, str(day.report[PARTIAL]), _REMEDY, ", ".join(channels)))
    return out


def partial_problem(day: np.datetime64, message: str, remedy: str, channel: str = "") -> dict[str, str]:
    """Return an entry of a run's problems for a day that is there, though not all of it was measured."""
    return {"day": str(day), "channel": channel, "cause": PARTIAL, "remedy": remedy, "message": message}


#: Entry of a day's report, of estimates and of products: the faults of its spin phase and sensor.
SPIN_FAULTS = "spin_faults"


@dataclass(frozen=True)
class PhaseOfDay:
    """The spin phase of a day's samples.

    Attributes
    ----------
    phase : Variable (time,)
        Radians, unwrapped; NaN where it is not known. Attributes: `kind`, `told` (a summary), `found` and
        `remedies` (the faults, lists of sentences), `period_s` (0 when not known).
    flag : ndarray of uint32, shape (time,)
        NO_PHASE, PHASE_BRIDGED, PHASE_JUMP.
    """

    phase: xr.Variable
    flag: npt.NDArray[np.uint32]


def spin_phase(
    mission: Mission, comparison: str, need: Need, series: Series | None, stamps: Int64
) -> PhaseOfDay:
    """Return the phase of the spin at stamps, and its faults.

    A day without a known phase has NaN and a fault that states it: its field stays in turning axes.

    Parameters
    ----------
    need : Need
        Of the channel it is taken from.
    series : Series or None
        Its day with a margin of its neighbours, as the archive has it; a row whose value is missing is no
        pulse.
    stamps : ndarray of int64
        TT2000.

    Raises
    ------
    SamplesError
        When the mission does not say how fast it spins.
    """
    import xarray as xr

    entry = mission.comparisons[comparison]
    if entry.kind != "spin" or "spin" not in mission.periods:
        raise SamplesError(
            "the mission does not say how fast it spins", remedy="state 'spin' under the mission's periods"
        )
    kind = mission.instruments[need.instrument].channels[need.channel].kind
    nominal = mission.periods["spin"] / SECOND
    try:
        if series is None:
            raise CalibrationError(
                "no day of it in the archive", remedy="ingest the day's file; samples carry the flag no_phase"
            )
        times = series.stamps
        values = np.asarray(series.values, dtype=np.float64)
        if kind == "sun_pulse":
            mark, times = np.deg2rad(entry.phase_at_pulse), times[np.isfinite(values)]
            found = phase_from_pulses(times, stamps, nominal_period=nominal, mark_phase=mark)
        else:
            found = phase_from_angle(times, values, stamps, nominal_period=nominal)
        phase, flag, faults = found.phase, found.flag, list(found.faults)
        period, summary = found.period, found.summary()
    except CalibrationError as error:
        summary = f"nothing tells the phase of the spin: {error.message}"
        phase, flag = np.full(stamps.size, np.nan), np.full(stamps.size, Flag.NO_PHASE, dtype=np.uint32)
        period, faults = 0.0, [PhaseFault(summary, error.remedy)]
    attrs = {
        "units": "rad",
        "kind": kind,
        "told": summary,
        "found": [fault.found for fault in faults],
        "remedies": [fault.remedy for fault in faults],
        "period_s": period,
    }
    return PhaseOfDay(xr.Variable("time", phase, attrs), flag)


def saturation_flags(readings: npt.NDArray[np.float64], channel: Channel) -> npt.NDArray[np.uint32]:
    """Return the flag SATURATED where a component lies at an end of its channel's range; (time,).

    Parameters
    ----------
    readings : ndarray, shape (time, axis)
        As delivered, in the channel's unit: what lies beyond the range is missing already.
    channel : Channel
    """
    if channel.range is None:
        return np.zeros(len(readings), dtype=np.uint32)
    low, high = channel.range
    half = 0.5 * (channel.resolution or 0.0)
    with np.errstate(invalid="ignore"):
        at_end = ((readings <= low + half) | (readings >= high - half)).any(axis=1)
    return np.where(at_end, np.uint32(Flag.SATURATED), np.uint32(0)).astype(np.uint32)


def day_faults(
    samples: xr.Dataset, needs: Iterable[Need], index: ArchiveIndex, day: np.datetime64
) -> list[dict[str, str]]:
    """Return the faults of a day's spin phase and sensor: `channel`, `message` and `remedy` of each.

    Parameters
    ----------
    samples : xarray.Dataset
        With `spin_phase` as `spin_phase` makes it, and `flag`.
    needs : iterable of Need
        Of the samples; files of the channels are named.
    index : ArchiveIndex
    """
    by_name = {need.name: need for need in needs}
    attributes = samples["spin_phase"].attrs
    found = [
        (by_name[SPIN_PHASE], PhaseFault(*both))
        for both in zip(attributes["found"], attributes["remedies"], strict=True)
    ]
    full = int(np.count_nonzero(samples["flag"].values & np.uint32(Flag.SATURATED)))
    if full:
        remedy = "they carry the flag saturated; turns around them are in no fit"
        fault = PhaseFault(f"{full} readings stand at an end of the sensor's range", remedy)
        found.append((by_name["vector"], fault))
    out = []
    for need, fault in found:
        source = index.get(need, day)
        files = ", ".join(source.report.get("files", ())) if source is not None else ""
        message = f"{files}: {fault.found}" if files else fault.found
        out.append(
            {"channel": f"{need.instrument}.{need.channel}", "message": message, "remedy": fault.remedy}
        )
    return out


def spin_problems(days: Iterable[Day]) -> list[dict[str, str]]:
    """Return the entries of a run's problems for days of a turning sensor that are there, with faults.

    Parameters
    ----------
    days : iterable of Day
        Estimates and products, as the catalog has them.
    """
    return [
        partial_problem(day.day, fault["message"], fault["remedy"], fault["channel"])
        for day in days
        for fault in day.report.get(SPIN_FAULTS, ())
    ]


def load_samples(
    cat: Catalog,
    mission: Mission,
    model: Model,
    day: np.datetime64,
    needs: list[Need],
    index: ArchiveIndex,
    geometry: bool = True,
    folded: bool = True,
    surroundings: bool = False,
) -> xr.Dataset:
    """Read one day from the archive and align it.

    Parameters
    ----------
    needs : list of Need
        As `needs_of` returns them.
    index : ArchiveIndex
        The days around.
    geometry : bool
        False leaves out what `add_geometry` makes unless a need or the model asks for it.
    folded : bool
        False leaves a spin comparison's samples as they were measured.
    surroundings : bool
        Samples reach as far into the neighbouring days as the needs say (`Need.around_ns`); `within_day`
        tells which are the day's own.

    Returns
    -------
    xarray.Dataset
        Samples of `inflight.align`, cut to the UTC day; attitude and position under these names,
        derived channels under theirs, and what `inflight.frames.add_geometry` makes of them. Those of
        a spin comparison have `spin_phase`, and are folded (`inflight.samples.spin_folding.fold_spins`).

    Raises
    ------
    SamplesError
        When a field's day is not in the archive.
    """
    if not surroundings:
        needs = [replace(need, around_ns=0) for need in needs]
    base = next(need for need in needs if need.name == base_role(mission, model.comparison))
    needs = [need for need in needs if need.name not in (SPIN_AXIS, RANGE)]
    clock = next((need for need in needs if need.name == SPIN_PHASE), None)
    present = _present(cat, [need for need in needs if need is not clock], base, day, index)
    present |= _own_range(cat, mission, model.comparison, present, day, index)
    stamps = present[base.name].stamps
    start, end = day_bounds(day)
    samples = align(present, stamps[(stamps >= start - base.around_ns) & (stamps < end + base.around_ns)])
    samples["flag"] = samples["flag"] | exclusion_flags(mission, model.comparison, samples["tt2000"].values)
    if clock is not None:
        series = channel_series(cat, clock, day, index)
        found = spin_phase(mission, model.comparison, clock, series, samples["tt2000"].values)
        samples[SPIN_PHASE] = found.phase
        channel = mission.instruments[base.instrument].channels[base.channel]
        flag = samples["flag"] | found.flag | saturation_flags(samples[base.name].values, channel)
        samples["flag"] = flag | flip_flags(mission, day, samples["tt2000"].values)
    for need in needs:
        if need.name not in samples:
            samples[need.name] = _absent(mission, need, samples.sizes["time"])
    samples = _name_geometry(mission, samples)
    entry = mission.comparisons[model.comparison]
    if entry.kind == "field_model":
        samples[REFERENCE] = _model_field(cat, mission, entry.model, present, samples)
    for role, name in mission.comparisons[model.comparison].instruments().items():
        if role in samples and samples[role].ndim == 2:
            samples[role].attrs["orientation"] = tuple(mission.instruments[name].orientation)
    geometry_names = set(GEOMETRY)
    if not geometry:
        # Only what the effects of the model and products of channels are made from.
        names = {channel for entry in model.effects for channel in entry.effect.channels}
        names |= {name for need in needs for name in need.products}
        geometry_names &= {factor for name in names for factor in name.split("*")}
    if geometry_names:
        samples = add_geometry(samples, geometry_names)
    samples = _with_products(samples, needs)
    folding = folding_of(mission, model.comparison) if folded else None
    return samples if folding is None else fold_spins(samples, folding, (start, end))


def within_day(stamps: Int64, day: np.datetime64) -> slice:
    """Return which of rising stamps (TT2000) lie within a UTC day."""
    first, last = np.searchsorted(stamps, day_bounds(day))
    return slice(int(first), int(last))


def _present(
    cat: Catalog, needs: Sequence[Need], base: Need, day: np.datetime64, index: ArchiveIndex
) -> dict[str, Series]:
    """Return the series of what is needed and there; refused where a field is not."""
    channels = {
        need.name: channel_series(cat, need, day, index, not index.shares_stamps(need, base, day))
        for need in needs
    }
    missing = [need for need in needs if need.name in FIELD_ROLES and channels[need.name] is None]
    if missing:
        raise SamplesError(
            f"no measurements of '{missing[0].instrument}'", day=str(day), remedy="ingest the day's files"
        )
    return {name: series for name, series in channels.items() if series is not None}


def _own_range(
    cat: Catalog,
    mission: Mission,
    comparison: str,
    present: Mapping[str, Series],
    day: np.datetime64,
    index: ArchiveIndex,
) -> dict[str, Series]:
    """Return the vector readings of the range of a comparison; nothing when it states none."""
    own = {}
    for need in range_of(mission, comparison):
        telling = channel_series(cat, need, day, index)
        own["vector"] = in_own_range(mission, comparison, need, telling, present["vector"])
    return own


def _model_field(
    cat: Catalog, mission: Mission, name: str, present: Mapping[str, Series], samples: xr.Dataset
) -> xr.Variable:
    """Return a model's field at the samples, nT, spacecraft axes; NaN without a position or an attitude.

    It is summed where the orbit has positions: between these a straight line would leave the orbit by
    kilometres.
    """
    import xarray as xr

    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    field = np.full((stamps.size, 3), np.nan)
    channel = position_channel(mission)
    series = present.get(channel)
    if series is not None and "attitude" in samples and "position" in samples:
        attributes = samples["position"].attrs
        kilometres = factor_and_offset(str(attributes["units"]), "km")[0]
        frame = str(attributes["frame"])
        own = series.stamps + int(series.attrs.get("lag_ns", 0))
        places = position_in_itrf(np.asarray(series.values, dtype=np.float64) * kilometres, frame, own)
        field = MainField.of(name, Path(cat.workspace)).along_orbit(places, own, stamps)
        here = position_in_itrf(np.asarray(samples["position"].values, dtype=np.float64), frame, stamps)
        attitude = np.asarray(samples["attitude"].values, dtype=np.float64)
        towards = str(samples["attitude"].attrs.get("frame", ""))
        field = itrf_to_spacecraft(field, attitude, towards, here, stamps)
    return xr.Variable(("time", "axis"), field, {"units": "nT", "frame": "spacecraft"})


def _with_products(samples: xr.Dataset, needs: Sequence[Need]) -> xr.Dataset:
    """Add the products of channels; a factor that is missing makes a product of nothing but gaps."""
    import xarray as xr

    for name in sorted({name for need in needs for name in need.products}):
        factors = [samples[part.name] for part in parse_channel(name).parts]
        values = channel_product([np.asarray(factor.values, dtype=np.float64) for factor in factors])
        dims = next((factor.dims for factor in factors if factor.ndim == values.ndim), ("time",))
        unit = parse_unit("1")
        for factor in factors:
            unit = unit * parse_unit(str(factor.attrs.get("units", "1")))
        samples[name] = xr.Variable(dims, values, {"units": str(unit), "kind": "other"})
    return samples


def _absent(mission: Mission, need: Need, count: int) -> xr.DataArray:
    """Return a channel of nothing but gaps, so that the samples show what is missing."""
    import xarray as xr

    channel = mission.instruments[need.instrument].channels[need.channel]
    from_geometry = need.part is not None and need.part.channel in GEOMETRY
    width = 0 if from_geometry else len(channel.axis_names)
    shape = (count, width) if width else (count,)
    dims = ("time", "axis" if width == 3 else f"{need.name}_component")[: len(shape)]
    attrs = {"units": channel.unit, "kind": channel.kind} | (
        {"frame": channel.frame} if channel.frame else {}
    )
    return xr.DataArray(np.full(shape, np.nan), dims=dims, attrs=attrs)


def _name_geometry(mission: Mission, samples: xr.Dataset) -> xr.Dataset:
    """Call the attitude and the position by their kinds, whatever the mission names them."""
    first = {"position": position_channel(mission)}
    for name in geometry_channels(mission):
        instrument, channel = channels_by_name(mission)[name]
        kind = mission.instruments[instrument].channels[channel].kind
        if name in samples:
            first[kind] = first.get(kind) or name
    return samples.rename(
        {
            name: kind
            for kind, name in first.items()
            if name in samples and name != kind and kind not in samples
        }
    )
