"""What is missing of the days of a dataset, as spans in time: days, samples, and values of samples."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from inflight.catalog import Day
from inflight.flags import Flag
from inflight.time import GAP, SECOND, day_bounds, usual_step, utc_text

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class MissingSpan:
    """A span in which something of a dataset is missing.

    Attributes
    ----------
    start, end : int
        TT2000, half-open.
    what : str
        ``day``, ``samples``, or the variables that samples have no value of.
    why : str
        Cause of a missing day, flags of samples that lack values.
    samples : int
        How many are there all the same.
    """

    dataset: str
    start: int
    end: int
    what: str
    why: str
    samples: int = 0

    def row(self) -> dict[str, object]:
        """Return the row of ``missing.csv``."""
        return {
            "dataset": self.dataset,
            "start": utc_text(self.start),
            "end": utc_text(self.end),
            "seconds": round((self.end - self.start) / SECOND, 3),
            "what": self.what,
            "samples": self.samples,
            "why": self.why,
        }


def span_of_absent_day(day: Day) -> MissingSpan:
    """Return the span of a day that is not there, with what the catalog knows of the cause."""
    why = ": ".join(filter(None, (day.cause or day.state, day.message)))
    return MissingSpan(day.dataset, *day_bounds(day.day), "day", why)


def missing_spans(day: Day, dataset: xr.Dataset) -> Iterator[MissingSpan]:
    """Yield the spans of a day without samples, and those whose samples lack values, with their flags."""
    start, end = day_bounds(day.day)
    stamps = dataset["tt2000"].values
    step = usual_step(stamps, end - start)
    edges = np.concatenate([[start - step], stamps, [end]])
    for place in np.flatnonzero(np.diff(edges) > GAP * step):
        yield MissingSpan(day.dataset, int(edges[place] + step), int(edges[place + 1]), "samples", "")
    names = [
        str(name)
        for name, array in dataset.data_vars.items()
        if array.dims[:1] == ("time",) and array.dtype.kind == "f"
    ]
    lost = np.zeros((stamps.size, len(names)), dtype=np.bool_)
    for column, name in enumerate(names):
        lost[:, column] = ~np.isfinite(dataset[name].values).reshape(stamps.size, -1).all(axis=1)
    flags = dataset["flag"].values if "flag" in dataset else np.zeros(stamps.size, dtype=np.uint32)
    places = np.flatnonzero(lost.any(axis=1))
    if not places.size:
        return
    # A run is of the same variables and the same flags.
    goes_on = (np.diff(places) == 1) & (np.diff(stamps[places]) <= GAP * step)
    goes_on &= (lost[places[1:]] == lost[places[:-1]]).all(axis=1) & (flags[places[1:]] == flags[places[:-1]])
    for run in np.split(places, np.flatnonzero(~goes_on) + 1):
        until = min(int(stamps[run[-1]]) + step, end)
        what = " ".join(name for name, absent in zip(names, lost[run[0]], strict=True) if absent)
        why = " ".join(str(bit.name).lower() for bit in Flag if bit and flags[run[0]] & np.uint32(bit))
        yield MissingSpan(day.dataset, int(stamps[run[0]]), until, what, why, run.size)


def joined_spans(spans: Sequence[MissingSpan]) -> list[MissingSpan]:
    """Return spans in order of dataset and time; those that midnight cut are one again."""
    out: list[MissingSpan] = []
    for one in sorted(spans, key=lambda span: (span.dataset, span.what, span.start)):
        last = out[-1] if out else None
        if last and (last.dataset, last.what, last.why, last.end) == (
            one.dataset,
            one.what,
            one.why,
            one.start,
        ):
            out[-1] = replace(last, end=one.end, samples=last.samples + one.samples)
        else:
            out.append(one)
    return sorted(out, key=lambda span: (span.dataset, span.start, span.what))
