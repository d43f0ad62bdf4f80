from .combination import Combined, combined
from .estimate import Question
from .flipper import PARTS, Flipped, separate
from .intervals import AXES, Intervals
from .methods import (
    ALFVENIC,
    COMPRESSIONAL,
    DAVIS_SMITH,
    MINIMUM_CORRELATION,
    MIRROR_MODE,
    WANG_PAN,
    Kinds,
    correlation,
    davis_smith,
    minimum_correlation,
    pairs_within,
)
from .published import PUBLISHED, SET, Scatter, Sets, averages, largest_leak

__all__ = [
    "ALFVENIC",
    "AXES",
    "COMPRESSIONAL",
    "DAVIS_SMITH",
    "MINIMUM_CORRELATION",
    "MIRROR_MODE",
    "PARTS",
    "PUBLISHED",
    "SET",
    "WANG_PAN",
    "Combined",
    "Flipped",
    "Intervals",
    "Kinds",
    "Question",
    "Scatter",
    "Sets",
    "averages",
    "combined",
    "correlation",
    "davis_smith",
    "largest_leak",
    "minimum_correlation",
    "pairs_within",
    "separate",
]
