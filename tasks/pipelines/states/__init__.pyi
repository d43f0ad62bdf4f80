from .compare import DualCompareReport, compare_dual
from .day import days_to_do
from .reprocess import reprocess_states
from .tables import constant_sentences, housekeeping, named_units

__all__ = [
    "DualCompareReport",
    "compare_dual",
    "constant_sentences",
    "days_to_do",
    "housekeeping",
    "named_units",
    "reprocess_states",
]
