"""NumPy archives; pickled content is refused."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from inflight.catalog.readers.source import Source, Variable, read_errors, require_content
from inflight.instruments import Files


@contextmanager
def open_source(path: Path, files: Files) -> Iterator[Source]:
    """Open an .npz file; its variables are its arrays."""
    require_content(path)
    with read_errors(path):
        archive = np.load(path, allow_pickle=False)
        names = tuple(archive.files)
    with archive:
        yield Source(path, names, lambda name: Variable(np.atleast_1d(archive[name])), tuple(files.drop))
