from .comparing import compare, measured
from .diagnosis import diagnose
from .diagnosis_page import DiagnosisReport, diagnosis_sections, examine, report
from .gram_pass import DiagnoseSettings, block_evidence
from .revise import Revision, Workbench, diagnose_span, last_diagnosis, open_workbench, require_sampled

__all__ = [
    "DiagnoseSettings",
    "DiagnosisReport",
    "Revision",
    "Workbench",
    "block_evidence",
    "compare",
    "diagnose",
    "diagnose_span",
    "diagnosis_sections",
    "examine",
    "last_diagnosis",
    "measured",
    "open_workbench",
    "report",
    "require_sampled",
]
