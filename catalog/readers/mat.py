"""MATLAB files up to version 7.2 through scipy; fields of structures are named ``structure.field``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from inflight.catalog.readers.source import Array, Source, Variable, read_errors, require_content
from inflight.errors import ReadError
from inflight.instruments import Files


@contextmanager
def open_source(path: Path, files: Files) -> Iterator[Source]:
    """Open a .mat file."""
    require_content(path)
    with path.open("rb") as stream:
        if b"MATLAB 7.3" in stream.read(128):
            raise ReadError(
                "is a MATLAB 7.3 file, which is HDF5", remedy="use 'reader: netcdf'", file=str(path)
            )
    with read_errors(path):
        arrays: dict[str, Array] = {}
        for name, value in scipy.io.loadmat(path).items():
            if not name.startswith("__"):
                _collect(name, value, arrays)
    yield Source(path, tuple(arrays), lambda name: Variable(arrays[name]), tuple(files.drop))


def _collect(name: str, value: Any, arrays: dict[str, Array]) -> None:
    """Add an array, or the fields of a 1 by 1 structure; a row or column vector becomes one series."""
    found = np.asarray(value)
    if found.dtype.names:
        if found.size == 1:
            for field in found.dtype.names:
                _collect(f"{name}.{field}", found.ravel()[0][field], arrays)
    elif found.dtype != object:
        arrays[name] = found.ravel() if found.ndim == 2 and 1 in found.shape else found
