"""The chain of a whole mission: a day's statistics, and what all days together say."""

from inflight.chain.continuous import Continuous, continuous_model, continuous_table, fit_mission
from inflight.chain.wide import (
    BIN_S,
    empty_equations,
    terms_of,
    wide_and_beside,
    wide_equations,
    with_nine,
)
from inflight.chain.within import DayDrift, rates

__all__ = [
    "BIN_S",
    "Continuous",
    "DayDrift",
    "continuous_model",
    "continuous_table",
    "empty_equations",
    "fit_mission",
    "rates",
    "terms_of",
    "wide_and_beside",
    "wide_equations",
    "with_nine",
]
