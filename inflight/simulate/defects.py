"""What goes wrong between an instrument and its delivered files; every defect by name."""

from __future__ import annotations

from collections.abc import Callable, Collection

import numpy as np
import xarray as xr

from inflight.simulate.randomness import generator
from inflight.time import DAY, SECOND

#: Stands for "no value" in every delivered variable of type float.
FILL = 99999.9
_FIELDS = {"fgm": "FGM_RAW", "fgm2": "FGM_RAW", "ovm": "F"}
#: Length of a gap of `cut_gaps`, s.
_GAP_S = 900.0


def apply_defects(
    instruments: dict[str, xr.Dataset], names: Collection[str], seed: int, day: int
) -> dict[str, xr.Dataset]:
    """Return the deliveries of one day with defects.

    Parameters
    ----------
    instruments : dict of Dataset
        Undamaged deliveries, dimension ``record``; left as they are.
    names : collection of str
        Any of gaps, duplicates, missing_days, fill_values, clock_step, unsorted, flags, spikes.
    seed, day : int
        They alone decide where the defects fall.

    Returns
    -------
    dict of Dataset
        An instrument whose whole day is missing is not in it.
    """
    damaged: dict[str, xr.Dataset] = {}
    for instrument, delivered in instruments.items():
        data, field = delivered, _FIELDS.get(instrument, "")
        for name, damage in _DAMAGES.items():
            # Every seventh day the scalar stamps step; what damages a field needs one.
            strikes = (instrument == "ovm" and day % 7 == 3) if name == "clock_step" else True
            if name in names and strikes and (field or name in ("duplicates", "unsorted")):
                data = damage(data, field, generator(seed, f"{name} {instrument}", day))
        missing = generator(seed, f"missing_days {instrument}", day).random() < 0.05
        if not ("missing_days" in names and field and missing):
            damaged[instrument] = data
    return damaged


def cut_gaps(data: xr.Dataset, start: int, random: np.random.Generator) -> xr.Dataset:
    """Return the delivery of a day that begins at TT2000 `start` without three spans of 15 minutes."""
    since = (data["Epoch"].values - start) / SECOND
    lost = random.uniform(0.0, DAY / SECOND - _GAP_S, 3)
    return data.isel(record=~np.any([(since >= one) & (since < one + _GAP_S) for one in lost], axis=0))


def _block(count: int, longest: int, random: np.random.Generator) -> slice:
    length = int(random.integers(5, max(6, min(longest, count // 4))))
    start = int(random.integers(0, count - length))
    return slice(start, start + length)


def _spikes(data: xr.Dataset, field: str, random: np.random.Generator) -> xr.Dataset:
    values = data[field].copy(deep=True)
    struck = random.random(values.sizes["record"]) < 2e-4
    values.values[struck] += random.choice([-50.0, 50.0], size=values.values[struck].shape)
    return data.assign({field: values})


def _flags(data: xr.Dataset, field: str, random: np.random.Generator) -> xr.Dataset:
    """Twice a day the fluxgate reads 500 nT more for some time, and says so."""
    if field != "FGM_RAW":
        return data
    values, flag = data[field].copy(deep=True), data["FGM_FLAG"].copy(deep=True)
    for _ in range(2):
        bad = _block(data.sizes["record"], 300, random)
        values.values[bad] += 500.0
        flag.values[bad] = 1
    return data.assign(FGM_RAW=values, FGM_FLAG=flag)


def _fill_values(data: xr.Dataset, field: str, random: np.random.Generator) -> xr.Dataset:
    values = data[field].copy(deep=True)
    values.values[random.random(values.sizes["record"]) < 1e-3] = FILL
    return data.assign({field: values})


def _gaps(data: xr.Dataset, field: str, random: np.random.Generator) -> xr.Dataset:
    del field
    keep = np.ones(data.sizes["record"], dtype=bool)
    for _ in range(int(random.poisson(1.5))):
        keep[_block(keep.size, 90, random)] = False
    return data if keep.all() else data.isel(record=keep)


def _clock_step(data: xr.Dataset, field: str, random: np.random.Generator) -> xr.Dataset:
    """The stamps are a second late from some time on."""
    del field
    epoch = data["Epoch"].copy(deep=True)
    epoch.values[int(random.integers(1, epoch.size)) :] += SECOND
    return data.assign(Epoch=epoch)


def _duplicates(data: xr.Dataset, field: str, random: np.random.Generator) -> xr.Dataset:
    del field
    order = np.arange(data.sizes["record"])
    again = _block(order.size, 60, random)
    return data.isel(record=np.concatenate([order[: again.stop], order[again], order[again.stop :]]))


def _unsorted(data: xr.Dataset, field: str, random: np.random.Generator) -> xr.Dataset:
    del field
    order = np.arange(data.sizes["record"])
    late = _block(order.size, 60, random)
    return data.isel(record=np.concatenate([order[: late.start], order[late.stop :], order[late]]))


#: In the order in which they happen: in the instrument, then on the way.
_DAMAGES: dict[str, Callable[[xr.Dataset, str, np.random.Generator], xr.Dataset]] = {
    "spikes": _spikes,
    "flags": _flags,
    "fill_values": _fill_values,
    "gaps": _gaps,
    "clock_step": _clock_step,
    "duplicates": _duplicates,
    "unsorted": _unsorted,
}
