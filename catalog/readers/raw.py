"""One delivered file, one instrument: times, channels in the YAML's units, flags, and what was dropped.

Every format passes through here, so the options of `Files` and `Channel` mean the same for all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from inflight.catalog.readers import cdf, iaga2002, mat, netcdf, npz, parquet, table
from inflight.catalog.readers.channels import read_channel, read_for_expression
from inflight.catalog.readers.patterns import NameSpan
from inflight.catalog.readers.source import Float, Source
from inflight.catalog.readers.times import decode_times
from inflight.errors import ContentError
from inflight.expression import Expression
from inflight.flags import Flag
from inflight.instruments import Files, Instrument
from inflight.time import TT2000_FILL, Int64

Open = Callable[[Path, Files], AbstractContextManager[Source]]
Flags = npt.NDArray[np.uint32]

FORMATS: dict[str, Open] = {
    "cdf": cdf.open_source,
    "netcdf": netcdf.open_source,
    "iaga2002": iaga2002.open_source,
    "table": table.open_source,
    "parquet": parquet.open_source,
    "npz": npz.open_source,
    "mat": mat.open_source,
}


@dataclass(frozen=True, kw_only=True)
class RawTable:
    """Rows of one instrument in one file, in the order of the file.

    `times` (row,) int64 TT2000; `channels` name -> (row,) or (row, axis) in the YAML's unit, NaN where
    missing; `flag` (row,) uint32 of `inflight.flags.Flag`; `rows` (row,) each row's number in the file
    from 1; `dropped` reason -> number of rows; `notes` sentences for the report.
    """

    file: str
    times: Int64
    channels: dict[str, Float]
    flag: Flags
    rows: Int64
    dropped: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def take(self, where: npt.NDArray[np.bool_] | Int64) -> RawTable:
        """Return the rows chosen by a mask or by indices."""
        return replace(
            self,
            times=self.times[where],
            channels={name: values[where] for name, values in self.channels.items()},
            flag=self.flag[where],
            rows=self.rows[where],
        )


def read_file(
    path: Path, files: Files, instrument: Instrument, span: NameSpan | None = None, name: str = ""
) -> RawTable:
    """Read one file of an instrument.

    Parameters
    ----------
    path : Path
        The file.
    files : Files
        How it is read, `same_as` resolved (``mission.files(name)``).
    instrument : Instrument
        Its channels and cadence.
    span : NameSpan, optional
        The span the file's name states.
    name : str
        How errors and reports call the file; its path when empty.

    Raises
    ------
    ReadError
        When the file is empty, truncated, damaged or of another format.
    ContentError
        When a variable, unit, shape or text is not as the YAML states.
    """
    span = span or NameSpan()
    with _open(path, files) as source:
        times, keep, dropped = _times(source, files, instrument, span)
        flag = np.zeros(times.shape, dtype=np.uint32)
        channels, notes = {}, []
        for channel_name, channel in instrument.channels.items():
            values, outside = read_channel(source, channel_name, channel, times.shape)
            channels[channel_name] = values
            flag |= np.where(outside, Flag.OUT_OF_RANGE, 0).astype(np.uint32)
            if outside.any():
                notes.append(f"channel '{channel_name}': {int(outside.sum())} rows out of range")
        if files.good_when is not None:
            condition = Expression(files.good_when)
            variables = {name: read_for_expression(source, name, times.shape) for name in condition.names}
            try:
                good = np.broadcast_to(condition.evaluate(variables), times.shape)
            except (ValueError, IndexError) as error:
                remedy = "correct the expression in the mission YAML"
                raise ContentError(f"'good_when' {error}", remedy=remedy, file=str(source.path)) from None
            flag |= np.where(good, 0, Flag.INSTRUMENT_FLAG).astype(np.uint32)
    rows = np.arange(1, times.size + 1)
    whole = RawTable(
        file=name or str(path),
        times=times.ravel(),
        channels=channels,
        flag=flag.ravel(),
        rows=rows,
        dropped=dropped,
        notes=tuple(notes),
    )
    return whole.take(keep) if dropped else whole


def read_times(path: Path, files: Files, instrument: Instrument, span: NameSpan | None = None) -> Int64:
    """Return only the times of the rows that `read_file` keeps, int64 TT2000 (row,)."""
    with _open(path, files) as source:
        times, keep, _ = _times(source, files, instrument, span or NameSpan())
    return np.asarray(times.ravel()[keep])


def _open(path: Path, files: Files) -> AbstractContextManager[Source]:
    if files.reader is None:
        raise ContentError("the mission YAML names no reader", remedy="add 'reader'", file=str(path))
    return FORMATS[files.reader](path, files)


def _times(
    source: Source, files: Files, instrument: Instrument, span: NameSpan
) -> tuple[Int64, npt.NDArray[np.bool_], dict[str, int]]:
    """Return times (row,) or (report, sample), which rows to keep, and why the others are dropped."""
    if files.time_start is not None:
        name, channel = next(iter(instrument.channels.items()))
        rows = len(source.read(channel.sources[0], name).values)
        times = files.time_start + np.arange(rows, dtype=np.int64) * instrument.cadence
    else:
        times = _times_of_rows(decode_times(source, files, span), source, files)
    missing = times == TT2000_FILL
    moments = times + clock_offset(times, files) + instrument.moment_ns
    times = np.where(missing, TT2000_FILL, moments)
    outside = np.zeros(times.shape, dtype=bool)
    if span.start is not None:
        outside |= times < span.start - files.spill
    if span.end is not None:
        outside |= times >= span.end + files.spill
    outside &= ~missing
    found = {"no_time": int(missing.sum()), "outside_span_of_file_name": int(outside.sum())}
    dropped = {reason: count for reason, count in found.items() if count}
    return times, ~(missing | outside).ravel(), dropped


def clock_offset(times: Int64, files: Files) -> Int64:
    """Return what `Files.clock_offset` adds to each stamp, ns: the last step that has begun."""
    offset = np.zeros(times.shape, dtype=np.int64)
    steps = [(-(2**63) if step.since is None else step.since, step.offset) for step in files.clock_offset]
    for since, added in sorted(steps):
        offset[times >= since] = added
    return offset


def _times_of_rows(times: Int64, source: Source, files: Files) -> Int64:
    """Return times of shape (row,), or (report, sample) when `files.flatten` joins them."""
    if times.ndim == 1:
        return times
    if times.ndim == 2 and files.time_column is not None and files.time_column < times.shape[1]:
        return np.asarray(times[:, files.time_column])
    if times.ndim == 2 and times.shape[1] == 1:
        return np.asarray(times[:, 0])
    if times.ndim == 2 and files.flatten:
        return times
    raise ContentError(
        f"times have shape {times.shape}, one column is expected",
        remedy="set 'flatten: true' for (report, sample), or choose one with 'time_column'",
        file=str(source.path),
    )
