"""A mission with two sensors whose second day is delivered anew, spoilt, from its files to its products."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.ndimage import uniform_filter1d

from inflight.catalog import Catalog, Workspace
from inflight.simulate.dual import DualSettings, simulate_dual_day
from inflight.tasks.archive import ingest
from inflight.tasks.archive.simulated_deliveries import VENUS_EXPRESS, write_cdf
from inflight.tasks.pipelines import ReprocessSettings, reprocess

MISSION = Path(__file__).parents[2] / "missions" / "venus-express.yaml"
CADENCE = 8
SETTINGS = DualSettings(days=2, seed=102, overrides={"cadence": float(CADENCE)})
GOOD, BAD = SETTINGS.day_list
CHOSEN = ReprocessSettings(table="daily", batch_days=1)
Spoil = Callable[[dict[str, xr.Dataset]], None]


@cache
def simulated(day: np.datetime64):
    """Return a day as it is simulated: what is delivered and the truth; not to be changed."""
    return simulate_dual_day(SETTINGS, day)


def boom(folder: Path, days: Sequence[np.datetime64] = (GOOD, BAD)) -> Workspace:
    """Return a workspace of good days, reprocessed one by one."""
    source = folder / "boom.yaml"
    text = MISSION.read_text(encoding="utf-8").replace("cadence: 1 s", f"cadence: {CADENCE} s")
    source.write_text(text, encoding="utf-8")
    made = Workspace.create(folder / "boom", source)
    for day in days:
        deliver(made, day)
    taken, report = work(made)
    assert taken.days["failed"] == report.days["failed"] == 0
    return made


def deliver(made: Workspace, day: np.datetime64, spoil: Spoil | None = None) -> None:
    """Write a day's files as `spoil` leaves them; an instrument that it takes away has none."""
    instruments = dict(simulated(day).instruments)
    for name in instruments:
        VENUS_EXPRESS.path(made.data, name, day).unlink(missing_ok=True)
    if spoil is not None:
        spoil(instruments)
    for name, data in instruments.items():
        path = VENUS_EXPRESS.path(made.data, name, day)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_cdf(path, VENUS_EXPRESS, name, data, day)


def copied(made: Workspace, folder: Path) -> Workspace:
    """Return a copy of a workspace."""
    shutil.copytree(made.root, folder)
    return Workspace.open(folder)


def work(made: Workspace):
    """Take in what was delivered and reprocess; return both reports."""
    cat, mission = Catalog(made.root), made.mission()
    taken = ingest(cat, mission, made.data)
    return taken, reprocess(cat, mission, settings=CHOSEN)


def product(made: Workspace, day: np.datetime64 = BAD) -> xr.Dataset:
    """Return a day's product."""
    cat = Catalog(made.root)
    (found,) = [one for one in cat.days("l2/field", states=("published",)) if one.day == day]
    return cat.read(found, with_time=False)


def reference_stray(made: Workspace, data: xr.Dataset) -> np.ndarray | None:
    """Return the true stray field, (axis,) nT, of the state a product is relative to, or None."""
    words = data.attrs["constant"]
    if not words.startswith("relative to state "):
        return None
    for day in (BAD, GOOD):
        truth, there = simulated(day).truth, product(made, day)
        stamps = truth["Epoch"].values.astype(np.int64)
        at = there["tt2000"].values[there["state"].values == int(words.split()[-1])]
        if at.size:
            rows = np.minimum(np.searchsorted(stamps, at), stamps.size - 1)
            return np.median(truth["STRAY_OUT"].values[rows], axis=0)
    return None


def errors(
    data: xr.Dataset,
    day: np.datetime64 = BAD,
    between: bool = False,
    constant: np.ndarray | None = None,
    mean_of: int = 1,
) -> dict[str, np.ndarray]:
    """Return errors of the outboard reading and of the field, without constants; (time, axis) nT, NaN
    where the product is missing. The truth is interpolated where the product has stamps between its own, and
    averaged over so many of its samples where the product has means.

    ``relative`` is the error of the field less a known constant (axis,), or less its median: its sigma is
    that of the difference to the state which the field is relative to."""
    truth = simulated(day).truth
    stamps = truth["Epoch"].values.astype(np.int64)
    known = truth["FIELD"].values + truth["OFFSET_OUT"].values
    known = uniform_filter1d(known, mean_of, axis=0)
    if between:
        inside = (data["tt2000"].values > stamps[0]) & (data["tt2000"].values < stamps[-1])
        data = data.isel(time=np.flatnonzero(inside))
        at = data["tt2000"].values - stamps[0]
        known = np.stack([np.interp(at, stamps - stamps[0], one) for one in known.T], axis=1)
        stamps = data["tt2000"].values
    rows = np.clip(np.searchsorted(data["tt2000"].values, stamps), 0, data.sizes["time"] - 1)
    there = data["tt2000"].values[rows] == stamps
    out = {"flag": data["flag"].values[rows[there]], "sigma": data["uncertainty"].values[rows[there]]}
    for name in ("outboard", "field_spacecraft"):
        left = data[name].values[rows[there]] - known[there]
        out[name] = left - np.nanmedian(left, axis=0)
    out["relative"] = out["field_spacecraft"] if constant is None else left - constant
    return out
