from .alignment import FIELD_ROLES, PlainSamples, align
from .derived import Derived, Part, base_channels, derive, parse, product, respond
from .spin_folding import FOLDING_VERSION, ORDER, Complex, Folding, fold, fold_series

__all__ = [
    "FIELD_ROLES",
    "FOLDING_VERSION",
    "ORDER",
    "Complex",
    "Derived",
    "Folding",
    "Part",
    "PlainSamples",
    "align",
    "base_channels",
    "derive",
    "fold",
    "fold_series",
    "parse",
    "product",
    "respond",
]
