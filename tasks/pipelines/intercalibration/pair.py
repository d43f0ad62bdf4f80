"""Which comparisons calibrate both sensors of a pair, and which tables are made of their products."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.errors import MissionError
from inflight.mission import Mission
from inflight.tasks.pipelines.base import product_of
from inflight.tasks.pipelines.intercalibration.tables import (
    bending_day,
    bending_table,
    corner_table,
    daily_relation_table,
    relation_day,
    relation_table,
)

if TYPE_CHECKING:
    import xarray as xr

#: Why two fluxgates have no product.
NO_PRODUCT = (
    "two vector sensors against each other calibrate nothing: tables of how they stand to each other are "
    "made, products come from each one's comparison with a scalar sensor"
)

#: Why two spinning sensors have no product.
NO_PRODUCT_OF_BOOM = (
    "two sensors on a boom calibrate nothing between them: a table of the bend is made, products come from "
    "each one's own spin comparison"
)


@dataclass(frozen=True, kw_only=True)
class Relation:
    """What is made of the products of two sensors, by how they are calibrated.

    Attributes
    ----------
    kind : str
        Of the comparisons that calibrate both sensors.
    read : tuple of str
        Variables of the products.
    make_day : callable
        Makes a day's statistics from both products.
    tables : mapping of str to callable
        Makes each table from the statistics of all days, and what the errors of both calibrations do to each
        (`tables.calibration_errors`; none for spinning sensors).
    note : str
        Why there is no product.
    """

    kind: str
    read: tuple[str, ...]
    make_day: Callable[[Sequence[xr.Dataset], np.datetime64], tuple[xr.Dataset, dict[str, Any]]]
    tables: Mapping[str, Callable[[Sequence[xr.Dataset], Sequence[xr.Dataset]], xr.Dataset]]
    note: str


#: In the order of preference.
RELATIONS = (
    Relation(
        kind="scalar",
        read=("field_spacecraft", "residual", "flag"),
        make_day=relation_day,
        tables={
            "relation": relation_table,
            "relation-daily": daily_relation_table,
            "corners": corner_table,
        },
        note=NO_PRODUCT,
    ),
    Relation(
        kind="spin",
        read=("field_sensor", "spin_phase", "flag"),
        make_day=bending_day,
        tables={"bending": bending_table},
        note=NO_PRODUCT_OF_BOOM,
    ),
)


@dataclass(frozen=True)
class Pair:
    """The comparisons that calibrate both sensors, the inboard one's first, and what is made of them."""

    first: str
    second: str
    relation: Relation

    @classmethod
    def of(cls, mission: Mission, comparison: str) -> Pair:
        """Return those of a mission's dual comparison.

        Raises
        ------
        MissionError
            When one of the sensors is calibrated by no scalar comparison, nor both by their spin.
        """
        own = mission.comparisons[comparison].instruments()
        names: dict[tuple[str, str], str] = {}
        for name, entry in mission.comparisons.items():
            if "vector" in entry.instruments():
                names.setdefault((entry.kind, entry.instruments()["vector"]), name)
        roles = ("inboard", "outboard")
        for relation in RELATIONS:
            if all((relation.kind, own[role]) in names for role in roles):
                first, second = (names[relation.kind, own[role]] for role in roles)
                return cls(first, second, relation)
        role = next(role for role in roles if ("scalar", own[role]) not in names)
        raise MissionError(
            f"no scalar comparison calibrates '{own[role]}', the {role} sensor of '{comparison}'",
            remedy="state one in the mission's file, or see 'inflight diagnose' for the difference",
        )

    @property
    def products(self) -> tuple[str, str]:
        """Datasets of the products of both."""
        return product_of(self.first), product_of(self.second)
