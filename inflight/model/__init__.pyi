from .apply import ModelEffect, corrected
from .diff import changes, tree_of
from .model import Model, make_effect
from .rows import Band, Layout, ResidualRows, RowFilter, filter_rows, folding_of, rows_of, turn_residual
from .substitution import Substituted, Treated, Typical, missing_rows, substitute
from .time_dependence import Dependence, TimedValue, component_names

__all__ = [
    "Band",
    "Dependence",
    "Layout",
    "Model",
    "ModelEffect",
    "ResidualRows",
    "RowFilter",
    "Substituted",
    "TimedValue",
    "Treated",
    "Typical",
    "changes",
    "component_names",
    "corrected",
    "filter_rows",
    "folding_of",
    "make_effect",
    "missing_rows",
    "rows_of",
    "substitute",
    "tree_of",
    "turn_residual",
]
