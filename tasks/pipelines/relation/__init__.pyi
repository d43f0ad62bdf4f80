from .pipeline import RelationPipeline
from .report import dual_report

__all__ = [
    "RelationPipeline",
    "dual_report",
]
