from .pipeline import RelationPipeline
from .report import relation_report

__all__ = [
    "RelationPipeline",
    "relation_report",
]
