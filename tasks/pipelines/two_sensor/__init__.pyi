from .pipeline import StatesPipeline
from .tables import constant_sentences, housekeeping_channels, named_units

__all__ = [
    "StatesPipeline",
    "constant_sentences",
    "housekeeping_channels",
    "named_units",
]
