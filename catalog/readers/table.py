"""Text tables through pandas: any delimiter, decimal comma, encoding, header or none, plain or gzipped."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from inflight.catalog.readers.source import Source, Variable, open_text, read_errors, require_content
from inflight.errors import ContentError
from inflight.instruments import Files

if TYPE_CHECKING:
    import pandas as pd


@contextmanager
def open_source(path: Path, files: Files) -> Iterator[Source]:
    """Open a text table; its variables are the columns. Time columns given as text stay text."""
    import pandas as pd

    require_content(path)
    with read_errors(path), open_text(path, files.encoding) as stream:
        table = _table(stream, files, path)
    table.columns = [str(name).strip() for name in table.columns]

    def read(name: str) -> Variable:
        column = table[name]
        if name in (files.time or []) or column.dtype.kind in "biuf":
            return Variable(np.asarray(column.to_numpy()))
        text = column.astype(str).str.strip()
        plain = text.str.replace(",", ".", regex=False) if files.decimal == "," else text
        numbers = pd.to_numeric(plain, errors="coerce")
        bad = np.flatnonzero(numbers.isna().to_numpy() & column.notna().to_numpy() & (text != "").to_numpy())
        if bad.size:
            raise ContentError(
                f"column {name!r}, row {bad[0] + 1}: {str(column.iloc[bad[0]])!r} is no number",
                remedy="correct 'delimiter', 'decimal', 'skip' or 'comment', or repair the file",
                file=str(path),
            )
        return Variable(np.asarray(numbers.to_numpy(dtype=np.float64)))

    yield Source(path, tuple(table.columns), read, tuple(files.drop))


def _table(stream: TextIO, files: Files, path: Path) -> pd.DataFrame:
    """Read the table; unnamed columns are dropped only when a closing delimiter makes them."""
    import pandas as pd

    delimiter = files.delimiter
    options: dict[str, Any] = {
        "sep": r"\s+" if delimiter == "whitespace" else delimiter or ",",
        "decimal": files.decimal,
        "skiprows": files.skip,
        "comment": files.comment,
        "index_col": False,
        "skipinitialspace": True,
        # One type a column, whatever the length of the file.
        "low_memory": False,
    }
    if files.columns is not None:
        options |= {"header": None, "names": files.columns}
    if files.time_unit is None:
        # A stamp such as 0921235902 must keep its leading zero.
        options["dtype"] = dict.fromkeys(files.time or [], str)
    with warnings.catch_warnings():
        # pandas drops such columns and only warns, so that `1,5` could become 1.
        warnings.simplefilter("error", pd.errors.ParserWarning)
        try:
            return pd.DataFrame(pd.read_csv(stream, **options))
        except pd.errors.ParserError as error:
            raise _uneven(f"rows differ in their number of columns ({error})", path) from None
        except pd.errors.ParserWarning:
            _require_closing_delimiters(stream, files, path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pd.errors.ParserWarning)
        stream.seek(0)
        return pd.DataFrame(pd.read_csv(stream, **options))


def _require_closing_delimiters(stream: TextIO, files: Files, path: Path) -> None:
    stream.seek(0)
    lines = [line.split(files.comment)[0] if files.comment else line for line in stream]
    rows = [line.rstrip("\r\n") for line in lines[files.skip :] if line.strip()]
    first = 0 if files.columns is not None else 1
    if not all(row.endswith(files.delimiter or ",") for row in rows[first:]):
        raise _uneven("rows have more columns than there are names", path)


def _uneven(message: str, path: Path) -> ContentError:
    remedy = "correct 'skip' (lines before the header), 'delimiter', 'decimal' or 'columns'"
    return ContentError(message, remedy=remedy, file=str(path))
