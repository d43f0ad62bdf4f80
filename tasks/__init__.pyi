from .analysis import (
    DiagnoseSettings,
    Revision,
    Workbench,
    compare,
    diagnose,
    diagnose_span,
    open_workbench,
)
from .archive import ingest, simulate, simulate_dual, simulate_spinning
from .batches import Mapper, batch_mapper, counted, each_result, result_of
from .models import Versions, comparison_of, current_model, find_model, preflight_model
from .pipelines import ReprocessSettings, reprocess
from .release import make_release
from .report import (
    Progress,
    RunReport,
    as_settings_error,
    place_of,
    print_report,
    to_json,
    told_error,
    write_page,
)

__all__ = [
    "DiagnoseSettings",
    "Mapper",
    "Progress",
    "ReprocessSettings",
    "Revision",
    "RunReport",
    "Versions",
    "Workbench",
    "as_settings_error",
    "batch_mapper",
    "compare",
    "comparison_of",
    "counted",
    "current_model",
    "diagnose",
    "diagnose_span",
    "each_result",
    "find_model",
    "ingest",
    "make_release",
    "open_workbench",
    "place_of",
    "preflight_model",
    "print_report",
    "reprocess",
    "result_of",
    "simulate",
    "simulate_dual",
    "simulate_spinning",
    "to_json",
    "told_error",
    "write_page",
]
