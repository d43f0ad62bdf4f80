"""Opening days as one Dataset: lazily over any span (`open_days`), or one day at once (`read_one_day`).

In go `Day` records; values come from their stores (`inflight.catalog.stores`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from inflight.catalog.layout import FIXED_ATTRIBUTES, ROW_TIMES, shared_attributes
from inflight.catalog.records import Day
from inflight.catalog.spans import Span
from inflight.catalog.stores import Store, open_store
from inflight.errors import CatalogError
from inflight.time import to_utc

if TYPE_CHECKING:
    import dask.array as da
    import xarray as xr

Array = npt.NDArray[Any]

#: Up to so many samples the time index is made in memory (half a year at 1 Hz, 256 MB with tt2000);
#: beyond, `time` is a lazy coordinate without an index, so that a mission opens in bounded memory.
INDEX_LIMIT: Final = 16_000_000


@dataclass(frozen=True)
class _Piece:
    """Rows ``[start, stop)`` of one day in one store."""

    store: Store
    day: Day
    start: int
    stop: int


def read_one_day(
    workspace: Path, day: Day, variables: Iterable[str] | None, dated: bool = True
) -> xr.Dataset:
    """Read one day eagerly, without dask; the parameters and errors are those of `Catalog.read_day`."""
    store = open_store(str(workspace / day.segment))
    names = _names_to_read([store], day.dataset, variables)
    start, stop = day.rows
    dataset = store.dataset_of_day(start // store.chunk, names, start, stop)
    if store.row_dim == "time" and dated:
        dataset = dataset.assign_coords(time=("time", to_utc(dataset["tt2000"].values)))
    return dataset


def stored_variables(workspace: Path, day: Day) -> tuple[str, ...]:
    """Return the names of the variables of a day's store."""
    return tuple(open_store(str(workspace / day.segment)).variables)


def read_variable(workspace: Path, day: Day, name: str) -> tuple[Array, dict[str, Any]]:
    """Read one variable of a day; the parameters and errors are those of `Catalog.read_variable`."""
    store = open_store(str(workspace / day.segment))
    _names_to_read([store], day.dataset, [name])
    start, stop = day.rows
    values = store.rows(name, start, stop) if store.in_rows(name) else store.whole(name)
    return values, store.attributes_on(name, start // store.chunk)


def open_days(
    workspace: Path, days: Sequence[Day], span: Span, variables: Iterable[str] | None
) -> xr.Dataset:
    """Open published days as one lazy Dataset; the parameters and errors are those of `Catalog.open`."""
    import xarray as xr

    requested = None if variables is None else list(variables)
    opened_days = [_Piece(open_store(str(workspace / day.segment)), day, *day.rows) for day in days]
    pieces = [_cut(piece, span) for piece in opened_days]
    pieces = [piece for piece in pieces if piece.stop > piece.start] or pieces[:1]
    stores = list({piece.store.folder: piece.store for piece in pieces}.values())
    dataset, row_dim = days[0].dataset, stores[0].row_dim
    names = _names_to_read(stores, dataset, requested)
    data = {name: _variable(name, stores, pieces) for name in names}
    coordinates = frozenset.union(*(store.coordinates for store in stores)) & set(names)
    attributes, _ = shared_attributes([store.attributes for store in stores])
    opened = xr.Dataset(data, attrs=attributes).set_coords(coordinates)
    if row_dim != "time":
        return opened
    if sum(piece.stop - piece.start for piece in pieces) > INDEX_LIMIT:
        tasks = [(load_times, str(piece.store.folder), piece.start, piece.stop) for piece in pieces]
        time = xr.Variable(("time",), _lazy_array("time", tasks, pieces, (), np.dtype("datetime64[ns]")))
        return opened.assign_coords(xr.Coordinates({"time": time}, indexes={}))
    stamps = [_row_times(piece) for piece in pieces]
    opened["tt2000"] = ("time", np.concatenate(stamps), opened["tt2000"].attrs)
    return opened.assign_coords(time=("time", np.concatenate([to_utc(part) for part in stamps])))


def load_rows(folder: str, name: str, start: int, stop: int) -> Array:
    """Read rows of one day of one variable: the task of every lazy chunk."""
    return open_store(folder).rows(name, start, stop)


def load_times(folder: str, start: int, stop: int) -> npt.NDArray[np.datetime64]:
    """Read the UTC stamps of rows of one day."""
    return to_utc(open_store(folder).rows("tt2000", start, stop))


def _cut(piece: _Piece, span: Span) -> _Piece:
    """Cut a day to the span; only the days at its two ends are read for it."""
    day = piece.day
    inside = (span.start is None or day.first_tt2000 >= span.start) and (
        span.end is None or day.last_tt2000 < span.end
    )
    if inside or not day.count:
        return piece
    stamps = _row_times(piece)
    first = 0 if span.start is None else int(np.searchsorted(stamps, span.start))
    last = stamps.size if span.end is None else int(np.searchsorted(stamps, span.end))
    return _Piece(piece.store, day, piece.start + first, piece.start + max(first, last))


def _row_times(piece: _Piece) -> npt.NDArray[np.int64]:
    """Return TT2000 of a piece's rows; evenly spaced days need no read."""
    day, offset = piece.day, piece.start - piece.day.rows[0]
    if day.step_ns:
        first = day.first_tt2000 + offset * day.step_ns
        return first + day.step_ns * np.arange(piece.stop - piece.start, dtype=np.int64)
    return piece.store.rows(ROW_TIMES[piece.store.row_dim], piece.start, piece.stop)


def read_table(workspace: Path, path: str, table_id: int) -> xr.Dataset:
    """Read a calibration table; the errors are those of `Catalog.table`."""
    store = open_store(str(workspace / path))
    dataset = store.dataset_of_day(0, list(store.variables), 0, 0)
    return dataset.assign_attrs(table_id=table_id)


def _names_to_read(stores: Sequence[Store], dataset: str, variables: Iterable[str] | None) -> list[str]:
    """Return the names to read, with the variable that dates the rows."""
    known = list(dict.fromkeys(name for store in stores for name in store.variables))
    if variables is None:
        return known
    names = list(dict.fromkeys(variables))
    if missing := [name for name in names if name not in known]:
        raise CatalogError(
            f"{dataset} has no variables {missing}; it has {sorted(known)}", remedy="check the names"
        )
    time = ROW_TIMES.get(stores[0].row_dim)
    return names if time is None or time in names else [*names, time]


def _variable(name: str, stores: Sequence[Store], pieces: Sequence[_Piece]) -> xr.Variable:
    import xarray as xr

    holders = [store for store in stores if name in store.variables]
    like = holders[0].variables[name]
    attributes, _ = shared_attributes([store.variables[name].attributes for store in holders])
    for store in holders[1:]:
        other = store.variables[name]
        clash = [key for key in FIXED_ATTRIBUTES if other.attributes.get(key) != like.attributes.get(key)]
        if other.dims != like.dims or _inner(store, name) != _inner(holders[0], name) or clash:
            raise CatalogError(
                f"variable '{name}' changes its {clash or 'shape'} between {holders[0].folder.name} and "
                f"{store.folder.name}",
                remedy="open the two spans apart, or make the older days again",
            )
    if holders[0].in_rows(name):
        return xr.Variable(like.dims, _lazy_rows(name, holders, pieces), attributes)
    values = holders[0].whole(name)
    for store in holders[1:]:
        if not np.array_equal(values, store.whole(name), equal_nan=values.dtype.kind in "fc"):
            raise CatalogError(
                f"variable '{name}' has no rows and differs between {holders[0].folder.name} "
                f"and {store.folder.name}",
                remedy="open the two spans apart, or make the older days again",
            )
    return xr.Variable(like.dims, values, attributes)


def _lazy_rows(name: str, holders: Sequence[Store], pieces: Sequence[_Piece]) -> da.Array:
    dtype = np.result_type(*(store.variables[name].decoded_dtype() for store in holders))
    if len(holders) < len({piece.store.folder for piece in pieces}) and dtype.kind not in "fc":
        raise CatalogError(
            f"variable '{name}' is not on all days and {dtype} has no value for 'missing'",
            remedy="leave it out with variables=[...], or open the spans apart",
        )
    inner = _inner(holders[0], name)
    tasks = [
        (load_rows, str(piece.store.folder), name, piece.start, piece.stop)
        if name in piece.store.variables
        else (np.full, (piece.stop - piece.start, *inner), np.nan, dtype)
        for piece in pieces
    ]
    return _lazy_array(name, tasks, pieces, inner, dtype)


def _lazy_array(
    name: str, tasks: list[tuple[Any, ...]], pieces: Sequence[_Piece], inner: tuple[int, ...], dtype: Any
) -> da.Array:
    """Make one chunk a day by hand: slicing and joining 3000 days takes dask a second a channel."""
    import dask.array as da

    token = f"{name}-{hashlib.sha256(repr([task[1:] for task in tasks]).encode()).hexdigest()[:32]}"
    layer = {(token, index, *([0] * len(inner))): task for index, task in enumerate(tasks)}
    chunks = (tuple(piece.stop - piece.start for piece in pieces), *((size,) for size in inner))
    return da.Array(layer, token, chunks, dtype=dtype)  # type: ignore[no-untyped-call]


def _inner(store: Store, name: str) -> tuple[int, ...]:
    return store.variables[name].shape[1:]
