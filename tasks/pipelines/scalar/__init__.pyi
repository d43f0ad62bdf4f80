from .day import fit_day
from .pipeline import ScalarPipeline
from .product import level2_day, z_offsets_of
from .tables import load_equations

__all__ = [
    "ScalarPipeline",
    "fit_day",
    "level2_day",
    "load_equations",
    "z_offsets_of",
]
