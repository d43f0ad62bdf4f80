"""Days of samples with currents that step, made for tests: known coefficients, any noise."""

import numpy as np
import xarray as xr
from scipy.signal import lfilter

from inflight.mission_fit import concat_epochs, extract_epochs
from inflight.residual import find_steps
from inflight.time import SECOND, day_bounds

ORBIT = 5560.0
FIRST = np.datetime64("2007-01-01", "D")
TRUTH = np.array([0.02, 0.01, -0.01])


def direction_at(seconds, tilt=0.3):
    """Field's direction of a dipole along a polar orbit, with a small and changing y."""
    angle = 2 * np.pi * seconds / ORBIT
    field = np.column_stack([np.cos(angle), tilt * np.sin(0.13 * angle), 2 * np.sin(angle)])
    return field / np.linalg.norm(field, axis=1, keepdims=True)


def settle(wanted, seconds_per_sample, time_constant=5.0):
    """A level that follows what is wanted with a time constant."""
    keep = np.exp(-seconds_per_sample / time_constant)
    return lfilter([1.0 - keep], [1.0, -keep], wanted, zi=[keep * wanted[0]])[0]


def make_day(number, value=TRUTH, *, seed=0, noise=0.09, drops=14, hours=24.0, slow=1.0):
    """Return (samples, residual) of a day: a current that drops for 1500 s at random times.

    `value` nT/A; `slow` scales what follows the orbit: 0.3 nT once a turn, 0.1 nT three times.
    """
    random = np.random.default_rng([seed, number])
    start, _ = day_bounds(FIRST + number)
    seconds = np.arange(0.0, 3600.0 * hours)
    stamps = start + (seconds * SECOND).astype(np.int64)
    clock = seconds + number * 86400.0
    direction = direction_at(clock)
    level = np.zeros(seconds.size)
    for moment in random.uniform(300, seconds[-1] - 400, drops):
        level[(seconds >= moment) & (seconds < moment + 1500)] = 1.0
    top = 8.0 - 0.8 * np.cos(2 * np.pi * clock / ORBIT)
    current = top + (2.9 - top) * settle(level, 1.0)
    orbit = 0.3 * np.sin(2 * np.pi * clock / ORBIT + 1.0) + 0.1 * np.sin(6 * np.pi * clock / ORBIT)
    residual = direction @ np.asarray(value) * current + slow * orbit
    residual = residual + noise * random.standard_normal(seconds.size)
    samples = xr.Dataset(
        {
            "tt2000": ("time", stamps),
            "field": (("time", "axis"), 40000.0 * direction),
            "solar_current": ("time", current, {"units": "A"}),
            "battery_current": ("time", 500.0 * current, {"units": "mA"}),
            "sunlit": ("time", np.ones(seconds.size), {"units": "1"}),
        }
    )
    return samples, residual


def steps_of(samples):
    """Steps found in the current as housekeeping gives it: every 10 s, to 5 mA."""
    read = np.rint(samples["solar_current"].values[::10] / 0.005) * 0.005
    return find_steps(samples["tt2000"].values[::10], read)


def epochs_of_days(days, others=(), windows=None, **options):
    """Stored epochs of some days, joined."""
    parts = []
    for number in range(days):
        samples, residual = make_day(number, **options)
        steps = steps_of(samples)
        parts.append(
            extract_epochs(samples, residual, steps, channel="solar_current", others=others, windows=windows)
        )
    return concat_epochs(parts)


def stored_epochs(seed, days=12, a_day=15, shared=0.0, value=TRUTH, share=None):
    """Epochs as they are stored, made directly: for coverage over many seeds.

    `shared` nT is common to a day; `share` (epoch, panel) with `value` (panel, 3) makes panels.
    """
    random = np.random.default_rng(seed)
    count = days * a_day
    day = np.repeat(np.arange(days), a_day)
    direction = direction_at(random.uniform(0, 30 * ORBIT, count))
    size = random.uniform(-7.0, -2.0, count)
    columns = direction * size[:, None]
    coefficient = np.broadcast_to(value, (count, 3)) if share is None else share @ np.asarray(value)
    sigma = random.uniform(0.03, 0.05, count)
    contrast = np.einsum("ij,ij->i", columns, coefficient) + sigma * random.standard_normal(count)
    contrast += shared * random.standard_normal(days)[day] * size / 5.0
    placebo = sigma * random.standard_normal(count)
    return xr.Dataset(
        {
            "contrast": ("epoch", contrast),
            "sigma": ("epoch", sigma),
            "column": (("epoch", "current", "axis"), columns[:, None, :]),
            "placebo": ("epoch", placebo),
            "placebo_column": (("epoch", "current", "axis"), np.zeros((count, 1, 3))),
            "step": (("epoch", "current"), size[:, None]),
            "unit": ("current", ["A"]),
            "time": ("epoch", np.arange(count) * SECOND),
            "day": ("epoch", day),
        },
        coords={"current": ["solar_current"], "axis": ["x", "y", "z"]},
    )
