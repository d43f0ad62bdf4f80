from .columns import (
    BURSTS,
    EQUATIONS,
    Outliers,
    Rows,
    bin_channel,
    bin_means,
    bridge_gaps,
    coarsen,
    design,
    grid,
    sensor_matrices,
)
from .terms import Candidate, ChannelSummary, Library, Term, term_of, within_span

__all__ = [
    "BURSTS",
    "EQUATIONS",
    "Candidate",
    "ChannelSummary",
    "Library",
    "Outliers",
    "Rows",
    "Term",
    "bin_channel",
    "bin_means",
    "bridge_gaps",
    "coarsen",
    "design",
    "grid",
    "sensor_matrices",
    "term_of",
    "within_span",
]
