from .comparing import compare, measure_comparison
from .diagnosis import Examined, diagnose
from .diagnosis_page import diagnosis_sections, report, write_report
from .gram_pass import block_grams
from .kept_comparison import compare_if_unchanged
from .kept_diagnosis import (
    DiagnosisReport,
    asked_of,
    diagnose_if_unchanged,
    last_diagnosis,
    page_of_diagnosis,
    report_if_unchanged,
)
from .plumbing import check_plumbing
from .revise import Revision, Workbench, diagnose_span, open_workbench, require_change
from .settings import DiagnoseSettings, require_sampled, sampled_comparisons

__all__ = [
    "DiagnoseSettings",
    "DiagnosisReport",
    "Examined",
    "Revision",
    "Workbench",
    "asked_of",
    "block_grams",
    "check_plumbing",
    "compare",
    "compare_if_unchanged",
    "diagnose",
    "diagnose_if_unchanged",
    "diagnose_span",
    "diagnosis_sections",
    "last_diagnosis",
    "measure_comparison",
    "open_workbench",
    "page_of_diagnosis",
    "report",
    "report_if_unchanged",
    "require_change",
    "require_sampled",
    "sampled_comparisons",
    "write_report",
]
