from .figure import Agreement, Estimate, EvidenceKind, PublishedFigure, ScorecardResult, ToleranceInterval
from .registry import SECTIONS, figures, run_scorecard, select_figures
from .scene import OrbitDay, SimulatedDays

__all__ = [
    "SECTIONS",
    "Agreement",
    "Estimate",
    "EvidenceKind",
    "OrbitDay",
    "PublishedFigure",
    "ScorecardResult",
    "SimulatedDays",
    "ToleranceInterval",
    "figures",
    "run_scorecard",
    "select_figures",
]
