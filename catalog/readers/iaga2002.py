"""IAGA-2002 text files (IAGA Division V, data exchange format of 2002), plain or gzipped."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from inflight.catalog.readers.source import Source, Variable, open_text, read_errors, require_content
from inflight.errors import ReadError
from inflight.instruments import Files

#: 99999: missing; 88888: the observatory does not record the element.
_FILL = (99999.0, 99999.9, 88888.0, 88888.8)
#: Elements that are angles; all others are field strengths in nT.
_ANGLES = {"D": "arcmin", "I": "arcmin"}
#: Lines a header may have before the line of column names.
_LONGEST_HEADER = 500


@contextmanager
def open_source(path: Path, files: Files) -> Iterator[Source]:
    """Open an IAGA-2002 file; its variables are the four columns, named as in its header, and ``time``."""
    import pandas as pd

    require_content(path)
    with read_errors(path):
        with path.open("rb") as stream:
            packed = stream.read(2) == b"\x1f\x8b"
        names, lines = _header(path, files.encoding)
        table = pd.read_csv(
            path,
            sep=r"\s+",
            header=None,
            names=names,
            usecols=list(range(len(names))),
            skiprows=lines,
            encoding=files.encoding,
            dtype={"DATE": str, "TIME": str, "DOY": str},
            compression="gzip" if packed else None,
        )
    # A row whose date or time is shorter than the first one's: the file was cut within it.
    lengths = table[["DATE", "TIME"]].apply(lambda column: column.str.len())
    unlike = np.flatnonzero((lengths != lengths.head(1).squeeze()).any(axis=1).to_numpy())
    if unlike.size:
        row = int(unlike[0])
        date, time = table[["DATE", "TIME"]].iloc[row]
        raise ReadError(
            f"row {row + 1} has the date {date!r} and the time {time!r}, unlike the first row",
            remedy="it is cut or damaged; fetch it again",
            file=str(path),
        )

    def read(name: str) -> Variable:
        if name == "time":
            dates, times = (table[key].to_numpy().astype(np.str_) for key in ("DATE", "TIME"))
            return Variable(np.strings.add(np.strings.add(dates, "T"), times))
        unit = _ANGLES.get(name[-1:], "nT")
        return Variable(table[name].to_numpy(), unit=unit, fill=_FILL)

    yield Source(path, ("time", *names[3:]), read, tuple(files.drop))


def _header(path: Path, encoding: str) -> tuple[list[str], int]:
    """Return the column names and the number of lines up to and including theirs."""
    with open_text(path, encoding) as stream:
        for number, line in enumerate(stream):
            if line.lstrip().upper().startswith("DATE "):
                return line.replace("|", " ").split(), number + 1
            if number > _LONGEST_HEADER:
                break
    raise ReadError(
        "has no line 'DATE TIME DOY ...' as IAGA-2002 files have",
        remedy="fetch it again or correct 'reader'",
        file=str(path),
    )
