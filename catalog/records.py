"""What the catalog gives and takes: days, segments, tables, files. Plain frozen records without a database.

Words: a *segment* is one immutable Zarr store that holds several days of one dataset; a *day* is one
revision of one UTC day of one dataset; a *row* of a segment is the place of a day in it.
"""

from __future__ import annotations

import datetime as dt
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from inflight.errors import CatalogError

if TYPE_CHECKING:
    import xarray as xr

#: The states a day goes through; the last four are ends. Nothing needs a revision that was freed.
DAY_STATES: Final = ("planned", "running", "staged", "verified", "published", "failed", "no_work", "freed")
#: Why a day is not there, or, with ``partial``, why not all of it is.
CAUSES: Final = ("no_work", "repeatable", "partial", "bug", "transient")

#: How far a product is checked. What no release holds is quick-look; definitive needs approved tables.
MATURITIES: Final = ("quick-look", "preliminary", "definitive")

#: Begin the note of a store that is not to be used any more: it was found damaged, or its place was freed.
DAMAGED: Final = "damaged: "
FREED: Final = "freed: "


def is_gone(notes: Sequence[str]) -> bool:
    """Return True when a store's notes state that it was found damaged, or was freed."""
    return any(note.startswith((DAMAGED, FREED)) for note in notes)


@dataclass(frozen=True)
class DayData:
    """One day of one dataset, to be written.

    Parameters
    ----------
    day : datetime64[D]
        The UTC day; every sample must lie in it.
    dataset : xarray.Dataset
        With row dimension ``time`` and int64 ``tt2000`` (time), or row dimension ``block`` and
        int64 ``start`` (block), both strictly increasing. A ``time`` coordinate is dropped: it
        follows from ``tt2000``. Variables without the row dimension are the same for all days of a segment.
    key : str
        Idempotency key, see `idempotency_key`.
    parents : tuple of str
        Lineage ids of what the day was made from.
    report : dict
        JSON-able; ``coverage`` (0 to 1) and ``gaps`` have a meaning to the catalog's listings, and
        ``partial`` is the message of a day that was made though something it needs was missing.
    """

    day: np.datetime64
    dataset: xr.Dataset
    key: str = ""
    parents: tuple[str, ...] = ()
    report: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class SegmentRow:
    """Where one day lies in a segment: rows ``[start, stop)``; times are TT2000, both samples included."""

    day: np.datetime64
    start: int
    stop: int
    key: str
    first_tt2000: int
    last_tt2000: int
    count: int
    report: Mapping[str, Any]
    parents: tuple[str, ...] = ()
    #: Spacing of the samples in ns when it is exactly constant, else 0.
    step_ns: int = 0


@dataclass(frozen=True, kw_only=True)
class Segment:
    """A complete, verified, immutable store.

    `path` is relative to the workspace, `sha256` that of its manifest; `notes` list what could not be packed.
    """

    path: str
    name: str
    sha256: str
    bytes: int
    rows: tuple[SegmentRow, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Day:
    """One revision of one day of one dataset, as the catalog knows it.

    `version` is empty and `revision` is -1 until the day is published. `rows` are the rows
    ``[start, stop)`` of the store `segment` (relative to the workspace). `coverage` is the part of
    the day's expected samples that is there (0 to 1), None when unknown.
    """

    dataset: str
    day: np.datetime64
    state: str
    cause: str = ""
    message: str = ""
    version: str = ""
    revision: int = -1
    coverage: float | None = None
    count: int = 0
    key: str = ""
    run: str = ""
    id: str = ""
    segment: str = ""
    rows: tuple[int, int] = (0, 0)
    report: Mapping[str, Any] = field(default_factory=dict)
    context: str | None = None
    first_tt2000: int = 0
    last_tt2000: int = 0
    step_ns: int = 0


@dataclass(frozen=True, kw_only=True)
class ReleaseRecord:
    """A release: its version, when it was made (ISO 8601, UTC), first and last day of each dataset in it.

    `maturity` is one of `MATURITIES`.
    """

    version: str
    created: str
    datasets: Mapping[str, tuple[dt.date, dt.date]]
    maturity: str = "preliminary"


@dataclass(frozen=True, kw_only=True)
class TableRecord:
    """One calibration table; `certified` lists ``(context, start, end)`` in half-open TT2000.

    A `damaged` one is known by its record only: its store was found not to be as it was written, or was
    freed. `approved` lists who answers for it and when they said so, with a note. A person took validity of a
    `decertified` one away: runs do not give it back.
    """

    id: int
    name: str
    start: int
    end: int
    run: str
    context: str | None
    key: str
    segment: str
    certified: tuple[tuple[str | None, int, int], ...] = ()
    damaged: bool = False
    approved: tuple[tuple[str, str, str], ...] = ()
    decertified: bool = False


@dataclass(frozen=True, kw_only=True)
class FileRecord:
    """A delivered file that was taken in."""

    instrument: str
    path: str
    sha256: str
    size: int
    mtime_ns: int
    days: tuple[str, ...]
    report: Mapping[str, Any]
    run: str


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """One run; `state` is running, done or failed."""

    id: str
    kind: str
    state: str
    cause: str
    message: str
    context: str | None
    settings: Mapping[str, Any]
    started: str
    ended: str | None


@dataclass(frozen=True, kw_only=True)
class CertificationAct:
    """What was done to the validity of a table in ``[start, end)``, TT2000: by whom, when and why.

    `act` is ``certify``, which ends what other tables of the name had there, or ``decertify``. `run` is the
    run that did it, None for a person. `context` is None for validities in any context.
    """

    table: int
    name: str
    context: str | None
    act: str
    start: int
    end: int
    author: str
    reason: str
    created: str
    run: str | None


#: A table is valid in half-open TT2000: (table id, start, end).
Validity = tuple[int, int, int]


@dataclass(frozen=True)
class ContextRecord:
    """What a context pins: the mission YAML, one model version, and which table of a name is valid when."""

    id: str
    mission_text: str
    model_name: str
    model_version: int
    tables: Mapping[str, Sequence[Validity]]


@dataclass(frozen=True, kw_only=True)
class NamedContext:
    """The context of one comparison that a name stands for.

    `run` is the reprocessing whose choices go with it, `as_of` up to when it knows what was done.
    """

    name: str
    comparison: str
    context: str
    run: str
    author: str
    reason: str
    as_of: str
    created: str


@dataclass(frozen=True, kw_only=True)
class ModelRecord:
    """One version of a model; `parent` is the version it was made from.

    `change` is what making it did to the residual, as plain fields: rms before and after, held out and not,
    noise floor (nT), days. None where nothing was measured.
    """

    name: str
    version: int
    parent: int | None
    message: str
    sha256: str
    created: str
    change: dict[str, Any] | None = None


def idempotency_key(
    product: str, day: str | np.datetime64, algorithm_version: int, context: str | None, inputs: Sequence[str]
) -> str:
    """Return the key of a piece of work: same key, nothing to do.

    Parameters
    ----------
    product : str
        Dataset that is made.
    day : str or datetime64[D]
        The UTC day.
    algorithm_version : int
        Raised by hand with each change of the algorithm: a commit hash would re-run a mission for a typo.
    context : str or None
        Id of the context.
    inputs : sequence of str
        Hashes or keys of what goes in; their order does not matter.

    Returns
    -------
    str
        64 hexadecimal digits.
    """
    parts = [product, str(utc_day(day)), algorithm_version, context or "", sorted(inputs)]
    return sha256_text(json.dumps(parts))


def utc_day(day: str | dt.date | np.datetime64) -> np.datetime64:
    """Return a day given as text, date or datetime64 as datetime64[D]."""
    date: np.datetime64 = np.datetime64(day).astype("datetime64[D]")
    return date


def sha256_text(text: str) -> str:
    """Return the sha256 of a text's UTF-8 bytes, in hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


def version_text(baseline: int, revision: int) -> str:
    """Write a version as ``vXX.YY``."""
    return f"v{baseline:02d}.{revision:02d}"


def parse_version(version: str) -> tuple[int, int]:
    """Read ``vXX.YY``; return baseline and revision.

    Raises
    ------
    CatalogError
        When the text is no version.
    """
    baseline, dot, revision = version.removeprefix("v").partition(".")
    if not (dot and baseline.isdigit() and revision.isdigit()):
        raise CatalogError(f"{version!r} is no version", remedy="write baseline and revision, as in 'v01.03'")
    return int(baseline), int(revision)
