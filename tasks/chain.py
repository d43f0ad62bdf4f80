"""A day of the whole chain: its own fit, its wide equations, and what only fast samples can witness.

One look at a day's samples makes all that later steps are computed from: normal equations of everything
the model lets data move, the equations of the torquers' band, epochs of currents that step, and means of
channels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import BlockFit
from inflight.catalog import Catalog
from inflight.chain import empty_equations, wide_and_beside, with_nine
from inflight.chain.beside import Beside
from inflight.comparison import Rows, rows_of
from inflight.errors import SamplesError
from inflight.estimators.contrasts import in_amperes
from inflight.estimators.current_steps import find_steps
from inflight.estimators.epochs import epochs_of
from inflight.estimators.torquer_band import band_equations
from inflight.geometry import direction_of, geometry_at
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.calibrate import Job, Outcome, fit_day, make_days
from inflight.tasks.chain_parts import alike, pack_parts
from inflight.tasks.channel_series import own_readings
from inflight.tasks.needs import channel_homes, position_channel
from inflight.time import Int64, day_bounds, usual_step

#: Bumped by hand when the numbers of the chain's days change.
CHAIN_VERSION = 3
#: Kinds of channels whose currents may step.
CURRENTS = ("solar_current", "battery_current", "camera_current", "heater", "current")


@dataclass(frozen=True)
class Witnesses:
    """Channels the chain looks at beside the model's own.

    Attributes
    ----------
    currents : tuple of str
        Scalar currents, the one of the solar array first where there is one.
    torquer : str
        Three torquer currents; empty when the mission has none.
    temperatures : tuple of str
        Of the comparison's vector sensor.
    orbit : bool
        Whether there are positions.
    """

    currents: tuple[str, ...]
    torquer: str
    temperatures: tuple[str, ...] = ()
    orbit: bool = False

    @classmethod
    def of(cls, mission: Mission, comparison: str) -> Witnesses:
        """Return those of a mission's comparison, by the kinds of its channels."""
        homes = channel_homes(mission)
        kinds = {
            name: mission.instruments[instrument].channels[channel]
            for name, (instrument, channel) in homes.items()
        }
        currents = [
            name
            for kind in CURRENTS
            for name, one in kinds.items()
            if one.kind == kind and not one.axis_names
        ]
        torquers = [name for name, one in kinds.items() if one.kind == "torquer_current"]
        own = mission.comparisons[comparison].instruments().get("vector", "")
        warm = [
            name
            for name, one in kinds.items()
            if one.kind == "temperature" and homes[name][0] == own and not one.axis_names
        ]
        orbit = bool(position_channel(mission))
        return cls(tuple(currents), torquers[0] if torquers else "", tuple(warm), orbit)

    @property
    def names(self) -> tuple[str, ...]:
        """All of them."""
        return (*self.driven, *self.temperatures)

    @property
    def driven(self) -> tuple[str, ...]:
        """All currents."""
        return (*self.currents, *((self.torquer,) if self.torquer else ()))

    @property
    def beside(self) -> Beside:
        """What is looked at beside the model."""
        return Beside(self.temperatures, self.orbit)


def chain_batch(
    cat: Catalog, mission: Mission, model: Model, job: Job, witnesses: Witnesses, min_coverage: float
) -> Outcome:
    """Make the chain's days of a batch and write them as one segment; parameters as `calibrate_batch`."""
    return make_days(
        cat, job, lambda day: chain_day(cat, mission, model, day, job, witnesses, min_coverage), alike
    )


def chain_day(
    cat: Catalog,
    mission: Mission,
    model: Model,
    day: np.datetime64,
    job: Job,
    witnesses: Witnesses,
    min_coverage: float,
) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return all that one day says, and a report of its own fit.

    Raises
    ------
    CalibrationError
        As `inflight.tasks.calibrate.calibrate_day`.
    """
    fitted = fit_day(cat, mission, model, day, job, None, min_coverage)
    span = day_bounds(day)
    attributes = {
        "comparison": model.comparison,
        "model": model.sha,
        "cadence_ns": fitted.step,
        "filter": "raw",
    }
    means = _means(
        _currents(fitted.samples, witnesses.driven) | _temperatures(cat, job, day, witnesses.temperatures)
    )
    if not fitted.fit.used:
        # Fields without the channels the model needs: the day tells nothing, and gets a product all the same.
        empty = empty_equations(model, span, attributes).assign(_own_fit(fitted.fit))
        return pack_parts(empty, {"channel": means}), fitted.report
    own = with_nine(model, fitted.fit.value)
    rows = rows_of(own, fitted.samples)
    wide, strip = wide_and_beside(own, fitted.samples, rows, span, attributes, beside=witnesses.beside)
    residual = np.where(rows.good, rows.residual[:, 0], np.nan)
    parts = {
        "band": _band(fitted.samples, residual, rows, witnesses),
        "epoch": _epochs(fitted.samples, residual, rows, witnesses),
        "channel": means,
        "beside": strip,
    }
    return pack_parts(wide.assign(_own_fit(fitted.fit)), parts), fitted.report


def _own_fit(fit: BlockFit) -> dict[str, Any]:
    """Return the day's own nine parameters with their covariance, and what they leave."""
    return {
        "fit": (("block", "nine"), fit.value[None]),
        "fit_covariance": (("block", "nine", "other_nine"), fit.covariance[None]),
        "before": ("block", np.array([fit.before])),
        "after": ("block", np.array([fit.after])),
        "used": ("block", np.array([fit.used], dtype=np.int64)),
    }


def _band(samples: xr.Dataset, residual: Floats, rows: Rows, witnesses: Witnesses) -> xr.Dataset | None:
    """Return the equations of the torquers' band; None without torquers or a stretch long enough."""
    if not witnesses.torquer or witnesses.torquer not in samples:
        return None
    current, _ = in_amperes(samples[witnesses.torquer])
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    try:
        return band_equations(stamps, residual, direction_of(rows.field), current)
    except SamplesError:
        return None


def _epochs(samples: xr.Dataset, residual: Floats, rows: Rows, witnesses: Witnesses) -> xr.Dataset | None:
    """Return the epochs at which the first current steps; None when it never does."""
    there = [name for name in witnesses.currents if name in samples]
    if not there:
        return None
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    channel = samples[there[0]]
    own = _own_readings(stamps, channel)
    try:
        values = np.asarray(channel.values, dtype=np.float64)[own]
        steps = find_steps(stamps[own], values, unit=str(channel.attrs["units"]))
        known = {name: samples[name].variable for name in ("tt2000", "weight", *there) if name in samples}
        known["field"] = xr.Variable(("time", "axis"), rows.field, {"units": "nT"})
        known |= _where(samples, np.searchsorted(stamps, steps.time))
        found = epochs_of(xr.Dataset(known), residual, steps, channel=there[0], others=there[1:])
    except SamplesError:
        return None
    return found if found.sizes["epoch"] else None


def _where(samples: xr.Dataset, rows: Int64) -> dict[str, xr.Variable]:
    """Return places of the orbit at some samples, NaN at all others."""
    count = samples.sizes["time"]
    rows = np.unique(np.minimum(rows, count - 1))
    out = {}
    for name, told in (geometry_at(samples, rows) if rows.size else {}).items():
        whole = np.full((count, *told.shape[1:]), np.nan)
        whole[rows] = told.values
        out[name] = xr.Variable(told.dims, whole, told.attrs)
    return out


def _own_readings(stamps: Int64, channel: xr.DataArray) -> npt.NDArray[np.bool_]:
    """Return which samples are a channel's own readings, where it is slower than the samples; (time,).

    What alignment put between two readings knows nothing of steps, and has none of their noise.
    """
    cadence = int(channel.attrs.get("cadence_ns", 0))
    usual = usual_step(stamps, cadence)
    if cadence <= usual:
        return np.ones(stamps.size, dtype=bool)
    number = (stamps - stamps[0] + usual // 2) // cadence
    return np.asarray(np.concatenate([[True], np.diff(number) > 0]))


def _currents(samples: xr.Dataset, names: Sequence[str]) -> dict[str, Floats]:
    """Return currents at the samples, component by component; A."""
    out = {}
    for name in (one for one in names if one in samples):
        values, _ = in_amperes(samples[name])
        for index, column in enumerate(values.reshape(len(values), -1).T):
            out[name if values.ndim == 1 else f"{name}[{'xyz'[index] if index < 3 else index}]"] = column
    return out


def _temperatures(cat: Catalog, job: Job, day: np.datetime64, names: Sequence[str]) -> dict[str, Floats]:
    """Return a day's own readings of temperatures, each at its own cadence; empty ones of what is missing."""
    out = {}
    for need in job.needs:
        if need.name in names and need.part is None:
            found = own_readings(cat, job.index, need, day)
            out[need.name] = np.zeros(0) if found is None else np.asarray(found, dtype=np.float64)
    return out


def _means(series: Mapping[str, Floats]) -> xr.Dataset:
    """Return mean, spread and number of known values of channels over the day."""
    rows = []
    for values in series.values():
        known = values[np.isfinite(values)]
        told = (known.mean(), known.std()) if known.size else (np.nan, np.nan)
        rows.append((*told, float(known.size)))
    table = np.array(rows, dtype=np.float64).reshape(-1, 3)
    return xr.Dataset(
        {name: ("channel", table[:, place]) for place, name in enumerate(("mean", "spread", "count"))},
        coords={"channel": list(series)},
    )
