"""Chunks of a store, packed and written one file at a time.

Zarr writes a store's metadata; its chunks go to the disk here, by the codecs that the metadata states.
Zarr would take an event loop's turn for every chunk, ten times as long as packing it. The bytes are the
ones that it would write, which tests hold, and it reads them back for the first day of every segment.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numcodecs.blosc
import numpy as np
import numpy.typing as npt

from inflight.errors import IntegrityError

#: Level 5 takes 5 to 10 times as long on differences of channels and is 3 % smaller at best.
COMPRESSION_LEVEL: Final = 2
COMPRESSOR: Final = "zstd"

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class ChunkWriter:
    """Writes the chunks of one array of a store, and holds them against what they were made from.

    Attributes
    ----------
    folder : Path
        Of the array.
    delta : bool
        Store differences of neighbours.
    """

    folder: Path
    delta: bool

    def write(self, place: tuple[int, ...], values: Array) -> None:
        """Write one chunk.

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
        flat = self._flat(values)
        path = self.folder.joinpath("c", *map(str, place))
        if not place[-1] or len(place) == 1:
            path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(
            numcodecs.blosc.compress(
                flat,
                COMPRESSOR.encode(),
                COMPRESSION_LEVEL,
                numcodecs.blosc.SHUFFLE,
                numcodecs.blosc.AUTOBLOCKS,
                typesize=flat.itemsize,
            )
        )
        self._read_back(path, flat)

    def _flat(self, values: Array) -> Array:
        """Return what is packed: the values in a row, or their differences behind the first one."""
        flat = np.ascontiguousarray(values).ravel()
        if not self.delta:
            return flat
        steps = np.empty_like(flat)
        steps[:1] = flat[:1]
        np.subtract(flat[1:], flat[:-1], out=steps[1:])
        return steps

    def _read_back(self, path: Path, flat: Array) -> None:
        try:
            found = np.frombuffer(numcodecs.blosc.decompress(path.read_bytes()), dtype=np.uint8)
        except (RuntimeError, ValueError):
            found = np.empty(0, dtype=np.uint8)
        if not np.array_equal(found, flat.view(np.uint8)):
            raise IntegrityError(
                "a chunk reads back differently from what was written",
                file=os.fspath(path),
                channel=self.folder.name,
                remedy="check the disk, then run again",
            )
