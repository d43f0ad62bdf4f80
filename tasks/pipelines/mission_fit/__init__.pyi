from .fit import trend_of_products
from .pipeline import MissionPipeline
from .report import mission_fit_report

__all__ = [
    "MissionPipeline",
    "mission_fit_report",
    "trend_of_products",
]
