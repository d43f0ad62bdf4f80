from .compare import SpinCompareReport, compare_spin
from .report import spin_report, spin_table_parts
from .reprocess import solve_spin, spin_batch, spin_product
from .tables import TABLES, SpinResults

__all__ = [
    "TABLES",
    "SpinCompareReport",
    "SpinResults",
    "compare_spin",
    "solve_spin",
    "spin_batch",
    "spin_product",
    "spin_report",
    "spin_table_parts",
]
