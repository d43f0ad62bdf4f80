from .conformance import Example, ReadOptions, check_reader
from .day_assembly import assemble_day, split_days
from .patterns import (
    Delivered,
    NameSpan,
    find_files,
    folder_of_delivery,
    nearest_names,
    newest_versions,
    parse_name,
    pattern_for,
)
from .raw import RawTable, read_file, read_times
from .source import Source, Variable, read_errors, require_bytes, require_content

__all__ = [
    "Delivered",
    "Example",
    "NameSpan",
    "RawTable",
    "ReadOptions",
    "Source",
    "Variable",
    "assemble_day",
    "check_reader",
    "find_files",
    "folder_of_delivery",
    "nearest_names",
    "newest_versions",
    "parse_name",
    "pattern_for",
    "read_errors",
    "read_file",
    "read_times",
    "require_bytes",
    "require_content",
    "split_days",
]
