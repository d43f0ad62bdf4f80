"""The ledger of what a release lacks: each span once, with its flags or cause."""

import numpy as np
import xarray as xr

from inflight.catalog import Day
from inflight.flags import Flag
from inflight.tasks.missing_spans import joined_spans, missing_spans, span_of_absent_day
from inflight.time import SECOND, day_bounds

DAYS = [np.datetime64("2016-12-31") + step for step in range(3)]


def product(day, kept, without=slice(0)):
    """Return a day with a sample a minute, of which some are kept, and some of these have no field."""
    start, end = day_bounds(day)
    stamps = np.arange(start, end, 60 * SECOND)
    field, flag = np.ones((stamps.size, 3)), np.zeros(stamps.size, dtype=np.uint32)
    field[without, 1] = np.nan
    flag[without] = np.uint32(Flag.VECTOR_MISSING | Flag.OUT_OF_RANGE)
    scalar = np.ones(stamps.size)
    scalar[np.arange(stamps.size)[without][-1:]] = np.nan
    variables = {"tt2000": ("time", stamps), "flag": ("time", flag), "scalar": ("time", scalar)}
    variables["field_nec"] = (("time", "axis"), field)
    return xr.Dataset(variables).isel(time=kept)


def test_gaps_run_on_over_midnight_and_missing_values_have_their_flags():
    first, last = (Day(dataset="l2/field", day=day, state="published") for day in DAYS[:2])
    lost = Day(dataset="l2/field", day=DAYS[2], state="no_work", cause="no_work", message="no file")
    # A day with a leap second: its last minute but one begins at 23:59:00 and lasts two steps.
    spans = [
        *missing_spans(first, product(DAYS[0], slice(0, 1430), slice(10, 13))),
        *missing_spans(last, product(DAYS[1], slice(5, None))),
        span_of_absent_day(lost),
    ]
    rows = [one.row() for one in joined_spans(spans)]
    assert [(row["what"], row["start"][:19], row["end"][:19], row["samples"]) for row in rows] == [
        ("field_nec", "2016-12-31T00:10:00", "2016-12-31T00:12:00", 2),
        ("scalar field_nec", "2016-12-31T00:12:00", "2016-12-31T00:13:00", 1),
        ("samples", "2016-12-31T23:50:00", "2017-01-01T00:05:00", 0),
        ("day", "2017-01-02T00:00:00", "2017-01-03T00:00:00", 0),
    ]
    assert [row["seconds"] for row in rows] == [120.0, 60.0, 901.0, 86_400.0]
    bad = "vector_missing out_of_range"
    assert [row["why"] for row in rows] == [bad, bad, "", "no_work: no file"]
    assert not list(missing_spans(last, product(DAYS[1], slice(None))))
