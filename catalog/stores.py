"""Reading stores: one decoder for the eager, the lazy and the verifying way.

A store is immutable, so its metadata is read once a process. Each day is one chunk a variable (in what is
made again all days of a small one are; a vector has one a component, together in a shard, or in files of
their own in portable stores and those of layout 1), so a day is read without an event loop, and a chunk that
is missing is an error here, where Zarr would give fill. Every file is compared with the manifest as it is
read: of flipped bits a third decode to other numbers without an error, and the check costs half a
millisecond a day.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numcodecs.blosc
import numpy as np
import numpy.typing as npt

from inflight.catalog.encoding import Encoding
from inflight.catalog.layout import LAYOUT_ATTRIBUTE, LAYOUTS, chunk_key, split_shard
from inflight.catalog.manifest import stated_hashes
from inflight.errors import CatalogError, IntegrityError

if TYPE_CHECKING:
    import xarray as xr

Array = npt.NDArray[Any]

#: The way back from a damaged store.
REMEDY: Final = "run 'inflight catalog repair', then 'inflight ingest' and 'inflight reprocess' make it again"


@dataclass(frozen=True, kw_only=True)
class StoredVariable:
    """One array of a store; `shape`, `chunks` and what separates the parts of their names are those on disk.

    A file holds so many chunks side by side, `in_file`: more than one are a shard.
    """

    name: str
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    attributes: dict[str, Any]
    encoding: Encoding
    delta: bool
    in_file: int
    separator: str

    def decoded_dtype(self) -> np.dtype[Any]:
        """Return the dtype of the values as they are read."""
        if self.encoding.kind == "labels":
            return np.array(self.encoding.labels or ("",)).dtype
        return np.dtype(self.encoding.dtype)


@dataclass(frozen=True, kw_only=True)
class Store:
    """An opened store: metadata only, until values are asked for."""

    folder: Path
    row_dim: str
    chunk: int
    counts: tuple[int, ...]
    days: tuple[str, ...]
    variables: dict[str, StoredVariable]
    attributes: dict[str, Any]
    coordinates: frozenset[str]
    day_attributes: tuple[dict[str, Any], ...]
    variable_attributes: dict[str, list[dict[str, Any]]]

    @cached_property
    def hashes(self) -> dict[str, str]:
        """The sha256 of every file of the store, as it was when it was written."""
        return stated_hashes(self.folder)

    def in_rows(self, name: str) -> bool:
        """Return True when a variable has a value for each row."""
        return bool(self.row_dim) and self.variables[name].dims[:1] == (self.row_dim,)

    def rows(self, name: str, start: int, stop: int) -> Array:
        """Return the decoded values of rows ``[start, stop)``, which lie in one day.

        Raises
        ------
        IntegrityError
            When the chunk is missing or damaged.
        """
        variable = self.variables[name]
        if stop - start > self.chunk - start % self.chunk:
            raise CatalogError(f"rows {start} to {stop} are not in one day of {self.folder}")
        if start == stop or 0 in variable.shape:
            # Nothing is stored of it, such as the estimate of days that tell nothing.
            return _no_values(variable, (stop - start, *variable.shape[1:]))
        # A small array has several days in one chunk.
        index, offset = divmod(start, variable.chunks[0])
        grid = [
            range(-(-size // chunk))
            for size, chunk in zip(variable.shape[1:], variable.chunks[1:], strict=True)
        ]
        if variable.in_file > 1:
            grid = [range(1)]
        places = itertools.product(*grid)
        day = self.days[start // self.chunk]
        parts = [one for place in places for one in self._chunks(variable, (index, *place), day)]
        block = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1)
        return variable.encoding.decode(block[offset : offset + stop - start])

    def whole(self, name: str) -> Array:
        """Return the decoded values of a variable without rows."""
        variable = self.variables[name]
        if 0 in variable.shape:
            # Nothing is stored of it, such as the units of a table that knows none.
            return _no_values(variable, variable.shape)
        (chunk,) = self._chunks(variable, (0,) * len(variable.shape))
        values = variable.encoding.decode(chunk)
        # A single number is stored as one value.
        return values if variable.dims else values.reshape(())

    def dataset_of_day(self, index: int, names: Sequence[str], start: int, stop: int) -> xr.Dataset:
        """Read rows ``[start, stop)`` of day `index` as a Dataset, with the attributes of that day."""
        import xarray as xr

        data = {
            name: (
                self.variables[name].dims,
                self.rows(name, start, stop) if self.in_rows(name) else self.whole(name),
                self.attributes_on(name, index),
            )
            for name in names
        }
        own = self.day_attributes[index] if self.day_attributes else {}
        # Made with its coordinates at once: xarray looks at every variable again when they join later.
        coordinates = {name: data.pop(name) for name in names if name in self.coordinates}
        return xr.Dataset(data, coordinates, {**self.attributes, **own})

    def attributes_on(self, name: str, index: int) -> dict[str, Any]:
        """Return a variable's attributes on day `index` of the store."""
        own = self.variable_attributes.get(name)
        return {**self.variables[name].attributes, **(own[index] if own else {})}

    def _chunks(self, variable: StoredVariable, place: tuple[int, ...], day: str = "") -> list[Array]:
        """Return the chunks of the file at a place, as they are stored."""
        name = f"{variable.name}/{chunk_key(place, variable.separator)}"
        try:
            content = (self.folder / name).read_bytes()
            if hashlib.sha256(content).hexdigest() != self.hashes.get(name):
                raise ValueError("its content is not what was written")
            packed = split_shard(content, variable.in_file) if variable.in_file > 1 else [content]
            dtype = np.dtype(variable.encoding.stored).newbyteorder("<")
            flats = [np.frombuffer(numcodecs.blosc.decompress(one), dtype) for one in packed]
            blocks = [flat.reshape(variable.chunks) for flat in flats]
        except (OSError, RuntimeError, ValueError) as error:
            raise IntegrityError(
                f"chunk cannot be read: {error}",
                file=str(self.folder / name),
                channel=variable.name,
                day=day,
                remedy=REMEDY,
            ) from error
        if variable.delta:
            sums = (np.cumsum(block, axis=None, dtype=block.dtype) for block in blocks)
            blocks = [one.reshape(variable.chunks) for one in sums]
        return blocks


def _no_values(variable: StoredVariable, shape: tuple[int, ...]) -> Array:
    return variable.encoding.decode(np.empty(shape, dtype=variable.encoding.stored))


def open_store(folder: str) -> Store:
    """Open a store by the absolute path of its folder; it is read once a process.

    Raises
    ------
    IntegrityError
        When it is missing, damaged, or of a layout this version does not know.
    """
    try:
        stamp = (Path(folder) / "zarr.json").stat().st_mtime_ns
    except OSError as error:
        raise _cannot_open(folder, error) from error
    return _read_metadata(folder, stamp)


# The hashes of all chunks come with each: those in use at a time are kept, not a mission's.
@lru_cache(maxsize=64)
def _read_metadata(folder: str, _stamp: int) -> Store:
    path = Path(folder)
    try:
        text = (path / "zarr.json").read_bytes()
        if hashlib.sha256(text).hexdigest() != stated_hashes(path).get("zarr.json"):
            raise ValueError("its zarr.json is not what was written")
        root = json.loads(text)
        described = root["attributes"].pop(LAYOUT_ATTRIBUTE)
        arrays = root["consolidated_metadata"]["metadata"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _cannot_open(folder, error) from error
    if described["layout"] not in LAYOUTS:
        raise IntegrityError(
            f"store has layout {described['layout']}, this version reads up to {LAYOUTS[-1]}", file=folder
        )
    return Store(
        folder=path,
        row_dim=described["row_dim"],
        chunk=described["chunk"],
        counts=tuple(described["counts"]),
        days=tuple(described["days"]),
        variables={name: _variable(name, metadata) for name, metadata in arrays.items()},
        attributes=root["attributes"],
        coordinates=frozenset(described["coordinates"]),
        day_attributes=tuple(described.get("day_attributes", ())),
        variable_attributes=described.get("variable_attributes", {}),
    )


def _cannot_open(folder: str, error: Exception) -> IntegrityError:
    return IntegrityError(f"store cannot be opened: {error}", file=folder, remedy=REMEDY)


def _variable(name: str, metadata: dict[str, Any]) -> StoredVariable:
    attributes = dict(metadata["attributes"])
    encoding = Encoding.from_attributes(attributes, metadata["data_type"])
    chunks, codecs = tuple(metadata["chunk_grid"]["configuration"]["chunk_shape"]), metadata["codecs"]
    in_file = 1
    if codecs[0]["name"] == "sharding_indexed":
        shard, inner = chunks, codecs[0]["configuration"]
        chunks, codecs = tuple(inner["chunk_shape"]), inner["codecs"]
        in_file = shard[-1] // chunks[-1]
    names = [codec["name"] for codec in codecs]
    if names[-1] != "blosc" or names[:-1] not in (["bytes"], ["numcodecs.delta", "bytes"]):
        raise IntegrityError(f"variable '{name}' has codecs {names}, which this version does not write")
    return StoredVariable(
        name=name,
        dims=tuple(metadata.get("dimension_names") or ()),
        shape=tuple(metadata["shape"]),
        chunks=chunks,
        attributes=attributes,
        encoding=encoding,
        delta="numcodecs.delta" in names,
        in_file=in_file,
        separator=metadata["chunk_key_encoding"]["configuration"]["separator"],
    )
