from .assumptions import Assumption, check_assumptions
from .averaging import (
    AveragingRule,
    AveragingWarning,
    average_spans,
    check_averaging,
    delivered_rule,
    remaining_part,
    whole_average,
)
from .combination import CombinedEstimate, combine_methods, independent_covariance
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
    classify_intervals,
    compression,
    davis_smith,
    minimum_correlation,
    pairs_within,
    size_angle_covariance,
    zero_of_minimum_correlation,
)
from .sets import SET, OffsetSets, correlation_sets

__all__ = [
    "AXES",
    "COMBINED_METHODS",
    "KIND_SETTINGS",
    "METHODS",
    "MINIMUM_CORRELATION",
    "PARTS",
    "SET",
    "Assumption",
    "AveragingRule",
    "AveragingWarning",
    "Bools",
    "CombinedEstimate",
    "Estimate",
    "Estimator",
    "FlipperSolution",
    "IntervalKinds",
    "Intervals",
    "OffsetSearch",
    "OffsetSets",
    "average_spans",
    "check_assumptions",
    "check_averaging",
    "classify_intervals",
    "combine_methods",
    "compression",
    "correlation_sets",
    "davis_smith",
    "delivered_rule",
    "independent_covariance",
    "minimum_correlation",
    "pairs_within",
    "remaining_part",
    "separate_flipped",
    "size_angle_covariance",
    "whole_average",
    "zero_of_minimum_correlation",
]
