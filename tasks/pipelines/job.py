"""A batch of days and what became of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from inflight.catalog import Catalog, DayData, Segment, cause_of, write_segment
from inflight.errors import InflightError
from inflight.tasks.archive import ArchiveIndex, Need, cached_readings


@dataclass(frozen=True)
class Failure:
    """Why a day could not be made."""

    cause: str
    message: str
    remedy: str = ""
    channel: str = ""


@dataclass(frozen=True)
class Job:
    """A batch of days for one worker; it is read without the database."""

    days: tuple[np.datetime64, ...]
    keys: Mapping[np.datetime64, str]
    parents: Mapping[np.datetime64, tuple[str, ...]]
    index: ArchiveIndex
    needs: tuple[Need, ...]
    run: str
    dataset: str


@dataclass
class Outcome:
    """What a worker made of its batch."""

    segment: Segment | None = None
    failures: dict[np.datetime64, Failure] = field(default_factory=dict)


def failure_of(error: BaseException) -> Failure:
    """Return cause and remedy of an error; what is no error of ours is a bug."""
    if isinstance(error, InflightError):
        told = f"{error.file}: {error.message}" if error.file else error.message
        return Failure(error.cause, told, error.remedy, error.channel)
    cause = cause_of(error)
    return Failure(
        cause, f"{type(error).__name__}: {error}", "please report it with the log" if cause == "bug" else ""
    )


def make_days(
    cat: Catalog,
    job: Job,
    make: Callable[[np.datetime64], tuple[xr.Dataset, dict[str, Any]]],
    together: Callable[[Sequence[xr.Dataset]], list[xr.Dataset]] = list,
) -> Outcome:
    """Make each day of a batch, on one BLAS thread, and write those that succeed as one segment.

    Parameters
    ----------
    cat : Catalog
        Only its workspace is used.
    job : Job
        The batch.
    make : callable
        Returns the dataset and the report of a day.
    together : callable, optional
        Makes the datasets of the days fit for one store.

    Returns
    -------
    Outcome
        The segment, and why days are not in it.
    """
    outcome, made = Outcome(), []
    with threadpool_limits(1), cached_readings():
        for day in job.days:
            try:
                dataset, report = make(day)
            except Exception as error:  # one bad day must not stop the others; its cause is recorded
                outcome.failures[day] = failure_of(error)
                continue
            made.append(DayData(day, dataset, job.keys[day], job.parents[day], report))
        if made:
            fit = together([one.dataset for one in made])
            made = [replace(one, dataset=dataset) for one, dataset in zip(made, fit, strict=True)]
            outcome.segment = write_segment(cat.workspace, job.run, job.dataset, made)
    return outcome
