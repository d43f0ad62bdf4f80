"""What every format gives: named variables of one file, with the unit and fill values it states itself."""

from __future__ import annotations

import gzip
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path
from typing import Any, TextIO, cast

import numpy as np
import numpy.typing as npt

from inflight.errors import ContentError, InflightError, ReadError, did_you_mean
from inflight.time import Int64

Array = npt.NDArray[Any]
Float = npt.NDArray[np.floating[Any]]

#: What the format libraries raise on damaged files; anything else is a defect of ours and passes through.
_DAMAGE = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    IndexError,
    TypeError,
    AttributeError,
    OverflowError,
    NotImplementedError,
    RuntimeError,
    MemoryError,
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
)


@dataclass(frozen=True)
class Variable:
    """One variable as the file holds it, rows first.

    `values` are numbers or text before any scaling; ``value = scale[0] * number + scale[1]``. `times`
    is set (TT2000, same shape) when the format itself marks the variable as a time.
    """

    values: Array
    unit: str | None = None
    fill: tuple[float, ...] = ()
    scale: tuple[float, float] = (1.0, 0.0)
    times: Int64 | None = None


@dataclass(frozen=True)
class Source:
    """An open file: the names of its variables, and how to read one."""

    path: Path
    names: tuple[str, ...]
    get: Callable[[str], Variable]
    #: Variables that are never read (``drop`` of the mission YAML).
    dropped: tuple[str, ...] = ()

    def read(self, name: str, channel: str = "") -> Variable:
        """Read one variable.

        Raises
        ------
        ContentError
            When the file does not hold it; the message lists what it holds.
        ReadError
            When it cannot be decoded.
        """
        held = [other for other in self.names if other not in self.dropped]
        if name not in held:
            why = "is listed under 'drop'" if name in self.dropped else "is not in the file"
            raise ContentError(
                f"variable {name!r} {why}, which holds {', '.join(held[:40]) or 'no variables'}"
                f"{did_you_mean(name, held)}",
                remedy="correct the variable's name in the mission YAML",
                file=str(self.path),
                channel=channel,
            )
        with read_errors(self.path, channel):
            return self.get(name)


@contextmanager
def read_errors(path: Path, channel: str = "") -> Iterator[None]:
    """Turn what a format library raises on a damaged file into a `ReadError` that names the file."""
    try:
        yield
    except InflightError:
        raise
    except UnicodeDecodeError as error:
        raise ReadError(
            f"byte {error.start + 1} is no text in the encoding {error.encoding}",
            remedy="state the file's 'encoding', such as latin-1, or correct 'reader'",
            file=str(path),
            channel=channel,
        ) from error
    except _DAMAGE as error:
        raise ReadError(
            f"cannot be read: {type(error).__name__}: {error}",
            remedy="it is damaged or of another format; fetch it again or correct 'reader'",
            file=str(path),
            channel=channel,
        ) from error


def require_content(path: Path) -> None:
    """Raise `ReadError` when a file is missing or has no bytes."""
    if not path.is_file():
        raise ReadError("is not there any more", remedy="restore the file", file=str(path))
    if path.stat().st_size == 0:
        raise ReadError("has zero length", remedy="fetch it again", file=str(path))


def require_bytes(path: Path, needed: int) -> None:
    """Raise `ReadError` when a file is shorter than its own header states."""
    size = path.stat().st_size
    if size < needed:
        raise ReadError(
            f"is truncated: {size} bytes where its header needs {needed}",
            remedy="fetch it again",
            file=str(path),
        )


def open_text(path: Path, encoding: str) -> TextIO:
    """Open a text file for reading, through gzip when its first bytes say so."""
    with path.open("rb") as stream:
        packed = stream.read(2) == b"\x1f\x8b"
    if packed:
        return TextIOWrapper(cast("Any", gzip.open(path, "rb")), encoding=encoding)
    return path.open(encoding=encoding)


def as_floats(variable: Variable) -> Float:
    """Return scaled floating-point values, NaN where the file's own fill value stands.

    A float32 or a small integer without scaling stays float32, which holds it exactly; everything else
    becomes float64.

    Raises
    ------
    ValueError
        When the values are text that is no number.
    """
    values = variable.values
    if values.dtype.kind not in "biuf":
        values = values.astype(np.float64)
    missing = is_missing(values, variable.fill)
    plain = variable.scale == (1.0, 0.0)
    small = values.dtype.kind in "bf" or values.dtype.itemsize <= 2
    target = np.float32 if plain and small and values.dtype.itemsize <= 4 else np.float64
    result: Array = np.array(values, dtype=target)
    if not plain:
        result = np.add(np.multiply(result, variable.scale[0]), variable.scale[1])
    result[missing] = np.nan
    return result


def is_missing(values: Array, fill: tuple[float, ...]) -> npt.NDArray[np.bool_]:
    """Return where numbers equal a fill value (compared in their own type) or are not finite."""
    missing = ~np.isfinite(values) if values.dtype.kind == "f" else np.zeros(values.shape, dtype=bool)
    for value in fill:
        if np.isnan(value):
            continue
        if values.dtype.kind in "iu":
            limits = np.iinfo(values.dtype)
            if not (float(value).is_integer() and limits.min <= value <= limits.max):
                continue
        with np.errstate(over="ignore"):
            missing |= values == values.dtype.type(value)
    return missing
