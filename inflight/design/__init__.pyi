from .columns import (
    EQUATIONS,
    MOST,
    Outliers,
    Rows,
    bin_means,
    bridged,
    channel_on,
    coarsen,
    design,
    grid,
    turns_of,
)
from .terms import Candidate, Library, Term, Told, term_of, within_span

__all__ = [
    "EQUATIONS",
    "MOST",
    "Candidate",
    "Library",
    "Outliers",
    "Rows",
    "Term",
    "Told",
    "bin_means",
    "bridged",
    "channel_on",
    "coarsen",
    "design",
    "grid",
    "term_of",
    "turns_of",
    "within_span",
]
