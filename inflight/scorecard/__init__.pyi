from .figure import Basis, Figure, Report, Verdict, Within
from .registry import SECTIONS, figures, scorecard, selected
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
    "scorecard",
    "selected",
]
