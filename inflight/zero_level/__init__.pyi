from .combination import CombinedEstimate, combine_methods
from .estimate import Estimate, OffsetSearch
from .flipper import PARTS, FlipperSolution, separate_flipped
from .intervals import AXES, Bools, Intervals
from .methods import (
    COMBINED_METHODS,
    KIND_SETTINGS,
    METHODS,
    MINIMUM_CORRELATION,
    Estimator,
    IntervalKinds,
    davis_smith,
    minimum_correlation,
    pairs_within,
    size_angle_covariance,
    zero_of_minimum_correlation,
)

__all__ = [
    "AXES",
    "COMBINED_METHODS",
    "KIND_SETTINGS",
    "METHODS",
    "MINIMUM_CORRELATION",
    "PARTS",
    "Bools",
    "CombinedEstimate",
    "Estimate",
    "Estimator",
    "FlipperSolution",
    "IntervalKinds",
    "Intervals",
    "OffsetSearch",
    "combine_methods",
    "davis_smith",
    "minimum_correlation",
    "pairs_within",
    "separate_flipped",
    "size_angle_covariance",
    "zero_of_minimum_correlation",
]
