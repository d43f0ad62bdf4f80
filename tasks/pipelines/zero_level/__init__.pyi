from .pipeline import ZeroLevelPipeline
from .tables import BEFORE_ZERO_LEVEL, SUBTRACTED

__all__ = ["BEFORE_ZERO_LEVEL", "SUBTRACTED", "ZeroLevelPipeline"]
