"""What is served: one dataset a release and product, described from what the release holds.

In goes a workspace or a release's folder (`Collection.open`); out come datasets (`Served`) that say what they
are (`info`) and give their samples block by block (`blocks`). A release never changes, so what was
described once is kept; samples are read a day at a time and kept by nobody.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from inflight.catalog import (
    Catalog,
    DatasetDescription,
    Day,
    MissionStatement,
    ReleaseFolder,
    ReleaseRecord,
    Workspace,
)
from inflight.errors import CatalogError, IntegrityError
from inflight.serve.records import TIME, Parameter, time_info
from inflight.serve.times import day_text, duration_text
from inflight.time import SECOND, as_day, day_bounds, day_of, utc_text

#: Numbers and texts of one block: bounds the memory of a request beside the day that is read.
CELLS_PER_BLOCK: Final = 200_000
#: Days whose records are looked up at once.
_DAYS_AT_ONCE: Final = 32
#: Samples of the span that ``info`` names as an example.
_EXAMPLE: Final = 100
_OTHER_NAMES: Final = "its name has a comma, or is another's in other letters"


@dataclass(frozen=True)
class Served:
    """One dataset of one release.

    Parameters
    ----------
    catalog : Catalog
        Where its days are.
    statement : MissionStatement
        What the mission says of itself.
    release : ReleaseRecord
    dataset : str
        In the catalog, such as ``l2/field``.
    """

    catalog: Catalog
    statement: MissionStatement
    release: ReleaseRecord
    dataset: str

    @property
    def id(self) -> str:
        """Mission, version and dataset: ``champ/1.0/l2/field``."""
        return f"{self.statement.mission or 'mission'}/{self.release.version}/{self.dataset}"

    @property
    def title(self) -> str:
        """Short name for people."""
        return f"{self.dataset}, release {self.release.version}"

    @property
    def start(self) -> int:
        """TT2000 at which its first day begins."""
        return day_bounds(np.datetime64(self.release.datasets[self.dataset][0]))[0]

    @property
    def stop(self) -> int:
        """TT2000 at which its last day ends."""
        return day_bounds(np.datetime64(self.release.datasets[self.dataset][1]))[1]

    @cached_property
    def description(self) -> DatasetDescription:
        """What the release holds of it; read once."""
        return self.catalog.describe(self.dataset, self.release.version)

    @cached_property
    def has_samples(self) -> bool:
        """True when it has samples in time: a record of HAPI has one."""
        first, _ = self.release.datasets[self.dataset]
        try:
            days = self._days(*day_bounds(np.datetime64(first)))
            return all("tt2000" in self.catalog.read(day, with_time=False) for day in days)
        except IntegrityError:
            # Damage is told to who asks for the data, and does not hide what is whole.
            return True

    @cached_property
    def parameters(self) -> dict[str, Parameter]:
        """Its parameters by name, without the time."""
        found: dict[str, Parameter] = {}
        for variable in self.description.variables:
            parameter = Parameter.of(variable)
            taken = variable.name.lower() in {TIME.lower(), *(name.lower() for name in found)}
            if parameter is not None and not taken and "," not in variable.name:
                found[variable.name] = parameter
        return found

    def info(self, parameters: Sequence[Parameter]) -> dict[str, Any]:
        """Return what ``info`` says of it, without version and status, with some of its parameters."""
        described, stated = self.description, self.statement
        # Whole seconds: two at least, so that one of them is whole.
        example = described.first_tt2000 + max(_EXAMPLE * described.cadence_ns, 2 * SECOND)
        last_day = self.release.datasets[self.dataset][1]
        stop = day_text(last_day + dt.timedelta(days=1))
        header, person = stated.header, (stated.header.pi_name, stated.header.pi_affiliation)
        fields = {
            "startDate": day_text(self.release.datasets[self.dataset][0]),
            "stopDate": stop,
            # Instruments do not state whether they stamp the beginning, middle or end of what they average.
            "timeStampLocation": "other",
            "cadence": duration_text(described.cadence_ns) if described.cadence_ns else "",
            "sampleStartDate": utc_text(described.first_tt2000),
            "sampleStopDate": utc_text(example) if example < self.stop else stop,
            "description": ": ".join(filter(None, (stated.description, self.title))),
            "contact": ", ".join(filter(None, person)),
            "resourceURL": header.link,
            "resourceID": header.doi,
            "citation": _doi_url(header.doi),
            "x_version": self.release.version,
            "x_frozen": True,
            **self._active(),
            "x_maturity": self.release.maturity if self.dataset.startswith("l2/") else "",
            "x_dataset": self.dataset,
            "x_days": described.days,
            "x_samples": described.samples,
            "x_doi": header.doi,
            "x_acknowledgement": stated.acknowledgement,
            "x_rules_of_use": header.rules_of_use,
            "x_left_out": self._left_out(),
        }
        return {
            **{key: value for key, value in fields.items() if value not in ("", {})},
            "parameters": [time_info(), *(parameter.info() for parameter in parameters)],
        }

    def _active(self) -> dict[str, Any]:
        """Return the newest release that has the dataset, and the published days that none has yet.

        Those may still change, and are not served; of a release's folder nothing of the kind is known.
        """
        releases = [one.version for one in self.catalog.releases() if self.dataset in one.datasets]
        frozen = {day.id for version in releases for day in self.catalog.days(self.dataset, release=version)}
        days = [
            day.day for day in self.catalog.days(self.dataset, states=("published",)) if day.id not in frozen
        ]
        newest = {"x_newest_release": releases[-1]}
        if not days:
            return newest
        ends = days[0], days[-1] + np.timedelta64(1, "D")
        span = {
            name: f"{day}T00:00:00Z"
            for name, day in zip(("x_active_start", "x_active_stop"), ends, strict=True)
        }
        return {**newest, "x_active_days": len(days), **span}

    def _left_out(self) -> dict[str, str]:
        """Variable -> why it is no parameter."""
        no_type = {
            variable.name: "HAPI has no type for it" if Parameter.of(variable) is None else _OTHER_NAMES
            for variable in self.description.variables
            if variable.name not in self.parameters
        }
        return {**self.description.left_out, **no_type}

    def blocks(
        self, start: int, stop: int, parameters: Sequence[Parameter]
    ) -> Iterator[tuple[npt.NDArray[np.int64], list[npt.NDArray[Any]]]]:
        """Yield times and values of the samples in TT2000 ``[start, stop)``, a part of a day at a time.

        Yields
        ------
        tt2000 : ndarray of int64, shape (n,)
        columns : list of ndarray, shape (n, ...)
            Of each parameter, as `Parameter.values` gives them.

        Raises
        ------
        IntegrityError
            When a store is not as it was written.
        """
        begin = start
        while begin < stop:
            # Windows end with a day, so that none is met twice.
            _, end = day_bounds(as_day(str(day_of(begin))) + np.timedelta64(_DAYS_AT_ONCE - 1, "D"))
            for day in self._days(begin, min(end, stop)):
                yield from self._blocks_of_day(day, start, stop, parameters)
            begin = end

    def _days(self, start: int, stop: int) -> list[Day]:
        return [
            day
            for day in self.catalog.days(self.dataset, slice(start, stop), release=self.release.version)
            if day.count
        ]

    def _blocks_of_day(
        self, day: Day, start: int, stop: int, parameters: Sequence[Parameter]
    ) -> Iterator[tuple[npt.NDArray[np.int64], list[npt.NDArray[Any]]]]:
        stamps, _ = self.catalog.read_variable(day, "tt2000")
        first, last = (int(place) for place in np.searchsorted(stamps, (start, stop)))
        if first == last:
            return
        columns = [
            (parameter, None)
            if day.segment in parameter.variable.absent
            else (parameter, self.catalog.read_variable(day, parameter.name)[0])
            for parameter in parameters
        ]
        cells = 1 + sum(int(np.prod(parameter.variable.shape)) for parameter in parameters)
        rows = max(1, CELLS_PER_BLOCK // cells)
        for begin in range(first, last, rows):
            end = min(begin + rows, last)
            yield (
                stamps[begin:end],
                [
                    parameter.absent(end - begin) if stored is None else parameter.values(stored[begin:end])
                    for parameter, stored in columns
                ],
            )


class Collection:
    """The datasets of all releases of a catalog.

    Parameters
    ----------
    catalog : Catalog
        Of a workspace, or of a release's folder.
    statement : MissionStatement
        What the mission says of itself.
    """

    def __init__(self, catalog: Catalog, statement: MissionStatement) -> None:
        self.catalog, self.statement = catalog, statement
        self._known: dict[str, Served] = {}

    @classmethod
    def open(cls, folder: Path) -> Collection:
        """Open a workspace or a release's folder.

        Raises
        ------
        WorkspaceError
            When it is neither.
        CatalogError
            When nothing was released, or the release holds no Zarr stores.
        """
        release = ReleaseFolder.find(folder)
        if release is not None:
            collection = cls(Catalog(folder), release.statement)
        else:
            workspace = Workspace.open(folder)
            collection = cls(Catalog(workspace.root), MissionStatement.of(workspace.mission()))
        if not collection.datasets():
            raise CatalogError(
                "nothing was released here", file=str(folder), remedy="first 'inflight release 1.0'"
            )
        return collection

    def datasets(self) -> list[Served]:
        """Return what there is, the oldest release first; a release made meanwhile is among them."""
        found = []
        for record in self.catalog.releases():
            for name in record.datasets:
                served = Served(self.catalog, self.statement, record, name)
                found.append(self._known.setdefault(served.id, served))
        return [served for served in found if served.has_samples]

    def find(self, id: str) -> Served | None:
        """Return the dataset of an id, None when there is none."""
        if id not in self._known:
            self.datasets()
        served = self._known.get(id)
        return served if served is not None and served.has_samples else None


def _doi_url(doi: str) -> str:
    return f"https://doi.org/{doi.removeprefix('https://doi.org/').removeprefix('doi:')}" if doi else ""
