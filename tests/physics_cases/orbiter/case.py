"""One case: draw a spacecraft and its hidden causes, fly it, write the workspace, keep the truth apart."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from inflight.time import day_bounds, day_range

from .archive import Table, instrument_entry, make_workspace, sampled, write_archive, write_files
from .causes import CAUSES, Cause, World
from .decoys import make_decoys, near_copy
from .field import draw_field, main_field
from .held import draw_held, wrong_value
from .house import Channel, keep_house
from .known import Error, draw_known, model_tree
from .orbit import ATTITUDES, Orbit, fly
from .readings import RESOLUTION, Nine, Noise, Readings, read
from .rivals import ALIKE, equivalents, retained
from .scenario import Scenario

CADENCE = 10.0
#: Retained part of a contribution below which the data cannot show it.
BLIND = 1e-4
#: Cadences of an instrument where they are unequal, s.
UNEQUAL = {"aocs": 1.0, "power": 10.0, "thermal": 32.0, "misc": 60.0}
SENSORS = (("fluxgate", "overhauser"), ("vfm", "asm"), ("mag_v", "mag_s"), ("fgm", "potassium"))
ORBITS: dict[str, Callable[[np.random.Generator], Orbit]] = {
    "polar": lambda r: _circular(r, 300, 800, r.choice([-1, 1]) * r.uniform(3, 9) + 90, r.uniform(0, 24)),
    "eclipses": lambda r: _circular(r, 380, 650, r.uniform(50, 98), r.choice([9.5, 11, 12.5, 22, 0.5])),
    "dawn_dusk": lambda r: _sun_synchronous(r, 1450, 1650, 6.0),
    "elliptical": lambda r: Orbit(
        r.uniform(350, 500), r.uniform(0.03, 0.12), r.uniform(60, 95), r.uniform(0, 24), r.uniform(0, 360),
        r.uniform(0, 360)),
    "uniform": lambda r: _circular(r, 500, 700, r.uniform(0.5, 2.0), r.uniform(0, 24)),
}  # fmt: skip


def _circular(
    rng: np.random.Generator, low: float, high: float, inclination: float, local_time: float
) -> Orbit:
    altitude, eccentricity = rng.uniform(low, high), rng.uniform(0.0005, 0.004)
    return Orbit(altitude, eccentricity, inclination, local_time, rng.uniform(0, 360), rng.uniform(0, 360))


def _sun_synchronous(rng: np.random.Generator, low: float, high: float, local_time: float) -> Orbit:
    """Return an orbit whose node follows the mean Sun; above 1400 km at dawn it is never in shadow."""
    made = _circular(rng, low, high, 0.0, local_time)
    per_cosine, year = made.node_rate, 2 * np.pi / (365.2422 * 86_400.0)
    return replace(made, inclination=float(np.rad2deg(np.arccos(year / per_cosine))))


@dataclass(frozen=True)
class Case:
    """Everything of one case in memory: what is delivered, and the truth."""

    scenario: Scenario
    seed: int
    start: np.datetime64
    world: World
    readings: Readings
    nine: Nine
    noise: Noise
    mission: dict[str, Any]
    model: dict[str, Any]
    tables: dict[str, Table]
    truth: dict[str, Any]
    hidden: tuple[Cause, ...]
    known: dict[str, Cause]

    @property
    def days(self) -> list[np.datetime64]:
        """UTC days of the case."""
        return day_range(self.start, self.start + np.timedelta64(self.scenario.days, "D"))

    def write(self, root: Path) -> tuple[Path, Path]:
        """Write workspace and truth to folders of their own; return both paths."""
        label = f"{self.scenario.name}-{self.seed}"
        workspace = make_workspace(root / "work" / label, self.mission, self.model)
        if self.scenario.files:
            write_files(workspace, self.tables, self.days)
        else:
            write_archive(workspace, self.tables, self.days)
        truth = root / "truth" / f"{label}.json"
        truth.parent.mkdir(parents=True, exist_ok=True)
        truth.write_text(json.dumps(self.truth, indent=1), encoding="utf-8")
        return workspace.root, truth


def make_case(scenario: Scenario, seed: int) -> Case:
    """Return one case; equal scenario and seed give equal data."""
    rng = np.random.default_rng([seed, *scenario.name.encode()])
    start = np.datetime64("2018-01-01", "D") + int(rng.integers(0, 2000))
    orbit, attitude = _draw_flight(scenario, start, rng)
    orientation = Rotation.random(random_state=rng)
    world, turn = _fly(scenario, start, orbit, attitude, orientation, rng)
    noise = Noise(rng.uniform(0.05, 0.1), rng.uniform(0.05, 0.1), scenario.red, scenario.outliers)
    nine = Nine.draw(rng)
    known = draw_known(world, scenario.hidden, scenario.known, rng, scenario.wrong)
    hidden = tuple(
        _sized(CAUSES[name](world, rng), world, noise.size, scenario, rng) for name in scenario.hidden
    )
    if not scenario.number:
        readings = read(world, [*hidden, *known.values()], nine, noise, rng)
    delivered, names = _deliver(scenario, world, hidden, noise, rng)
    sensors = SENSORS[rng.integers(len(SENSORS))]
    if scenario.number:
        held, vector = draw_held(scenario.number, world, rng, sensors[0], names, nine.offset)
        acting = held.cause(world, held.true, vector)
        readings = read(world, [*hidden, *known.values(), acting], nine, noise, rng)
    geometry = _geometry(world, turn)
    mission = _mission(scenario, sensors, orientation, orbit, hidden, delivered, geometry, seed)
    wrong, errors = _wrong(scenario, known, world, noise.size, rng)
    model = model_tree(mission["mission"], sensors, nine, known, world, names, noise.size, rng, errors)
    tables = _tables(scenario, start, world, readings, sensors, [*delivered.values(), *geometry], rng)
    truth = _truth(scenario, seed, start, world, orbit, attitude, noise, readings, nine, known, sensors)
    shown = {**delivered, "sunlit": Channel("sunlit", world.track.sunlit, "1", "sunlight", "", 1e-3)}
    missing = (*hidden, *wrong)
    told = [_told(one, missing, world, shown, names, noise.size, scenario.kinds) for one in missing]
    truth["effects"] = told
    if scenario.number:
        low, high = np.log(scenario.size)
        value, missed = wrong_value(held, world, vector, 0.1 * noise.size * np.exp(rng.uniform(low, high)))
        # In the equation of the sensor it stands before the nine parameters, as a field behind them.
        model["effects"].insert(0 if held.gain else len(model["effects"]), held.entry(value))
        for instrument in mission["instruments"].values():
            if scenario.number == "delay" and held.number.removesuffix(".lag") in instrument["channels"]:
                instrument["channels"][held.number.removesuffix(".lag")]["lag"] = f"{value:.6f} s"
        one = _told(missed, (missed,), world, shown, names, noise.size, scenario.kinds)
        told.append(one | {"number": held.number, "held_value": value, "true_value": held.true})
    if wrong:
        told[-1]["held"] = model["effects"][_place(model, scenario.wrong)]["effect"]
    return Case(
        scenario, seed, start, world, readings, nine, noise, mission, model, tables, truth, hidden, known
    )


def _wrong(
    scenario: Scenario, known: dict[str, Cause], world: World, sigma: float, rng: np.random.Generator
) -> tuple[tuple[Cause, ...], dict[str, Error]]:
    """Return what the wrong numbers of a known cause leave, and how wrong they are."""
    if not scenario.wrong:
        return (), {}
    cause = known[scenario.wrong]
    left = _sized(cause, world, sigma, scenario, rng)
    part = float(np.sqrt(np.mean(left.seen(world) ** 2) / np.mean(cause.seen(world) ** 2)))
    return (left,), {scenario.wrong: Error(part, rng.uniform(3.0, 10.0), scenario.held)}


def _place(model: dict[str, Any], name: str) -> int:
    """Return which effect of the model a known cause is."""
    labels = {"temperature_scale": "temperature", "clock": "time_shift"}
    wanted = labels.get(name, name)
    return next(at for at, one in enumerate(model["effects"]) if one["effect"] == wanted)


def _draw_flight(scenario: Scenario, start: np.datetime64, rng: np.random.Generator) -> tuple[Orbit, str]:
    usual = ("polar", "eclipses", "elliptical")
    kind = scenario.orbit if scenario.orbit != "any" else usual[rng.integers(len(usual))]
    attitude = scenario.attitude or str(rng.choice(ATTITUDES))
    return ORBITS[kind](rng), attitude


def _fly(
    scenario: Scenario,
    start: np.datetime64,
    orbit: Orbit,
    attitude: str,
    orientation: Rotation,
    rng: np.random.Generator,
) -> tuple[World, np.ndarray]:
    """Return the world in sensor axes, and the attitude's quaternions from spacecraft axes to itrf."""
    seconds = np.arange(0.0, scenario.days * 86_400.0, CADENCE)
    track = fly(orbit, attitude, start, seconds, rng)
    earth = main_field(draw_field(rng, scenario.orbit == "uniform"), seconds, track.position)
    body = np.einsum("tak,ta->tk", track.turn, earth)
    quaternion = Rotation.from_matrix(track.turn).as_quat()
    turn = orientation.as_matrix()
    track = replace(track, sun=track.sun @ turn)
    field = body @ turn
    strength = np.linalg.norm(field, axis=1)
    rate = CubicSpline(seconds, strength).derivative()(seconds)
    house = keep_house(track, rng)
    return World(track, field, strength, rate, house, orbit.period), quaternion


def _sized(cause: Cause, world: World, sigma: float, scenario: Scenario, rng: np.random.Generator) -> Cause:
    """Return a cause so large that the nine parameters leave the wanted multiple of a detectable one."""
    seen = cause.seen(world)
    left, whole = np.std(retained(world, seen)), np.sqrt(np.mean(seen**2))
    if cause.told.get("unidentifiable") or left**2 < BLIND * whole**2:
        return replace(
            cause.scaled(rng.uniform(0.3, 1.0) / whole), told=cause.told | {"unidentifiable": True}
        )
    low, high = np.log(scenario.size)
    wanted = 0.1 * sigma * np.exp(rng.uniform(low, high))
    return cause.scaled(wanted / left)


def _deliver(
    scenario: Scenario, world: World, hidden: tuple[Cause, ...], noise: Noise, rng: np.random.Generator
) -> tuple[dict[str, Channel], dict[str, str]]:
    """Return what is delivered by its delivered name, and telling name -> delivered name."""
    acting = {name for cause in hidden for name in cause.channels}
    channels = list(world.house.values())
    if scenario.near_copy:
        channels.append(_indistinguishable(world, hidden[0], noise.size, rng))
    channels += make_decoys(world.track, world.house, acting, scenario.decoys, rng)
    if scenario.cadences:
        channels = [replace(c, cadence=UNEQUAL[c.instrument]) for c in channels]
    labels = rng.permutation(900)[: len(channels)] + 10
    named = [
        c.renamed(f"hk_{label:03d}" if scenario.opaque else c.name, scenario.kinds)
        for c, label in zip(channels, labels, strict=True)
    ]
    names = {c.name: n.name for c, n in zip(channels, named, strict=True)}
    return {c.name: c for c in sorted(named, key=lambda c: c.name)}, names


def _indistinguishable(world: World, cause: Cause, sigma: float, rng: np.random.Generator) -> Channel:
    """Return a copy of the acting channel that differs by a quarter of what the data could tell."""
    source = world.house[cause.channels[0]]
    power = world.strength.size * np.mean(retained(world, cause.seen(world)) ** 2) / sigma**2
    return near_copy(source, "second_monitor", min(1e-3, ALIKE / 4 / power), rng)


def _geometry(world: World, quaternion: np.ndarray) -> list[Channel]:
    return [
        Channel("attitude", quaternion, "1", "attitude", "attitude", 1e-8),
        Channel("position", world.track.position, "km", "position", "orbit", 1e-4),
    ]


def _mission(
    scenario: Scenario,
    sensors: tuple[str, str],
    orientation: Rotation,
    orbit: Orbit,
    hidden: tuple[Cause, ...],
    delivered: dict[str, Channel],
    geometry: list[Channel],
    seed: int,
) -> dict[str, Any]:
    """Return the mission YAML as a tree."""
    vector, scalar = sensors
    field = Channel("field", np.zeros((1, 3)), "nT", "other", vector, RESOLUTION, CADENCE)
    strength = Channel("field", np.zeros(1), "nT", "other", scalar, RESOLUTION, CADENCE)
    place = {"position": [3.5, 0, 0], "orientation": orientation.as_quat().tolist()}
    instruments = {
        vector: instrument_entry("vector", [field], vector, place),
        scalar: instrument_entry("scalar", [strength], scalar, {"position": [5.0, 0, 0]}),
    }
    groups: dict[str, list[Channel]] = {}
    for channel in [*delivered.values(), *geometry]:
        groups.setdefault(channel.instrument, []).append(channel)
    for name, channels in groups.items():
        role = name if name == "attitude" else {"orbit": "orbit"}.get(name, "housekeeping")
        instruments[name] = instrument_entry(role, channels, name, {})
    periods = {"orbit": f"{orbit.period:.3f} s"}
    recorded = [c for c in hidden if "period_s" in c.told and "unrecorded" not in c.told]
    periods |= {f"line_{i}": f"{c.told['period_s']:.6f} s" for i, c in enumerate(recorded)}
    return {
        "mission": f"orbiter-{seed}",
        "description": "A spacecraft of the second simulator",
        "periods": periods,
        "positions": {"unit": "m", "axis_along_boom": "x"},
        "instruments": instruments,
        "comparisons": {"main": {"kind": "scalar", "vector": vector, "scalar": scalar}},
        "preflight": "models/preflight.yaml",
    }


def _tables(
    scenario: Scenario,
    start: np.datetime64,
    world: World,
    readings: Readings,
    sensors: tuple[str, str],
    channels: list[Channel],
    rng: np.random.Generator,
) -> dict[str, Table]:
    """Return the rows of every instrument, gaps cut out."""
    begin, seconds = day_bounds(start)[0], world.track.seconds
    stamps = begin + np.round(seconds * 1e9).astype(np.int64)
    tables: dict[str, Table] = {
        sensors[0]: (stamps, {"field": readings.vector}),
        sensors[1]: (stamps, {"field": readings.scalar}),
    }
    for channel in channels:
        own, values = sampled(channel, seconds, begin)
        tables.setdefault(channel.instrument, (own, {}))[1][channel.name] = values
    return {name: _with_gaps(table, scenario.gaps, rng) for name, table in tables.items()}


def _with_gaps(table: Table, share: float, rng: np.random.Generator) -> Table:
    """Return a table without about so large a share of its rows, cut in stretches of minutes to hours."""
    stamps, columns = table
    keep, wanted = np.ones(stamps.size, dtype=bool), share * stamps.size
    step = float(stamps[1] - stamps[0]) / 1e9
    while (~keep).sum() < wanted:
        long = int(np.exp(rng.uniform(np.log(60.0), np.log(20_000.0))) / step) + 1
        at = int(rng.integers(stamps.size))
        keep[at : at + min(long, int(wanted - (~keep).sum()) + 1)] = False
    return stamps[keep], {name: values[keep] for name, values in columns.items()}


def _truth(
    scenario: Scenario,
    seed: int,
    start: np.datetime64,
    world: World,
    orbit: Orbit,
    attitude: str,
    noise: Noise,
    readings: Readings,
    nine: Nine,
    known: dict[str, Cause],
    sensors: tuple[str, str],
) -> dict[str, Any]:
    """Return what the scorer is told, all but the hidden effects."""
    return {
        "scenario": scenario.name,
        "seed": seed,
        "start": str(start),
        "days": scenario.days,
        "verdicts": list(scenario.verdicts),
        "floor_nT": float(np.std(readings.noise[~readings.outlier])),
        "white_nT": noise.size,
        "sensors": {"vector": sensors[0], "scalar": sensors[1]},
        "orbit": {"altitude_km": orbit.altitude, "inclination_deg": orbit.inclination,
                  "eccentricity": orbit.eccentricity, "local_time_h": orbit.local_time,
                  "period_s": orbit.period, "attitude": attitude,
                  "sunlit_share": float(world.track.sunlit.mean())},
        "nine": {"scale_factor": nine.scale_factor.tolist(), "misalignment": nine.misalignment.tolist(),
                 "offset": nine.offset.tolist()},
        "known": list(known),
    }  # fmt: skip


def _told(
    cause: Cause,
    hidden: tuple[Cause, ...],
    world: World,
    shown: dict[str, Channel],
    names: dict[str, str],
    sigma: float,
    kinds: bool,
) -> dict[str, Any]:
    """Return the truth about one hidden cause."""
    seen = cause.seen(world)
    left = retained(world, seen)
    beside = tuple(other.seen(world) for other in hidden if other is not cause)
    families = list(cause.families)
    if not kinds and cause.channels and cause.channels[0] in names:
        families = ["current", "unknown"]
    told: dict[str, Any] = {
        "name": cause.name,
        "families": families,
        "channels": [names.get(name, name) for name in cause.channels],
        "coefficients": list(cause.coefficients),
        "identifiable": not cause.told.get("unidentifiable", False),
        "rms_nT": float(np.sqrt(np.mean(seen**2))),
        "retained_rms_nT": float(np.std(left)),
        "jointly_retained_rms_nT": float(np.std(retained(world, seen, beside))),
        "equivalents": [],
    }
    if told["identifiable"]:
        found = equivalents(world, cause, shown, sigma)
        told["equivalents"] = [one for one in found if one["channel"] not in told["channels"]]
    return told | {key: value for key, value in cause.told.items() if key != "unidentifiable"}
