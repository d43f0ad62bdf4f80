from .pipeline import SpinPipeline
from .tables import SpinResults

__all__ = [
    "SpinPipeline",
    "SpinResults",
]
