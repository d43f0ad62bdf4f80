"""A mission of daily equations on a CHAMP-like orbit, made up column by column, with auxiliary columns."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import xarray as xr

from inflight.calibration import NormalEquations, block_equations, concat_equations, nine_columns
from inflight.mission import Mission
from inflight.mission_fit import MissionFit, fit_mission, free_terms, switched_columns
from inflight.mission_fit.daily_equations import split_auxiliary
from inflight.mission_fit.temperature import KINDS, coil_columns
from inflight.model import Model
from inflight.scorecard import SimulatedDays
from inflight.time import SECOND

MISSION = Mission.parse((Path(__file__).parents[2] / "missions" / "champ.yaml").read_text(encoding="utf-8"))
NINE_AND_SHIFT = """
model: made-up
version: 1
mission: champ
comparison: main
effects:
{more}
  - effect: vector_sensor
    sensor: fgm
    scale_factor: {{time: block, unit: "1", value: [1.0, 1.0, 1.0], sigma: [2.0e-3, 2.0e-3, 2.0e-3]}}
    misalignment: {{time: block, unit: deg, value: [90.0, 90.0, 90.0], sigma: [0.01, 0.01, 0.01]}}
    offset: {{time: block, unit: nT, value: [0.0, 0.0, 0.0], sigma: [10.0, 10.0, 10.0]}}
  - {{effect: time_shift, sensor: ovm, seconds: {{unit: s, value: 0.0, sigma: 0.02}}}}
"""
TEMPERATURE = """
  - effect: temperature
    sensor: fgm
    channel: coil_temperature
    linear: {unit: 1/K, value: [30.0e-6, 30.0e-6, 30.0e-6], sigma: [4.0e-7, 4.0e-7, 4.0e-7]}
    quadratic: {unit: 1/K^2, value: [4.0e-8, 4.0e-8, 4.0e-8], sigma: [1.0e-8, 1.0e-8, 1.0e-8]}
    reference: {unit: degC, value: 10.0, free: false}
"""
SCENE = SimulatedDays()
KNOWN = 30e-6, 4e-8
#: What follows the temperature in truth: 1/K and 1/K^2.
LINEAR, QUADRATIC = np.array([30.2e-6, 29.7e-6, 30.1e-6]), np.array([4.5e-8, 4e-8, 3.5e-8])


@dataclass(frozen=True)
class MadeUp:
    """Equations of days with their auxiliary columns, and the fit of all of them."""

    model: Model
    equations: NormalEquations
    auxiliary: list[xr.Dataset]
    found: MissionFit = field(repr=False)


def model_with(more: str = "") -> Model:
    return Model.parse(NINE_AND_SHIFT.format(more=more), MISSION)


def made_up(model: Model, blocks: list[NormalEquations]) -> MadeUp:
    """Split blocks into equations of the model and auxiliary ones, and fit them."""
    own = [name for term in free_terms(model) for name in term.columns]
    auxiliary = [split_auxiliary(one.dataset, own, dict.fromkeys(one.columns, True)) for one in blocks]
    equations = concat_equations([one.select(own) for one in blocks])
    reference = np.concatenate(
        [term.entry.parameters[p].value[:, 0] for term in free_terms(model) for p in term.parameters]
    )
    data = equations.dataset
    whole = np.broadcast_to(np.append(reference, 0.0), data["reference"].shape)
    equations = NormalEquations(data.assign(reference=(data["reference"].dims, whole.copy())))
    return MadeUp(model, equations, auxiliary, fit_mission(equations, model, "linear"))


def nights(days: range, by_day: tuple[float, float, float], seed: int = 0, noise: float = 0.1) -> MadeUp:
    """Make days with a field by day at the vector sensor.

    White noise of `noise` nT, and waves of minutes to hours, each a fifth of it.
    """
    model, random, blocks = model_with(), np.random.default_rng(seed), []
    for mjd in days:
        day = SCENE.day(mjd)
        columns = nine_columns(day.field) | {"time_shift.seconds": day.rate}
        columns |= switched_columns(day.direction, day.sunlit)
        t = np.arange(day.strength.size)
        waves = sum(
            random.normal(0, 0.2 * noise)
            * np.sin(2 * np.pi * t / random.uniform(10, 200) + random.uniform(0, 7))
            for _ in range(6)
        )
        seen = (day.direction @ np.array(by_day)) * day.sunlit
        blocks.append(
            block_equations(columns, seen + waves + random.normal(0, noise, t.size), day.span, robust=False)
        )
    return made_up(model, blocks)


@cache
def _warm(mjd: int, lag: float) -> np.ndarray:
    """A temperature that follows orbit and season, degC, `lag` seconds ago; (time,)."""
    day = SCENE.day(mjd)
    seconds = np.arange(day.strength.size) * 30.0 + 86400.0 * (mjd % 1000) - lag
    return 12 + 4 * np.sin(2 * np.pi * seconds / 5580) + 3 * np.sin(2 * np.pi * seconds / (17 * 86400))


@cache
def _electronics(mjd: int) -> np.ndarray:
    """Another one, slower to follow and with a course of its own, degC; (time,)."""
    day = SCENE.day(mjd)
    seconds = np.arange(day.strength.size) * 30.0 + 86400.0 * (mjd % 1000)
    return 20 + 2 * np.sin(2 * np.pi * seconds / 5580 - 1.2) + 3 * np.sin(2 * np.pi * seconds / (11 * 86400))


@cache
def _columns(mjd: int) -> dict[str, np.ndarray]:
    day = SCENE.day(mjd)
    stamps = day.span[0] + np.arange(day.strength.size) * 30 * SECOND
    found = nine_columns(day.field)
    for name, values, reference in (
        ("coil_temperature", _warm(mjd, 0.0), 10.0),
        ("electronics_temperature", _electronics(mjd), 10.0),
    ):
        found |= coil_columns(name, day.field, stamps, values, 0.0, reference)
    renamed = {}
    for name, one in found.items():
        kind = name.partition("[")[0]
        own = kind in [f"coil_temperature.{one}" for one in KINDS[:2]]
        renamed[name.replace("coil_temperature", "temperature") if own else name] = one
    order = [name for term in free_terms(model_with(TEMPERATURE)) for name in term.columns]
    renamed["time_shift.seconds"] = day.rate
    return {name: renamed[name] for name in [*order, *(one for one in renamed if one not in order)]}


def warm_days(
    days: range,
    lag: float,
    seed: int,
    scale: float = 1.0,
    follows: str = "coil",
    by_day: tuple[float, float, float] | None = None,
) -> MadeUp:
    """Make days whose scale factors follow a temperature `lag` seconds before the recorded one.

    Where a field `by_day` is given, nT, the days know their orbit.

    The residual is that of a model that takes `KNOWN` coefficients of the coil without a lag; `follows` names
    what is followed in truth, ``coil``, ``electronics`` or ``none``; `scale` multiplies the noise of 0.1 nT.
    """
    random, blocks = np.random.default_rng(seed), []
    for mjd in days:
        columns, day = dict(_columns(mjd)), SCENE.day(mjd)
        truth = {"coil": _warm(mjd, lag) - 10, "electronics": _electronics(mjd) - 10}.get(follows)
        recorded = _warm(mjd, 0.0) - 10
        residual = scale * random.normal(0, 0.1, recorded.size)
        for axis, name in enumerate(("x", "y", "z")):
            signal = columns[f"vector_sensor.scale_factor[{name}]"]
            if truth is not None:
                residual += signal * (LINEAR[axis] * truth + QUADRATIC[axis] * truth**2)
            residual -= signal * (KNOWN[0] * recorded + KNOWN[1] * recorded**2)
        if by_day is not None:
            columns |= switched_columns(day.direction, day.sunlit)
            residual += (day.direction @ np.array(by_day)) * day.sunlit
        blocks.append(block_equations(columns, residual, day.span, robust=False))
    return made_up(model_with(TEMPERATURE), blocks)


def with_noise(made: MadeUp, seed: int, sigma: float) -> MadeUp:
    """Return the same days with white noise of `sigma` nT more, drawn for the Gram matrices themselves.

    Of white noise n of a block only ``X' n``, of covariance ``sigma^2 X'X``, and ``n' n`` are in them.
    """
    random, data = np.random.default_rng(seed), made.equations.dataset
    gram, auxiliary = data["gram"].values.copy(), []
    for place, quiet in enumerate(made.auxiliary):
        part = quiet.copy(deep=True)
        inner, cross = gram[place, :-1, :-1], part["cross"].values
        both = np.block([[inner, cross[:, :-1].T], [cross[:, :-1], part["own"].values]])
        size = np.sqrt(np.diag(both))
        own, vectors = np.linalg.eigh(both / np.outer(size, size))
        drawn = random.standard_normal(own.size)
        noise = sigma * size * (vectors @ (np.sqrt(np.clip(own, 0.0, None)) * drawn))
        signal = np.concatenate([gram[place, :-1, -1], cross[:, -1]]) / size
        answer = vectors @ np.where(
            own > 1e-9 * own[-1], (vectors.T @ signal) / np.clip(own, 1e-300, None), 0.0
        )
        more = 2 * answer @ (noise / size)
        more += sigma**2 * (drawn @ drawn + random.chisquare(data["count"].values[place] - own.size))
        wide = len(inner)
        gram[place, :-1, -1] += noise[:wide]
        gram[place, -1, :-1] += noise[:wide]
        gram[place, -1, -1] += more
        cross[:, -1] += noise[wide:]
        auxiliary.append(part)
    equations = NormalEquations(data.assign(gram=(data["gram"].dims, gram)))
    return MadeUp(made.model, equations, auxiliary, fit_mission(equations, made.model, "linear"))
