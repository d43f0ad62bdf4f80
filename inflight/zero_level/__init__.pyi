from .combination import CombinedEstimate, combine_methods
from .estimate import Question
from .flipper import PARTS, Flipped, separate_flipped
from .intervals import AXES, Intervals
from .methods import (
    ALFVENIC,
    COMPRESSIONAL,
    DAVIS_SMITH,
    MINIMUM_CORRELATION,
    MIRROR_MODE,
    WANG_PAN,
    IntervalKinds,
    davis_smith,
    minimum_correlation,
    pairs_within,
    size_angle_covariance,
)
from .published import PUBLISHED, SET, OffsetSets, ScatterWithHours, average_spans, largest_leak

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
    "CombinedEstimate",
    "Flipped",
    "IntervalKinds",
    "Intervals",
    "OffsetSets",
    "Question",
    "ScatterWithHours",
    "average_spans",
    "combine_methods",
    "davis_smith",
    "largest_leak",
    "minimum_correlation",
    "pairs_within",
    "separate_flipped",
    "size_angle_covariance",
]
