from .pipeline import MissionPipeline
from .report import chain_report

__all__ = [
    "MissionPipeline",
    "chain_report",
]
