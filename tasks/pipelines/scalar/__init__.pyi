from .day import fit_day
from .pipeline import ScalarPipeline
from .product import level2_day
from .tables import load_equations

__all__ = [
    "ScalarPipeline",
    "fit_day",
    "level2_day",
    "load_equations",
]
