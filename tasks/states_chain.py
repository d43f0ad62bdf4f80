"""Windows of states joined in the order of time: the same state and unit have one number in all of them.

Windows are learnt from independently, in any order and at the same time. Afterwards each goes on from the
one before it (`inflight.dual.ageing`), which can be undone: a window that changed is learnt from again, and
those behind it are only joined anew.
"""

from __future__ import annotations

import hashlib

import numpy as np
import xarray as xr

from inflight.catalog import Catalog
from inflight.dual.ageing import Ageing, alone, continued
from inflight.dual.table import from_dataset, to_dataset
from inflight.dual.training import Training
from inflight.time import day_bounds

#: Characters of a key that tell a window's own inputs; the others tell the windows before it, too.
OWN = 32
_CHANGES = ("change", "change_sigma", "aged")


def chained_key(own: str, before: str) -> str:
    """Return the key of a joined table, from that of its own inputs and the joined one before it."""
    return own[:OWN] + hashlib.sha256(f"{own}{before}".encode()).hexdigest()[: 64 - OWN]


def table_before(cat: Catalog, name: str, day: np.datetime64) -> tuple[str, xr.Dataset] | None:
    """Return key and content of the last certified table that began before a day; None without any."""
    begin, _ = day_bounds(day)
    found = [
        (start, one.id, one)
        for one in cat.tables(name)
        for context, start, _ in one.certified
        if context is None and start < begin and not one.damaged
    ]
    if not found:
        return None
    last = max(found, key=lambda one: one[:2])[2]
    return last.key, cat.table_by_id(last.id)


def joined(before: xr.Dataset | None, table: xr.Dataset) -> xr.Dataset:
    """Return a window's table that goes on from the one before it.

    Parameters
    ----------
    before : Dataset, optional
        Joined itself; the chain begins here without it.
    table : Dataset
        As it was learnt, or joined to any other.

    Returns
    -------
    Dataset
        Numbers and constant part of `inflight.dual.ageing.continued`. Of states that both windows know
        `change` and `change_sigma` (state, axis) tell how the outboard correction changed beside what all
        have in common, nT, and `aged` (state,) where that is more than noise.
    """
    later = from_dataset(table)
    bare = table.drop_vars([name for name in _CHANGES if name in table])
    bare.attrs.pop("table_id", None)
    if before is None or not before.sizes["state"] or not len(later):
        return _with_training(bare, alone(later), "no")
    going = continued(from_dataset(before), later)
    told = _with_training(bare, going.training, "yes" if len(going.matched) else "no")
    return told.assign(_changes(going))


def _with_training(table: xr.Dataset, training: Training, goes_on: str) -> xr.Dataset:
    fresh = to_dataset(training)
    return table.assign(fresh.data_vars).assign_attrs({**fresh.attrs, "goes_on": goes_on})


def _changes(going: Ageing) -> dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]]:
    count = len(going.training)
    change, sigma, aged = np.full((count, 3), np.nan), np.full((count, 3), np.nan), np.zeros(count, np.int64)
    rows = going.matched[:, 1]
    change[rows], sigma[rows], aged[rows] = going.change, going.sigma, going.aged
    both = ("state", "axis")
    return {
        "change": (both, change, {"units": "nT"}),
        "change_sigma": (both, sigma, {"units": "nT"}),
        "aged": (("state",), aged, {}),
    }
