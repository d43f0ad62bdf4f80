"""Coverage of a spinning sensor: how often the truth lies within one and two sigmas of its table and product.

Each seed is a short mission of its own: all twelve parameters are drawn from what the ground states of them,
hours of a THEMIS-like orbit are read by a sensor that has them (`inflight.simulate`), and days and table are
made as ``inflight reprocess`` makes them. Three things are counted: errors of the parameters in their
`sigma`; errors for given values of the four that leave no tone, in `conditional_sigma`; and errors of the
corrected field, free of the reading's own noise, in the uncertainty of the product.

``make coverage`` prints the table.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from benchmarks.coverage import intervals
from inflight.arrays import Floats
from inflight.mission import Mission
from inflight.model import Model
from inflight.simulate.spinning import ambient, sensor
from inflight.simulate.spinning.attitude import payload_axes, to_payload
from inflight.simulate.spinning.settings import SPACECRAFT_PRESETS, STANDARD, SpinningParameters
from inflight.spin import (
    HELD,
    PARAMETER_NAMES,
    SPIN_RELATED,
    CalibrationParameters,
    despin,
    field_uncertainty,
    fit_held,
    held_slopes,
    respin,
    sums_near_earth,
)
from inflight.tasks.pipelines.intercalibration.tables import bending_day, bending_table
from inflight.tasks.pipelines.spin.day import SpinRecord, estimates_of, ground_of, require_spinning
from inflight.tasks.pipelines.spin.tables import spin_table
from inflight.time import SECOND, Int64, day_bounds

_MISSIONS = Path(__file__).parents[1] / "missions"
_FIRST = np.datetime64("2012-03-01", "D")
#: Each day has two stretches of so many hours: hours after perigee, and at apogee. Minutes between them.
_HOURS, _AFTER_PERIGEE_H, _PAUSE_S = 1.5, 3.0, 600.0
_EIGHT = [PARAMETER_NAMES.index(name) for name in SPIN_RELATED]
_HELD = [PARAMETER_NAMES.index(name) for name in HELD]
#: Samples of a day, one of each stretch, at which the product is looked at.
_LOOKED_AT = (0.2, 0.8)
#: Bends of a boom are drawn from so much, rad.
_BEND = 0.003
#: What a field model lacks, nT, and how near the Earth it is looked at, km.
_EXTERNAL_NT, _NEAR_KM = 20.0, 3.0 * ambient.EARTH_RADIUS_KM


@dataclass(frozen=True, kw_only=True)
class SpinCoverage:
    """Errors of one quantity in stated sigmas, one a seed; (seed,)."""

    name: str
    of: str
    pulls: Floats

    @property
    def within(self) -> tuple[float, float]:
        """Shares within one and two sigmas."""
        size = np.abs(self.pulls)
        return float(np.mean(size < 1.0)), float(np.mean(size < 2.0))

    def is_right(self, chance: float = 0.01) -> bool:
        """Return whether both shares lie where right ones do, all but a chance."""
        both = zip(self.within, intervals(self.pulls.size, chance), strict=True)
        return all(low <= share <= high for share, (low, high) in both)


@dataclass(frozen=True)
class _Stretch:
    """A day's noiseless field in turning axes, phase and stamps; (time, 3) and (time,)."""

    field: Floats
    phase: Floats
    stamps: Int64


def _stretch(seed: int, number: int, parameters: SpinningParameters) -> _Stretch:
    axis = 0.5 * (parameters.perigee + parameters.apogee) * ambient.EARTH_RADIUS_KM
    orbit = 2.0 * np.pi * np.sqrt(axis**3 / 398_600.4)
    one = np.arange(round(_HOURS * 3600.0 / parameters.cadence)) * parameters.cadence
    fields = []
    for part, after in enumerate((_AFTER_PERIGEE_H * 3600.0, 0.5 * orbit)):
        seconds = (1000 * seed + number) * orbit + after + one
        place = ambient.position(seconds, parameters)
        fields.append(ambient.field(seconds, place, 2 * seed + part, number, parameters))
    seconds = np.concatenate([one, one + one[-1] + _PAUSE_S])
    phase = 2.0 * np.pi * seconds / parameters.spin_period
    stamps = day_bounds(_FIRST + number)[0] + np.rint(seconds * SECOND).astype(np.int64)
    return _Stretch(sensor.apparent(np.concatenate(fields), phase), phase, stamps)


def spin_coverage(seeds: int = 200, days: int = 2) -> list[SpinCoverage]:
    """Return the counts of every parameter and component over missions of some days."""
    mission = Mission.parse((_MISSIONS / "themis.yaml").read_text(encoding="utf-8"))
    model = Model.parse((_MISSIONS / "models/themis-preflight.yaml").read_text(encoding="utf-8"), mission)
    names = [
        *(("table", name) for name in SPIN_RELATED),
        *(("tones alone", name) for name in SPIN_RELATED),
        *(("product", f"field[{axis}]") for axis in "xyz"),
    ]
    pulls = np.array([_pulls(seed, days, mission, model) for seed in range(seeds)])
    return [SpinCoverage(name=name, of=of, pulls=one) for (of, name), one in zip(names, pulls.T, strict=True)]


def _pulls(seed: int, days: int, mission: Mission, model: Model) -> Floats:
    """Return the errors of one mission in stated sigmas: of table, tones and product; (19,)."""
    entry, comparison = require_spinning(model), mission.comparisons["main"]
    assert comparison.kind == "spin"
    ground, sigma = ground_of(entry, day_bounds(_FIRST)[0])
    generator = np.random.default_rng([seed, 1])
    truth = ground.values() + generator.normal(size=12) * [sigma[name] for name in PARAMETER_NAMES]
    drawn = _with_values(SPACECRAFT_PRESETS["themis"], truth)
    rows = sensor.projection(drawn, frozenset(STANDARD), np.zeros(2))
    records: list[xr.Dataset] = []
    for number in range(days):
        one = _stretch(seed, number, drawn)
        plain = one.field @ rows.T + np.asarray(drawn.offset)
        noisy = plain + drawn.noise * generator.normal(size=plain.shape)
        record = SpinRecord(noisy, one.phase, one.stamps, np.ones(one.phase.size, dtype=np.bool_))
        known = {name: sigma[name] for name in SPIN_RELATED}
        records.append(estimates_of(record.estimate(comparison, ground, known), day_bounds(_FIRST + number)))
    table = spin_table(records, model, [_FIRST, _FIRST + days], "window").isel(interval=0)
    value = table["value"].values
    error = value - truth
    in_use = CalibrationParameters.from_values(value)
    alone = error[_EIGHT] - held_slopes(in_use) @ error[_HELD]
    at = [int(part * one.phase.size) for part in _LOOKED_AT]
    off = in_use.correct(plain[at]) - one.field[at]
    uncertainty = field_uncertainty(plain[at], in_use, table["covariance"].values)
    # Of each component at one of the two places, in turn: both share the parameters' errors.
    product = (off / uncertainty)[seed % len(at)]
    errors = error[_EIGHT] / table["sigma"].values[_EIGHT], alone / table["conditional_sigma"].values[_EIGHT]
    return np.concatenate([*errors, product])


def bending_coverage(seeds: int = 40, days: int = 2) -> list[SpinCoverage]:
    """Return the counts of the bend between two spinning sensors on a boom, day by day.

    Each is calibrated by its own tones. Errors of the rotation on the ground are part of the bend as it is
    defined, and none are drawn.
    """
    mission = Mission.parse((_MISSIONS / "themis.yaml").read_text(encoding="utf-8"))
    model = Model.parse((_MISSIONS / "models/themis-preflight.yaml").read_text(encoding="utf-8"), mission)
    pulls = np.array([_pulls_of_bends(seed, days, mission, model) for seed in range(seeds)])
    return [
        SpinCoverage(name=f"bend, day {day + 1}", of="table", pulls=one) for day, one in enumerate(pulls.T)
    ]


def _pulls_of_bends(seed: int, days: int, mission: Mission, model: Model) -> Floats:
    """Return the errors of each day's bend in its sigma; (day,)."""
    entry, comparison = require_spinning(model), mission.comparisons["main"]
    assert comparison.kind == "spin"
    ground, sigma = ground_of(entry, day_bounds(_FIRST)[0])
    known = {name: sigma[name] for name in SPIN_RELATED}
    generator = np.random.default_rng([seed, 3])
    bends = _BEND * generator.normal(size=days)
    stretches = [_stretch(seed, number, SPACECRAFT_PRESETS["themis"]) for number in range(days)]
    products: list[list[xr.Dataset]] = []
    for bent in (np.zeros(days), bends):
        drawn = ground.spin_related() + generator.normal(size=len(SPIN_RELATED)) * [
            known[name] for name in SPIN_RELATED
        ]
        sensor_is = ground.changed(dict(zip(SPIN_RELATED, drawn.tolist(), strict=True)))
        noise, readings, records = SPACECRAFT_PRESETS["themis"].noise, [], []
        for number, (one, bend) in enumerate(zip(stretches, bent, strict=True)):
            turned = respin(despin(one.field, one.phase), one.phase + bend)
            plain = sensor_is.disturb(turned)
            readings.append(plain + noise * generator.normal(size=plain.shape))
            good = np.ones(one.phase.size, dtype=np.bool_)
            record = SpinRecord(readings[-1], one.phase, one.stamps, good)
            records.append(
                estimates_of(record.estimate(comparison, ground, known), day_bounds(_FIRST + number))
            )
        table = spin_table(records, model, [_FIRST, _FIRST + days], "window").isel(interval=0)
        in_use = CalibrationParameters.from_values(table["value"].values)
        products.append(
            [_product(one, in_use.correct(own)) for one, own in zip(stretches, readings, strict=True)]
        )
    each = [bending_day(pair, _FIRST + number)[0] for number, pair in enumerate(zip(*products, strict=True))]
    found = bending_table(each, [])
    return np.asarray((found["value"].values[:, 0] - bends) / found["sigma"].values[:, 0])


def _product(one: _Stretch, field: Floats) -> xr.Dataset:
    """Return what of a day's product the bend is made from."""
    return xr.Dataset(
        {
            "tt2000": ("time", one.stamps),
            "field_sensor": (("time", "axis"), field),
            "spin_phase": ("time", np.mod(one.phase, 2.0 * np.pi)),
            "flag": ("time", np.zeros(one.phase.size, dtype=np.uint32)),
        }
    )


def perigee_coverage(seeds: int = 40, passages: int = 3) -> list[SpinCoverage]:
    """Return the counts of what a field model tells of `HELD` in some passages of perigee.

    A field that the model lacks and that stays is drawn from the 20 nT that are stated; the simulated field
    fluctuates about the IGRF besides.
    """
    mission = Mission.parse((_MISSIONS / "themis.yaml").read_text(encoding="utf-8"))
    model = Model.parse((_MISSIONS / "models/themis-preflight.yaml").read_text(encoding="utf-8"), mission)
    pulls = np.array([_pulls_at_perigee(seed, passages, model) for seed in range(seeds)])
    of = f"{passages} passages"
    return [SpinCoverage(name=name, of=of, pulls=one) for name, one in zip(HELD, pulls.T, strict=True)]


def _pulls_at_perigee(seed: int, passages: int, model: Model) -> Floats:
    """Return the errors of `HELD` of one mission in stated sigmas; (4,)."""
    ground, sigma = ground_of(require_spinning(model), day_bounds(_FIRST)[0])
    generator = np.random.default_rng([seed, 2])
    known = np.array([sigma[name] for name in HELD])
    truth = known * generator.normal(size=len(HELD))
    # The sensor that reads so, the eight as on the ground but for what goes with the four.
    change = dict(zip(HELD, ground.values()[_HELD] + truth, strict=True))
    moved = ground.spin_related() + held_slopes(ground) @ truth
    sensor_is = ground.changed(change | dict(zip(SPIN_RELATED, moved.tolist(), strict=True)))
    parameters = SPACECRAFT_PRESETS["themis"].changed({"apogee": 8.0, "main_field": True})
    axis = 0.5 * (parameters.perigee + parameters.apogee) * ambient.EARTH_RADIUS_KM
    orbit = 2.0 * np.pi * np.sqrt(axis**3 / 398_600.4)
    stays, sums = _EXTERNAL_NT * generator.normal(size=3), []
    first = np.ceil(day_bounds(_FIRST)[0] / SECOND / orbit)
    for number in range(passages):
        # Turns of the spin are left out: D commutes with them.
        seconds = (first + number) * orbit + np.arange(-5400.0, 5400.0, 30.0)
        place = ambient.position(seconds, parameters)
        seconds, place = (one[np.linalg.norm(place, axis=1) < _NEAR_KM] for one in (seconds, place))
        field = ambient.field(seconds, place, seed, number, parameters) + stays
        earth = to_payload(ambient.main_field(seconds, parameters), payload_axes(place, parameters))
        stamps = np.rint(seconds * SECOND).astype(np.int64)
        despun = ground.correct(sensor_is.disturb(field))
        sums.append(sums_near_earth(despun, earth, stamps, ground))
    found = fit_held(np.concatenate(sums), np.zeros(len(HELD)), known, _EXTERNAL_NT)
    assert found is not None
    return (found.value - truth) / np.sqrt(np.diag(found.covariance))


def _with_values(parameters: SpinningParameters, values: Floats) -> SpinningParameters:
    """Return a sensor with twelve values in the order of `PARAMETER_NAMES`."""
    one = CalibrationParameters.from_values(values)
    return parameters.changed(dict(vars(one)))


def table(found: list[SpinCoverage]) -> Iterator[str]:
    """Yield the lines of the table, as Markdown: shares within one and two sigmas, rms errors in sigmas."""
    yield "| parameter | error of | 1 sigma | 2 sigma | rms |"
    yield "|---|---|---|---|---|"
    for one in found:
        shares = " | ".join(f"{share:.1%}" for share in one.within)
        rms = float(np.sqrt(np.mean(one.pulls**2)))
        yield f"| `{one.name}` | {one.of} | {shares} | {rms:.2f}{'' if one.is_right() else ' *'} |"
    low_high = ", ".join(f"{low:.1%} to {high:.1%}" for low, high in intervals(found[0].pulls.size, 0.01))
    yield ""
    yield f"`*`: outside the interval that holds 99 of 100 right counts of {found[0].pulls.size}: {low_high}."
