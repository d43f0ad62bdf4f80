"""Storage: the mission archive, calibration tables, level-2 products and releases of one workspace."""

from inflight.catalog.catalog import Catalog
from inflight.catalog.lineage import Edge
from inflight.catalog.records import (
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
from inflight.catalog.runs import Run
from inflight.catalog.segments import write_segment, write_table

__all__ = [
    "Catalog",
    "ContextRecord",
    "Day",
    "DayData",
    "Edge",
    "FileRecord",
    "ModelRecord",
    "Run",
    "RunRecord",
    "Segment",
    "SegmentRow",
    "TableRecord",
    "idempotency_key",
    "write_segment",
    "write_table",
]
