"""A number of an effect, with its unit and what is known of it beforehand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats


@dataclass(frozen=True)
class Parameter:
    """A number of an effect.

    Attributes
    ----------
    unit : str
        Unit of the value.
    axes : tuple of str, optional
        Names of the components; None for a single number.
    default : float or tuple of float
        Value that does nothing, or the nominal one.
    sigma : float
        What is known beforehand: standard deviation of the prior around `default`.
    bounds : tuple of float, optional
        Physical limits.
    step : float
        Typical size, the unit of finite differences and of scaled columns.
    linear : bool
        False when the residual bends within a typical step.
    bank : tuple of float, optional
        Grid of a parameter that is searched, not solved for (a lag, a width).
    per_channel : int
        Power of the first channel that the value is per: 1 for nT per unit of the channel. A model
        may then state the whole unit (``nT/A``), whatever unit the channel comes in.
    """

    unit: str
    axes: tuple[str, ...] | None = None
    default: float | tuple[float, ...] = 0.0
    sigma: float = float("inf")
    bounds: tuple[float, float] | None = None
    step: float = 1.0
    linear: bool = True
    bank: tuple[float, ...] | None = None
    per_channel: int = 0

    @property
    def size(self) -> int:
        """Number of components."""
        return len(self.axes) if self.axes else 1

    @property
    def default_values(self) -> Floats:
        """Default as an array over the axes."""
        return np.broadcast_to(np.asarray(self.default, dtype=np.float64), (self.size,)).copy()
