from .catalog import Catalog
from .day_files import components
from .differences import DayChange, VariableChange, measured_changes
from .manifest import folder_bytes
from .provenance import Edge
from .records import (
    ContextRecord,
    Day,
    DayData,
    FileRecord,
    ModelRecord,
    RunRecord,
    Segment,
    SegmentRow,
    TableRecord,
    idempotency_key,
)
from .release import ReleaseContents, ReleasePlan
from .runs import Run, failure_cause
from .segments import write_segment, write_table
from .workspace import Workspace, shipped_missions

__all__ = [
    "Catalog",
    "ContextRecord",
    "Day",
    "DayChange",
    "DayData",
    "Edge",
    "FileRecord",
    "ModelRecord",
    "ReleaseContents",
    "ReleasePlan",
    "Run",
    "RunRecord",
    "Segment",
    "SegmentRow",
    "TableRecord",
    "VariableChange",
    "Workspace",
    "components",
    "failure_cause",
    "folder_bytes",
    "idempotency_key",
    "measured_changes",
    "shipped_missions",
    "write_segment",
    "write_table",
]
