from .pipeline import ZeroLevelPipeline
from .tables import BEFORE_ZERO_LEVEL, STATES_TABLE, SUBTRACTED

__all__ = ["BEFORE_ZERO_LEVEL", "STATES_TABLE", "SUBTRACTED", "ZeroLevelPipeline"]
