from .analysis import (
    DiagnoseSettings,
    Revision,
    Workbench,
    check_plumbing,
    compare,
    diagnose,
)
from .archive import ingest, simulate
from .batches import Mapper, batch_mapper, expect_work, few_at_once, result_of
from .coverage import COVERAGE, CoverageDay, comparison_of_product, coverage_days
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
from .release_documents import panels_of_day
from .report import (
    RunReport,
    as_settings_error,
    error_fields,
    in_plain_words,
    location_of,
    print_report,
    problem,
    problem_of,
    to_json,
)
from .run_progress import RunProgress, failure_lines, run_log, runs_progress

__all__ = [
    "COVERAGE",
    "CoverageDay",
    "DiagnoseSettings",
    "Mapper",
    "ModelHistory",
    "ReprocessSettings",
    "Revision",
    "RunProgress",
    "RunReport",
    "Workbench",
    "as_settings_error",
    "batch_mapper",
    "check_plumbing",
    "compare",
    "comparison_of",
    "comparison_of_product",
    "coverage_days",
    "current_model",
    "diagnose",
    "error_fields",
    "expect_work",
    "failure_lines",
    "few_at_once",
    "find_model",
    "find_table",
    "in_plain_words",
    "ingest",
    "location_of",
    "make_release",
    "model_label",
    "panels_of_day",
    "plan_release",
    "preflight_model",
    "print_report",
    "problem",
    "problem_of",
    "reprocess",
    "result_of",
    "run_log",
    "runs_progress",
    "simulate",
    "to_json",
]
