"""Readers: a delivered file of any supported format becomes one `RawTable`, rows of it become days."""

from inflight.catalog.readers.days import assemble_day, split_days
from inflight.catalog.readers.patterns import Delivered, NameSpan, describe, find_files, newest
from inflight.catalog.readers.raw import RawTable, read_file, read_times

__all__ = [
    "Delivered",
    "NameSpan",
    "RawTable",
    "assemble_day",
    "describe",
    "find_files",
    "newest",
    "read_file",
    "read_times",
    "split_days",
]
