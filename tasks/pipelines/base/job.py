"""A batch of days for one worker, and its outcome.

`Batch` and `ProductBatch` are what a pipeline's `make_day` and `make_product` are given. `make_days` makes
each day of a batch and writes those that succeed as one segment of the archive; a day that fails does not
stop the others, and its `Failure` is recorded.
"""

from __future__ import annotations

import re
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight import __version__
from inflight.catalog import Catalog, DayData, Segment, failure_cause, write_segment
from inflight.errors import InflightError
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.archive import ArchiveIndex, Need, cached_readings
from inflight.tasks.pipelines.base.planning import ReprocessSettings
from inflight.threads import one_thread
from inflight.time import day_bounds

if TYPE_CHECKING:
    import xarray as xr


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

    @property
    def span(self) -> tuple[int, int]:
        """Half-open TT2000 of the days, with what their samples reach into those around."""
        reach = max((need.around_ns for need in self.needs), default=0)
        return day_bounds(min(self.days))[0] - reach, day_bounds(max(self.days))[1] + reach


@dataclass(frozen=True, kw_only=True)
class Batch:
    """What a worker is given to make the statistics of a batch of days.

    Attributes
    ----------
    cat : Catalog
        Only its workspace is used.
    model : Model
        What is fitted, its start and its priors.
    job : Job
        The days, and what they are made from.
    reference : sequence of float, optional
        Parameters that the equations are expressed at; the model's own when None.
    """

    cat: Catalog
    mission: Mission
    model: Model
    job: Job
    settings: ReprocessSettings
    reference: Sequence[float] | None = None


@dataclass(frozen=True, kw_only=True)
class ProductBatch(Batch):
    """What a worker is given to make the products of a batch of days.

    Attributes
    ----------
    model : Model
        What is corrected, in order.
    table : xarray.Dataset
        The calibration table whose values the model takes, or the rows of it that the days need.
    preflight : Model
        What the residual before calibration is made with.
    table_name, model_name, context_name : str
        What of them the product's header says; no context unless one was named.
    """

    table: xr.Dataset
    preflight: Model
    table_name: str = ""
    model_name: str = ""
    context_name: str = ""


@dataclass
class Outcome:
    """What a worker made of its batch: a segment of the days that succeeded, and failures of the others."""

    segment: Segment | None = None
    failures: dict[np.datetime64, Failure] = field(default_factory=dict)


def failure_of(error: BaseException, work: str, workspace: Path) -> Failure:
    """Return cause and remedy of an error; one that is no `InflightError` is a bug, or of the machine.

    Of a bug the traceback is written below the workspace's reports, and the remedy names the file.

    Parameters
    ----------
    work : str
        What was being made, for the file's name: a run, a dataset and a day.
    workspace : Path
    """
    if isinstance(error, InflightError):
        message = f"{error.file}: {error.message}" if error.file else error.message
        return Failure(error.cause, message, error.remedy, error.channel)
    cause = failure_cause(error)
    remedy = f"please report it with {_traceback_file(error, work, workspace)}" if cause == "bug" else ""
    return Failure(cause, f"{type(error).__name__}: {error}", remedy)


def _traceback_file(error: BaseException, work: str, workspace: Path) -> str:
    """Write where an error was raised, and with which software; return the file's name."""
    file = workspace / "reports" / "tracebacks" / f"{re.sub('[^A-Za-z0-9.-]+', '-', work)}.txt"
    text = "".join(traceback.format_exception(error))
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        software = f"inflight {__version__}, Python {sys.version}"
        file.write_text(f"{software}\n{work}\n\n{text}", encoding="utf-8")
    except OSError:
        return f"this: {text.strip().splitlines()[-1]}"
    return str(file.relative_to(workspace))


def make_days(
    cat: Catalog,
    job: Job,
    make: Callable[[np.datetime64], tuple[xr.Dataset, dict[str, Any]]],
    unify: Callable[[Sequence[xr.Dataset]], list[xr.Dataset]] = list,
    folder: Path | None = None,
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
    folder : Path, optional
        Where the segment goes; the workspace when absent.
    unify : callable, optional
        Returns the datasets of the days with variables of one size, as one store needs them.

    Returns
    -------
    Outcome
        The segment, and why days are not in it.
    """
    outcome, made = Outcome(), []
    with one_thread(), cached_readings():
        for day in job.days:
            try:
                dataset, report = make(day)
            except Exception as error:  # one bad day must not stop the others; its cause is recorded
                work = f"{job.run} {job.dataset} {day}"
                outcome.failures[day] = failure_of(error, work, cat.workspace)
                continue
            made.append(DayData(day, dataset, job.keys[day], job.parents[day], report))
        if made:
            unified = unify([one.dataset for one in made])
            made = [replace(one, dataset=dataset) for one, dataset in zip(made, unified, strict=True)]
            # Days' statistics are made again from the archive any time.
            remade = job.dataset.startswith("equations/")
            outcome.segment = write_segment(folder or cat.workspace, job.run, job.dataset, made, quick=remade)
    return outcome
