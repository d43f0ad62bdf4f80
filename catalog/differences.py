"""What changed between two collections of days: which days, and by how much their values.

In go days as the catalog knows them, before and after; out come `DayChange` records. Days that were made of
the same things by the same software (`Day.key`) are equal and not read; of the others both revisions are
read, one day at a time, and compared where their samples have the same stamp.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from sqlalchemy import select

from inflight.catalog.days import dataset_names, published_days, released_days, revisions_of_days
from inflight.catalog.opening import read_one_day
from inflight.catalog.records import Day
from inflight.catalog.schema import ContextRow
from inflight.catalog.spans import Span
from inflight.errors import CatalogError
from inflight.progress import Progress, silent, tell_each

if TYPE_CHECKING:
    import xarray as xr
    from sqlalchemy.orm import Session

#: The collection of what is published now.
NOW = "now"


@dataclass(frozen=True, kw_only=True)
class VariableChange:
    """By how much a variable changed where both revisions have a value; vectors by the length of the change.

    Attributes
    ----------
    variable, units : str
    rms, largest : float
    samples : int
        Samples with a value in both.
    """

    variable: str
    units: str
    rms: float
    largest: float
    samples: int


@dataclass(frozen=True, kw_only=True)
class DayChange:
    """A day that is there in one collection only, or is another revision in the other.

    Attributes
    ----------
    dataset : str
    day : datetime64[D]
    kind : {'added', 'removed', 'changed'}
    before, after : Day or None
    variables : tuple of VariableChange
        Variables whose values differ; empty when the day was made anew and came out the same.
    gained, lost : tuple of str
        Variables that only the later, or only the earlier revision has.
    """

    dataset: str
    day: np.datetime64
    kind: Literal["added", "removed", "changed"]
    before: Day | None
    after: Day | None
    variables: tuple[VariableChange, ...] = ()
    gained: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()

    @property
    def main(self) -> VariableChange | None:
        """The change of the day's field, or else of what changed most; None when no value did."""
        fields = [part for part in self.variables if part.variable.startswith("field")]
        return max(fields or self.variables, key=lambda part: part.rms, default=None)


def days_of_collection(session: Session, name: str, patterns: Sequence[str]) -> list[Day]:
    """Return the days of a release, of what is published ``now``, or of a model's version (``model:2``).

    ``v01.03`` is that revision of every day that has it.

    Parameters
    ----------
    patterns : sequence of str
        Of datasets, such as ``l2/*``.

    Raises
    ------
    CatalogError
        When there is no such release, or nothing was published with such a model.
    """
    names = dataset_names(session, patterns)
    whole = Span(None, None)
    if name == NOW:
        return [day for one in names for day in published_days(session, one, whole, None)]
    version = name.removeprefix("model:")
    if re.fullmatch(r"v\d+\.\d+", name):
        return [day for one in names for day in revisions_of_days(session, one, whole) if day.version == name]
    if version == name:
        return [day for day in released_days(session, name, None, whole) if day.dataset in set(names)]
    contexts = select(ContextRow.id).where(
        ContextRow.model_version == (int(version) if version.isdigit() else -1)
    )
    newest: dict[tuple[str, np.datetime64], Day] = {}
    for context in session.scalars(contexts):
        for one in names:
            for day in published_days(session, one, whole, context):
                key = day.dataset, day.day
                if key not in newest or newest[key].revision < day.revision:
                    newest[key] = day
    if not newest:
        known = sorted(set(session.scalars(select(ContextRow.model_version))))
        raise CatalogError(
            f"nothing that matches {' or '.join(patterns)} was published with model version {version!r}",
            remedy=f"'inflight model history' lists versions; products were made with {known or 'none'}",
        )
    return [newest[key] for key in sorted(newest)]


def changed_days(before: Sequence[Day], after: Sequence[Day]) -> list[DayChange]:
    """Return days that differ by what they were made of, ordered by dataset and day; nothing is read."""
    old = {(day.dataset, day.day): day for day in before}
    new = {(day.dataset, day.day): day for day in after}
    out = []
    for key in sorted(old.keys() | new.keys()):
        one, other = old.get(key), new.get(key)
        if one is None or other is None:
            kind: Literal["added", "removed"] = "added" if one is None else "removed"
            out.append(DayChange(dataset=key[0], day=key[1], kind=kind, before=one, after=other))
        elif one.id != other.id and (one.key != other.key or not one.key):
            out.append(DayChange(dataset=key[0], day=key[1], kind="changed", before=one, after=other))
    return out


def measured_changes(
    workspace: Path, before: Sequence[Day], after: Sequence[Day], progress: Progress = silent
) -> Iterator[DayChange]:
    """Yield `changed_days`, the changed ones with the sizes of their changes; reads one day at a time."""
    for one in tell_each(progress, "changes", changed_days(before, after)):
        if one.before is None or one.after is None:
            yield one
            continue
        first, second = (read_one_day(workspace, day, None, dated=False) for day in (one.before, one.after))
        old, new = set(map(str, first.data_vars)), set(map(str, second.data_vars))
        yield replace(
            one,
            variables=tuple(_variable_changes(first, second)),
            gained=tuple(sorted(new - old)),
            lost=tuple(sorted(old - new)),
        )


def _variable_changes(before: xr.Dataset, after: xr.Dataset) -> Iterator[VariableChange]:
    rows = next((name for name in ("tt2000", "start") if name in before and name in after), None)
    if rows is None:
        return
    dim = before[rows].dims[0]
    _, old, new = np.intersect1d(
        before[rows].values, after[rows].values, assume_unique=True, return_indices=True
    )
    for name in map(str, before.data_vars):
        one = before[name]
        if name not in after or name == rows or one.dims[:1] != (dim,) or one.dtype.kind != "f":
            continue
        other = after[name]
        if other.shape[1:] != one.shape[1:]:
            continue
        # Both are stored to a resolution: equal numbers are equal bits.
        apart = (other.values[new] - one.values[old]).reshape(new.size, -1)
        size = np.sqrt(np.sum(apart**2, axis=1))
        size = size[np.isfinite(size)]
        if size.size and size.max() > 0:
            yield VariableChange(
                variable=name,
                units=str(one.attrs.get("units", "")),
                rms=float(np.sqrt(np.mean(size**2))),
                largest=float(size.max()),
                samples=int(size.size),
            )
