"""The phase of the spin at samples, from what a mission delivers: sun pulses, or an angle."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.catalog import Day
from inflight.errors import CalibrationError, SamplesError
from inflight.flags import Flag
from inflight.instruments import Channel
from inflight.mission import Mission
from inflight.spin.phase import Fault, SpinPhase, phase_from_angle, phase_from_pulses
from inflight.tasks.archive_index import ArchiveIndex
from inflight.tasks.needs import SPIN_PHASE, Need
from inflight.tasks.stand_ins import PARTIAL
from inflight.time import SECOND, Int64

#: Entry of a day's report, of estimates and of products: what was not as it should be of its spin.
FAULTS = "spin_faults"


@dataclass(frozen=True)
class Turned:
    """How a day's samples were turned.

    Attributes
    ----------
    phase : Variable (time,)
        Radians, unwrapped; NaN where nothing tells it. Attributes: `kind`, `told`, `found` and `remedies`
        (lists of sentences about what was not as it should be), `period_s` (0 when not known).
    flag : ndarray of uint32, shape (time,)
        NO_PHASE, PHASE_BRIDGED, PHASE_JUMP.
    """

    phase: xr.Variable
    flag: npt.NDArray[np.uint32]


def spin_phase(
    mission: Mission, comparison: str, need: Need, told: xr.DataArray | None, stamps: Int64
) -> Turned:
    """Return the phase of the spin at stamps, and what was not as it should be.

    A day whose phase nothing tells has none, and says so: its field is still that of turning axes.

    Parameters
    ----------
    need : Need
        Of the channel that tells it.
    told : DataArray or None
        Its day with a margin of its neighbours, as the archive has it; a row whose value is missing is no
        pulse.
    stamps : ndarray of int64
        TT2000.

    Raises
    ------
    SamplesError
        When the mission does not say how fast it spins.
    """
    entry = mission.comparisons[comparison]
    if entry.kind != "spin" or "spin" not in mission.periods:
        raise SamplesError(
            "the mission does not say how fast it spins", remedy="state 'spin' under the mission's periods"
        )
    kind = mission.instruments[need.instrument].channels[need.channel].kind
    common = {"units": "rad", "kind": kind}
    try:
        found = _found(kind, told, stamps, mission.periods["spin"] / SECOND, entry.phase_at_pulse)
    except CalibrationError as error:
        fault = Fault(f"nothing tells the phase of the spin: {error.message}", error.remedy)
        attrs = {**common, "told": fault.found, **_listed([fault]), "period_s": 0.0}
        nothing = np.full(stamps.size, np.nan)
        return Turned(
            xr.Variable("time", nothing, attrs), np.full(stamps.size, Flag.NO_PHASE, dtype=np.uint32)
        )
    attrs = {**common, "told": found.told(), **_listed(found.faults), "period_s": found.period}
    return Turned(xr.Variable("time", found.phase, attrs), found.flag)


def _found(kind: str, told: xr.DataArray | None, stamps: Int64, period: float, at_pulse: float) -> SpinPhase:
    if told is None:
        raise CalibrationError(
            "no day of it in the archive", remedy="ingest the day's file; samples carry the flag no_phase"
        )
    times = np.asarray(told["tt2000"].values, dtype=np.int64)
    values = np.asarray(told.values, dtype=np.float64)
    if kind == "sun_pulse":
        times = times[np.isfinite(values)]
        return phase_from_pulses(times, stamps, nominal_period=period, mark_phase=np.deg2rad(at_pulse))
    return phase_from_angle(times, values, stamps, nominal_period=period)


def _listed(faults: Iterable[Fault]) -> dict[str, list[str]]:
    whole = list(faults)
    return {"found": [one.found for one in whole], "remedies": [one.remedy for one in whole]}


def saturated(readings: npt.NDArray[np.float64], channel: Channel) -> npt.NDArray[np.uint32]:
    """Return the flag SATURATED where a component stands at an end of the range its channel states; (time,).

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
    """Return what was not as it should be of a day's spin: `channel`, `message` and `remedy` of each.

    Parameters
    ----------
    samples : xarray.Dataset
        With `spin_phase` as `spin_phase` makes it, and `flag`.
    needs : iterable of Need
        Of the samples; files of the channels are named.
    index : ArchiveIndex
    """
    by_name = {need.name: need for need in needs}
    told = samples["spin_phase"].attrs
    found = [
        (by_name[SPIN_PHASE], Fault(*both)) for both in zip(told["found"], told["remedies"], strict=True)
    ]
    full = int(np.count_nonzero(samples["flag"].values & np.uint32(Flag.SATURATED)))
    if full:
        remedy = "they carry the flag saturated; turns around them are in no fit"
        fault = Fault(f"{full} readings stand at an end of the sensor's range", remedy)
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
        {
            "day": str(day.day),
            "channel": fault["channel"],
            "cause": PARTIAL,
            "remedy": fault["remedy"],
            "message": fault["message"],
        }
        for day in days
        for fault in day.report.get(FAULTS, ())
    ]
