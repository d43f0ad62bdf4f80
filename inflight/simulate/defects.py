"""What goes wrong between an instrument and its delivered files; every defect by name."""

from __future__ import annotations

from collections.abc import Callable, Collection

import numpy as np
import xarray as xr

from inflight.simulate.randomness import generator

#: Stands for "no value" in every delivered variable of type float.
FILL = 99999.9
_FIELDS = {"fgm": "FGM_RAW", "fgm2": "FGM_RAW", "ovm": "F"}


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
    damaged = dict(instruments)
    for name, damage in _DAMAGES.items():
        if name not in names:
            continue
        for instrument in list(damaged):
            random = generator(seed, f"{name} {instrument}", day)
            result = damage(damaged[instrument], instrument, random, day)
            if result is None:
                del damaged[instrument]
            else:
                damaged[instrument] = result
    return damaged


def _block(count: int, longest: int, random: np.random.Generator) -> slice:
    length = int(random.integers(5, max(6, min(longest, count // 4))))
    start = int(random.integers(0, count - length))
    return slice(start, start + length)


def _spikes(data: xr.Dataset, instrument: str, random: np.random.Generator, day: int) -> xr.Dataset:
    del day
    if instrument not in _FIELDS:
        return data
    field = data[_FIELDS[instrument]].copy(deep=True)
    struck = random.random(field.sizes["record"]) < 2e-4
    field.values[struck] += random.choice([-50.0, 50.0], size=field.values[struck].shape)
    return data.assign({_FIELDS[instrument]: field})


def _flags(data: xr.Dataset, instrument: str, random: np.random.Generator, day: int) -> xr.Dataset:
    del day
    if _FIELDS.get(instrument) != "FGM_RAW":
        return data
    field, flag = data["FGM_RAW"].copy(deep=True), data["FGM_FLAG"].copy(deep=True)
    for _ in range(2):
        bad = _block(data.sizes["record"], 300, random)
        field.values[bad] += 500.0
        flag.values[bad] = 1
    return data.assign(FGM_RAW=field, FGM_FLAG=flag)


def _fill_values(data: xr.Dataset, instrument: str, random: np.random.Generator, day: int) -> xr.Dataset:
    del day
    if instrument not in _FIELDS:
        return data
    field = data[_FIELDS[instrument]].copy(deep=True)
    field.values[random.random(field.sizes["record"]) < 1e-3] = FILL
    return data.assign({_FIELDS[instrument]: field})


def _gaps(data: xr.Dataset, instrument: str, random: np.random.Generator, day: int) -> xr.Dataset:
    del day
    keep = np.ones(data.sizes["record"], dtype=bool)
    if instrument in _FIELDS:
        for _ in range(int(random.poisson(1.5))):
            keep[_block(keep.size, 90, random)] = False
    return data if keep.all() else data.isel(record=keep)


def _clock_step(data: xr.Dataset, instrument: str, random: np.random.Generator, day: int) -> xr.Dataset:
    """Every seventh day the scalar stamps are a second late from some time on."""
    if instrument != "ovm" or day % 7 != 3:
        return data
    epoch = data["Epoch"].copy(deep=True)
    epoch.values[int(random.integers(1, epoch.size)) :] += 1_000_000_000
    return data.assign(Epoch=epoch)


def _duplicates(data: xr.Dataset, instrument: str, random: np.random.Generator, day: int) -> xr.Dataset:
    del instrument, day
    order = np.arange(data.sizes["record"])
    again = _block(order.size, 60, random)
    return data.isel(record=np.concatenate([order[: again.stop], order[again], order[again.stop :]]))


def _unsorted(data: xr.Dataset, instrument: str, random: np.random.Generator, day: int) -> xr.Dataset:
    del instrument, day
    order = np.arange(data.sizes["record"])
    late = _block(order.size, 60, random)
    return data.isel(record=np.concatenate([order[: late.start], order[late.stop :], order[late]]))


def _missing_days(
    data: xr.Dataset, instrument: str, random: np.random.Generator, day: int
) -> xr.Dataset | None:
    del day
    return None if instrument in _FIELDS and random.random() < 0.05 else data


_Damage = Callable[[xr.Dataset, str, np.random.Generator, int], xr.Dataset | None]
#: In the order in which they happen: in the instrument, then on the way.
_DAMAGES: dict[str, _Damage] = {
    "spikes": _spikes,
    "flags": _flags,
    "fill_values": _fill_values,
    "gaps": _gaps,
    "clock_step": _clock_step,
    "duplicates": _duplicates,
    "unsorted": _unsorted,
    "missing_days": _missing_days,
}
