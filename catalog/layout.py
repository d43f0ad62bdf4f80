"""The days of one segment, checked and laid out: variables, rows and encodings, and the names of files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from inflight.catalog.records import DayData, SegmentRow, utc_day
from inflight.errors import ContentError
from inflight.time import SECOND, TT2000_FILL, day_bounds

if TYPE_CHECKING:
    import xarray as xr

#: Row dimension of a segment -> the variable that dates its rows.
ROW_TIMES: Final = {"time": "tt2000", "block": "start"}
#: Attribute of a store's root group that describes its rows.
LAYOUT_ATTRIBUTE: Final = "inflight"
#: Bumped when earlier versions cannot read what is written; they then say so.
LAYOUT_VERSION: Final = 2
#: Layouts that are read. In 1 a chunk had folders for its place in the grid, and each component its own file.
LAYOUTS: Final = (1, 2)
#: Stands between the parts of a new chunk's name: with a dot all chunks of an array lie in one folder.
CHUNK_SEPARATOR: Final = "."
#: Attributes that give a variable its meaning: they may not change inside a segment.
FIXED_ATTRIBUTES: Final = ("units", "frame", "resolution", "cadence_ns")

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Variable:
    """One variable of a segment: its values for each day, or once when it has no rows."""

    name: str
    dims: tuple[str, ...]
    pieces: tuple[Array, ...]
    attributes: dict[str, Any]
    #: Attributes that differ from day to day, one dict a day; empty when none does.
    by_day: tuple[dict[str, Any], ...]
    in_rows: bool
    coordinate: bool


@dataclass(frozen=True)
class Layout:
    """Row space of a segment: day k has rows ``[k * chunk, k * chunk + count_k)``."""

    row_dim: str
    chunk: int
    days: tuple[DayData, ...]
    rows: tuple[SegmentRow, ...]


def chunk_key(place: Sequence[int], separator: str) -> str:
    """Return the name of a chunk in the folder of its array: Zarr's default encoding of chunk keys."""
    return separator.join(("c", *map(str, place)))


def join_shard(chunks: Sequence[bytes]) -> bytes:
    """Return packed chunks as one shard: Zarr's codec ``sharding_indexed``, its index at the end."""
    from numcodecs.checksum32 import CRC32C

    ends = np.cumsum([len(chunk) for chunk in chunks])
    index = np.column_stack([np.append(0, ends[:-1]), np.diff(ends, prepend=0)]).astype("<u8").tobytes()
    return b"".join([*chunks, index, CRC32C.checksum(index).to_bytes(4, "little")])


def split_shard(content: bytes, count: int) -> list[memoryview]:
    """Return the packed chunks of a shard, in order.

    Raises
    ------
    ValueError
        When it has not so many.
    """
    index = np.frombuffer(content[-16 * count - 4 : -4], dtype="<u8").reshape(count, 2)
    return [memoryview(content)[begin : begin + size] for begin, size in index.tolist()]


def lay_out(days: Sequence[DayData]) -> Layout:
    """Sort and check the days of a segment and give each its rows.

    Raises
    ------
    ContentError
        When there is no day, a day comes twice, or its times are missing, unsorted or outside the day.
    """
    if not days:
        raise ContentError("a segment needs at least one day", remedy="skip the write when nothing was made")
    ordered = tuple(sorted(days, key=lambda item: utc_day(item.day)))
    dims = [name for name in ROW_TIMES if name in ordered[0].dataset.dims]
    if len(dims) != 1:
        raise ContentError(
            f"dimensions are {tuple(map(str, ordered[0].dataset.dims))}, expected one of 'time' and 'block'",
            day=str(ordered[0].day),
            remedy="write a dataset that is not cut in days with write_table",
        )
    row_dim = dims[0]
    times = [_row_times(item, row_dim) for item in ordered]
    names = [utc_day(item.day) for item in ordered]
    if len(set(names)) < len(names):
        twice = next(day for day in names if names.count(day) > 1)
        raise ContentError(
            "the day comes twice in one segment", day=str(twice), remedy="merge its data first"
        )
    chunk = max(1, *(stamps.size for stamps in times))
    rows = tuple(
        _row(item, stamps, index * chunk)
        for index, (item, stamps) in enumerate(zip(ordered, times, strict=True))
    )
    return Layout(row_dim, chunk, ordered, rows)


def variables(layout: Layout) -> list[Variable]:
    """Return the segment's variables; each exists on every day with equal dims, dtype and fixed attributes.

    Raises
    ------
    ContentError
        When days disagree.
    """
    first = layout.days[0].dataset
    names = _variable_names(first, layout.row_dim)
    for item in layout.days[1:]:
        if difference := names ^ _variable_names(item.dataset, layout.row_dim):
            raise ContentError(
                f"variables {sorted(difference)} are not in all days of the segment",
                day=str(item.day),
                remedy="give every day the same variables, all NaN and flagged where one is missing",
            )
    return [_variable(name, layout) for name in map(str, first.variables) if name in names]


def plain_attributes(attributes: Mapping[Any, Any], where: str) -> dict[str, Any]:
    """Return attributes as JSON has them (numpy scalars and arrays become numbers and lists).

    Raises
    ------
    ContentError
        When one has no JSON form.
    """
    try:
        plain: dict[str, Any] = json.loads(json.dumps(dict(attributes), default=_plain))
    except TypeError as error:
        raise ContentError(
            f"attribute of {where} cannot be stored: {error}", remedy="use text, numbers or lists of them"
        ) from None
    return plain


def shared_attributes(each: Sequence[Mapping[str, Any]]) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Split attributes into those equal on all days, and each day's own."""
    common = {
        name: value for name, value in each[0].items() if all(other.get(name) == value for other in each)
    }
    return common, [{name: value for name, value in own.items() if name not in common} for own in each]


def _plain(value: Any) -> Any:
    if isinstance(value, np.datetime64):
        return str(value)
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} {value!r:.60}")


def _row_times(item: DayData, row_dim: str) -> npt.NDArray[np.int64]:
    name, day = ROW_TIMES[row_dim], str(item.day)
    if name not in item.dataset.variables or item.dataset[name].dtype != np.int64:
        raise ContentError(
            f"variable '{name}' (int64 TT2000) is missing", day=day, remedy=f"add it over '{row_dim}'"
        )
    stamps = np.asarray(item.dataset[name].values)
    if np.any(np.diff(stamps) <= 0):
        raise ContentError(
            f"'{name}' does not increase strictly", day=day, remedy="sort and merge the samples first"
        )
    start, end = day_bounds(item.day)
    if stamps.size and (stamps[0] < start or stamps[-1] >= end):
        outside = int(np.count_nonzero((stamps < start) | (stamps >= end)))
        raise ContentError(
            f"{outside} of {stamps.size} samples lie outside the day",
            day=day,
            remedy="give them to their own day",
        )
    return stamps


def _row(item: DayData, stamps: npt.NDArray[np.int64], start: int) -> SegmentRow:
    steps = np.diff(stamps)
    uniform = steps.size > 0 and bool(np.all(steps == steps[0]))
    first, last = (int(stamps[0]), int(stamps[-1])) if stamps.size else (int(TT2000_FILL), int(TT2000_FILL))
    report = plain_attributes(item.report, f"the report of day {item.day}")
    of_variables = [variable.attrs for variable in item.dataset.variables.values()]
    stated = [attributes.get("cadence_ns") for attributes in (item.dataset.attrs, *of_variables)]
    cadence = min((int(value) for value in stated if value), default=0)
    if "coverage" not in report and 0 < cadence < 3600 * SECOND:
        begin, end = day_bounds(item.day)
        report["coverage"] = round(min(1.0, stamps.size * cadence / (end - begin)), 6)
    return SegmentRow(
        day=utc_day(item.day),
        start=start,
        stop=start + stamps.size,
        key=item.key,
        first_tt2000=first,
        last_tt2000=last,
        count=int(stamps.size),
        report=report,
        parents=tuple(item.parents),
        step_ns=int(steps[0]) if uniform else 0,
    )


def _variable_names(dataset: xr.Dataset, row_dim: str) -> set[str]:
    # The UTC stamps follow from tt2000; storing both would let them disagree.
    return {str(name) for name in dataset.variables} - ({"time"} if row_dim == "time" else set())


def _variable(name: str, layout: Layout) -> Variable:
    first = layout.days[0].dataset
    arrays = [item.dataset[name] for item in layout.days]
    in_rows = layout.row_dim in arrays[0].dims
    dims = tuple(map(str, arrays[0].dims))
    if in_rows and dims[0] != layout.row_dim:
        raise ContentError(
            f"dims are {dims}, expected '{layout.row_dim}' first", channel=name, remedy="transpose it"
        )
    pieces = tuple(np.asarray(array.values) for array in arrays)
    for item, array, piece in zip(layout.days, arrays, pieces, strict=True):
        _check_like_first(name, str(item.day), (arrays[0], pieces[0]), (array, piece), in_rows)
    attributes = [plain_attributes(array.attrs, f"variable '{name}'") for array in arrays]
    common, by_day = shared_attributes(attributes)
    if changed := sorted({key for own in by_day for key in own} & set(FIXED_ATTRIBUTES)):
        raise ContentError(
            f"{changed} differ between days of one segment", channel=name, remedy="write two segments"
        )
    if len({piece.dtype for piece in pieces}) > 1 and pieces[0].dtype.kind not in "UOTmM":
        shared = np.result_type(*pieces)
        pieces = tuple(piece.astype(shared) for piece in pieces)
    return Variable(
        name,
        dims,
        pieces if in_rows else pieces[:1],
        common,
        tuple(by_day) if any(by_day) else (),
        in_rows,
        name in first.coords,
    )


def _check_like_first(
    name: str, day: str, first: tuple[xr.DataArray, Array], other: tuple[xr.DataArray, Array], in_rows: bool
) -> None:
    (array, piece), (its_array, its_piece) = first, other
    inner, its_inner = (piece.shape[1:], its_piece.shape[1:]) if in_rows else (piece.shape, its_piece.shape)
    if array.dims != its_array.dims or inner != its_inner or piece.dtype.kind != its_piece.dtype.kind:
        raise ContentError(
            f"has dims {its_array.dims}, shape {its_piece.shape}, {its_piece.dtype}; "
            f"the segment's first day has {array.dims}, {piece.shape}, {piece.dtype}",
            channel=name,
            day=day,
            remedy="make the days alike, or write two segments",
        )
    with_nan = piece.dtype.kind in "fcmM"
    if not in_rows and not np.array_equal(piece, its_piece, equal_nan=with_nan):
        raise ContentError(
            "has no rows and differs between days",
            channel=name,
            day=day,
            remedy=f"give it dimension {list(ROW_TIMES)}",
        )
