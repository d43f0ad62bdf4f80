"""Scalar calibration: nine parameters a block from normal equations, with what the data can determine."""

from inflight.calibration.normal_equations import NormalEquations
from inflight.calibration.scalar import (
    BlockFit,
    Reference,
    empty_block,
    fit_block,
    reference_of,
    split_chain,
    sub_blocks_for,
    usable,
)
from inflight.calibration.table import Interval, calibration_table, describe_directions
from inflight.lsq.solver import Solution

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
