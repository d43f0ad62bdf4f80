from .analysis import (
    DiagnoseSettings,
    Revision,
    Workbench,
    check_plumbing,
    compare,
    diagnose,
)
from .archive import ingest, simulate
from .batches import Mapper, batch_mapper, few_at_once, result_of, with_progress
from .models import (
    ModelHistory,
    comparison_of,
    current_model,
    find_model,
    find_table,
    model_label,
    preflight_model,
)
from .pipelines import ReprocessSettings, reprocess
from .release import make_release, plan_release
from .report import (
    Progress,
    RunReport,
    as_settings_error,
    error_fields,
    in_plain_words,
    location_of,
    print_report,
    to_json,
)

__all__ = [
    "DiagnoseSettings",
    "Mapper",
    "ModelHistory",
    "Progress",
    "ReprocessSettings",
    "Revision",
    "RunReport",
    "Workbench",
    "as_settings_error",
    "batch_mapper",
    "check_plumbing",
    "compare",
    "comparison_of",
    "current_model",
    "diagnose",
    "error_fields",
    "few_at_once",
    "find_model",
    "find_table",
    "in_plain_words",
    "ingest",
    "location_of",
    "make_release",
    "model_label",
    "plan_release",
    "preflight_model",
    "print_report",
    "reprocess",
    "result_of",
    "simulate",
    "to_json",
    "with_progress",
]
