from .catalog import Catalog
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
from .release import ReleasePlan
from .runs import Run, failure_cause
from .segments import write_segment, write_table
from .workspace import Workspace, shipped_missions

__all__ = [
    "Catalog",
    "ContextRecord",
    "Day",
    "DayData",
    "Edge",
    "FileRecord",
    "ModelRecord",
    "ReleasePlan",
    "Run",
    "RunRecord",
    "Segment",
    "SegmentRow",
    "TableRecord",
    "Workspace",
    "failure_cause",
    "idempotency_key",
    "shipped_missions",
    "write_segment",
    "write_table",
]
