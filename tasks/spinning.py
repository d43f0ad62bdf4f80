"""The phase of the spin at samples, from what a mission delivers: sun pulses, or an angle."""

from __future__ import annotations

import numpy as np
import xarray as xr

from inflight.errors import SamplesError
from inflight.mission import Mission
from inflight.spin.phase import phase_from_angle, phase_from_pulses
from inflight.tasks.needs import Need
from inflight.time import SECOND, Int64


def spin_phase(
    mission: Mission, comparison: str, need: Need, told: xr.DataArray | None, stamps: Int64, day: str
) -> xr.Variable:
    """Return the phase of the spin at stamps.

    Parameters
    ----------
    need : Need
        Of the channel that tells it.
    told : DataArray or None
        Its day with a margin of its neighbours, as the archive has it.
    stamps : ndarray of int64
        TT2000.
    day : str
        For errors.

    Returns
    -------
    Variable (time,)
        Radians, unwrapped; NaN where nothing tells it.

    Raises
    ------
    SamplesError
        When the day has no phase.
    """
    if told is None or told.sizes["time"] < 2:
        raise SamplesError(
            "nothing tells the phase of the spin",
            channel=f"{need.instrument}.{need.channel}",
            day=day,
            remedy="ingest the day's sun pulses, or exclude the day",
        )
    entry = mission.comparisons[comparison]
    if entry.kind != "spin" or "spin" not in mission.periods:
        raise SamplesError(
            "the mission does not say how fast it spins", remedy="state 'spin' under the mission's periods"
        )
    kind = mission.instruments[need.instrument].channels[need.channel].kind
    times = np.asarray(told["tt2000"].values, dtype=np.int64)
    period = mission.periods["spin"] / SECOND
    if kind == "sun_pulse":
        found = phase_from_pulses(
            times, stamps, nominal_period=period, mark_phase=np.deg2rad(entry.phase_at_pulse)
        )
    else:
        found = phase_from_angle(
            times, np.asarray(told.values, dtype=np.float64), stamps, nominal_period=period
        )
    return xr.Variable("time", found.phase, {"units": "rad", "kind": kind, "told": found.told()})
