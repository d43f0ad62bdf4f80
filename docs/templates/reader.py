"""A reader to copy: text files with one reading a line, ``YYYY-MM-DDThh:mm:ss x y z temperature``.

A reader opens one delivered file and gives its variables as they stand in it; times, units, fill values,
flags and days are made of them by the archive, for all formats alike. Copy this file to
``catalog/readers/NAME.py``, change what it reads, and name it in `inflight.catalog.readers.raw.FORMATS` and
in `inflight.instruments.Reader`. ``python NAME.py`` says nothing when the reader keeps what the archive
relies on, and what to mend when it does not.
"""

from contextlib import contextmanager

import numpy as np

from inflight.catalog.readers import (
    ReadOptions,
    Source,
    Variable,
    check_reader,
    read_errors,
    require_content,
)
from inflight.errors import ReadError

NAMES = ("time", "x", "y", "z", "temperature")

#: What the format writes for a missing number.
FILL = 9999.0


@contextmanager
def open_source(path, files):
    """Open a file of the format; its variables are ``time``, ``x``, ``y``, ``z`` (nT) and ``temperature``."""
    require_content(path)
    # What a library raises on a damaged file becomes a ReadError that names the file.
    with read_errors(path):
        rows = [line.split() for line in path.read_text(encoding=files.encoding).splitlines()]
    if not rows or any(len(row) != len(NAMES) for row in rows):
        raise ReadError(
            f"has lines without {len(NAMES)} columns",
            remedy="fetch it again or correct 'reader'",
            file=str(path),
        )

    def read(name):
        column = [row[NAMES.index(name)] for row in rows]
        if name == "time":
            # Text and numbers with a unit of time are understood; a format that knows its times sets `times`.
            return Variable(np.array(column))
        unit = "degC" if name == "temperature" else "nT"
        return Variable(np.array(column, dtype=np.float64), unit=unit, fill=(FILL,))

    yield Source(path, NAMES, read, tuple(files.drop))


def write(path, example):
    """Write an example in the format, and say how a mission YAML describes it."""
    values = np.column_stack(
        [example.field, np.where(np.isnan(example.temperature), FILL, example.temperature)]
    )
    lines = [
        f"{str(time)[:19]} {' '.join(f'{number:.3f}' for number in row)}\n"
        for time, row in zip(example.times, values, strict=True)
    ]
    path.write_text("".join(lines), encoding="utf-8")
    return ReadOptions(
        field={"variables": ["x", "y", "z"]}, temperature={"variable": "temperature"}, files={"time": "time"}
    )


if __name__ == "__main__":
    check_reader(open_source, write)
