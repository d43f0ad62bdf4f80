"""Parquet files through pyarrow; only the columns asked for are read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from inflight.catalog.readers.source import Source, Variable, read_errors, require_content
from inflight.instruments import Files
from inflight.time import to_tt2000


@contextmanager
def open_source(path: Path, files: Files) -> Iterator[Source]:
    """Open a Parquet file; a list column is one variable of shape (row, item)."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    require_content(path)
    with read_errors(path):
        table = pq.ParquetFile(path)

    def read(name: str) -> Variable:
        column = table.read(columns=[name]).column(0)
        if pa.types.is_timestamp(column.type):
            # Arrow keeps zoned stamps in UTC, so the zone only has to be taken off.
            stamps = column.cast(pa.timestamp("ns")).to_numpy()
            return Variable(stamps, times=to_tt2000(stamps))
        unit = (table.schema_arrow.field(name).metadata or {}).get(b"units", b"").decode() or None
        if pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
            return Variable(np.array(column.to_pylist(), dtype=np.float64), unit=unit)
        values = np.asarray(column.to_numpy())
        return Variable(values.astype(np.str_) if values.dtype == object else values, unit=unit)

    try:
        yield Source(path, tuple(table.schema_arrow.names), read, tuple(files.drop))
    finally:
        table.close()
