"""A current that both sensors see: the residual is at the noise, the vector wrong until the place is told."""

import datetime as dt

import numpy as np
import pytest

from benchmarks.archive import simulated_workspace
from inflight.simulate import SimulationSettings, simulate_day

DAYS = 4
#: Where the simulator's battery stands, m, and what it makes at the vector sensor, nT/A.
PLACE, FIELD = (-0.6, 0.2, 0.1), np.array([0.10, -0.10, 0.20])
SETTINGS = SimulationSettings(
    seed=3,
    start=dt.date(2005, 1, 1),
    days=DAYS,
    cadence=10,
    defects=(),
    without=tuple(sorted(set(SimulationSettings.standard_effects) - {"battery", "offset", "misalignment"})),
    overrides={"battery_field": tuple(FIELD), "battery_position": PLACE},
)
MODEL = """model: champ-preflight
version: 1
mission: champ
effects:
  - effect: vector_sensor
    sensor: fgm
    scale_factor: {time: block, value: [1.00139, 1.00223, 1.00221], sigma: 2.0e-3}
    misalignment: {time: block, unit: deg, value: [90.0225, 90.0640, 90.0350], sigma: 0.05}
    offset: {time: block, unit: nT, value: [23.0, 24.5, 19.0], sigma: 10.0}
"""


def errors_of(inflight, cat):
    """True error of the product's field and what it states, (time, axis) nT, and the residual, nT."""
    inflight("reprocess", "--no-prefect", "-w", cat.workspace)
    off, sigma, residual = [], [], []
    for day in SETTINGS.day_list:
        product = cat.read_day("l2/field", day)
        off.append(product["field_sensor"].values - simulate_day(SETTINGS, day).truth["FIELD"].values)
        sigma.append(product["uncertainty"].values)
        residual.append(product["residual"].values)
    return np.concatenate(off), np.concatenate(sigma), np.concatenate(residual)


def rms(values):
    return np.sqrt(np.nanmean(values**2, axis=0))


def slow(values):
    """Means of half an hour: what is left of an error that noise has no part in."""
    return np.nanmean(values[: len(values) // 180 * 180].reshape(-1, 180, *values.shape[1:]), axis=1)


def test_the_vector_is_right_once_it_is_told_where_the_current_flows(inflight, tmp_path):
    cat = simulated_workspace(tmp_path / "champ", DAYS, settings=SETTINGS, workers=1)
    root = cat.workspace
    (root / "models" / "champ-preflight.yaml").write_text(MODEL, encoding="utf-8")
    before = errors_of(inflight, cat)
    added = inflight("add", "{effect: channel_field, name: battery, channel: battery_current}", "-w", root)
    assert "battery.dipole=" in " ".join(added.out.split())
    apart = errors_of(inflight, cat)
    noise = float(np.hypot(SETTINGS.vector_noise, SETTINGS.scalar_noise))
    # The two sensors agree, and the vector is still wrong by what the scalar one saw.
    assert rms(before[2]) > 1.3 * noise
    assert rms(apart[2]) == pytest.approx(noise, rel=0.03)
    assert (rms(slow(apart[0])) > 0.05).all()

    refused = inflight("set", "battery.dipole=here", "-w", root)
    assert refused.code == 1
    assert "0.3 0 0.1 +- 0.2" in " ".join((refused.out + refused.err).split())
    inflight("set", "battery.dipole=-0.4 0.1 0 +- 0.2", "-w", root)
    told = errors_of(inflight, cat)
    assert rms(told[2]) == pytest.approx(noise, rel=0.03)
    assert (rms(slow(told[0])) < 0.25 * rms(slow(apart[0]))).all()
    # What is stated covers it, and holds the place: more than without it.
    assert (rms(slow(told[0])) < rms(told[1])).all()
    assert (rms(told[1]) > rms(apart[1])).all()
    pulls = told[0] / told[1]
    assert 0.6 < np.sqrt(np.nanmean(pulls**2)) < 1.2
    shown = inflight("model", "show", "-w", root).out
    assert "battery: a dipole at -0.4, 0.1, 0 m" in " ".join(shown.split())

    # Back: the coefficients are those of the difference again, the product's field as it was.
    inflight("set", "battery.dipole=none", "-w", root)
    np.testing.assert_allclose(rms(errors_of(inflight, cat)[0]), rms(apart[0]), rtol=0.02)
