from .pipeline import MissionPipeline
from .report import mission_fit_report

__all__ = [
    "MissionPipeline",
    "mission_fit_report",
]
