"""Writing segments: staged, read back, hashed, flushed, then made visible by one rename.

In go the days of a dataset (`write_segment`), or a table (`write_table`); out comes a `Segment`, which
`Run.attach` registers. Nothing here opens the database, so Dask workers in other processes may call it.

Zarr makes the metadata of a store, in memory; they and the chunks go to the disk here (`ChunkWriter`), by
the codecs that the metadata states. Zarr would take turns of its event loop for every file, ten times as long
as packing it. The bytes are those that Zarr would write, which tests hold, and Zarr reads them back for the
first day of every segment.
"""

from __future__ import annotations

import asyncio
import hashlib
import itertools
import os
import re
import shutil
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numcodecs.blosc
import numpy as np
import numpy.typing as npt

from inflight.catalog.encoding import Encoding, encode
from inflight.catalog.faultpoints import fault_point
from inflight.catalog.layout import (
    CHUNK_SEPARATOR,
    LAYOUT_ATTRIBUTE,
    LAYOUT_VERSION,
    Layout,
    Variable,
    chunk_key,
    join_shard,
    lay_out,
    plain_attributes,
    shared_attributes,
    split_shard,
    variables,
)
from inflight.catalog.manifest import MANIFEST, flush, flush_files, folder_bytes, write_manifest
from inflight.catalog.records import DayData, Segment
from inflight.errors import ContentError, InflightError, IntegrityError, StorageError

if TYPE_CHECKING:
    import xarray as xr

# The layout is ours on purpose: delta is the filter that makes the archive small, and consolidated
# metadata is one read instead of one a variable. Releases are written without the filter.
warnings.filterwarnings("ignore", message=".*Numcodecs codecs are not in the Zarr version 3 specification.*")
warnings.filterwarnings(
    "ignore", message=".*Consolidated metadata is currently not part in the Zarr format 3.*"
)

#: Up to so many components of a packed variable have chunks of their own, in one file: differences along time
#: pack a vector in half the space that interleaved components take.
MOST_COMPONENTS: Final = 4

#: Up to so many bytes, unpacked, all days of an array are one chunk where it is made again: a file costs as
#: much as packing a tenth of a megabyte.
SMALL_ARRAY: Final = 1 << 16

#: Level 5 takes 5 to 10 times as long on differences of channels and is 3 % smaller at best.
COMPRESSION_LEVEL: Final = 2
COMPRESSOR: Final[Literal["zstd"]] = "zstd"
#: For what is made again from the archive any time: its numbers hardly pack, and this takes a tenth of the
#: time to write and to read, for a tenth more bytes.
QUICK_COMPRESSOR: Final[Literal["lz4"]] = "lz4"

Array = npt.NDArray[Any]


def write_segment(
    workspace: Path | str,
    run_id: str,
    name: str,
    days: Sequence[DayData],
    *,
    portable: bool = False,
    quick: bool = False,
) -> Segment:
    """Write several days of one dataset as one immutable Zarr store.

    Written once, where it stays, below ``stores/<run_id>``: every file under its final name, read back and
    hashed, its manifest last; it is put on the disk (`flush_segment`) before a catalog names it, and nobody
    sees it until then. Equal input gives equal bytes.

    Parameters
    ----------
    workspace : path
        Folder of the catalog.
    run_id : str
        Run that the store belongs to.
    name : str
        Dataset, such as ``l1/fgm``.
    days : sequence of DayData
    portable : bool
        Leave out the delta filter, which the Zarr v3 specification does not know, and shards, which not every
        reader does.
    quick : bool
        What is made again from the archive any time: packed quickly rather than well, and all days of a small
        array in one chunk, so that it takes few files.

    Returns
    -------
    Segment
        To be given to `Run.attach` in the process that holds the run.

    Raises
    ------
    ContentError
        When the days cannot make one segment: unlike variables, wrong times, attributes without JSON form.
    StorageError
        When the disk refuses a write; nothing stays behind.
    IntegrityError
        When what is read back is not what was written.
    """
    layout = lay_out(days)
    contents = variables(layout)
    common, by_day = shared_attributes(
        [plain_attributes(item.dataset.attrs, f"dataset '{name}'") for item in layout.days]
    )
    described = {
        "row_dim": layout.row_dim,
        "chunk": layout.chunk,
        "days": [str(row.day) for row in layout.rows],
        "counts": [row.count for row in layout.rows],
        "day_attributes": by_day if any(by_day) else [],
        "variable_attributes": {item.name: list(item.by_day) for item in contents if item.by_day},
    }
    label = f"{_label(name)}-{_compact(layout.rows[0].day)}-{_compact(layout.rows[-1].day)}"
    with _begun(Path(workspace), run_id, label) as begun:
        packing = _Packing(portable, quick)
        notes = _write_store(begun, contents, layout, common, described, packing)
        path, sha256, size = begun.finish()
    return Segment(path=path, name=name, sha256=sha256, bytes=size, rows=layout.rows, notes=tuple(notes))


def write_table(
    workspace: Path | str, run_id: str, name: str, dataset: xr.Dataset, *, portable: bool = False
) -> Segment:
    """Write a dataset that is not cut into days (a calibration table, a library of matrices).

    Parameters and errors are those of `write_segment`; variables of any dims, one chunk each.
    """
    contents = [
        Variable(
            name=str(key),
            dims=tuple(map(str, array.dims)),
            pieces=(np.asarray(array.values),),
            attributes=plain_attributes(array.attrs, f"variable '{key}'"),
            by_day=(),
            in_rows=False,
            coordinate=key in dataset.coords,
        )
        for key, array in ((key, dataset[key]) for key in dataset.variables)
    ]
    attributes = plain_attributes(dataset.attrs, f"dataset '{name}'")
    described: dict[str, Any] = {"row_dim": "", "chunk": 0, "days": [], "counts": []}
    with _begun(Path(workspace), run_id, _label(name)) as begun:
        notes = _write_store(begun, contents, None, attributes, described, _Packing(portable))
        path, sha256, size = begun.finish()
    return Segment(path=path, name=name, sha256=sha256, bytes=size, rows=(), notes=tuple(notes))


def flush_segment(workspace: Path, segment: Segment) -> None:
    """Put a segment on the disk: it survives a power failure when this returns.

    Raises
    ------
    StorageError
        When the disk refuses it.
    """
    store = workspace / segment.path
    try:
        flush_files(store)
        for folder in (store.parent, store.parent.parent):
            flush(folder)
    except OSError as error:
        raise StorageError(
            f"could not write: {os.strerror(error.errno or 0)}; nothing was published",
            file=str(store),
            remedy=f"free space below {workspace} and run again",
        ) from error


class _Begun:
    """One store on its way: whole when its manifest is there."""

    def __init__(self, workspace: Path, run_id: str, label: str) -> None:
        self._workspace = workspace
        target = workspace / "stores" / run_id
        for number in itertools.count(1):
            self.folder = target / (f"{label}.zarr" if number == 1 else f"{label}-{number}.zarr")
            # No store is ever replaced.
            with suppress(FileExistsError):
                self.folder.mkdir(parents=True)
                break
        #: sha256 of each chunk, as it was read back.
        self.hashes: dict[Path, str] = {}

    def finish(self) -> tuple[str, str, int]:
        """Hash; return path relative to the workspace, manifest sha256, bytes."""
        fault_point("segment_written")
        sha256 = write_manifest(self.folder, known=self.hashes)
        fault_point("manifest_written")
        return self.folder.relative_to(self._workspace).as_posix(), sha256, folder_bytes(self.folder)


@contextmanager
def _begun(workspace: Path, run_id: str, label: str) -> Iterator[_Begun]:
    begun = None
    try:
        begun = _Begun(workspace, run_id, label)
        yield begun
    except InflightError:
        raise
    except (OSError, MemoryError) as error:
        reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)
        raise StorageError(
            f"could not write: {reason}; nothing was published",
            file=str(begun.folder if begun else workspace),
            remedy=f"free space below {workspace} and run again",
        ) from error
    finally:
        clear_unfinished(workspace, run_id, [begun.folder] if begun else [])


def clear_unfinished(workspace: Path, run_id: str, folders: Iterable[Path] | None = None) -> None:
    """Remove stores of a run (or of some folders of it) without a manifest: nobody writes them any more."""
    of_run = workspace / "stores" / run_id
    for folder in of_run.glob("*.zarr") if folders is None else folders:
        if not (folder / MANIFEST).exists():
            shutil.rmtree(folder, ignore_errors=True)
    # Refused where a store stays.
    with suppress(OSError):
        of_run.rmdir()


class _Packing(NamedTuple):
    """How the chunks of a store are packed: see `write_segment`."""

    portable: bool
    quick: bool = False

    @property
    def compressor(self) -> Literal["zstd", "lz4"]:
        """Which of Blosc's."""
        return QUICK_COMPRESSOR if self.quick else COMPRESSOR


def _write_store(
    begun: _Begun,
    contents: Sequence[Variable],
    layout: Layout | None,
    attributes: dict[str, Any],
    described: dict[str, Any],
    packing: _Packing,
) -> list[str]:
    """Write and read back all arrays; return notes about values that could not be packed."""
    folder = begun.folder
    coordinates = [item.name for item in contents if item.coordinate]
    root = {
        **attributes,
        LAYOUT_ATTRIBUTE: {"layout": LAYOUT_VERSION, **described, "coordinates": coordinates},
    }
    for item in contents:
        # It names a folder, which is written before Zarr hears of it.
        if "/" in item.name or item.name in ("", ".", ".."):
            raise ContentError(f"{item.name!r} is no name of a variable", remedy="name it without '/'")
    fault_point("segment_begun")
    notes, written, arrays = [], [], []
    for item in contents:
        encoding, pieces = encode(item.name, item.pieces, item.attributes)
        blocks = _blocks(item, pieces, encoding, layout)
        arrays.append(_write_array(begun, item, encoding, blocks, packing))
        written.append(blocks[0])
        if encoding.note:
            notes.append(encoding.note)
    for name, content in _metadata(root, arrays).items():
        (folder / name).write_bytes(content)
    _read_back(folder, contents, written)
    return notes


def _metadata(attributes: dict[str, Any], arrays: Sequence[dict[str, Any]]) -> dict[str, bytes]:
    """Return the files of metadata of a store, as Zarr makes them of what describes its arrays."""
    from zarr.api.asynchronous import consolidate_metadata, open_group  # only who writes waits for it
    from zarr.core.sync import sync
    from zarr.storage import MemoryStore

    files: dict[str, Any] = {}
    store = MemoryStore(files)

    async def make() -> None:
        group = await open_group(store, mode="w-", zarr_format=3, attributes=attributes)
        for array in arrays:
            await group.create_array(**array)
        await consolidate_metadata(store)

    # One turn of Zarr's event loop, as in `read_with_zarr`.
    sync(make())
    return {name: content.to_bytes() for name, content in files.items()}


def _blocks(
    item: Variable, pieces: Sequence[Array], encoding: Encoding, layout: Layout | None
) -> list[Array]:
    """Return the stored values, one block of `chunk` rows for each day, the rest of it filled."""
    if layout is None or not item.in_rows:
        return [np.ascontiguousarray(pieces[0])]
    blocks = []
    for piece in pieces:
        if piece.shape[0] == layout.chunk:
            blocks.append(piece)
            continue
        block = np.full((layout.chunk, *piece.shape[1:]), encoding.fill, dtype=encoding.stored)
        block[: piece.shape[0]] = piece
        blocks.append(block)
    return blocks


def _write_array(
    begun: _Begun, item: Variable, encoding: Encoding, blocks: Sequence[Array], packing: _Packing
) -> dict[str, Any]:
    """Write the chunks of an array; return what describes it to Zarr."""
    from zarr.codecs import BloscCodec
    from zarr.codecs.numcodecs import Delta

    inner = blocks[0].shape[1:] if item.in_rows else ()
    is_vector = encoding.delta and len(inner) == 1 and 1 < inner[0] <= MOST_COMPONENTS
    shape = (sum(len(block) for block in blocks), *inner) if item.in_rows else blocks[0].shape
    if packing.quick and item.in_rows and sum(block.nbytes for block in blocks) <= SMALL_ARRAY:
        blocks = [np.concatenate(blocks)]
    delta = encoding.delta and not packing.portable
    in_shards = is_vector and not packing.portable
    (begun.folder / item.name).mkdir()
    writer = ChunkWriter(begun.folder / item.name, delta, packing.compressor, begun.hashes)
    for index, block in enumerate(blocks):
        place = (index, *(0,) * (block.ndim - 1))[: block.ndim]
        parts = np.hsplit(block, inner[0]) if is_vector else [block]
        if in_shards:
            writer.write_shard(place, parts)
            continue
        for part, values in enumerate(parts):
            writer.write((index, part) if is_vector else place, values)
    size = tuple(max(1, one) for one in blocks[0].shape)
    return {
        "name": item.name,
        "shape": shape,
        "dtype": encoding.stored,
        "chunks": (size[0], 1) if is_vector else size,
        "shards": size if in_shards else None,
        "chunk_key_encoding": {"name": "default", "separator": CHUNK_SEPARATOR},
        "filters": [Delta(dtype=np.dtype(encoding.stored).str)] if delta else None,
        "compressors": [BloscCodec(cname=packing.compressor, clevel=COMPRESSION_LEVEL, shuffle="shuffle")],
        "fill_value": encoding.fill,
        "attributes": {**item.attributes, **encoding.attributes()},
        "dimension_names": item.dims,
    }


def _read_back(folder: Path, contents: Sequence[Variable], written: Sequence[Array]) -> None:
    """Compare a store with what it was written from, as any Zarr reader has it: of days, the first.

    Parameters
    ----------
    written : sequence of ndarray
        Of each variable the stored values, of days those of the first.
    """
    rows = {item.name: len(block) for item, block in zip(contents, written, strict=True)}
    read = read_with_zarr(folder, rows)
    if set(read) != set(rows):
        raise IntegrityError("variables read back differently", file=str(folder), remedy="run again")
    for item, block in zip(contents, written, strict=True):
        attributes, found = read[item.name]
        if any(attributes.get(key) != value for key, value in item.attributes.items()):
            raise IntegrityError("attributes read back differently", file=str(folder), channel=item.name)
        if found.dtype != block.dtype or found.shape != block.shape or found.tobytes() != block.tobytes():
            raise IntegrityError(
                "an array reads back differently from what was written",
                file=str(folder / item.name),
                channel=item.name,
                remedy="check the disk, then run again",
            )


def read_with_zarr(folder: Path, rows: Mapping[str, int]) -> dict[str, tuple[dict[str, Any], Array]]:
    """Return attributes and the first rows of all arrays of a store, read by Zarr in one go.

    Parameters
    ----------
    rows : mapping of str to int
        How many of each; all of an array that is not named.
    """
    from zarr.api.asynchronous import open_group
    from zarr.core.sync import sync

    async def read() -> dict[str, tuple[dict[str, Any], Array]]:
        group = await open_group(folder, mode="r", use_consolidated=True)
        arrays = {name: array async for name, array in group.arrays()}
        values = await asyncio.gather(*(one.getitem(slice(rows.get(name))) for name, one in arrays.items()))
        return {
            name: (dict(one.attrs), np.asarray(found))
            for (name, one), found in zip(arrays.items(), values, strict=True)
        }

    # One turn of Zarr's event loop: array by array each costs as much as packing a day of it.
    return sync(read())


@dataclass(frozen=True)
class ChunkWriter:
    """Writes the chunks of one array of a store and compares each with what was written.

    Attributes
    ----------
    folder : Path
        Of the array.
    delta : bool
        Store the first value and the differences of neighbours.
    compressor : str
        Of Blosc.
    hashes : dict of Path to str
        Receives the sha256 of each chunk as it was read back.
    """

    folder: Path
    delta: bool
    compressor: str = COMPRESSOR
    hashes: dict[Path, str] = field(default_factory=dict)

    def write(self, place: tuple[int, ...], values: Array) -> None:
        """Write one chunk; of no values none, as Zarr does.

        Parameters
        ----------
        place : tuple of int
            Of the chunk in the grid.
        values : ndarray
            As stored, of the chunk's shape.

        Raises
        ------
        OSError
            When the disk refuses it.
        IntegrityError
            When what is read back is not what was written.
        """
        if values.size:
            flat = self._flat(values)
            self._put(place, self._pack(flat), [flat])

    def write_shard(self, place: tuple[int, ...], parts: Sequence[Array]) -> None:
        """Write chunks of one shape as one file, a shard; of no values none.

        Parameters
        ----------
        place : tuple of int
            Of the shard in the grid of shards.
        parts : sequence of ndarray
            Its chunks, side by side along the last axis.

        Raises
        ------
        OSError, IntegrityError
            As `write`.
        """
        if parts[0].size:
            flats = [self._flat(part) for part in parts]
            self._put(place, join_shard([self._pack(flat) for flat in flats]), flats)

    def _flat(self, values: Array) -> Array:
        """Return the values of a chunk in order, or their differences."""
        flat = np.ascontiguousarray(values).ravel()
        if not self.delta:
            return flat
        differences = np.empty_like(flat)
        differences[0] = flat[0]
        np.subtract(flat[1:], flat[:-1], out=differences[1:])
        return differences

    def _pack(self, flat: Array) -> bytes:
        return bytes(
            numcodecs.blosc.compress(
                flat,
                self.compressor.encode(),
                COMPRESSION_LEVEL,
                numcodecs.blosc.SHUFFLE,
                numcodecs.blosc.AUTOBLOCKS,
                typesize=flat.itemsize,
            )
        )

    def _put(self, place: tuple[int, ...], content: bytes, flats: Sequence[Array]) -> None:
        """Write a file, read it back and compare what is in it."""
        path = self.folder / chunk_key(place, CHUNK_SEPARATOR)
        path.write_bytes(content)
        there = path.read_bytes()
        try:
            packed = [there] if len(flats) == 1 else split_shard(there, len(flats))
            found = [numcodecs.blosc.decompress(one) for one in packed]
        except (RuntimeError, ValueError):
            found = []
        if len(found) != len(flats) or any(a != b.tobytes() for a, b in zip(found, flats, strict=True)):
            raise IntegrityError(
                "a chunk reads back differently from what was written",
                file=os.fspath(path),
                channel=self.folder.name,
                remedy="check the disk, then run again",
            )
        self.hashes[path] = hashlib.sha256(there).hexdigest()


def _label(name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*", name) or ".." in name:
        raise ContentError(
            f"{name!r} is no dataset name", remedy="use letters, digits, '_', '-', '.' and '/'"
        )
    return name.replace("/", ".")


def _compact(day: np.datetime64) -> str:
    return str(day).replace("-", "")
