from .columns import (
    BURST_SETTINGS,
    SENSOR_EQUATIONS,
    DesignRows,
    OutlierReport,
    bin_channel,
    bin_edges,
    bin_means,
    bridge_gaps,
    coarsen,
    design_matrix,
    sensor_matrices,
)
from .terms import Candidate, ChannelSummary, Library, Term, term_of, within_span

__all__ = [
    "BURST_SETTINGS",
    "SENSOR_EQUATIONS",
    "Candidate",
    "ChannelSummary",
    "DesignRows",
    "Library",
    "OutlierReport",
    "Term",
    "bin_channel",
    "bin_edges",
    "bin_means",
    "bridge_gaps",
    "coarsen",
    "design_matrix",
    "sensor_matrices",
    "term_of",
    "within_span",
]
