"""What switches in a dual comparison, with housekeeping and without, and the stretches between."""

from __future__ import annotations

import numpy as np

from inflight.diagnosis.series import Series
from inflight.diagnosis.stretches import Stretches
from inflight.dual.unexplained import Switched, switched
from inflight.mission import Mission
from inflight.tasks.evidence import PassPlan
from inflight.tasks.states_units import housekeeping, is_told_by_states
from inflight.time import SECOND, day_bounds

#: A stretch between unexplained switchings is cut to this, s.
_LONGEST_S = 3 * 3600


def switched_in(mission: Mission, plan: PassPlan, series: Series) -> Switched | None:
    """Return the switchings in the residual of a pass without stretches.

    Parameters
    ----------
    series : Series
        Of that pass; its residual is the difference of both sensors less what the model explains.

    Returns
    -------
    Switched or None
        None of another comparison than one of two sensors that tell of states, or when there are none.
    """
    if not is_told_by_states(mission, plan.model.comparison):
        return None
    residual = series["residual"].reshape(len(series.tt2000), -1)
    there = (series["weight"] > 0) & np.asarray(np.isfinite(residual).all(axis=1))
    names = [name for name in housekeeping(mission) if name in series.channels]
    channels = {}
    for name in names:
        values = series[name].copy()
        if name in series.missing:
            values[series.missing[name]] = np.nan
        channels[name] = values[there]
    row_ns = series.step_s * SECOND
    cadence = {need.name: need.cadence_ns for need in plan.channel_needs}
    reach = {name: int(np.ceil(cadence[name] / row_ns)) + 1 for name in names}
    return switched(series.tt2000[there], residual[there], channels, reach)


def stretches_between(found: Switched, plan: PassPlan) -> Stretches:
    """Return the stretches between switchings that no channel follows, and what belongs to none.

    A channel is late or early by some of its own cadence: around every switching the residual holds what
    the channel does not tell of, in proportion to the field that the calibration rests on. These rows go.
    Offsets wander by hours, which no scatter between blocks tells of: no stretch is longer than some of them.
    """
    half = plan.cadence_ns * plan.series_step // 2
    lost = tuple(zip((found.last + half).tolist(), (found.first - half).tolist(), strict=True))
    step = _LONGEST_S * SECOND
    regular = [at for day in plan.days for at in range(day_bounds(day)[0], day_bounds(day)[1], step)]
    middle = found.last + (found.first - found.last) // 2
    return Stretches(tuple(sorted({*regular, *middle[~found.follows].tolist()})), lost)
