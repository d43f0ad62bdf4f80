"""Windows of states and the keys of what is made from them: what has to be done, told before it is."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from inflight.catalog import Catalog, TableRecord, idempotency_key
from inflight.tasks.planning import Plan, ReprocessSettings
from inflight.tasks.states_chain import OWN, Chain, chained_key
from inflight.tasks.states_day import STATES_PRODUCT_VERSION
from inflight.tasks.states_window import STATES_VERSION
from inflight.tasks.tables import window_edges

#: The table, by name without the comparison.
STATES = "states"


def windows(days: Sequence[np.datetime64], settings: ReprocessSettings) -> list[list[np.datetime64]]:
    """Return the days of each window that has any: days, windows of the fixed grid, or all together."""
    if settings.table == "span":
        return [list(days)]
    size = 1 if settings.table == "daily" else settings.window_days
    edges = window_edges(min(days), max(days), size)
    groups = [[day for day in days if low <= day < high] for low, high in pairwise(edges)]
    return [group for group in groups if group]


def table_name(made: Plan) -> str:
    """Return the name of a plan's table of states."""
    return f"{made.settings.comparison}-{STATES}"


def window_key(made: Plan, group: Sequence[np.datetime64]) -> str:
    """Return the key of what a window tells by itself: of its days' readings, mission and model."""
    told = [STATES, str(STATES_VERSION), made.context, *(made.keys[day] for day in group)]
    return hashlib.sha256("".join(told).encode()).hexdigest()


def product_key(made: Plan, day: np.datetime64, table_key: str) -> str:
    """Return the key of a day's product, from its readings and the table that holds."""
    inputs = [made.keys[day], table_key]
    return idempotency_key(made.product, day, STATES_PRODUCT_VERSION, made.context, inputs)


@dataclass
class KnownTables:
    """The tables of states that the archive has, certified or left by a run that was ended.

    Attributes
    ----------
    joined : dict of str to TableRecord
        By the whole key.
    learnt : dict of str to TableRecord
        By the part of the key that tells a window's own inputs: what it tells by itself need not be
        learnt again, whatever it was joined to.
    """

    joined: dict[str, TableRecord] = field(default_factory=dict)
    learnt: dict[str, TableRecord] = field(default_factory=dict)

    @classmethod
    def of(cls, cat: Catalog, name: str) -> KnownTables:
        """Return those of a name; damaged ones are not known."""
        records = [one for one in cat.tables(name) if not one.damaged]
        return cls({one.key: one for one in records}, {one.key[:OWN]: one for one in records})


def days_to_do(cat: Catalog, made: Plan) -> tuple[list[np.datetime64], list[np.datetime64]]:
    """Return the days whose products a run would make, and those it would leave alone.

    A window that is to be learnt from changes those behind it: they are joined to it anew.
    """
    name = table_name(made)
    known = KnownTables.of(cat, name)
    current = {day.day: day.key for day in cat.days(made.product, states=("published",))}
    groups = windows(made.days, made.settings)
    chain = Chain.before(cat, name, groups[0][0])
    todo: list[np.datetime64] = []
    same: list[np.datetime64] = []
    for group in groups:
        key = chained_key(window_key(made, group), chain.keys)
        for day in group:
            unchanged = key in known.joined and current.get(day) == product_key(made, day, key)
            (same if unchanged else todo).append(day)
        if key in known.joined:
            chain.add(key, cat.table_by_id(known.joined[key].id))
        else:
            chain.add_unknown(key)
    return todo, same
