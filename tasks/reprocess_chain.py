"""The whole chain of a mission: one look at every day, one fit of all days, tables of what they witness.

Stages of `inflight.tasks.reprocess.reprocess` for the table ``continuous``. Products are made with the
fitted model, whose scale factors are functions of time, so that no day jumps against its neighbour.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr

from inflight.catalog import Catalog, Day, Run
from inflight.chain import Continuous, continuous_table, fit_mission, rates
from inflight.errors import CalibrationError, InflightError, SamplesError
from inflight.estimators.epoch_fits import fit_step
from inflight.estimators.epochs import join_epochs
from inflight.estimators.panels import choose_panels
from inflight.estimators.secular import carried_mean
from inflight.estimators.torquer_band import daily_fits, fit_band, join_equations, robust_mean
from inflight.estimators.z_offset import noise_of, offsets_from_spread
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.chain import CHAIN_VERSION, Witnesses
from inflight.tasks.chain_beside import beside_makers
from inflight.tasks.chain_daily import (
    daily_after,
    daily_temperatures,
    faults_table,
    node_times,
    periods_of,
    stated_periods,
)
from inflight.tasks.chain_parts import equations_of_days, means_of_channels, part_of
from inflight.tasks.planning import Plan
from inflight.tasks.tables import content_keys
from inflight.time import day_of, to_tt2000

#: Days whose spread tells what the noise alone makes of it, at least.
_FEWEST_DAYS = 5
#: Bumped by hand when the numbers of the chain's tables change.
CHAIN_TABLES_VERSION = 5

#: Attributes of tables: what all of one run are made from; and, of ``trend``, what could not be made and why.
MADE_FROM, LEFT_OUT = "made_from", "left_out"


@dataclass
class Chained:
    """What the chain made of all days.

    Attributes
    ----------
    found : Continuous
        The fit of everything to all days.
    tables : dict of str to Dataset
        By name without the comparison: ``continuous``, ``trend`` and what was witnessed.
    left_out : dict of str to str
        Tables that could not be made, and why.
    """

    found: Continuous
    tables: dict[str, xr.Dataset] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)


def chain_arguments(cat: Catalog, mission: Mission, made: Plan, jobs: Sequence[Any]) -> list[tuple[Any, ...]]:
    """Return the arguments of `chain_batch` for the jobs of a plan."""
    witnesses = Witnesses.of(mission, made.settings.comparison)
    return [(cat, mission, made.model, job, witnesses, made.settings.min_coverage) for job in jobs]


def chained(cat: Catalog, made: Plan, days: Mapping[np.datetime64, Day]) -> Chained:
    """Fit all days together and make every table their parts allow.

    Raises
    ------
    CalibrationError
        When the days do not suffice for the fit itself; tables that fail only say so.
    """
    ordered = [days[day] for day in sorted(days)]
    read = [cat.read(day) for day in ordered]
    settings = made.settings
    origin = None if settings.origin is None else int(to_tt2000(np.datetime64(settings.origin, "ns")))
    every, drift = equations_of_days(read)
    full = np.flatnonzero(every.dataset["count"].values > 0)
    found = fit_mission(every.filled, made.model, settings.trend, origin, drift.of_blocks(full))
    noise = np.array([float(day["after"].values[0]) for day in read])
    # A day that could not be fitted is taken to be as noisy as the others.
    noise = np.where(every.dataset["count"].values > 0, noise, np.median(noise[full]))
    out = Chained(found)
    every = drift.taken_out(every, rates(found.fit, every))
    out.tables["continuous"] = continuous_table(every, found, made.model, noise)
    out.tables["trend"] = found.fit.table()
    if found.choice is not None:
        out.tables["trend-choice"] = found.choice.table()
    out.tables["own-fit"] = _own_fits([read[place] for place in full], found)
    makers: dict[str, Callable[[], xr.Dataset]] = {
        "torquer-band": lambda: fit_band(_band(read), by="day").table(),
        "torquer-band-daily": lambda: daily_fits(_band(read)),
        "torquer-band-mean": lambda: robust_mean(_made(out, "torquer-band-daily")),
        "current-steps": lambda: fit_step(join_epochs(part_of(read, "epoch"))).table(),
        "panels": lambda: _panels(read),
        "torquer-mean": lambda: _torquer_mean(read, settings.mean_days),
        "daily-after": lambda: daily_after(found.equations, found),
        "daily-temperature": lambda: daily_temperatures(_mission(cat, made), made.model, read),
        "clock-faults": lambda: _clock_faults(out),
        "periods": lambda: periods_of(_made(out, "daily-after"), stated_periods(_mission(cat, made))),
    }
    some = [read[place] for place in full]
    makers |= beside_makers(_mission(cat, made), made.model, found.equations, some, found)
    for name, make in makers.items():
        try:
            out.tables[name] = make()
        except InflightError as error:
            out.left_out[name] = error.message
    # Tables of older runs stay certified where this one has none: a reader must know which belong together.
    same = tables_key(made, "", days)[:16]
    for table in out.tables.values():
        table.attrs[MADE_FROM] = same
    out.tables["trend"].attrs[LEFT_OUT] = json.dumps(out.left_out)
    return out


def _made(out: Chained, name: str) -> xr.Dataset:
    if name not in out.tables:
        raise CalibrationError(out.left_out[name], remedy="see the table it is made from")
    return out.tables[name]


def _clock_faults(out: Chained) -> xr.Dataset:
    return faults_table(_made(out, "daily-after"))


def _mission(cat: Catalog, made: Plan) -> Mission:
    return Mission.parse(cat.context(made.context).mission_text)


def _own_fits(read: Sequence[xr.Dataset], found: Continuous) -> xr.Dataset:
    """Return each day's own nine parameters: what is left to wander beside the continuous ones."""
    each = ("interval", "parameter")
    names = list(found.fit.trends)[:9]
    covariance = np.concatenate([day["fit_covariance"].values for day in read])
    return xr.Dataset(
        {
            "value": (each, np.concatenate([day["fit"].values for day in read])),
            "sigma": (each, np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))),
            "covariance": ((*each, "other"), covariance),
            "after": ("interval", np.concatenate([day["after"].values for day in read])),
            "units": ("parameter", np.array([found.fit.units[name] for name in names], dtype="U8")),
            "start": ("interval", np.concatenate([day["start"].values for day in read])),
            "end": ("interval", np.concatenate([day["end"].values for day in read])),
        },
        coords={"parameter": names, "other": names},
    )


def _band(read: Sequence[xr.Dataset]) -> xr.Dataset:
    parts = part_of(read, "band")
    if not parts:
        raise SamplesError(
            "no day has a stretch of torquer currents at a cadence that holds their band",
            remedy="see the missing days of the torquers' channel",
        )
    return join_equations(parts)


def _panels(read: Sequence[xr.Dataset]) -> xr.Dataset:
    epochs = join_epochs(part_of(read, "epoch"))
    return choose_panels(epochs, node_times(epochs)).table()


def _torquer_mean(read: Sequence[xr.Dataset], window: float) -> xr.Dataset:
    """Return the running mean of the torquer currents, A."""
    told = {
        name: one for name, one in means_of_channels(read).items() if name.endswith(("[x]", "[y]", "[z]"))
    }
    if len(told) != 3:
        raise SamplesError("no day has torquer currents", remedy="see the missing days of their channel")
    value = np.stack([one[:, 0] for one in told.values()], axis=1)
    count = np.min([one[:, 2] for one in told.values()], axis=0)
    known = np.isfinite(count)
    start = np.concatenate([day["start"].values for day in read])
    days = day_of(start).astype("datetime64[D]").astype(np.int64)
    return (
        carried_mean(days[known], value[known], count[known], window=window)
        .table()
        .assign_attrs(window_days=window)
    )


def spread_offsets(reports: Mapping[np.datetime64, Mapping[str, Any]]) -> xr.Dataset | str:
    """Return the daily offsets along z from the spread of the products' residual, or why there are none.

    The days' reports hold what `inflight.estimators.z_offset.day_statistics` made of them.
    """
    told = [reports[day]["spread"] for day in sorted(reports) if reports[day].get("spread")]
    if len(told) < _FEWEST_DAYS:
        return f"{len(told)} days tell the spread of their residual, {_FEWEST_DAYS} needed"
    each = {"covariance": ("interval", "statistic", "other"), "start": ("interval",), "end": ("interval",)}
    each |= dict.fromkeys(("direction_mean", "direction_square"), ("interval", "axis"))
    statistics = xr.Dataset(
        {name: (each.get(name, ("interval",)), np.array([one[name] for one in told])) for name in told[0]}
    )
    try:
        return offsets_from_spread(statistics, *noise_of(statistics)).table()
    except InflightError as error:
        return error.message


def tables_key(made: Plan, name: str, days: Mapping[np.datetime64, Day]) -> str:
    """Return what a table of the chain is made from, as one hash."""
    settings = made.settings
    told = [name, str(CHAIN_VERSION), str(CHAIN_TABLES_VERSION), settings.trend, str(settings.origin)]
    return hashlib.sha256("".join([*content_keys(days), *told, made.context]).encode()).hexdigest()


def save_fitted(cat: Catalog, made: Plan, run: Run, found: Continuous) -> Model:
    """Save the fitted model as a version of ``<model>-continuous`` and return it."""
    model = replace(found.model, name=f"{made.model.name}-continuous")
    version = cat.save_model(model.name, model.text, message=f"all days together, run {run.id}")
    return replace(model, version=version)
