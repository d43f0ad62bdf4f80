"""CDF files (ISTP and INTERMAGNET) through cdflib: z and r variables, EPOCH, EPOCH16 and TT2000."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from inflight.catalog.readers.source import (
    Array,
    Source,
    Variable,
    read_errors,
    require_bytes,
    require_content,
)
from inflight.catalog.readers.times import from_tt2000
from inflight.errors import ContentError, ReadError
from inflight.instruments import Files
from inflight.time import TT2000_FILL, Int64, to_tt2000

#: Milliseconds from 0000-01-01, where CDF_EPOCH begins, to 1970-01-01 (proleptic Gregorian calendar).
_EPOCH_TO_1970_MS = 62_167_219_200_000
_EPOCH_TO_1970_S = 62_167_219_200
_MAGIC = {0xCDF30001: 8, 0xCDF26002: 4}
_PLAIN, _PACKED = 0x0000FFFF, 0xCCCC0001
#: Bytes; every variable and every attribute has a record of at least this size.
_SMALLEST_RECORD = 50


@contextmanager
def open_source(path: Path, files: Files) -> Iterator[Source]:
    """Open a CDF file; see `Source`."""
    import cdflib

    require_content(path)
    _require_whole(path)
    with read_errors(path):
        cdf = cdflib.CDF(path)
        info = cdf.cdf_info()
    names = (*info.zVariables, *info.rVariables)
    yield Source(path, names, lambda name: _read(cdf, name, path), tuple(files.drop))


def _require_whole(path: Path) -> None:
    """Compare the file's length with what its own records state (CDF internal format, CDR, GDR, CCR, CPR).

    cdflib reads a truncated file without an error, and follows a damaged count of variables for hours.
    """
    with path.open("rb") as stream:
        head = stream.read(28)
        if len(head) < 28:
            raise ReadError("is truncated within its header", remedy="fetch it again", file=str(path))
        magic, kind = struct.unpack(">II", head[:8])
        wide = _MAGIC.get(magic)
        if wide is None or kind not in (_PLAIN, _PACKED):
            raise ReadError(
                f"is no CDF file of version 2.6 or later (it begins with {head[:8].hex()})",
                remedy="fetch it again or correct 'reader'",
                file=str(path),
            )
        offset = "q" if wide == 8 else "i"
        # Both CDR and CCR: record size, record type, offset of the next record (GDR or CPR).
        (record,) = struct.unpack_from(f">{offset}", head, 8 + wide + 4)
        if kind == _PACKED:
            # The CPR stands last and begins with its size.
            (length,) = _unpack(path, stream, record, f">{offset}")
            require_bytes(path, record + length)
            return
        # The GDR: heads of three lists, then the end of file, then counts.
        place = record + wide + 4 + 3 * wide
        end, rvars, attributes, _, _, zvars = _unpack(path, stream, place, f">{offset}iiiii")
    require_bytes(path, end)
    counts = (rvars, attributes, zvars)
    if min(counts) < 0 or sum(counts) * _SMALLEST_RECORD > end:
        raise ReadError(
            f"is damaged: its header counts {rvars} and {zvars} variables and {attributes} attributes in "
            f"{end} bytes",
            remedy="fetch it again",
            file=str(path),
        )


def _unpack(path: Path, stream: BinaryIO, place: int, layout: str) -> tuple[Any, ...]:
    require_bytes(path, place + struct.calcsize(layout))
    stream.seek(max(place, 0))
    return struct.unpack(layout, stream.read(struct.calcsize(layout)))


def _read(cdf: Any, name: str, path: Path) -> Variable:
    inquiry = cdf.varinq(name)
    attributes = cdf.varattsget(name)
    if inquiry.Last_Rec < 0:
        raise ContentError(
            f"variable {name!r} holds no records",
            remedy="the file is empty of data; remove it or fetch it again",
            file=str(path),
        )
    values = np.asarray(cdf.varget(name))
    if values.ndim == 0 or not inquiry.Rec_Vary:
        values = values[None]
    decode = _TIMES.get(inquiry.Data_Type_Description)
    unit = attributes.get("UNITS")
    fill = np.asarray(attributes.get("FILLVAL", ())).ravel()[:1]
    numeric = values.dtype.kind in "iuf" and fill.dtype.kind in "iuf"
    return Variable(
        values,
        unit=str(unit).strip() or None if unit is not None else None,
        fill=tuple(map(float, fill)) if numeric else (),
        times=decode(values) if decode else None,
    )


def from_epoch(milliseconds: Array) -> Int64:
    """Convert CDF_EPOCH (float ms since 0000-01-01, no leap seconds) to TT2000; fill gives `TT2000_FILL`."""
    missing = ~np.isfinite(milliseconds) | (milliseconds <= 0)
    whole = np.floor(np.where(missing, _EPOCH_TO_1970_MS, milliseconds))
    part = np.rint((np.where(missing, whole, milliseconds) - whole) * 1e6).astype(np.int64)
    label = (whole.astype(np.int64) - _EPOCH_TO_1970_MS) * 1_000_000 + part
    return np.where(missing, TT2000_FILL, to_tt2000(label.astype("datetime64[ns]")))


def from_epoch16(pairs: Array) -> Int64:
    """Convert CDF_EPOCH16 (seconds since 0000-01-01 and picoseconds) to TT2000, picoseconds rounded.

    Parameters
    ----------
    pairs : ndarray
        complex (row,) or float (row, 2).
    """
    seconds, picoseconds = (
        (pairs.real, pairs.imag) if np.iscomplexobj(pairs) else (pairs[..., 0], pairs[..., 1])
    )
    missing = ~np.isfinite(seconds) | (seconds <= 0)
    whole = np.where(missing, _EPOCH_TO_1970_S, seconds).astype(np.int64) - _EPOCH_TO_1970_S
    part = np.rint(np.where(missing, 0, picoseconds) / 1000).astype(np.int64)
    return np.where(missing, TT2000_FILL, to_tt2000((whole * 1_000_000_000 + part).astype("datetime64[ns]")))


#: Types of a CDF that are times, and how they become TT2000.
_TIMES: dict[str, Callable[[Array], Int64]] = {
    "CDF_TIME_TT2000": from_tt2000,
    "CDF_EPOCH": from_epoch,
    "CDF_EPOCH16": from_epoch16,
}
