"""A small spacecraft in a tilted dipole: readings, channels and evidence, a sample every two minutes.

A flight is made once and looked at with several residuals: what is hidden changes the residual, not the
columns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from inflight.calibration import PARAMETER_GROUPS, ParameterPrior, fit_block
from inflight.design import ChannelSummary, DesignRows, Library, Term, coarsen, design_matrix, sensor_matrices
from inflight.diagnosis import (
    Diagnosis,
    DiagnosisData,
    Rules,
    Search,
    Series,
    TimeVariableColumns,
    features_of,
    make_library,
    pack_blocks,
    run_search,
    thin_rows,
)
from inflight.frames import GEOMETRY, add_geometry
from inflight.lsq import GramArrays, gram_of, parts_of, prewhiten
from inflight.mission import Mission, sensors_of
from inflight.model import Model, make_effect, rows_of
from inflight.residual import NoiseFloor
from inflight.samples import channel_product, parse_channel, slow_response
from inflight.time import DAY, SECOND, day_bounds

#: Usual spacing of the samples, seconds.
STEP_S = 120.0
NOISE_NT = 0.09
CHANNELS = (
    "solar_current",
    "battery_current",
    "boom_temperature",
    "coil_temperature",
    "heater_current",
    "payload_current",
)
#: Nine parameters of the vector sensor, as a model states them.
TRUE_NINE = np.array([1.00139, 1.00223, 1.00221, 90.0225, 90.0640, 90.0350, 23.0, 24.5, 19.0])
MU, EARTH_KM = 398_600.4418, 6378.137

MISSION_YAML = """\
mission: small
description: A vector and a scalar magnetometer on a boom
periods: {orbit: ORBIT s}
instruments:
  fgm:
    role: vector
    cadence: 120 s
    files: {pattern: "fgm_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels: {field: {variables: [x, y, z], unit: nT}}
  ovm:
    role: scalar
    cadence: 120 s
    files: {pattern: "ovm_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels: {field: {variable: f, unit: nT}}
  house:
    role: housekeeping
    cadence: 120 s
    files: {pattern: "house_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels:
      solar_current: {variable: a, unit: A, kind: solar_current}
      battery_current: {variable: b, unit: A, kind: battery_current}
      boom_temperature: {variable: c, unit: degC, kind: temperature}
      coil_temperature: {variable: d, unit: degC, kind: temperature}
      heater_current: {variable: e, unit: A, kind: heater}
      payload_current: {variable: g, unit: A, kind: current}
  pointing:
    role: attitude
    cadence: 120 s
    files: {pattern: "att_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels: {attitude: {variables: [x, y, z, w], unit: "1", kind: attitude, frame: itrf}}
  track:
    role: orbit
    cadence: 120 s
    files: {pattern: "orb_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels: {position: {variables: [x, y, z], unit: km, kind: position, frame: itrf}}
comparisons: {main: {kind: scalar, vector: fgm, scalar: ovm}}
"""
MODEL_YAML = """\
model: small
mission: small
comparison: main
effects:
  - effect: vector_sensor
    sensor: fgm
    scale_factor: {time: block, unit: "1", value: [1.0014, 1.0022, 1.0022], sigma: [2.0e-3, 2.0e-3, 2.0e-3]}
    misalignment: {time: block, unit: deg, value: [90.02, 90.06, 90.03], sigma: [0.01, 0.01, 0.01]}
    offset: {time: block, unit: nT, value: [23.0, 24.0, 19.0], sigma: [10.0, 10.0, 10.0]}
"""


@dataclass(frozen=True)
class Orbit:
    """A Kepler ellipse; altitude of the perigee in km, angles in degrees, local time of the node in hours.

    `node_drift` is the node's motion against the mean Sun, degrees a day.
    """

    altitude: float = 450.0
    eccentricity: float = 0.003
    inclination: float = 87.3
    local_time: float = 12.0
    node_drift: float = -1.4

    @property
    def period_s(self) -> float:
        """Period, seconds."""
        return float(2 * np.pi * np.sqrt(self._axis**3 / MU))

    @property
    def _axis(self) -> float:
        return (EARTH_KM + self.altitude) / (1 - self.eccentricity)

    def at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return radius vector (km), unit vectors along and up (time, 3); x towards the mean Sun, z north."""
        e, mean = self.eccentricity, 2 * np.pi * seconds / self.period_s
        turn = mean + e * np.sin(mean)
        for _ in range(6):
            turn = turn - (turn - e * np.sin(turn) - mean) / (1 - e * np.cos(turn))
        angle = 2 * np.arctan2(np.sqrt(1 + e) * np.sin(turn / 2), np.sqrt(1 - e) * np.cos(turn / 2))
        angle = angle + np.deg2rad(40.0) + np.deg2rad(3.0) * seconds / 86_400.0
        node = np.deg2rad(15.0 * (self.local_time - 12.0) + self.node_drift * seconds / 86_400.0)
        ci, si = np.cos(np.deg2rad(self.inclination)), np.sin(np.deg2rad(self.inclination))
        p = np.stack([np.cos(node), np.sin(node), 0 * node], axis=1)
        q = np.stack([-np.sin(node) * ci, np.cos(node) * ci, si + 0 * node], axis=1)
        up = p * np.cos(angle)[:, None] + q * np.sin(angle)[:, None]
        along = q * np.cos(angle)[:, None] - p * np.sin(angle)[:, None]
        return up * (self._axis * (1 - e * np.cos(turn)))[:, None], along, up


POLAR = Orbit()
ELLIPTIC = Orbit(altitude=420.0, eccentricity=0.06, inclination=45.0, local_time=8.0, node_drift=-5.5)
DAWN_DUSK = Orbit(altitude=780.0, eccentricity=0.001, inclination=98.5, local_time=18.0, node_drift=0.0)


def spun(vectors: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Turn axes by an angle about z; (time, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.stack([c * x + s * y, c * y - s * x, z], axis=1)


def dipole(position: np.ndarray) -> np.ndarray:
    """Return the field of a tilted dipole beside the Earth's centre; (time, 3) nT, itrf, position in km."""
    away = position - np.array([-400.0, 250.0, 150.0])
    radius = np.linalg.norm(away, axis=1)[:, None]
    unit = away / radius
    moment = -30_000.0 * np.array([0.05, -0.18, 0.98])
    return np.asarray((EARTH_KM / radius) ** 3 * (3.0 * (unit @ moment)[:, None] * unit - moment))


@dataclass(frozen=True)
class Flight:
    """A flight without anything hidden.

    Attributes
    ----------
    tt2000 : ndarray of int64, shape (time,)
    samples : xarray.Dataset
        Position, attitude, geometry and channels; the true `field` (time, axis) nT, sensor axes.
    """

    orbit: Orbit
    tt2000: np.ndarray
    samples: xr.Dataset

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a series; (time,) or (time, axis)."""
        return np.asarray(self.samples[name].values)

    @property
    def direction(self) -> np.ndarray:
        """Unit vector of the true field; (time, axis)."""
        return self["field"] / np.linalg.norm(self["field"], axis=1, keepdims=True)

    def along(self, field: np.ndarray) -> np.ndarray:
        """Return the part of a field (time, axis) that changes \\|B\\| - F; (time,) nT."""
        return np.einsum("ta,ta->t", self.direction, field)

    def channel(self, name: str) -> np.ndarray:
        """Return a derived channel."""
        return channel_product([part.of(self[part.channel], STEP_S) for part in parse_channel(name).parts])


def true_field(orbit: Orbit, seconds: np.ndarray, wobble: Rotation) -> tuple[np.ndarray, ...]:
    """Return position (km, itrf), quaternion body -> itrf, field (nT, body axes)."""
    place, along, up = orbit.at(seconds)
    side = np.cross(-up, along)
    side /= np.linalg.norm(side, axis=1)[:, None]
    body = np.stack([np.cross(side, -up), side, -up], axis=2)
    body = np.einsum("tij,tjk->tik", body, wobble.as_matrix())
    # At midnight of Greenwich the Sun stands over the date line.
    spin = np.pi + 2 * np.pi * seconds / 86_400.0
    position = spun(place, spin)
    axes = np.stack([spun(body[:, :, k], spin) for k in range(3)], axis=2)
    field = np.einsum("tak,ta->tk", axes, dipole(position))
    return position, Rotation.from_matrix(axes).as_quat(), field


def switched(generator: np.random.Generator, count: int, mean_s: float) -> np.ndarray:
    """Return a telegraph of 0 and 1 that changes at random; (time,)."""
    turns = generator.random(count) < STEP_S / mean_s
    return np.cumsum(turns) % 2 * 1.0


def slow_noise(generator: np.random.Generator, count: int, memory_s: float, rms: float) -> np.ndarray:
    """Return a first-order process; (time,)."""
    from scipy.signal import lfilter

    phi = np.exp(-STEP_S / memory_s)
    return lfilter([np.sqrt(1 - phi**2) * rms], [1.0, -phi], generator.normal(size=count))


def channels_of_flight(orbit: Orbit, samples: xr.Dataset, generator: np.random.Generator) -> dict[str, tuple]:
    """Return housekeeping with the causes it really has: light, load, heat."""
    lit, sun = samples["sunlit"].values, samples["sun_direction"].values
    count = lit.size
    light = lit * (
        0.7 * np.clip(sun[:, 1], 0, None)
        + 0.5 * np.clip(-sun[:, 1], 0, None)
        - 0.4 * np.clip(sun[:, 2], None, 0)
    )
    payload = switched(generator, count, 3600.0)
    heater = switched(generator, count, 2400.0)
    load = 1.5 + 0.4 * payload + 0.3 * heater
    missing, flow = 2000.0, np.zeros(count)
    for k in range(count):
        flow[k] = lit[k] * min(2.5, missing / 1500.0)
        missing = max(missing + STEP_S * (load[k] * (1 - lit[k]) - flow[k]), 0.0)
    battery = flow - load * (1 - lit) + slow_noise(generator, count, 600.0, 0.02)
    boom = (
        -10.0
        + slow_response(30.0 * light + 8.0 * lit, STEP_S, 1800.0)
        + slow_noise(generator, count, 8000.0, 0.3)
    )
    coil = 5.0 + slow_response(6.0 * lit, STEP_S, 2600.0) + slow_noise(generator, count, 40_000.0, 1.0)
    return {
        "solar_current": ("time", load * lit + flow + 1.6 * light, {"units": "A"}),
        "battery_current": ("time", battery, {"units": "A"}),
        "boom_temperature": ("time", boom, {"units": "degC"}),
        "coil_temperature": ("time", coil, {"units": "degC"}),
        "heater_current": ("time", 0.6 * heater, {"units": "A"}),
        "payload_current": (
            "time",
            0.5 * payload + slow_noise(generator, count, 900.0, 0.006),
            {"units": "A"},
        ),
    }


@lru_cache(maxsize=8)
def flight_of(orbit: Orbit, days: int, seed: int = 0, start: str = "2024-03-01") -> Flight:
    """Make a flight of so many days."""
    generator = np.random.default_rng(seed)
    first = day_bounds(start)[0]
    count = int(days * 86_400 / STEP_S)
    tt2000 = first + (np.arange(count) * STEP_S * SECOND).astype(np.int64) + int(STEP_S * SECOND) // 2
    seconds = (tt2000 - first) / SECOND
    waves = np.zeros((count, 3))
    for period in (700.0, 2100.0, 9000.0, 30_000.0):
        waves += np.deg2rad(1.0) * np.sin(
            2 * np.pi * seconds[:, None] / (period * generator.uniform(0.8, 1.2, 3))
            + generator.uniform(0, 6, 3)
        )
    position, quaternion, field = true_field(orbit, seconds, Rotation.from_rotvec(waves))
    data = {
        "tt2000": ("time", tt2000),
        "position": (("time", "axis"), position, {"units": "km", "frame": "itrf"}),
        "attitude": (("time", "quaternion"), quaternion, {"frame": "itrf"}),
        "vector": (("time", "axis"), field, {"orientation": (0.0, 0.0, 0.0, 1.0)}),
    }
    samples = add_geometry(xr.Dataset(data)).drop_vars("vector")
    samples = samples.assign(field=(("time", "axis"), field, {"units": "nT"}))
    return Flight(orbit, tt2000, samples.assign(channels_of_flight(orbit, samples, generator)))


def with_channels(flight: Flight, **channels: np.ndarray) -> Flight:
    """Return a flight some of whose channels have other values."""
    made = {name: ("time", values, flight.samples[name].attrs) for name, values in channels.items()}
    return replace(flight, samples=flight.samples.assign(made))


@dataclass(frozen=True)
class Readings:
    """What the two sensors read; nT.

    Attributes
    ----------
    vector : ndarray, shape (time, 3)
        Raw, the nine parameters in it.
    scalar : ndarray, shape (time,)
    """

    vector: np.ndarray
    scalar: np.ndarray


def read(
    flight: Flight,
    seed: int = 0,
    field: np.ndarray | float = 0.0,
    scalar: np.ndarray | float = 0.0,
    noise: float = NOISE_NT,
) -> Readings:
    """Return the readings of a flight; field (time, axis) at the vector sensor and scalar (time,) added."""
    generator = np.random.default_rng([77, seed])
    truth = flight["field"] + field
    cosines = np.cos(np.deg2rad(TRUE_NINE[3:6]))
    z = truth[:, 2] / TRUE_NINE[2]
    y = (truth[:, 1] - cosines[2] * z) / TRUE_NINE[1]
    x = (truth[:, 0] - cosines[0] * y - cosines[1] * z) / TRUE_NINE[0]
    raw = np.stack([x, y, z], axis=1) + TRUE_NINE[6:]
    total = np.linalg.norm(flight["field"], axis=1) + scalar
    return Readings(raw, total + generator.normal(0, noise, total.size))


@dataclass(frozen=True)
class Case:
    """Everything a search needs of a flight: library, evidence with several residuals, series."""

    flight: Flight
    mission: Mission
    model: Model
    library: Library
    rows: DesignRows
    residuals: np.ndarray
    raw: GramArrays
    white: GramArrays
    told: Mapping[str, ChannelSummary]

    def search(
        self, residual: int = 0, without: Sequence[str] = (), interval_days: int = 15, **rules: float
    ) -> Search:
        """Return a search of one residual; candidates of some mechanisms may be kept from it."""
        library = replace(
            self.library,
            terms=dict(self.library.terms),
            candidates=[one for one in self.library.candidates if one.mechanism not in without],
            unscorable=list(self.library.unscorable),
        )
        return Search.begin(
            alone(self.raw, residual),
            alone(self.white, residual),
            library,
            groups_of(self.raw, interval_days * DAY),
            groups_of(self.raw, DAY),
            Rules(**rules),
            time_variable=carriers_of(library),
        )

    def material(self, residual: int = 0) -> DiagnosisData:
        """Return what a verdict needs beside the search."""
        rows = replace(self.rows, residual=self.residuals[:, :, residual])
        features = features_of(rows, [*self.told, *GEOMETRY])
        stamps, values = thin_rows(rows, features, 1)
        edges = [*self.raw.start.tolist(), int(self.raw.end[-1])]
        packed = pack_blocks(stamps, values, edges, int(DAY // (STEP_S * SECOND)) + 2)
        good = rows.weight > 0
        sums = {
            "count": float(good.sum()),
            "square": float(np.sum(rows.residual[good] ** 2)),
            "inside": 0.0,
            "spikes": 0.0,
        }
        floor = NoiseFloor(NOISE_NT, 0.98 * NOISE_NT, 1.02 * NOISE_NT, int(good.sum()))
        series = Series.of(packed, self.raw.start, features)
        return DiagnosisData(
            mission=self.mission,
            model=self.model,
            linearised=self.model,
            series=series,
            sums=sums,
            cadence_s=STEP_S,
            floor=floor,
        )

    def diagnose(self, residual: int = 0, without: Sequence[str] = (), **rules: float) -> Diagnosis:
        """Return the diagnosis of one residual."""
        return run_search(self.search(residual, without, **rules), self.material(residual))[0]


def alone(evidence: GramArrays, residual: int) -> GramArrays:
    """Return evidence with one of its residuals, as a pass over an archive makes it."""
    own = len(evidence.names) - len(evidence.residuals)
    kept = np.array([*range(own), own + residual])
    return replace(
        evidence,
        names=(*evidence.names[:own], "residual"),
        gram=evidence.gram[:, kept[:, None], kept],
        scale=evidence.scale[kept],
    )


def groups_of(evidence: GramArrays, width: int) -> list[list[int]]:
    """Return the blocks of each span of a length; a short rest joins the span before."""
    place = (evidence.start - evidence.start[0]) // width
    groups = [np.flatnonzero(place == one).tolist() for one in np.unique(place)]
    if len(groups) > 1 and len(groups[-1]) < 0.5 * len(groups[0]):
        rest = groups.pop()
        groups[-1] += rest
    return groups


def carriers_of(library: Library) -> TimeVariableColumns:
    """Return the columns that may change in time."""

    def named(part: str) -> tuple[str, ...]:
        return tuple(name for name in library.columns if part in name)

    return TimeVariableColumns(
        named("vector_sensor.offset"),
        named("vector_sensor.scale_factor"),
        named("time_shift.seconds"),
        named("scalar_bias.bias"),
        named("vector_sensor.misalignment"),
    )


def mission_and_model(orbit: Orbit = POLAR) -> tuple[Mission, Model]:
    """Return the mission of an orbit and its model."""
    mission = Mission.parse(MISSION_YAML.replace("ORBIT", f"{orbit.period_s:.0f}"))
    return mission, Model.parse(MODEL_YAML, mission)


def linearised(model: Model, readings: Readings) -> tuple[Model, tuple[Term, ...]]:
    """Return the model at its fitted nine parameters, held constant, and their terms."""
    (entry,) = model.effects
    timed = [entry.parameters[part] for part in PARAMETER_GROUPS]
    sigma = np.concatenate([one.sigma[:, 0] for one in timed])
    prior = ParameterPrior(np.concatenate([one.value[:, 0] for one in timed]), sigma)
    good = np.ones(readings.scalar.size, dtype=bool)
    value = fit_block(readings.vector, np.zeros((1, 3)), readings.scalar, good, prior).value
    fixed = {
        part: replace(
            one,
            time="constant",
            value=value[3 * at : 3 * at + 3][:, None],
            sigma=one.sigma[:, :1],
            table=None,
        )
        for at, (part, one) in enumerate(zip(PARAMETER_GROUPS, timed, strict=True))
    }
    entry = entry.with_parameters(fixed)
    terms = tuple(
        Term(entry.name, entry, (part,), tuple(sigma[3 * at : 3 * at + 3]))
        for at, part in enumerate(PARAMETER_GROUPS)
    )
    return replace(model, effects=(entry,)), terms


def samples_of(flight: Flight, readings: Readings) -> xr.Dataset:
    """Return the readings as aligned raw samples."""
    return xr.Dataset(
        {
            "tt2000": ("time", flight.tt2000),
            "vector": (("time", "axis"), readings.vector, {"units": "nT"}),
            "scalar": ("time", readings.scalar, {"units": "nT"}),
            "flag": ("time", np.zeros(flight.tt2000.size, dtype=np.uint32)),
        }
    )


def told_of(flight: Flight, names: Sequence[str]) -> dict[str, ChannelSummary]:
    """Return means and ranges of channels."""
    out = {}
    for name in names:
        low, high = np.quantile(flight[name], [0.05, 0.95])
        kind = {"temperature": "temperature", "current": "current"}[name.split("_")[1]]
        out[name] = ChannelSummary(float(flight[name].mean()), float(high - low), 0.0, kind)
    return out


def placebos_of(flight: Flight, names: Sequence[str]) -> dict[str, float]:
    """Return shifts of one placebo a channel: days and part of an orbit, seconds."""
    generator = np.random.default_rng(20_000)
    period = flight.orbit.period_s
    return {
        f"{name}~1": float(generator.integers(1, 3) * 86_400 + generator.uniform(0.15, 0.85) * period)
        for name in names
    }


def derived_on(flight: Flight, name: str, shifts: Mapping[str, float]) -> np.ndarray:
    """Return a channel by its derived name, placebos rolled around the span's end."""
    if name in flight.samples:
        return flight[name]
    factors = []
    for part in parse_channel(name).parts:
        values = flight[part.channel]
        if part.placebo:
            values = np.roll(values, round(shifts[f"{part.channel}~{part.placebo}"] / STEP_S))
        factors.append(part.of(values, STEP_S))
    return channel_product(factors)


def case_of(
    flight: Flight,
    hidden: Sequence[Readings],
    noises: np.ndarray | None = None,
    block_days: float = 1.0,
    every: int = 1,
    channels: Sequence[str] = CHANNELS,
    held: Sequence[Mapping[str, object]] = (),
) -> Case:
    """Return the case of a flight: a residual for each of the readings, then some of noise alone.

    The columns are those of the first readings; hidden effects are too small to change them.

    Parameters
    ----------
    noises : ndarray, shape (time, residual), optional
        nT; they replace the residual.
    every : int
        Rows of the evidence: one of so many samples.
    held : sequence of mapping
        Effects that the model holds, entries of its file; what they make is in no residual.
    """
    mission, model = mission_and_model(flight.orbit)
    model, base = linearised(model, hidden[0])
    plain, sensors = model, sensors_of(mission)
    for entry in held:
        model = model.add(make_effect(entry, sensors, mission=mission))
    told, shifts = told_of(flight, channels), placebos_of(flight, channels)
    geometry = [name for name in GEOMETRY if name in flight.samples]
    seen = (2.0 * STEP_S, 0.5 * STEP_S * flight.tt2000.size)
    library = make_library(mission, model, told, geometry, shifts, base, seen)
    derived = {name: derived_on(flight, name, shifts) for name in library.channels if name}
    rows = rows_on_bins(flight, plain, hidden[0], derived)
    more = [rows_of(plain, samples_of(flight, one)).residual[:, :, None] for one in hidden[1:]]
    if noises is not None:
        more.append(noises[:, None, :])
    residuals = np.concatenate([rows.residual[:, :, None], *more], axis=2)
    raw, white = evidence_of(library, rows, residuals, block_days, every)
    return Case(flight, mission, model, library, rows, residuals, raw, white, told)


def rows_on_bins(
    flight: Flight, model: Model, readings: Readings, channels: Mapping[str, np.ndarray]
) -> DesignRows:
    """Return the rows of readings; one sample a bin."""
    samples = samples_of(flight, readings)
    half = int(STEP_S * SECOND) // 2
    edges = np.append(flight.tt2000 - half, flight.tt2000[-1] + half)
    variables = {name: flight.samples[name].variable for name in GEOMETRY if name in flight.samples}
    for name, values in channels.items():
        if name not in variables:
            base = parse_channel(name).parts[0].channel
            variables[name] = xr.Variable("time", values, {"units": flight.samples[base].attrs["units"]})
    return coarsen(
        samples, rows_of(model, samples), edges, variables, sensor_matrices(model, int(flight.tt2000[0]))
    )[0]


def evidence_of(
    library: Library, rows: DesignRows, residuals: np.ndarray, block_days: float = 1.0, every: int = 1
) -> tuple[GramArrays, GramArrays]:
    """Return raw and prewhitened evidence, a block a day or another span."""
    columns, weight = design_matrix(library.all_terms, rows)[::every], rows.weight[::every]
    residuals, stamps = residuals[::every], rows.samples["tt2000"].values[::every]
    first, width = int(stamps[0]) - int(STEP_S * SECOND) // 2, int(block_days * DAY)
    span = int(rows.weight.size * STEP_S * SECOND)
    cuts = [first + k * width for k in range(round(span / width) + 1)]
    parts = parts_of(stamps, cuts)
    count = residuals.shape[2]
    names = (*library.columns, *(f"residual~{k}" if k else "residual" for k in range(count)))
    scale = np.array([one for term in library.all_terms for one in term.scale] + [1.0] * count)
    rows_in = np.array([weight[part].sum() * residuals.shape[1] for part in parts])
    common = (np.array(cuts[:-1]), np.array(cuts[1:]), rows_in, scale)
    white = [prewhiten(values, weight, stamps, 600.0) for values in (columns, residuals)]
    return (
        GramArrays(names, gram_of(columns, residuals, weight, parts), *common),
        GramArrays(names, gram_of(*white, weight, parts), *common),
    )
