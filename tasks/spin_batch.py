"""The spin's part of a reprocessing: batches of days, and the tables of all of them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from inflight.catalog import Catalog, Day, Run
from inflight.errors import CalibrationError
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.calibrate import Job, Outcome, make_days
from inflight.tasks.flips import cut_at_flips, flips_of
from inflight.tasks.keeping import SolvedTables, TableKeeper
from inflight.tasks.planning import ONE_DAY, Plan
from inflight.tasks.spin_day import spin_day
from inflight.tasks.spin_flipper import flipper_table
from inflight.tasks.spin_tables import spin_table, zero_level_table
from inflight.tasks.tables import month_edges, window_edges


def spin_batch(cat: Catalog, mission: Mission, model: Model, job: Job) -> Outcome:
    """Make what each day of a batch tells, and write it as one segment."""
    return make_days(cat, job, lambda day: spin_day(cat, mission, model, day, job))


def solve_spin(
    cat: Catalog, made: Plan, run: Run, days: Mapping[np.datetime64, Day], *, mission: Mission
) -> SolvedTables:
    """Make the tables of a spin comparison: zero levels, each day, windows, months, the whole span.

    The offset along the spin axis takes many hours of wind: days and months have that of their calendar
    month, windows and the span those of the windows. No window holds two positions of a flipper.
    """
    settings, model = made.settings, made.model
    ordered = sorted(days)
    read = [cat.read(days[day]) for day in ordered]
    first, last = ordered[0], ordered[-1]
    windows = cut_at_flips(window_edges(first, last, settings.window_days), mission)
    months = cut_at_flips(month_edges(first, last), mission)
    whole = cut_at_flips([first, last + ONE_DAY], mission)
    keep = TableKeeper(cat, made, run, days)
    by_window = keep.table("zero-level", partial(zero_level_table, read, model, windows))
    by_month = keep.table("zero-level-monthly", partial(zero_level_table, read, model, months))
    makers = {
        "daily": ([*ordered, last + ONE_DAY], by_month),
        "window": (windows, by_window),
        "monthly": (months, by_month),
        "span": (whole, by_window),
    }
    tables = {
        kind: keep.table(kind, partial(spin_table, read, model, bounds, kind, zero))
        for kind, (bounds, zero) in makers.items()
    }
    notes = {}
    if flips_of(mission):
        try:
            keep.table("flipper", partial(flipper_table, read, model, whole, mission))
        except CalibrationError as error:
            notes["flipper"] = error.message
    return SolvedTables(tables[settings.table], keep.ids, keep.certify, model, notes)
