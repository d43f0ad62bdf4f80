from .conformance import Example, Written, check_reader
from .days import assemble_day, split_days
from .patterns import Delivered, NameSpan, describe, find_files, newest
from .raw import RawTable, read_file, read_times
from .source import Source, Variable, reading, require_bytes, require_content

__all__ = [
    "Delivered",
    "Example",
    "NameSpan",
    "RawTable",
    "Source",
    "Variable",
    "Written",
    "assemble_day",
    "check_reader",
    "describe",
    "find_files",
    "newest",
    "read_file",
    "read_times",
    "reading",
    "require_bytes",
    "require_content",
    "split_days",
]
