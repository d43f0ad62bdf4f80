from .day import CHAIN_VERSION, Witnesses, chain_batch
from .fit import chain_arguments, chained, save_fitted, spread_offsets
from .report import chain_report
from .sections import Part, with_error

__all__ = [
    "CHAIN_VERSION",
    "Part",
    "Witnesses",
    "chain_arguments",
    "chain_batch",
    "chain_report",
    "chained",
    "save_fitted",
    "spread_offsets",
    "with_error",
]
