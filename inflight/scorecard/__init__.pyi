from .figure import Basis, Figure, Report, Verdict, Within
from .registry import SECTIONS, figures, run_scorecard, select_figures
from .scene import OrbitDay, Scene

__all__ = [
    "SECTIONS",
    "Basis",
    "Figure",
    "OrbitDay",
    "Report",
    "Scene",
    "Verdict",
    "Within",
    "figures",
    "run_scorecard",
    "select_figures",
]
