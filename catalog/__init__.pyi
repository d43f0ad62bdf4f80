from .catalog import Catalog
from .descriptions import DatasetDescription, VariableDescription, components
from .differences import DayChange, VariableChange, measured_changes
from .garbage import Garbage
from .lineage import LineageGraph, LineageItem, LineageLink, LineageNode
from .location import CATALOG_VARIABLE
from .moving import Move, move_catalog
from .provenance import Edge
from .records import (
    CertificationAct,
    ContextRecord,
    Day,
    DayData,
    FileRecord,
    ModelRecord,
    NamedContext,
    ReleaseRecord,
    RunRecord,
    Segment,
    SegmentRow,
    TableRecord,
    Validity,
    idempotency_key,
)
from .release import ReleaseContents, ReleasePlan
from .release_folder import MissionStatement, ReleaseFolder
from .runs import Run, failure_cause
from .segments import write_segment, write_table
from .validity import after_act, validities
from .workspace import Workspace, shipped_missions

__all__ = [
    "CATALOG_VARIABLE",
    "Catalog",
    "CertificationAct",
    "ContextRecord",
    "DatasetDescription",
    "Day",
    "DayChange",
    "DayData",
    "Edge",
    "FileRecord",
    "Garbage",
    "LineageGraph",
    "LineageItem",
    "LineageLink",
    "LineageNode",
    "MissionStatement",
    "ModelRecord",
    "Move",
    "NamedContext",
    "ReleaseContents",
    "ReleaseFolder",
    "ReleasePlan",
    "ReleaseRecord",
    "Run",
    "RunRecord",
    "Segment",
    "SegmentRow",
    "TableRecord",
    "Validity",
    "VariableChange",
    "VariableDescription",
    "Workspace",
    "after_act",
    "components",
    "failure_cause",
    "idempotency_key",
    "measured_changes",
    "move_catalog",
    "shipped_missions",
    "validities",
    "write_segment",
    "write_table",
]
