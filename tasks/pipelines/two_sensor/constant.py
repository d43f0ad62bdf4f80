"""The constant part of a correction from zero levels of its own product: natural fluctuations tell it.

Two sensors alone do not tell what never switches, nor their own offsets. A comparison of kind ``zero_level``
that takes the product of this one estimates both together; here its newest table is found (`ZeroLevels`) and
given to the products (`with_zero_levels`, `without_constant`). A level is only taken where it was learnt from
products of the very table of states that holds, with the same constant part: the constant of another table is
another number.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.mission import Mission
from inflight.tasks.pipelines.base import (
    KEY_DIGITS,
    Pipeline,
    Reprocessing,
    TablesToPublish,
    UsedTable,
    newest_record,
    product_key,
    table_label,
)
from inflight.tasks.pipelines.two_sensor.tables import ABSOLUTE, describe_constant
from inflight.tasks.pipelines.zero_level import BEFORE_ZERO_LEVEL, STATES_TABLE, SUBTRACTED
from inflight.time import day_bounds
from inflight.units import with_error

#: Dimension of the days that a table of states has levels of.
_DAY = "zero_day"


@dataclass(frozen=True)
class ConstantPart:
    """The constant part of a day's field, from a zero level.

    Attributes
    ----------
    value, sigma : ndarray, shape (axis,)
        nT, spacecraft axes; 0 along axes that are not told.
    words : str
        What the constant part is now.
    """

    value: Floats
    sigma: Floats
    words: str

    @property
    def key(self) -> str:
        """A hash of it, for what is made with it."""
        content = [self.value.tolist(), self.sigma.tolist(), self.words]
        return hashlib.sha256(str(content).encode()).hexdigest()


@dataclass(frozen=True)
class ZeroLevels:
    """The newest table of zero levels of a comparison's product.

    Attributes
    ----------
    comparison : str
        The comparison of kind ``zero_level``.
    label : str
        Of the table: name and key; empty without one.
    table : Dataset or None
    number : int
        Of the table in the catalog.
    """

    comparison: str
    label: str = ""
    table: xr.Dataset | None = None
    number: int = 0

    @classmethod
    def of(cls, cat: Catalog, mission: Mission, comparison: str) -> ZeroLevels | None:
        """Return the levels of a comparison's product; None where no comparison asks for them."""
        for name, entry in mission.comparisons.items():
            if entry.kind == "zero_level" and entry.product == comparison:
                record = newest_record(cat, f"{name}-window")
                if record is None:
                    return cls(name)
                return cls(name, table_label(record), cat.table_by_id(record.id), record.id)
        return None

    def of_day(self, states: xr.Dataset, label: str, day: np.datetime64) -> ConstantPart | str:
        """Return the constant part of a day, or why there is none.

        Parameters
        ----------
        states : Dataset
            The table of states that holds on the day.
        label : str
            Of that table.
        """
        before = describe_constant(states)
        if before == ABSOLUTE:
            return "the ambient field tells the constant part"
        if self.table is None:
            return (
                f"no zero level yet: run 'inflight reprocess --comparison {self.comparison}', then this again"
            )
        middle = sum(day_bounds(day)) // 2
        inside = np.flatnonzero((self.table["start"].values <= middle) & (middle < self.table["end"].values))
        if not inside.size:
            return f"{self.label} has no zero level of the day"
        row = self.table.isel(interval=int(inside[-1]))
        if label not in str(row["basis"].values).split("; ") or before != str(row["constant"].values):
            return (
                f"{self.label} was learnt from other corrections than {label}: run 'inflight reprocess "
                f"--comparison {self.comparison}', then this again"
            )
        known = row["determined"].values.astype(bool)
        if not known.any():
            return f"{self.label} tells no zero level: {row['reason'].values}"
        value, sigma = (np.where(known, row[name].values, 0.0) for name in ("value", "sigma"))
        axes = [
            f"{axis} {with_error(float(value[at]), float(sigma[at]))}" if known[at] else f"{axis} {before}"
            for at, axis in enumerate("xyz")
        ]
        words = f"zero level of {self.label} taken off: {', '.join(axes)} nT ({row['method'].values})"
        return ConstantPart(value, sigma, words)


def inputs_with_zero_level(
    levels: ZeroLevels | None, name: str, table: xr.Dataset, key: str, day: np.datetime64
) -> tuple[str, ...]:
    """Return what the product of a day depends on: the key of its table of states, and of its zero level."""
    found = None if levels is None else levels.of_day(table, f"{name}:{key[:KEY_DIGITS]}", day)
    return (key, found.key) if isinstance(found, ConstantPart) else (key,)


def with_zero_levels(
    pipeline: Pipeline, work: Reprocessing, levels: ZeroLevels | None, name: str, solved: TablesToPublish
) -> TablesToPublish:
    """Return the tables of a run, those of states with the zero level of each day that has one.

    A table of states with levels is a table of its own, ``<name>-absolute``: products name it, and are made
    again from it.

    Parameters
    ----------
    name : str
        Of the table of states.
    """
    if levels is None:
        return solved
    days_of: dict[int, list[np.datetime64]] = {}
    for day in sorted(solved.used):
        days_of.setdefault(solved.used[day].number, []).append(day)
    used, certify = dict(solved.used), list(solved.certify)
    for number, days in days_of.items():
        first = solved.used[days[0]]
        label = f"{name}:{first.inputs[0][:KEY_DIGITS]}"
        found = {day: levels.of_day(first.table, label, day) for day in days}
        reasons = "; ".join(dict.fromkeys(one for one in found.values() if isinstance(one, str)))
        table = first.table.assign_attrs(zero_level=reasons)
        known = {day: one for day, one in found.items() if isinstance(one, ConstantPart)}
        used |= {day: UsedTable(number, first.inputs, table) for day in days}
        if not known:
            continue
        before = {day: product_key(pipeline, work.plan, day, solved.used[day]) for day in known}
        table = _with_days(table, known, before).assign_attrs({STATES_TABLE: label})
        record = _staged(
            work,
            f"{name}-absolute",
            table,
            [first.inputs[0], *(one.key for one in known.values())],
            [f"table:{number}", f"table:{levels.number}"],
            days,
        )
        certify.append(record)
        for day in days:
            more = (known[day].key,) if day in known else ()
            used[day] = UsedTable(record[0], (*first.inputs, *more), table)
    return replace(solved, used=used, certify=certify)


def _with_days(
    table: xr.Dataset, known: Mapping[np.datetime64, ConstantPart], before: Mapping[np.datetime64, str]
) -> xr.Dataset:
    """Return a table of states with the zero levels of days."""
    value, sigma = (np.array([getattr(one, name) for one in known.values()]) for name in ("value", "sigma"))
    words = np.array([one.words for one in known.values()], dtype=np.str_)
    return table.assign(
        zero_start=(
            _DAY,
            np.array([day_bounds(day)[0] for day in known], dtype=np.int64),
            {"scale": "TT2000"},
        ),
        zero_value=((_DAY, "axis"), value, {"units": "nT"}),
        zero_sigma=((_DAY, "axis"), sigma, {"units": "nT"}),
        zero_words=(_DAY, words),
        zero_before=(_DAY, np.array([before[day] for day in known], dtype=np.str_)),
    )


def _staged(
    work: Reprocessing,
    name: str,
    table: xr.Dataset,
    inputs: Sequence[str],
    parents: Sequence[str],
    days: Sequence[np.datetime64],
) -> tuple[int, int, int, None]:
    """Stage a table, unless the catalog has it; return what certifies it for the days."""
    key = hashlib.sha256("".join(inputs).encode()).hexdigest()
    start, end = day_bounds(days[0])[0], day_bounds(days[-1])[1]
    same = [one.id for one in work.cat.tables(name) if one.key == key and not one.damaged]
    number = (
        same[-1]
        if same
        else work.run.stage_table(name, table, start=start, end=end, parents=list(parents), key=key)
    )
    return number, start, end, None


def constant_of_day(table: xr.Dataset, day: np.datetime64) -> str:
    """Return what the constant part of a day's field is, in words."""
    row = _row_of(table, day)
    return describe_constant(table) if row is None else str(row["zero_words"].values)


def _row_of(table: xr.Dataset, day: np.datetime64) -> xr.Dataset | None:
    if _DAY not in table.dims:
        return None
    found = np.flatnonzero(table["zero_start"].values == day_bounds(day)[0])
    return table.isel({_DAY: int(found[0])}) if found.size else None


def without_constant(product: xr.Dataset, table: xr.Dataset, day: np.datetime64) -> xr.Dataset:
    """Return a day's product with its constant part taken off, where a zero level tells it.

    Its attribute `constant` says what the constant part is, `constant_before` what it would be without the
    zero level, `zero_level` what was taken off, nT. The error of the level is part of the uncertainty.
    """
    row, before = _row_of(table, day), describe_constant(table)
    if row is None:
        return product.assign_attrs(constant=before)
    value, sigma = np.asarray(row["zero_value"].values), np.asarray(row["zero_sigma"].values)
    changed = {
        "field_spacecraft": product["field_spacecraft"].values - value,
        "uncertainty": np.hypot(product["uncertainty"].values, sigma),
    }
    out = product.assign(
        {name: (product[name].dims, values, product[name].attrs) for name, values in changed.items()}
    )
    out["uncertainty"].attrs["long_name"] = "one sigma of the part that changes and of the zero level"
    return out.assign_attrs(
        {
            "constant": str(row["zero_words"].values),
            "constant_before": before,
            STATES_TABLE: table.attrs[STATES_TABLE],
            "constant_known": "yes" if (sigma > 0.0).all() else product.attrs["constant_known"],
            SUBTRACTED: value.tolist(),
        }
    )


def report_before(table: xr.Dataset, day: np.datetime64) -> dict[str, str]:
    """Return the entry of a product's report that is its key but for the zero level; empty without one."""
    row = _row_of(table, day)
    return {} if row is None else {BEFORE_ZERO_LEVEL: str(row["zero_before"].values)}


def constant_remarks(windows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a sentence for each window of which a zero level is asked for and not there."""
    return [
        f"{one['start']} to {one['end']}: the constant part is {one['constant']}: {one['zero_level']}"
        for one in windows
        if one.get("zero_level")
    ]
