"""Scalar calibration: nine parameters a block from normal equations, with what the data can determine."""

from inflight.calibration.equations import NormalEquations
from inflight.calibration.scalar import BlockFit, empty_block, fit_block, sub_blocks_for
from inflight.calibration.sensor import Reference, reference_of, split_chain, usable
from inflight.calibration.solution import Solution
from inflight.calibration.table import Interval, calibration_table, describe_directions

__all__ = [
    "BlockFit",
    "Interval",
    "NormalEquations",
    "Reference",
    "Solution",
    "calibration_table",
    "describe_directions",
    "empty_block",
    "fit_block",
    "reference_of",
    "split_chain",
    "sub_blocks_for",
    "usable",
]
