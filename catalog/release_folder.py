"""A release as a folder alone: its days as the catalog it was made from knew them, without that catalog.

In goes the folder that `inflight.catalog.release` wrote, wherever it was copied to; out come `Day` records
whose stores lie in it. ``days.csv`` says which days there are, the names of the stores in ``data/`` which
hold them. Nothing is ever written into it: its manifest would not hold any more.
"""

from __future__ import annotations

import csv
import datetime as dt
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple, NoReturn

from inflight.catalog.database import Database
from inflight.catalog.days import summary_of_days
from inflight.catalog.records import Day, ReleaseRecord, parse_version, utc_day
from inflight.catalog.spans import Span, as_date, parse_span
from inflight.catalog.stores import open_store
from inflight.errors import CatalogError, IntegrityError
from inflight.mission import Mission, ReleaseHeader
from inflight.time import day_bounds

#: The file that makes a folder a release.
MARKER: Final = "release.json"
_COPY_AGAIN: Final = "copy the release again, and check it with 'sha256sum -c MANIFEST.sha256'"
#: What a release without Zarr stores holds -> how that is read.
_OTHER_FORMATS: Final = {
    "netcdf": "open its NetCDF files with xarray.open_mfdataset('{}/netcdf/SOURCE/*/*.nc')",
    "cdf": "read its CDF files with cdflib, pyspedas or SPEDAS",
}


@dataclass(frozen=True, kw_only=True)
class MissionStatement:
    """What a release says of the mission; empty where it says nothing.

    Attributes
    ----------
    mission, description, acknowledgement : str
        As the mission YAML has them.
    header : ReleaseHeader
        Its key ``release``.
    """

    mission: str = ""
    description: str = ""
    acknowledgement: str = ""
    header: ReleaseHeader = field(default_factory=ReleaseHeader)

    @classmethod
    def of(cls, mission: Mission) -> MissionStatement:
        """Return what a mission YAML states."""
        return cls(
            mission=mission.mission,
            description=mission.description,
            acknowledgement=mission.acknowledgement,
            header=mission.release,
        )


def marker_text(version: str, mission: Mission | None, maturity: str) -> str:
    """Return the content of a release's marker: version, maturity, and what the mission states."""
    stated: dict[str, Any] = {"version": version, "maturity": maturity}
    if mission is not None:
        stated |= {
            "mission": mission.mission,
            "description": mission.description,
            "acknowledgement": mission.acknowledgement,
            "release": mission.release.model_dump(exclude_defaults=True),
        }
    return json.dumps(stated) + "\n"


class _Place(NamedTuple):
    """A store of a release: the days it spans, both included, and its path in the folder."""

    first: dt.date
    last: dt.date
    path: str


class ReleaseFolder:
    """A release that was copied out.

    Parameters
    ----------
    folder : Path
        Holds ``release.json``.

    Raises
    ------
    IntegrityError
        When that cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            stated = json.loads((folder / MARKER).read_text("utf-8"))
            self.version = str(stated["version"])
            self.maturity = str(stated.get("maturity", "preliminary"))
            self.statement = MissionStatement(
                mission=stated.get("mission", ""),
                description=stated.get("description", ""),
                acknowledgement=stated.get("acknowledgement", ""),
                header=ReleaseHeader.model_validate(stated.get("release", {})),
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise IntegrityError(
                f"the release cannot be read: {error}", file=str(folder / MARKER), remedy=_COPY_AGAIN
            ) from error

    @classmethod
    def find(cls, folder: Path) -> ReleaseFolder | None:
        """Return the release in a folder; None where there is none, or a workspace."""
        is_release = (folder / MARKER).is_file() and not (folder / "catalog.db").exists()
        return cls(folder) if is_release else None

    def releases(self) -> list[ReleaseRecord]:
        """Return the one release, as a catalog lists it; it was made when the folder was written."""
        written = dt.datetime.fromtimestamp((self.folder / MARKER).stat().st_mtime, dt.UTC)
        days = {
            name: [as_date(day.day) for day in listed if day.state == "published"]
            for name, listed in self._listed.items()
        }
        record = ReleaseRecord(
            version=self.version,
            created=written.isoformat(timespec="seconds"),
            datasets={name: (dates[0], dates[-1]) for name, dates in days.items() if dates},
            maturity=self.maturity,
        )
        return [record]

    def names(self) -> list[str]:
        """Return the names of all datasets in order."""
        return list(self._listed)

    def inventory(self, span: Span) -> list[dict[str, Any]]:
        """Describe each dataset; see `Catalog.inventory`."""
        return [summary_of_days(name, self.days(name, span)) for name in self._listed]

    def published(self, name: str) -> list[tuple[dt.date, str | None]]:
        """Return the published days, and what made each; see `Catalog.published`."""
        days = self.days(name, parse_span(None), ("published",)) if name in self._listed else []
        return [(day.day.astype(dt.date), day.context) for day in days]

    def current(self, name: str, day: dt.date) -> Day | None:
        """Return the published revision of a day; None without one."""
        return next(iter(self.days(name, parse_span(day), ("published",))), None)

    def of_version(self, name: str, day: dt.date, version: str) -> Day | None:
        """Return that revision, if it is the one that was released."""
        found = self.current(name, day)
        return found if found is not None and found.version == version else None

    def to_read(self, name: str, span: Span, release: str | None, context: str | None) -> list[Day]:
        """Return the days that opening a span reads.

        Raises
        ------
        CatalogError
            When the dataset is not in the release, or a context is asked for.
        """
        if context is not None and release is None:
            self.refuse()
        if name not in self._listed:
            raise CatalogError(
                f"release {self.version} has no dataset '{name}'; it has: {', '.join(self._listed)}",
                remedy="check the name",
            )
        return self.days(name, span, ("published",), release)

    def refuse(self) -> NoReturn:
        """Refuse what only a database tells.

        Raises
        ------
        CatalogError
            Always.
        """
        raise CatalogError(
            f"this folder is release {self.version}: it holds days, but no runs, models or lineage",
            file=str(self.folder),
            remedy="ask the workspace it was made in",
        )

    def days(
        self, name: str, span: Span, states: Iterable[str] | None = None, release: str | None = None
    ) -> list[Day]:
        """Return the days of a dataset, those that are missing, too, or those in some states.

        Times of the first and last sample are not known without reading them: they are the ends of the day.

        Raises
        ------
        CatalogError
            When another release is asked for, or the samples are in files of other formats.
        IntegrityError
            When the store of a day is not there.
        """
        if release not in (None, self.version):
            raise CatalogError(f"this folder is release {self.version}", remedy="ask for that, or for none")
        first, last = span.first_day(), span.last_day()
        accepted = {"published"} if release is not None else None if states is None else set(states)
        found = [
            day
            for day in self._listed.get(name, ())
            if (first is None or as_date(day.day) >= first)
            and (last is None or as_date(day.day) <= last)
            and (accepted is None or day.state in accepted)
        ]
        return [self._placed(day) if day.state == "published" else day for day in found]

    def _placed(self, day: Day) -> Day:
        """Return a published day with its store and rows."""
        date = as_date(day.day)
        for place in self._places(day.dataset):
            if not place.first <= date <= place.last:
                continue
            store = open_store(str(self.folder / place.path))
            if str(day.day) in store.days:
                index = store.days.index(str(day.day))
                start, (begin, end) = index * store.chunk, day_bounds(day.day)
                return replace(
                    day,
                    segment=place.path,
                    rows=(start, start + store.counts[index]),
                    first_tt2000=begin,
                    last_tt2000=end - 1,
                )
        raise IntegrityError(
            f"no store holds '{day.dataset}'", file=str(self.folder), day=str(day.day), remedy=_COPY_AGAIN
        )

    def _places(self, name: str) -> list[_Place]:
        if not self._stores:
            there = [form for form in _OTHER_FORMATS if (self.folder / form).is_dir()]
            ways = [_OTHER_FORMATS[form].format(self.folder) for form in there]
            raise CatalogError(
                f"release {self.version} holds no Zarr stores, but files of format {' and '.join(there)}",
                file=str(self.folder),
                remedy=" or ".join([*ways, "have it released with '--format zarr', too"]),
            )
        return self._stores.get(name.replace("/", "."), [])

    @cached_property
    def _stores(self) -> dict[str, list[_Place]]:
        """Label of a dataset -> its stores, the oldest first."""
        found: dict[str, list[_Place]] = {}
        for path in sorted((self.folder / "data").glob("*.zarr")):
            match = re.fullmatch(r"(.+)-(\d{8})-(\d{8})(-\d+)?\.zarr", path.name)
            if match:
                first, last = (dt.date.fromisoformat(text) for text in match.group(2, 3))
                found.setdefault(match[1], []).append(_Place(first, last, f"data/{path.name}"))
        return found

    @cached_property
    def _listed(self) -> dict[str, list[Day]]:
        """Dataset -> its days in ``days.csv``, in order."""
        found: dict[str, list[Day]] = {}
        try:
            with (self.folder / "days.csv").open(encoding="utf-8", newline="") as stream:
                for row in csv.DictReader(stream):
                    found.setdefault(row["dataset"], []).append(_listed_day(row))
        except (OSError, ValueError, KeyError) as error:
            raise IntegrityError(
                f"the list of days cannot be read: {error}",
                file=str(self.folder / "days.csv"),
                remedy=_COPY_AGAIN,
            ) from error
        return found


class NoDatabase(Database):
    """Stands where a release folder has no database: whatever asks it is told what the folder is."""

    def __init__(self, release: ReleaseFolder) -> None:
        self._release = release

    def read(self, *_arguments: Any, **_options: Any) -> NoReturn:
        """Refuse.

        Raises
        ------
        CatalogError
            Always.
        """
        self._release.refuse()

    write = write_to = write_beside = read


def _listed_day(row: dict[str, str]) -> Day:
    published = bool(row["version"])
    return Day(
        dataset=row["dataset"],
        day=utc_day(row["day"]),
        state=row["state"],
        cause=row["cause"],
        message=row["message"],
        version=row["version"],
        revision=parse_version(row["version"])[1] if published else -1,
        coverage=float(row["coverage"]) if row["coverage"] else None,
        count=int(row["samples"]),
        key=row["key"],
    )
