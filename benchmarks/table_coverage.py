"""Coverage of tables and products: short missions through every pipeline, errors in stated sigmas.

Each seed is a mission of its own: what the ground states with a sigma is drawn anew (or, without an absolute
instrument, the offset), days are simulated, ``reprocess`` makes tables and products, and both are held
against the truth. A spinning sensor has a table of its own (`benchmarks.spin_coverage`), values that a
search gives an effect another (`benchmarks.coverage`).

``make coverage`` prints the table; docs/reference/coverage.md shows it.
"""

from __future__ import annotations

import datetime as dt
import json
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import yaml

from benchmarks.archive import simulated_workspace
from benchmarks.coverage import intervals
from inflight.arrays import Floats
from inflight.calibration import mounting
from inflight.catalog import Catalog, Workspace, shipped_missions
from inflight.mission_fit import day_statistics, fit_spread_law, instrument_spectra, torquer_lines
from inflight.simulate import MissionSettings, SimulationSettings, simulate_day
from inflight.simulate.dual import DualSettings, simulate_dual_day
from inflight.simulate.grid import Sampling
from inflight.simulate.stray import coefficients
from inflight.simulate.torquers import torquer_currents
from inflight.tasks.archive import ingest, simulate
from inflight.tasks.pipelines import ReprocessSettings, reprocess
from inflight.tasks.pipelines.base import newest_table
from inflight.time import SECOND, day_bounds

#: Days of a mission, s between samples, and moments of a day at which its product is looked at.
_DAYS, _CADENCE, _MOMENTS = 3, 10, 5
#: Days of a mission whose tables have days as clusters, s between samples that hold the torquers' band, and
#: nT/A that the solar array's field is stated to.
_TABLE_DAYS, _TORQUER_CADENCE, _SOLAR_SIGMA = 7, 5, 0.05
#: What is wrong with the fluxgate and the scalar sensor; all else is left out, of the model, too.
_WRONG = ("misalignment", "offset", "scalar_bias", "time_shift")
#: What a model of the main field lacks and what stays, nT along each Earth-fixed axis: drawn, and stated.
_EXTERNAL_NT = 5.0
#: Units that switch, on the boom; and what wanders there.
_UNITS = ("transmitter", "spectrometer", "camera", "survival_heater")
_DRIFTS = ("offset_drift", "thermal_drift")
#: An instrument beside the two that knows the ambient field for a day.
_MONITOR = """\
  monitor:
    role: vector
    cadence: 10 s
    files: {pattern: "mon/vex_mon_{day:%Y%m%d}_v*.cdf", reader: cdf, time: Epoch}
    channels:
      field: {variable: B, unit: nT, axes: [x, y, z], frame: spacecraft}
"""

#: Errors in stated sigmas, by what they are of; each (value,).
Pulls = dict[str, Floats]


@dataclass(frozen=True, kw_only=True)
class TableCoverage:
    """Errors of one table or product of a pipeline in stated sigmas, mission by mission; (seed, value).

    NaN where a mission gave no value.
    """

    pipeline: str
    of: str
    pulls: Floats

    @property
    def within(self) -> tuple[float, float]:
        """Shares within one and two sigmas, of the values that there are."""
        there = np.abs(self.pulls[np.isfinite(self.pulls)])
        return float(np.mean(there < 1.0)), float(np.mean(there < 2.0))

    def is_right(self) -> bool:
        """Return whether both shares lie where right ones do, all but one in a hundred; missions count."""
        shares = zip(self.within, intervals(len(self.pulls), 0.01), strict=True)
        return all(low <= share <= high for share, (low, high) in shares)


def scalar_and_mission(seed: int, folder: Path) -> dict[str, Pulls]:
    """Return the errors of nine parameters and of the field, beside a scalar sensor."""
    generator = np.random.default_rng([seed, 1])
    settings = _champ(
        seed,
        {*_WRONG, "temperature", "temperature_lag", "external_field"},
        include=("scalar_bias",),
        # As the model says: 0 +- 0.2 nT, 14.5 +- 2 ms, and coefficients of the coil, ppm/K.
        overrides={
            "scalar_bias": float(generator.normal(0.0, 0.2)),
            "time_shift": float(generator.normal(0.0145, 0.002)),
            "temperature_linear": (1e-6 * generator.normal([29.9, 30.1, 30.7], 0.4)).tolist(),
        },
    )
    cat = simulated_workspace(folder, _DAYS, settings=settings, workers=1)
    kept = ("vector_sensor", "temperature", "scalar_bias", "time_shift")
    _keep_effects(folder / "models" / "champ-preflight.yaml", kept)
    truth = {day: simulate_day(settings, day).truth for day in settings.day_list}
    # Without ageing, all days have the same nine.
    nine = np.concatenate(list(json.loads(truth[settings.day_list[0]].attrs["nine_parameters"]).values()))
    out: dict[str, Pulls] = {}
    for tag, table in (("scalar", "window"), ("mission", "continuous")):
        _reprocess(cat, table=table, trend="constant")
        names = ("daily", "window", "span") if tag == "scalar" else ("continuous",)
        out[tag] = {f"{name} table": _table_pulls(cat, f"main-{name}", nine) for name in names}
        out[tag]["product"] = _field_pulls(cat, "l2/field", truth)
    return out


def field_model(seed: int, folder: Path) -> dict[str, Pulls]:
    """Return the errors of what a sensor is, and of the field, against a model of the main field."""
    generator = np.random.default_rng([seed, 2])
    drawn = {"offset": generator.normal(0.0, 30.0, 3), "steady_field": generator.normal(0.0, _EXTERNAL_NT, 3)}
    wrong = {"misalignment", "offset", "external_field"}
    settings = _champ(seed, wrong, overrides={name: one.tolist() for name, one in drawn.items()})
    cat = simulated_workspace(folder, _DAYS, settings=settings, workers=1)
    path = folder / "mission.yaml"
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    kept = [line for line in lines if not line.startswith(("comparisons:", "preflight:"))]
    comparison = f"comparisons: {{main: {{kind: field_model, vector: fgm, external: {_EXTERNAL_NT}}}}}\n"
    path.write_text("".join([*kept, comparison]), encoding="utf-8")
    _reprocess(cat)
    truth = {day: simulate_day(settings, day).truth for day in settings.day_list}
    nine = json.loads(truth[settings.day_list[0]].attrs["nine_parameters"])
    # Scale factors, angles, the sensor's axes on the body, offsets.
    expected = np.concatenate([nine["scale_factor"], nine["misalignment"], np.zeros(3), nine["offset"]])
    pulls: Pulls = {}
    for name in ("daily", "window", "span"):
        table = newest_table(cat, f"main-{name}")
        rows = []
        for row in range(table.sizes["interval"] if table is not None else 0):
            value, sigma = mounting(*(table[part].values[row] for part in ("value", "covariance")))
            rows.append((np.array(list(value.values())) - expected) / list(sigma.values()))
        pulls[f"{name} table"] = np.ravel(rows)
    pulls["product"] = _field_pulls(cat, "l2/field", truth)
    return {"field_model": pulls}


def zero_level(seed: int, folder: Path) -> dict[str, Pulls]:
    """Return the errors of an offset from the wind alone, and of the field without it."""
    offset = np.random.default_rng([seed, 3]).uniform(-8.0, 8.0, 3)
    settings = DualSettings(
        days=_DAYS,
        seed=seed,
        without=(*_UNITS, *_DRIFTS),
        overrides={"cadence": float(_CADENCE), "offset_outboard": offset.tolist()},
    )
    comparison = "  zero: {kind: zero_level, vector: outboard, step: 6 h}\nrelease:\n"
    cat = _boom(folder, settings, ("release:\n", comparison))
    _reprocess(cat, comparison="zero")
    truth = {day: simulate_dual_day(settings, day).truth for day in settings.day_list}
    names = ("daily", "window", "span", "steps")
    pulls = {f"{name} table": _table_pulls(cat, f"zero-{name}", offset) for name in names}
    return {"zero_level": {**pulls, "product": _field_pulls(cat, "l2/field-zero", truth)}}


def states(seed: int, folder: Path) -> dict[str, Pulls]:
    """Return the errors of the field of two sensors, the ambient field known for the first day."""
    settings = DualSettings(
        days=2,
        seed=seed,
        without=(*_DRIFTS, "offset"),
        include=("monitor",),
        overrides={"cadence": float(_CADENCE)},
    )
    known = ("    outboard: outboard\n", "    outboard: outboard\n    ambient: monitor\n")
    cat = _boom(folder, settings, known, ("comparisons:\n", f"{_MONITOR}comparisons:\n"))
    _reprocess(cat)
    truth = {day: simulate_dual_day(settings, day).truth for day in settings.day_list}
    return {"states": {"product": _field_pulls(cat, "l2/field", truth)}}


def relation(seed: int, folder: Path) -> dict[str, Pulls]:
    """Return the errors of how two sensors stand to each other, each calibrated beside the scalar sensor."""
    turn = np.random.default_rng([seed, 4]).normal(0.0, 0.05, 3)
    wrong = {"misalignment", "offset", "external_field"}
    settings = _champ(seed, wrong, overrides={"second_rotation": turn.tolist()}, second_fluxgate=True)
    text = shipped_missions()["champ-two-fluxgates"].read_text(encoding="utf-8")
    cat = _workspace(folder, settings, text.replace("cadence: 1 s", f"cadence: {_CADENCE} s"))
    for name in ("champ-preflight", "champ-second-preflight"):
        _keep_effects(folder / "models" / f"{name}.yaml", ("vector_sensor",))
    for comparison in ("main", "second", "between"):
        _reprocess(cat, comparison=comparison)
    # Both sensors are right where they are calibrated: turned against each other, and no more.
    expected = np.concatenate([turn, np.zeros(9)])
    names = {"relation table": "between-relation", "daily table": "between-relation-daily"}
    pulls = {of: _table_pulls(cat, name, expected) for of, name in names.items()}
    # White noise and rounding of each sensor; a mean holds so many readings as `corners` averages.
    table = newest_table(cat, "between-corners")
    readings = float(table.attrs["mean_s"]) / _CADENCE if table is not None else 1.0
    noise = np.array([settings.vector_noise, settings.vector_noise, settings.scalar_noise])
    variance = (noise**2 + settings.resolution**2 / 12.0) / readings
    return {"relation": {**pulls, "corners": _table_pulls(cat, "between-corners", variance)}}


def mission_tables(seed: int, folder: Path) -> dict[str, Pulls]:
    """Return the errors of what the fit of all days tells beside its parameters.

    All panels of the solar array have one field, drawn from what the model states, and no field switches with
    day and night: a current that steps with the light is not told from it.
    """
    generator = np.random.default_rng([seed, 5])
    solar = generator.normal(0.0, _SOLAR_SIGMA, 3).tolist()
    settings = _champ(
        seed,
        {*_WRONG, "temperature", "temperature_lag", "external_field", "torquer", "solar_array"},
        days=_TABLE_DAYS,
        cadence=_TORQUER_CADENCE,
        include=("scalar_bias",),
        overrides={
            "scalar_bias": float(generator.normal(0.0, 0.2)),
            "time_shift": float(generator.normal(0.0145, 0.002)),
            "panel_fields": [solar] * 3,
            "panel_positions": [[0.0, 0.0, 0.0]] * 3,
        },
    )
    cat = simulated_workspace(folder, _TABLE_DAYS, settings=settings, workers=1)
    path = folder / "models" / "champ-preflight.yaml"
    _keep_effects(path, ("vector_sensor", "temperature", "scalar_bias", "time_shift", "torquer"))
    model = yaml.safe_load(path.read_text(encoding="utf-8"))
    coefficient = {"unit": "nT/A", "value": [0.0, 0.0, 0.0], "sigma": [_SOLAR_SIGMA] * 3}
    array = {"effect": "channel_field", "sensor": "fgm", "channel": "solar_current"}
    model["effects"].append({**array, "coefficient": coefficient})
    path.write_text(yaml.safe_dump(model, sort_keys=False), encoding="utf-8")
    _reprocess(cat, table="continuous", trend="constant")
    # The model has the vector sensor's matrix right, and states another one at the scalar sensor.
    parameters = settings.parameters
    stated = next(one for one in model["effects"] if one.get("name") == "torquer_ovm")["matrix"]["value"]
    torquer = np.reshape(stated, (3, 3)) - np.array(parameters.torquer_scalar)
    at_vector, at_scalar = coefficients(parameters)["panel_left"]
    truth = {
        "current-steps": np.asarray(at_vector) - np.asarray(at_scalar),
        "torquer-band": torquer,
        "torquer-band-daily": torquer,
        "torquer-band-mean": torquer,
        "day-night": np.zeros(3),
        "day-night-series": np.zeros(12),
        "z-offset": np.zeros(1),
        "z-offset-slope": np.zeros(1),
    }
    pulls = {f"{name} table": _table_pulls(cat, f"main-{name}", one) for name, one in truth.items()}
    # A model of the panels has one to three of them.
    panels = _table_pulls(cat, "main-panels", truth["current-steps"])
    pulls["panels table"] = np.pad(panels, (0, 9 - panels.size), constant_values=np.nan)
    days = {day: simulate_day(settings, day).truth for day in settings.day_list}
    pulls |= _daily_pulls(cat, days, parameters.time_shift)
    pulls["torquer-lines table"] = _line_pulls(cat, settings, days, -torquer)
    pulls["z-offset law"] = _law_pulls(days, generator)
    lag = newest_table(cat, "main-coil-temperature")
    at = {} if lag is None else {name: float(lag[name].values[-1]) for name in ("value", "sigma")}
    pulls["coil-temperature table, lag"] = np.array(
        [(at["value"] - parameters.temperature_lag) / at["sigma"] if at else np.nan]
    )
    return {"tables": pulls}


def _daily_pulls(cat: Catalog, days: Mapping[np.datetime64, xr.Dataset], shift: float) -> dict[str, Floats]:
    """Return the errors of each day's nine parameters, time shift (s) and mean temperature of the coil."""
    nine = np.concatenate(list(json.loads(next(iter(days.values())).attrs["nine_parameters"]).values()))
    known = {
        "own-fit": nine,
        "daily-after": np.append(nine, shift),
        "day-night-daily": np.append(nine, shift),
    }
    pulls = {f"{name} table": _table_pulls(cat, f"main-{name}", one) for name, one in known.items()}
    means = newest_table(cat, "main-daily-temperature")
    assert means is not None
    warm = means.sel(channel="coil_temperature")
    # The coil follows its sensor by the lag, which a day's mean hardly shows.
    off = warm["value"].values - [float(one["T_EFF"].mean()) for one in days.values()]
    return {**pulls, "daily-temperature table": off / warm["sigma"].values}


def _line_pulls(
    cat: Catalog, settings: SimulationSettings, days: Mapping[np.datetime64, xr.Dataset], lacks: Floats
) -> Floats:
    """Return the errors of the lines' squares in the vector sensor, which has none, and in the scalar one.

    Parameters
    ----------
    lacks : ndarray, shape (3, 3)
        Matrix of the scalar sensor less that of the model, nT/A.
    """
    spectra = []
    for day, one in days.items():
        times = Sampling.of_span(*day_bounds(day), settings.cadence * SECOND)
        current = torquer_currents(times, settings.parameters, settings.seed, int(day.astype(np.int64)))
        along = one["FIELD"].values / one["STRENGTH"].values[:, None]
        line = np.einsum("ti,ij,tj->t", along, lacks, current)
        spectra.append(instrument_spectra(times.tt2000, line, line))
    true = [0.0, float(torquer_lines(spectra)["excess"].values[1])]
    found = newest_table(cat, "main-torquer-lines")
    assert found is not None
    return np.asarray((found["excess"].values - true) / found["excess_sigma"].values)


def _law_pulls(days: Mapping[np.datetime64, xr.Dataset], generator: np.random.Generator) -> Floats:
    """Return the errors of factor and noise of the law of the spread.

    No offset of the missions changes from day to day: some of 0.5 nT, known to 0.02 nT, are put into white
    noise of 0.06 nT on the orbit of their days.
    """
    offset, sigma, noise = generator.normal(0.0, 0.5, len(days)), 0.02, 0.06
    statistics = []
    for own, (day, one) in zip(offset, days.items(), strict=True):
        along = one["FIELD"].values / one["STRENGTH"].values[:, None]
        residual = own * along[:, 2] + noise * generator.normal(size=len(along))
        statistics.append(day_statistics(residual, along, *day_bounds(day)))
    joined = xr.concat(statistics, "interval")
    known = offset + sigma * generator.normal(size=offset.size)
    law = fit_spread_law(joined, known, np.full(offset.size, sigma)).table()
    true = [float(joined["geometry"].mean()), noise**2]
    return np.asarray((law["value"].values - true) / law["sigma"].values)


#: Pipelines by what makes their missions.
CASES: Mapping[tuple[str, ...], Callable[[int, Path], dict[str, Pulls]]] = {
    ("scalar", "mission"): scalar_and_mission,
    ("states",): states,
    ("zero_level",): zero_level,
    ("field_model",): field_model,
    ("relation",): relation,
    ("tables",): mission_tables,
}


def table_coverage(seeds: int = 12, only: str = "") -> Iterator[TableCoverage]:
    """Yield the errors of every table and product of the pipelines, pipeline by pipeline.

    Parameters
    ----------
    seeds : int
        Missions of each pipeline.
    only : str
        Pipelines whose tag holds this.
    """
    for tags, make in CASES.items():
        if not any(only in tag for tag in tags):
            continue
        missions = []
        for seed in range(seeds):
            with tempfile.TemporaryDirectory() as scratch:
                missions.append(make(seed, Path(scratch) / "w"))
        for tag in tags:
            for of in missions[0][tag]:
                pulls = np.array([one[tag][of] for one in missions])
                yield TableCoverage(pipeline=tag, of=of, pulls=pulls)


def _champ(seed: int, kept: set[str], **more: Any) -> SimulationSettings:
    """Return the settings of a low orbit in which some of the usual effects are there and no other."""
    standard = set(SimulationSettings.standard_effects)
    settings = {"days": _DAYS, "cadence": _CADENCE, "defects": (), **more}
    without = tuple(sorted(standard - kept))
    return SimulationSettings(seed=seed, start=dt.date(2005, 1, 1), without=without, **settings)


def _boom(folder: Path, settings: DualSettings, *changes: tuple[str, str]) -> Catalog:
    """Return the catalog of a workspace with days of two sensors, the mission's text changed."""
    text = shipped_missions()["venus-express"].read_text(encoding="utf-8")
    text = text.replace("cadence: 1 s", f"cadence: {_CADENCE} s")
    for old, new in changes:
        text = text.replace(old, new)
    return _workspace(folder, settings, text)


def _workspace(folder: Path, settings: MissionSettings, text: str) -> Catalog:
    """Return the catalog of a workspace with simulated days of a mission's text."""
    source = folder.parent / "mission.yaml"
    source.write_text(text, encoding="utf-8")
    models = source.with_name("models")
    if not models.exists():
        shutil.copytree(shipped_missions()["champ"].with_name("models"), models)
    made = Workspace.create(folder, source)
    simulate(settings, made.data, workers=1)
    cat = Catalog(made.root)
    ingest(cat, made.mission(), made.data)
    return cat


def _keep_effects(path: Path, kept: Collection[str]) -> None:
    """Leave out of a model's file all effects but some."""
    model = yaml.safe_load(path.read_text(encoding="utf-8"))
    model["effects"] = [one for one in model["effects"] if one["effect"] in kept]
    path.write_text(yaml.safe_dump(model, sort_keys=False), encoding="utf-8")


def _reprocess(cat: Catalog, **settings: Any) -> None:
    """Make tables and products; a mission of which no day could be made has no errors to count."""
    reprocess(cat, Workspace.open(cat.workspace).mission(), settings=ReprocessSettings(**settings))


def _table_pulls(cat: Catalog, name: str, truth: Floats) -> Floats:
    """Return the errors of a table's parameters in its sigmas, NaN where it says not determined."""
    table = newest_table(cat, name)
    if table is None:
        return np.full(truth.size, np.nan)
    pulls = (table["value"].values - truth) / table["sigma"].values
    if "determined" in table and table["determined"].dims == table["value"].dims:
        pulls = np.where(table["determined"].values, pulls, np.nan)
    return np.asarray(pulls.ravel())


def _field_pulls(cat: Catalog, dataset: str, truth: Mapping[np.datetime64, xr.Dataset]) -> Floats:
    """Return the errors of the field at some moments of each day in its uncertainty, by component."""
    pulls = []
    for day, one in truth.items():
        stamps = one["Epoch"].values.astype(np.int64)
        product = cat.read_day(dataset, day)
        at = np.linspace(0, stamps.size - 1, _MOMENTS + 2)[1:-1].astype(np.int64)
        rows = np.clip(np.searchsorted(product["tt2000"].values, stamps[at]), 0, product.sizes["time"] - 1)
        there = product["tt2000"].values[rows] == stamps[at]
        off = product["field_spacecraft"].values[rows] - one["FIELD"].values[at]
        pulls.append(np.where(there[:, None], off / product["uncertainty"].values[rows], np.nan))
    return np.concatenate(pulls).ravel()


def table(found: list[TableCoverage]) -> Iterator[str]:
    """Yield the lines of the table, as Markdown: shares within one and two sigmas, rms errors in sigmas."""
    yield "| pipeline | errors of | missions | values | 1 sigma | 2 sigma | rms |"
    yield "|---|---|---|---|---|---|---|"
    for one in found:
        there = one.pulls[np.isfinite(one.pulls)]
        shares = " | ".join(f"{share:.1%}" for share in one.within) if there.size else "- | -"
        rms = f"{np.sqrt(np.mean(there**2)):.2f}{'' if one.is_right() else ' *'}" if there.size else "-"
        yield f"| `{one.pipeline}` | {one.of} | {len(one.pulls)} | {there.size} | {shares} | {rms} |"
    yield ""
    yield "`*`: outside the interval that holds 99 of 100 right counts of so many missions."
