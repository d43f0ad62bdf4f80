"""A spinning mission whose deliveries are spoilt on one day, from its files to its products."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import numpy as np
import xarray as xr

from inflight.catalog import Catalog, Workspace
from inflight.simulate.spinning import SpinningSettings, simulate_spinning_day
from inflight.tasks.archive import ingest
from inflight.tasks.archive.simulated_deliveries import SPINNING, write_cdf
from inflight.time import SECOND, day_bounds

SETTINGS = SpinningSettings(craft="imp8", days=2, seed=31, without=("zero_drift",))
#: The day that is spoilt, and the hours of each day that are delivered.
BAD = SETTINGS.day_list[1]
HOURS = 9.0
Spoil = Callable[[dict[str, xr.Dataset]], None]


@cache
def simulated(day: np.datetime64):
    """Return a day as it is simulated: what is delivered and the truth; not to be changed."""
    return simulate_spinning_day(SETTINGS, day)


def at(hours: float) -> int:
    """Return the TT2000 so many hours into the bad day."""
    return day_bounds(BAD)[0] + round(hours * 3600 * SECOND)


def without(data: xr.Dataset, begin: float, end: float) -> xr.Dataset:
    """Return a dataset without the records between two hours of the bad day."""
    stamps = data["Epoch"].values
    return data.isel(record=(stamps < at(begin)) | (stamps >= at(end)))


def deliver(folder: Path, spoil: Spoil | None = None) -> None:
    """Write the first hours of each day; those of the bad day as `spoil` leaves them."""
    source = SPINNING[SETTINGS.craft]
    for day in SETTINGS.day_list:
        last = day_bounds(day)[0] + round(HOURS * 3600 * SECOND)
        made = simulated(day).instruments
        instruments = {name: data.isel(record=data["Epoch"].values < last) for name, data in made.items()}
        if spoil is not None and day == BAD:
            spoil(instruments)
        for name, data in instruments.items():
            path = source.path(folder, name, day)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_cdf(path, source, name, data, day)


def mission_of(folder: Path, spoil: Spoil | None = None, instead: Mapping[str, str] | None = None):
    """Return catalog, mission and the ingest's report; `instead` replaces text of the mission YAML."""
    made = Workspace.create(folder, SETTINGS.craft)
    text = made.mission_file.read_text()
    for before, after in (instead or {}).items():
        assert before in text
        text = text.replace(before, after)
    made.mission_file.write_text(text)
    deliver(made.data, spoil)
    cat, mission = Catalog(folder), Workspace.open(folder).mission()
    return cat, mission, ingest(cat, mission, made.data)


def product(cat: Catalog, day: np.datetime64 = BAD) -> xr.Dataset:
    """Return a day's product."""
    (found,) = [one for one in cat.days("l2/field", states=("published",)) if one.day == day]
    return cat.read(found)


def truth_of(data: xr.Dataset, day: np.datetime64 = BAD) -> tuple[np.ndarray, np.ndarray]:
    """Return the true field in turning and in payload axes at a product's samples; (time, 3) nT each."""
    true = simulated(day).truth
    place = np.searchsorted(true["Epoch"].values, data["tt2000"].values)
    field, phase = true["FIELD"].values[place], true["PHASE"].values[place]
    c, s = np.cos(phase), np.sin(phase)
    x, y, z = field.T
    return np.column_stack([c * x + s * y, -s * x + c * y, z]), field
