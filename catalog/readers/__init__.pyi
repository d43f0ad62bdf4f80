from .days import assemble_day, split_days
from .patterns import Delivered, NameSpan, describe, find_files, newest
from .raw import RawTable, read_file, read_times

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
