"""Windows of states joined in the order of time: the same state and unit have one number in all of them.

Windows are learnt from independently, in any order and at the same time. Afterwards each goes on from one
of those before it (`inflight.dual.ageing`), which can be undone: a window that changed is learnt from again,
and those behind it are only joined anew. A window that told little does not end the chain: the next one may
go on from one before that.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr

from inflight.catalog import Catalog
from inflight.dual.ageing import Ageing, alone, continued
from inflight.dual.table import from_dataset, to_dataset
from inflight.dual.training import Training
from inflight.time import day_bounds

#: Characters of a key that tell a window's own inputs; the others tell the windows before it, too.
OWN = 32
#: So many windows before it a window may go on from.
OFFERED = 5
_CHANGES = ("change", "change_sigma", "aged")


def chained_key(own: str, before: Sequence[str]) -> str:
    """Return the key of a joined table, from that of its own inputs and the joined ones before it."""
    told = "".join([own, *before])
    return own[:OWN] + hashlib.sha256(told.encode()).hexdigest()[: 64 - OWN]


@dataclass
class Chain:
    """The tables that the next window may go on from.

    Attributes
    ----------
    keys : list of str
        Of tables with states, the newest first.
    tables : list of Dataset
    """

    keys: list[str] = field(default_factory=list)
    tables: list[xr.Dataset] = field(default_factory=list)

    @classmethod
    def before(cls, cat: Catalog, name: str, day: np.datetime64) -> Chain:
        """Return the chain of the certified tables of a name that began before a day."""
        begin, _ = day_bounds(day)
        found = [
            (start, one.id, one)
            for one in cat.tables(name)
            for context, start, _ in one.certified
            if context is None and start < begin and not one.damaged
        ]
        keys: list[str] = []
        tables: list[xr.Dataset] = []
        for _, _, one in sorted(found, key=lambda each: each[:2], reverse=True):
            table = cat.table_by_id(one.id)
            if table.sizes["state"]:
                keys.append(one.key)
                tables.append(table)
            if len(keys) == OFFERED:
                break
        return cls(keys, tables)

    def add(self, key: str, table: xr.Dataset) -> None:
        """Put the next window's joined table in front; one without states tells the next ones nothing."""
        if table.sizes["state"]:
            self.keys[:] = [key, *self.keys[: OFFERED - 1]]
            self.tables[:] = [table, *self.tables[: OFFERED - 1]]

    def add_unknown(self, key: str) -> None:
        """Put a key in front whose table is still to be made."""
        self.keys[:] = [key, *self.keys[: OFFERED - 1]]


def joined(before: Sequence[xr.Dataset], table: xr.Dataset) -> xr.Dataset:
    """Return a window's table that goes on from one of those before it.

    Parameters
    ----------
    before : sequence of Dataset
        Joined themselves, the newest first; the chain begins here without any. Those whose correction is
        applied come first: a window that was left alone may have learnt little, and its constant is in no
        product. Of these the newest with which the constant goes on is taken.
    table : Dataset
        As it was learnt, or joined to any other.

    Returns
    -------
    Dataset
        Numbers and constant part of `inflight.dual.ageing.continued`. Of states that both windows know
        `change` and `change_sigma` (state, axis) tell how the outboard correction changed beside what all
        have in common, nT, and `aged` (state,) where that is more than noise. Attribute `goes_on` is ``yes``
        or ``no``.
    """
    later = from_dataset(table)
    bare = table.drop_vars([name for name in _CHANGES if name in table])
    bare.attrs.pop("table_id", None)
    known = [(one, from_dataset(one)) for one in before if one.sizes["state"]]
    if not known or not len(later):
        return _with_training(bare, alone(later), "no")
    going = _continued(known, later)
    told = _with_training(bare, going.training, "yes" if len(going.matched) else "no")
    return told.assign(_changes(going))


def _continued(known: Sequence[tuple[xr.Dataset, Training]], later: Training) -> Ageing:
    """Return how a window goes on from the best of those before it."""
    # A number that any window before has given is given to nothing else.
    number = max(one.next_number for _, one in known)
    unit = max(one.next_unit for _, one in known)
    order = sorted(known, key=lambda one: str(one[0].attrs.get("applied")) != "yes")
    tried: list[Ageing] = []
    for _, earlier in order:
        going = continued(replace(earlier, next_number=number, next_unit=unit), later)
        if _keeps_constant(earlier, going):
            return going
        tried.append(going)
    return next((one for one in tried if len(one.matched)), tried[0])


def _keeps_constant(earlier: Training, going: Ageing) -> bool:
    """Return True when the constant part of the correction is that of the window before."""
    if not len(going.matched):
        return False
    if going.training.constant_known:
        return True
    return not earlier.constant_known and going.training.reference == earlier.reference


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
