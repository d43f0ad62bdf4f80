"""What observatory records tell of a scale factor that follows a temperature, and of its lag.

``python -m benchmarks.coil_temperature`` prints it for ``conrad`` and ``wik-cobenzl``. A field of nearly
one direction e sees one number of three, ``sum e_i^2 linear_i``: how the strength follows the temperature.
"""

from __future__ import annotations

import os
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np

from inflight.arrays import Floats
from inflight.calibration import NINE_PARAMETER_NAMES, concat_equations
from inflight.catalog import Catalog
from inflight.effects import time_derivative
from inflight.errors import CalibrationError
from inflight.mission import Mission, sensors_of
from inflight.mission_fit import CoilBlock, coil_equations, compare_temperatures, fit_coil
from inflight.model import Model, ResidualDefinition, make_effect, rows_of
from inflight.tasks.archive import ArchiveIndex, ingest, load_samples, needs_of
from inflight.time import SECOND, Int64

ROOT = Path(__file__).parents[1]
#: Shipped mission, comparison, folder of the data, channels of temperature, hours of a block, and how far
#: the scalar instrument's clock is off, s (as `diagnose` finds it, see docs/science/real-data.md).
SETS = (
    (
        "conrad",
        "main",
        "conrad-wic-storm-may2024",
        ("sensor_temperature", "electronics_temperature"),
        12,
        0.178,
    ),
    (
        "wik-cobenzl",
        "main",
        "wik-cobenzl-2011",
        ("vault.temperature", "variometer_room.temperature"),
        24,
        5.4,
    ),
)
#: Seconds over which temperatures are averaged.
_SMOOTH_S = 600.0
#: One constant a block: a slow drift of the instruments is no temperature.
_EACH = (NINE_PARAMETER_NAMES[8],)


def real_data() -> Path:
    """Return the folder of real measurements."""
    return Path(os.environ.get("INFLIGHT_REAL_DATA", ROOT.parent / "shared" / "data"))


def load(name: str, comparison: str, folder: str, channels: tuple[str, ...], shift: float) -> list[CoilBlock]:
    """Return the days of a set, corrected for the clock."""
    mission = Mission.parse((ROOT / "missions" / f"{name}.yaml").read_text(encoding="utf-8"))
    layout = ResidualDefinition.of(mission, comparison)
    with tempfile.TemporaryDirectory() as scratch:
        cat = Catalog(Path(scratch))
        ingest(cat, mission, real_data() / folder)
        sensor = layout.sensor("vector").name
        entries = tuple(
            make_effect(
                {"effect": "temperature", "name": f"t{at}", "sensor": sensor, "channel": channel},
                sensors_of(mission),
                mission=mission,
            )
            for at, channel in enumerate(channels)
        )
        model = Model("temperatures", mission.mission, comparison, entries, layout=layout)
        needs = needs_of(mission, model)
        index = ArchiveIndex.of(cat, needs)
        days = []
        for day in index.complete_days(needs):
            samples = load_samples(cat, mission, model, day, needs, index)
            rows = rows_of(model, samples)
            strength = np.linalg.norm(rows.field, axis=1)
            stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
            residual = np.where(rows.good, rows.residual[:, 0], np.nan) + shift * time_derivative(
                strength, stamps
            )
            known = {one: _smooth(stamps, np.asarray(samples[one].values)) for one in channels}
            days.append(CoilBlock(stamps, rows.field, residual, known))
        return days


def _smooth(stamps: Int64, temperature: Floats) -> Floats:
    """Return means of ten minutes around each time, degC: readings to a millikelvin have no rate a second."""
    known = np.isfinite(temperature)
    seconds = (stamps - stamps[0]) / SECOND
    sums = [np.concatenate([[0.0], np.cumsum(one)]) for one in (np.where(known, temperature, 0.0), known)]
    low, high = (np.searchsorted(seconds, seconds + away) for away in (-_SMOOTH_S / 2, _SMOOTH_S / 2))
    total, count = (one[high] - one[low] for one in sums)
    return np.where(known & (count > 0), total / np.maximum(count, 1), np.nan)


def cut(days: list[CoilBlock], hours: int) -> list[CoilBlock]:
    """Return blocks of some hours."""
    parts = []
    for day in days:
        edges = np.searchsorted(day.stamps, day.stamps[0] + np.arange(0, 25, hours) * 3600 * SECOND)
        for low, high in pairwise(edges):
            own = {name: values[low:high] for name, values in day.temperature.items()}
            parts.append(CoilBlock(day.stamps[low:high], day.field[low:high], day.residual[low:high], own))
    return parts


def along_field(blocks: list[CoilBlock], channel: str, reference: float) -> tuple[float, float, str]:
    """Return ``sum e_i^2 linear_i`` and its sigma, ppm/K, and what is said of the fit.

    The quadratic terms are held at 0: temperatures that hardly move tell no curve.
    """
    equations = concat_equations([coil_equations(one, {}, reference) for one in blocks])
    fit = fit_coil(equations, channel, reference=reference, each=_EACH, prior=(1e-3, 1e-12, 3600.0))
    field = np.nanmean(np.concatenate([one.field for one in blocks]), axis=0)
    weight = np.zeros(7)
    weight[:3] = (field / np.linalg.norm(field)) ** 2
    sigma = float(np.sqrt(weight @ fit.fit.covariance @ weight))
    return 1e6 * float(weight @ fit.fit.value), 1e6 * sigma, fit.summary().split("; ")[-1]


def middle(blocks: list[CoilBlock], channel: str) -> tuple[float, float]:
    """Return the mean of a temperature and its rms change within the blocks, K."""
    parts: list[Floats] = [one.temperature[channel][np.isfinite(one.temperature[channel])] for one in blocks]
    parts = [one for one in parts if one.size]
    if not parts:
        raise CalibrationError(f"'{channel}' is nowhere in the record", remedy="see what was ingested")
    within = np.concatenate([one - one.mean() for one in parts])
    return float(np.concatenate(parts).mean()), float(within.std())


def main() -> None:
    """Print what each set tells."""
    for name, comparison, folder, channels, hours, shift in SETS:
        blocks = cut(load(name, comparison, folder, channels, shift), hours)
        print(f"{name} {comparison}: {len(blocks)} blocks of {hours} h")
        moving = []
        for channel in channels:
            mean, within = middle(blocks, channel)
            print(f"  {channel}: {mean:.2f} degC, changes by {within:.4f} K rms within a block")
            if within < 1e-6:
                print("    does not move: its coefficient cannot be fitted")
                continue
            moving.append(channel)
            value, sigma, text = along_field(blocks, channel, mean)
            print(f"    along the field {value:.1f} +- {sigma:.1f} ppm/K, detectable {3 * sigma:.1f}; {text}")
        if moving:
            equations = concat_equations([coil_equations(one, {}, mean) for one in blocks])
            choice = compare_temperatures(equations, moving, each=_EACH, prior=(1e-3, 1e-12, 3600.0))
            print(f"  held out: {choice.summary()}")
            print("  " + ", ".join(f"{one.channel} {one.score:.5f} nT" for one in choice.rivals))


if __name__ == "__main__":
    main()
