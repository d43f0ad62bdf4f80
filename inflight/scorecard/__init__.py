"""The scorecard: each published figure beside what the software obtains for it, and the verdict."""

from inflight.scorecard.figure import Basis, Figure, Report, Verdict, Within
from inflight.scorecard.registry import SECTIONS, figures, scorecard, selected
from inflight.scorecard.scene import OrbitDay, Scene

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
