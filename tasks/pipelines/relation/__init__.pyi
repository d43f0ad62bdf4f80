from .report import dual_parts, dual_report
from .reprocess import NO_PRODUCT, reprocess_dual

__all__ = [
    "NO_PRODUCT",
    "dual_parts",
    "dual_report",
    "reprocess_dual",
]
