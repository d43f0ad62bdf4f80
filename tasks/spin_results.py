"""What a workspace holds of a spin comparison: its tables, their days, and the estimates chosen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog, Day
from inflight.errors import CatalogError
from inflight.estimators.longrun import sigma_of_mean
from inflight.figures.spin_estimates import Cloud
from inflight.mission import Mission
from inflight.spin.equation import NAMES, SPIN_RELATED
from inflight.spin.layout import Bools
from inflight.spin.selection import choose
from inflight.tasks.planning import equations_of, product_of
from inflight.tasks.tables import newest_tables
from inflight.time import day_of

TABLES = ("daily", "window", "zero-level")
#: A published uncertainty is so many standard deviations of white noise (Plaschke et al. 2019, table 2).
_PUBLISHED = 1.7


@dataclass(frozen=True)
class SpinResults:
    """Tables and day results of a spin comparison.

    Attributes
    ----------
    tables : mapping of str to Dataset
        ``daily``, ``window``, ``zero-level``.
    days : list of Dataset
        As `inflight.tasks.spin_day.spin_day` makes them, those of the daily table.
    records, products : list of Day
        Of the same days.
    """

    cat: Catalog
    mission: Mission
    comparison: str
    tables: Mapping[str, xr.Dataset]
    days: list[xr.Dataset]
    records: list[Day]
    products: list[Day]

    @classmethod
    def of(cls, cat: Catalog, mission: Mission, comparison: str) -> SpinResults:
        """Read the newest tables that are certified, and the days they are made of.

        Raises
        ------
        CatalogError
            When there are none.
        """
        tables = newest_tables(cat, comparison, TABLES)
        if set(tables) != set(TABLES) or "own" not in tables["daily"]:
            raise CatalogError(
                f"no tables are published for comparison '{comparison}'",
                remedy=f"run 'inflight reprocess --comparison {comparison}' first",
            )
        wanted = set(day_of(tables["daily"]["start"].values).tolist())
        records = [
            day
            for day in cat.days(equations_of(comparison), states=("published",))
            if day.day.item() in wanted
        ]
        products = [
            day for day in cat.days(product_of(comparison), states=("published",)) if day.day.item() in wanted
        ]
        return cls(cat, mission, comparison, tables, [cat.read(day) for day in records], records, products)

    @property
    def span(self) -> list[str]:
        """First and last day."""
        return [str(one)[:10] for one in day_of(self.tables["daily"]["start"].values[[0, -1]])]

    @cached_property
    def cloud(self) -> Cloud:
        """All sub-intervals of all days, and those that a threshold chooses."""
        kept = [_filled(day) for day in self.days]

        def joined(name: str) -> np.ndarray:
            return np.concatenate(
                [day[name].values[0][which] for day, which in zip(self.days, kept, strict=True)]
            )

        return cloud_of(*(joined(name) for name in ("sub_start", "sub_end", "estimate", "uncertainty")))

    @cached_property
    def selected(self) -> tuple[Floats, Floats]:
        """Means of selected estimates, and errors, day by day; (day, 8), beside the daily table's `own`."""
        own = self.tables["daily"]["own"].values[:, [NAMES.index(name) for name in SPIN_RELATED]]
        value, sigma = np.full(own.shape, np.nan), np.full(own.shape, np.inf)
        rows = self.tables["daily"]["start"].values.tolist()
        for day in self.days:
            # A day of the table may be gone since.
            row, which = rows.index(int(day["start"].values[0])), _filled(day)
            one = cloud_of(
                *(day[name].values[0][which] for name in ("sub_start", "sub_end", "estimate", "uncertainty"))
            )
            # Estimates go with the pre-flight third offset, the table's offsets with the one in use.
            value[row] = one.value + np.nan_to_num(own[row] - day["value"].values[0])
            sigma[row] = one.sigma
        return value, sigma


def _filled(day: xr.Dataset) -> Bools:
    """Return which of a day's sub-intervals are any, (sub,): rows that fill up a store have no length."""
    return np.asarray(day["sub_end"].values[0] > day["sub_start"].values[0])


def cloud_of(start: np.ndarray, end: np.ndarray, estimate: Floats, uncertainty: Floats) -> Cloud:
    """Choose of estimates (sub, 8) by their uncertainties, and return them with the means."""
    chosen = np.zeros(estimate.shape, dtype=np.bool_)
    threshold, value = (np.full(estimate.shape[1], np.nan) for _ in range(2))
    sigma = np.full(estimate.shape[1], np.inf)
    for at in range(estimate.shape[1]):
        chosen[:, at], _ = choose(np.where(np.isfinite(estimate[:, at]), uncertainty[:, at], np.nan))
        if not chosen[:, at].any():
            continue
        mine, errors = estimate[chosen[:, at], at], uncertainty[chosen[:, at], at]
        threshold[at], value[at] = float(errors.max()), float(mine.mean())
        expected = float(np.sqrt(np.sum((errors / _PUBLISHED) ** 2)) / mine.size)
        sigma[at] = max(expected, sigma_of_mean(mine))
    return Cloud(start, end, estimate, uncertainty, chosen, threshold, value, sigma)
